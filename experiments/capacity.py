"""How many bits a pack holds, against N and gamma0, and alphabets of waveforms beside words.

python experiments/capacity.py [-o capacity] [--packs tetra-325-a,...] [--large tetra-1024-a,tetra-3267-a]

For each pack and gamma0 these are simulated: six signals on the pack, and again on the same pack after one experiment
(the difference is a noise); a kernel of 31 bumps; and on --simulated packs all words of 8 bits and an alphabet of 63
waveforms. The rest follows from the kernel. Simulations are kept, and studies in capacity.csv are not repeated, so that
a killed script goes on; it takes some 2.5e10 grain-steps in all. The table is drawn to capacity.png.
"""

import argparse
import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import jax
import numpy as np
from console import in_one_line, say
from packs import FIVE, called, over_packs
from rows import done, note

import gmem_jax as gm
from gmem_jax.design.by_kernel import KERNEL_BUMP_WIDTH, KERNEL_BUMPS
from gmem_jax.design.kernel import bumps
from gmem_jax.experiment.cost import LARGEST_BATCH
from gmem_jax.experiment.record import key_of_run
from gmem_jax.files.checkpoints import Checkpoints
from gmem_jax.physics.material import Material
from gmem_jax.reading.capacity import candidates, channels, decoded_bits, greedy_alphabet, smallest_distance
from gmem_jax.show.render_matplotlib import pyplot, save_picture

ROUND_OFF = 1e-9  # relative change of p_sig with another order of grains, skin or instruction set (docs/trust.md)
TIME_STEP = 2e-3  # relative change of p_sig with a time step four times shorter (docs/trust.md)
FIXED = (1.0, 5.0)  # Pa
PASCAL = float(Material().modulus)
SHORT = 8  # bits of the words that are simulated; relative noises refer to their recall
LONGER = {10: 2, 12: 1}  # bits of words that are only predicted, and number of draws of noise
USUAL = 1e-3  # gamma0 of the large packs, of longer words and of alphabets
SIZES = tuple(2**bits for bits in range(3, 11))
TRIED = 20000  # candidates for an alphabet
COLUMNS = ("pack", "N", "gamma0", "study", "quantity", "S", "noise", "sd_Pa", "value", "error")

Row = dict[str, str]
Found = dict[str, str | int | float]
Noises = dict[str, float]


class Case:
    """A pack at one gamma0; its simulations are kept in a folder."""

    def __init__(self, name: str, gamma0: float, t0: float, folder: Path) -> None:
        self.name, self.gamma0 = name, gamma0
        self.experiment = gm.Experiment(gm.load_pack(name), gm.six_signals(), gamma0=gamma0, t0=t0)
        self.parts = Checkpoints(folder / f"{name}-{gamma0:g}.parts", key_of_run(self.experiment))

    def repeated(self) -> np.ndarray:
        """Recalls of the six signals, on the pack and on the same pack after an experiment without signal, [2, 6, 256].

        The second pack has its grains where they came to rest; springs of friction begin anew, as in any pack.
        """

        def play(_: object) -> np.ndarray:
            first = gm.run(self.experiment, frames=2, frames_of=0, progress=say)
            assert first.frames is not None
            position, quaternion = first.frames.position[-1], first.frames.quaternion[-1]
            older = gm.pack_from(self.experiment.pack, position=position, quaternion=quaternion)
            again = gm.run(gm.replace(self.experiment, pack=older), progress=say)
            return np.stack([first.p_sig, again.p_sig])

        return np.asarray(self.parts("repeated", play))

    def kernel(self) -> gm.MemoryKernel:
        """The memory kernel on narrow bumps."""
        return gm.memory_kernel(self.experiment, KERNEL_BUMPS, KERNEL_BUMP_WIDTH, cache=self.parts, progress=say)

    def recalled(self, name: str, signals: gm.Signals) -> np.ndarray:
        """Recalls of any signals, [S, 256], a batch at a time."""
        wanted = gm.replace(self.experiment, signals=signals)
        return np.asarray(gm.run(wanted, batch=LARGEST_BATCH, cache=self.parts.scoped(name), progress=say).p_sig)


class Table:
    """The rows of the table in a file. A study of a case is done once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[Row] = done(path)

    def note(self, case: Case, study: str, found: Iterable[Found]) -> None:
        """Add the rows of a study, unless it is done already."""
        key = {"pack": case.name, "gamma0": f"{case.gamma0:g}", "study": study}
        if self.pick(**key):
            return
        key |= {"N": str(case.experiment.pack.grains)}
        rows = [key | {name: _text(value) for name, value in each.items()} for each in found]
        note(self.path, COLUMNS, rows)
        self.rows += [dict.fromkeys(COLUMNS, "") | row for row in rows]
        for row in rows:
            print(*(row[name] for name in COLUMNS if name in row), flush=True)

    def pick(self, **wanted: str) -> list[Row]:
        """Rows with these values."""
        return [row for row in self.rows if all(row[name] == value for name, value in wanted.items())]


def _text(value: str | int | float) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def relative(change: np.ndarray, signals: np.ndarray) -> float:
    """|change| / |signals|."""
    return float(np.linalg.norm(change) / np.linalg.norm(signals))


def noise(name: str, part_of_signal: float) -> Iterator[Found]:
    """A measured noise."""
    yield {"quantity": "noise over signal", "noise": name, "value": part_of_signal}


def carried(kernel: gm.MemoryKernel, deviations: Noises) -> Iterator[Found]:
    """Rows of the upper bound of the bits at each noise."""
    for name, sd in deviations.items():
        bits = channels(kernel, sd)
        own: Found = {"noise": name, "sd_Pa": sd * PASCAL}
        yield {"quantity": "bits", "value": float(bits.sum()), **own}
        yield {"quantity": "channels in use", "value": int(np.sum(bits > 0.0)), **own}


def decoded(signals: np.ndarray, deviations: Noises, draws: int = 4) -> Iterator[Found]:
    """Rows of the lower bound of the bits at each noise."""
    for name, sd in deviations.items():
        bits, error = decoded_bits(signals, sd, draws=draws)
        own: Found = {"S": len(signals), "noise": name, "sd_Pa": sd * PASCAL}
        yield {"quantity": "bits", "value": bits, "error": error, **own}


def checked(predicted: np.ndarray, simulated: np.ndarray) -> Iterator[Found]:
    """Distance of the two nearest simulated recalls, error of predictions, and accuracy of these as templates."""
    yield {"quantity": "nearest two (Pa)", "S": len(simulated), "value": smallest_distance(simulated) * PASCAL}
    yield {"quantity": "error of prediction", "value": relative(predicted - simulated, simulated)}
    away = np.linalg.norm(simulated[:, None] - predicted[None], axis=2)
    right = float(np.mean(away.argmin(axis=1) == np.arange(len(away))))
    yield {"quantity": "read by nearest prediction", "S": len(simulated), "value": right}


def distances(kernel: gm.MemoryKernel, alphabet: np.ndarray) -> Iterator[Found]:
    """Smallest distances among the first recalls of an alphabet, and among those of as many words, as predicted."""
    for size in SIZES:
        words = kernel.predict(gm.words(size.bit_length() - 1))
        yield {"quantity": "nearest two (Pa)", "S": size, "value": float(alphabet[size - 1]) * PASCAL}
        yield {"quantity": "nearest two words (Pa)", "S": size, "value": smallest_distance(words) * PASCAL}


def deviations(kernel: gm.MemoryKernel, noises: Noises) -> Noises:
    """Standard deviations in E of noises that are given as parts of the words' recall; and those of fixed noises."""
    rms = math.sqrt(np.mean(kernel.predict(gm.words(SHORT)) ** 2))
    fixed = {f"{pascals:g} Pa": pascals / PASCAL for pascals in FIXED}
    return {name: share * rms for name, share in noises.items()} | fixed


def alphabet_of(kernel: gm.MemoryKernel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The largest alphabet: amplitudes [S, n], their predicted recalls [S, 256], and the smallest distances [S]."""
    amplitudes = candidates(kernel, TRIED)
    recalls = kernel.recalled(amplitudes)
    chosen, distance = greedy_alphabet(recalls, max(SIZES))
    return amplitudes[chosen], recalls[chosen], distance


def predict(table: Table, case: Case, noises: Noises, *, close: bool) -> None:
    """The studies that follow from the kernel in a moment; if `close`, alphabets too."""
    kernel = case.kernel()
    sd = deviations(kernel, noises)
    table.note(case, "channels", carried(kernel, sd))
    table.note(case, f"words {SHORT} predicted", decoded(kernel.predict(gm.words(SHORT)), sd))
    if close:
        table.note(case, "alphabets", distances(kernel, alphabet_of(kernel)[2]))


def check(table: Table, case: Case, noises: Noises) -> None:
    """The studies that need simulations of words and of an alphabet."""
    kernel, words = case.kernel(), gm.words(SHORT)
    found = case.recalled(f"words-{SHORT}", words)
    table.note(case, f"words {SHORT} simulated", decoded(found, deviations(kernel, noises)))
    table.note(case, f"words {SHORT} checked", checked(kernel.predict(words), found))
    if case.gamma0 == USUAL:
        amplitudes, recalls, _ = alphabet_of(kernel)
        found = case.recalled("alphabet", bumps(amplitudes[:LARGEST_BATCH], KERNEL_BUMP_WIDTH))
        table.note(case, "alphabet checked", checked(recalls[:LARGEST_BATCH], found))


def lengthen(table: Table, case: Case, noises: Noises) -> None:
    """The studies of longer words, predicted by the kernel; they take minutes of fitting."""
    kernel = case.kernel()
    for bits, draws in LONGER.items():
        predicted = kernel.predict(gm.words(bits))
        table.note(case, f"words {bits} predicted", decoded(predicted, deviations(kernel, noises), draws))


STYLES = {
    "channels": ("^--", "channels: at most, were it linear"),
    f"words {SHORT} predicted": ("o-", f"decoded, words of {SHORT} bits, predicted"),
    f"words {SHORT} simulated": ("x", f"decoded, words of {SHORT} bits, simulated"),
    "words 12 predicted": ("s", "decoded, words of 12 bits, predicted"),
}


def draw(table: Table, path: Path) -> None:
    """Draw the bounds against N and against gamma0, and distances against the size of an alphabet."""
    figure, axes = pyplot().subplots(1, 3, figsize=(15, 4.8))
    usual, small = f"{USUAL:g}", min((row["N"] for row in table.rows), key=int)
    names = list(dict.fromkeys(row["noise"] for row in table.pick(study="channels")))
    for axis, by, kept in ((axes[0], "N", {"gamma0": usual}), (axes[1], "gamma0", {"N": small})):
        for colour, name in enumerate(names):
            for study, (style, _) in STYLES.items():
                rows = table.pick(study=study, quantity="bits", noise=name, **kept)
                if rows:
                    axis.errorbar(
                        *over_packs(rows, by, "value"), fmt=style, color=f"C{colour}", capsize=2, mfc="none", ms=5
                    )
        axis.set(xscale="log", yscale="log", xlabel={"N": "N", "gamma0": r"$\gamma_0$"}[by], ylabel="bits")
        axis.set_ylim(1.0, 5e4)  # room for the legends
        places = sorted({float(row[by]) for row in table.pick(study="channels", **kept)})
        axis.set_xticks(places, [f"{place:g}" for place in places])
        axis.set_xticks([], minor=True)
    for colour, name in enumerate(names):
        axes[0].plot([], [], color=f"C{colour}", label=name)
    for style, label in STYLES.values():
        axes[1].plot([], [], style, color="0.4", mfc="none", label=label)
    axes[0].set_title(rf"$\gamma_0$ = {usual}", fontsize=9)
    axes[1].set_title(f"N = {small}, mean and SD over packs", fontsize=9)
    axes[0].legend(title="noise", loc="upper left", ncols=2, fontsize=7, title_fontsize=7, frameon=False)
    axes[1].legend(loc="upper left", fontsize=7, frameon=False)
    for colour, pack in enumerate(dict.fromkeys(row["pack"] for row in table.pick(study="alphabets"))):
        for kind, style, label in (("nearest two", "o-", "greedy"), ("nearest two words", "s--", "words")):
            rows = table.pick(study="alphabets", quantity=f"{kind} (Pa)", pack=pack)
            axes[2].plot(*points(rows), style, color=f"C{colour}", ms=4, mfc="none", label=f"{pack}, {label}")
        for study, marker in (("alphabet checked", "o"), (f"words {SHORT} checked", "s")):
            axes[2].plot(*points(table.pick(study=study, quantity="nearest two (Pa)", pack=pack, gamma0=usual)),
                         marker, color=f"C{colour}", ms=6)  # fmt: skip
    axes[2].set(xscale="log", yscale="log", xlabel="waveforms S", ylabel="nearest two recalls apart (Pa, rms)")
    axes[2].set_ylim(top=3.0 * axes[2].get_ylim()[1])  # room for the legend
    axes[2].set_title("predicted; full: simulated", fontsize=9)
    axes[2].legend(fontsize=7, frameon=False)
    save_picture(path, figure)


def points(rows: list[Row]) -> tuple[list[int], list[float]]:
    """Sizes and values of rows."""
    return [int(row["S"]) for row in rows], [float(row["value"]) for row in rows]


def main() -> None:
    """Do the noise between packs first, then each case, and the longest studies last."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("capacity"), help="folder to write to")
    parser.add_argument("--packs", type=called, default=FIVE, help="two or more of one size")
    parser.add_argument(
        "--large", type=called, default="tetra-1024-a,tetra-3267-a", help=f"packs at gamma0 = {USUAL:g} only"
    )
    parser.add_argument(
        "--simulated", type=called, default="tetra-325-a", help="packs whose words of 8 bits are simulated"
    )
    parser.add_argument("--gammas", default="1e-3,3e-4,3e-3")
    parser.add_argument("--t0", type=float, default=1.8e3)
    arguments = parser.parse_args()
    if len(arguments.packs) < 2:
        parser.error(f"--packs: two or more of one size, got {len(arguments.packs)}")
    arguments.output.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)
    table = Table(arguments.output / "capacity.csv")
    small, large, simulated = arguments.packs, arguments.large, arguments.simulated

    try:
        usual = [Case(name, USUAL, arguments.t0, arguments.output) for name in small]
    except gm.FileFormatError:
        parser.error(f"{arguments.output} holds parts of other experiments; name another folder with -o")
    recalls = np.stack([case.repeated()[0] for case in usual])  # packs, signals, bins
    between = math.sqrt(recalls.var(axis=0, ddof=1).mean() / np.mean(recalls**2))
    if (noted := table.pick(study="between packs")) and noted[0]["value"] != _text(between):
        parser.error(f"--packs: {table.path} is of other packs; name another folder with -o")
    table.note(usual[0], "between packs", noise("other pack", between))
    known: list[tuple[Case, Noises]] = []
    for gamma0 in map(float, arguments.gammas.split(",")):
        for name in small + (large if gamma0 == USUAL else []):
            case = Case(name, gamma0, arguments.t0, arguments.output)
            now, later = case.repeated()
            older = relative(later - now, now)
            table.note(case, "repeated", noise("older pack", older))
            noises = {"round-off": ROUND_OFF, "time step": TIME_STEP, "older pack": older, "other pack": between}
            known.append((case, noises))
            predict(table, case, noises, close=gamma0 == USUAL and name in large + simulated)
            draw(table, arguments.output / "capacity.png")
    for case, noises in known:
        if case.name in simulated:
            check(table, case, noises)
        if case.gamma0 == USUAL and case.name in large + simulated:
            lengthen(table, case, noises)
        draw(table, arguments.output / "capacity.png")


if __name__ == "__main__":
    in_one_line(main)
