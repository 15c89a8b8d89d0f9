"""The shelf of protocols, run: what each shows, on packs of two sizes.

python experiments/protocols.py [-o protocols] [--packs tetra-325-a,...] [--studies twice,two-channels,...]

Studies store six signals (some store sines or bumps) at t0 = 1,800; storage is 0.5 t0, since F does not depend on it
(docs/howto/time_reversal.md). Every study of a pack adds its rows to protocols.csv and is done once, so that a killed
script goes on. At the end it prints the table, with mean and standard error over packs.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from console import in_one_line
from packs import FIVE, called
from rows import done, note

import gmem_jax as gm
from gmem_jax import protocols
from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.experiment.analysis import spread
from gmem_jax.experiment.run import Prefix, prefix_of
from gmem_jax.reading import capacity
from gmem_jax.simulation.stage import BINS

jax.config.update("jax_enable_x64", True)

COLUMNS = ("pack", "N", "t0", "study", "quantity", "value", "seconds")
PASCAL = float(gm.Material().modulus)
STORE = 0.5  # t0
TRAINED = 5e-3  # gamma0 of shears at u = 1, where 1e-3 moves hardly anything
NOISES = (0.2, 1.0, 5.0)  # Pa: about that of an older pack, and two that are the same for all (docs/remember_more.md)
KERNEL, WIDTH = 15, 0.125  # bumps of a kernel, half a width apart

Found = dict[str, float]
SIX = gm.six_signals()
ORDER = np.roll(np.arange(6), 2)  # order of the six signals on a second channel, or in a second write


def chosen(signals: gm.Bumps, rows: Any) -> gm.Bumps:
    """Some signals of a set."""
    return replace(signals, amplitudes=signals.amplitudes[rows], centres=signals.centres[rows])


def stacked(*parts: gm.Bumps) -> gm.Bumps:
    """Sets of one width, joined to one set."""
    amplitudes, centres = (jnp.concatenate([getattr(p, name) for p in parts]) for name in ("amplitudes", "centres"))
    return gm.Bumps(amplitudes, centres, parts[0].width)


def silent(signals: gm.Bumps) -> gm.Bumps:
    """A set of as many signals that are zero."""
    return replace(signals, amplitudes=0.0 * signals.amplitudes)


class Case:
    """A pack, and the shear-free prefixes that its runs have in common."""

    def __init__(self, name: str, t0: float) -> None:
        self.name, self.t0, self.pack, self.status = name, t0, gm.load_pack(name), 0
        self._prefixes: dict[Any, Prefix] = {}

    def experiment(self, protocol: gm.Protocol, signals: Any = SIX, **more: Any) -> gm.Experiment:
        """A protocol on this pack."""
        return gm.Experiment(self.pack, signals, protocol=protocol, t0=self.t0, **more)

    def run(self, protocol: gm.Protocol, signals: Any = SIX, **more: Any) -> tuple[gm.Experiment, gm.Recall]:
        """The experiment of a protocol on this pack, and its recall."""
        one = self.experiment(protocol, signals, **more)
        begun = one.phases[0], one.observe
        if begun not in self._prefixes:
            self._prefixes[begun] = prefix_of(one)
        recall = gm.run(one, prefix=self._prefixes[begun], progress=False)
        self.status |= int(np.bitwise_or.reduce(np.ravel(recall.status)))
        return one, recall


def rms(values: Any) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


def fitted(p_sig: Any, *templates: Any) -> tuple[list[float], float]:
    """Gains of p_sig on templates by least squares, and the fidelity with the first; all else counts as error."""
    series, basis = np.ravel(p_sig), np.stack([np.ravel(one) for one in templates])
    gains = np.linalg.lstsq(basis.T, series, rcond=None)[0]
    return [float(g) for g in gains], 1.0 - float(np.linalg.norm(series - gains[0] * basis[0]) / np.linalg.norm(series))


def twice(case: Case) -> Found:
    """Is a write erased by the next read?"""
    _, recall = case.run(protocols.paper_twice_read(STORE))
    first, second = np.asarray(recall.p_sig)
    similar = np.sum(second * recall.J[0]) / np.sqrt(np.sum(second**2) * np.sum(np.asarray(recall.J[0]) ** 2))
    return {
        "G": float(recall.gain[0]),
        "F": float(recall.fidelity[0]),
        "G of the second read": float(recall.gain[1]),
        "G of the second over the first": float(recall.gain[1] / recall.gain[0]),
        "rms of the second over the first": rms(second) / rms(first),
        "correlation of the second with J": float(similar),
        "rms of the first (Pa)": PASCAL * rms(first),
    }


def two_writes(case: Case) -> Found:
    """Does the second write see the first?"""
    sets = gm.signals(first=SIX, second=chosen(SIX, ORDER))
    one, recall = case.run(protocols.write_read_write_read(STORE), sets)
    scale, (first, second) = float(one.scale), np.asarray(recall.J)
    (own,), fidelity = fitted(recall.p_sig[0], scale * first)
    (again, before), after = fitted(recall.p_sig[1], scale * second, scale * first)
    return {
        "G of the first": own,
        "F of the first": fidelity,
        "G of the second": again,
        "F of the second": after,
        "G of the first in the second read": before,
    }


def partly(case: Case) -> Found:
    """What is left where it was read, and where it was not?"""
    _, whole = case.run(protocols.paper(STORE))
    one, recall = case.run(protocols.partial_readout(0.5, STORE))
    scale, J = float(one.scale), np.asarray(whole.J)
    late, early = slice(BINS // 2, BINS), slice(0, BINS // 2)
    found: Found = {}
    for name, p_sig in (("paper", whole.p_sig), ("part", recall.p_sig[0]), ("again", recall.p_sig[1])):
        for half, bins in (("u > 0.5", late), ("u < 0.5", early)):
            if name != "part" or bins is late:
                (gain,), fidelity = fitted(p_sig[:, bins], scale * J[:, bins])
                found |= {f"G, {name}, {half}": gain, f"F, {name}, {half}": fidelity}
    change = np.asarray(recall.p_sig[1] - whole.p_sig)
    for half, bins in (("u > 0.5", late), ("u < 0.5", early)):
        found[f"again - paper over paper, {half}"] = rms(change[:, bins]) / rms(whole.p_sig[:, bins])
    return found


def two_channels(case: Case) -> Found:
    """Gains and cross-talk: six signals on xy alone, on z alone, and on both."""
    other = chosen(SIX, ORDER)
    sets = gm.signals(xy=stacked(SIX, silent(SIX), SIX), z=stacked(silent(SIX), other, other))
    one, recall = case.run(protocols.two_channels(store=STORE), sets)
    scale, p, J = float(one.scale), np.asarray(recall.p_sig), np.asarray(recall.J)
    xy, z, both = slice(0, 6), slice(6, 12), slice(12, 18)
    (g_xy,), f_xy = fitted(p[0, xy], scale * J[0, xy])
    (g_z,), f_z = fitted(p[1, z], scale * J[1, z])
    (to_z,), _ = fitted(p[1, xy], scale * J[0, xy])
    (to_xy,), _ = fitted(p[0, z], scale * J[1, z])
    (xx, xz), f_x = fitted(p[0, both], scale * J[0, both], scale * J[1, both])
    (zz, zx), f_zz = fitted(p[1, both], scale * J[1, both], scale * J[0, both])
    together = p[:, xy] + p[:, z]
    return {
        "G xy alone": g_xy, "G z alone": g_z, "F xy alone": f_xy, "F z alone": f_z,
        "G z of xy, alone": to_z, "G xy of z, alone": to_xy,
        "G xy of xy": xx, "G xy of z": xz, "G z of z": zz, "G z of xy": zx, "F xy": f_x, "F z": f_zz,
        "rms of z's recall where xy was written, over xy's": rms(p[1, xy]) / rms(p[0, xy]),
        "rms of xy's recall where z was written, over z's": rms(p[0, z]) / rms(p[1, z]),
        "both - sum of alone, over both, xy": rms(p[0, both] - together[0]) / rms(p[0, both]),
        "both - sum of alone, over both, z": rms(p[1, both] - together[1]) / rms(p[1, both]),
    }  # fmt: skip


def held(case: Case) -> Found:
    """Upper bound of the bits of one channel and of two at each noise; gain of the odd part, and even over odd part."""
    sets = gm.signals(xy=SIX, z=chosen(SIX, ORDER))
    matrix = gm.kernel_matrix(case.experiment(protocols.two_channels(store=STORE), sets), KERNEL, WIDTH, progress=False)
    kernels: dict[str, MemoryKernel | gm.KernelMatrix] = {
        "xy": matrix.blocks[0][0],
        "z": matrix.blocks[1][1],
        "both with the power of one": matrix,
    }
    found: Found = {}
    for noise in NOISES:
        for name, kernel, power in (*((*each, 1.0) for each in kernels.items()), ("both", matrix, 2.0)):
            bits = capacity.channels(kernel, noise / PASCAL, power)
            found[f"bits at most at {noise:g} Pa, {name}"] = float(bits.sum())
    for name, kernel in (("xy", matrix.blocks[0][0]), ("z", matrix.blocks[1][1])):
        odd = {"G": kernel.gain(), "F": 1.0 - kernel.distance(), "even over odd": kernel.asymmetry()}
        found |= {f"kernel, {what}, {name}": value for what, value in odd.items()}
    size = [[rms(block.odd) for block in row] for row in matrix.blocks]
    return found | {"kernel, z of xy over xy of xy": size[1][0] / size[0][0],
                    "kernel, xy of z over z of z": size[0][1] / size[1][1]}  # fmt: skip


def in_turn(case: Case) -> Found:
    """Does the order of two writes at u = 1 matter?"""
    sets = gm.signals(xy=SIX, z=chosen(SIX, ORDER))
    runs = [case.run(protocols.two_channels_in_turn(*names), sets, gamma0=TRAINED)[1]
            for names in (("xy", "z"), ("z", "xy"))]  # fmt: skip
    one, other = (np.asarray(recall.p_sig) for recall in runs)
    found = {f"rms of {name} (Pa)": PASCAL * rms(one[at]) for at, name in enumerate(("xy", "z"))}
    for at, name in enumerate(("xy", "z")):
        found[f"difference of the orders over one, {name}"] = rms(one[at] - other[at]) / rms(one[at])
    return found


def moved(simulation: Any, state: Any) -> jax.Array:
    """Root mean square of the displacement since the mark, in R, [B]."""
    change = state.grains.position - simulation.mark.grains.position
    return jnp.sqrt(jnp.mean(jnp.sum(change**2, axis=1), axis=0))


def turned(simulation: Any, state: Any) -> jax.Array:
    """Root mean square of the rotation since the mark, in rad, [B]."""
    same = jnp.sum(state.grains.quaternion * simulation.mark.grains.quaternion, axis=1)
    return jnp.sqrt(jnp.mean((2.0 * jnp.arccos(jnp.clip(jnp.abs(same), 0.0, 1.0))) ** 2, axis=0))


OBSERVED = {"moved": moved, "turned": turned}
LEVELS = (0.5, 1.0, 1.25)  # amplitudes of the sines of the training, one replica each


def sines() -> gm.Bumps:
    """One sine for each of the levels."""
    amplitudes = np.outer(LEVELS, [1.0, -1.0])
    return gm.Bumps(jnp.asarray(amplitudes), jnp.full(amplitudes.shape, jnp.asarray([0.25, 0.75])), 0.5)


def after_each(recall: gm.Recall, name: str) -> np.ndarray:
    """The value of an observer at the end of each read, [R, S + 1]."""
    return np.stack([np.asarray((recall.stages[read].observed or {})[name])[-1] for read in recall.reads])


def bend(curve: np.ndarray, at: float) -> float:
    """The mean of the curve at both neighbours of an amplitude, over its value there: 1 for a straight line."""
    place = protocols.READOUT.index(at)
    return float(0.5 * (curve[place - 1] + curve[place + 1]) / curve[place])


def trained(case: Case) -> Found:
    """Is there a cusp at the trained amplitude?"""
    _, recall = case.run(protocols.amplitude_training(), sines(), gamma0=TRAINED, observe=OBSERVED)
    away = after_each(recall, "moved")
    found: Found = {}
    for column, level in enumerate((0.0, *LEVELS)):
        for row, amplitude in enumerate(protocols.READOUT):
            found[f"moved (R), trained at {level:g}, read to {amplitude:g}"] = float(away[row, column])
    for column, amplitude in enumerate(LEVELS, 1):
        found[f"bend at {amplitude:g}, untrained"] = bend(away[:, 0], amplitude)
        found[f"bend at {amplitude:g}, trained there"] = bend(away[:, column], amplitude)
    return found


def several(case: Case) -> Found:
    """Are two amplitudes remembered, the smaller last and first?"""
    found: Found = {}
    for order in ((1.0, 0.5), (0.5, 1.0)):
        protocol = protocols.several_amplitudes(order)
        _, recall = case.run(protocol, chosen(sines(), np.asarray([1])), gamma0=TRAINED, observe=OBSERVED)
        away = after_each(recall, "moved")[:, 1]
        name = " then ".join(f"{one:g}" for one in order)
        found |= {f"bend at {a:g}, {name}": bend(away, a) for a in (0.5, 1.0)}
        found |= {f"moved (R), {name}, read to {a:g}": float(w)
                  for a, w in zip(protocols.READOUT, away, strict=True)}  # fmt: skip
    return found


def erased(case: Case) -> Found:
    """How much of a write do one slow cycle and vibration leave?"""
    found: Found = {}
    kinds: dict[str, tuple[Callable[..., gm.Protocol], tuple[float, ...]]] = {
        "one cycle": (protocols.erasure_by_shear, (0.0, 3.0, 10.0, 30.0)),
        "16 periods": (protocols.erasure_by_vibration, (3.0, 10.0)),
    }
    for name, (protocol, amplitudes) in kinds.items():
        for amplitude in amplitudes:
            _, recall = case.run(protocol(amplitude))
            found |= {f"G after {name} of {amplitude:g}": float(recall.gain),
                      f"F after {name} of {amplitude:g}": float(recall.fidelity)}  # fmt: skip
    return found


def stored(case: Case) -> Found:
    """Does a pack forget by itself?"""
    short, long = (case.run(protocols.long_storage(length))[1] for length in (STORE, 20.0))
    change = rms(long.p_sig - short.p_sig) / rms(short.p_sig)
    return {"G after 0.5 t0": float(short.gain), "G after 20 t0": float(long.gain), "F after 0.5 t0":
            float(short.fidelity), "F after 20 t0": float(long.fidelity), "change over recall": change}  # fmt: skip


def sheared(case: Case) -> Found:
    """How does a pack respond to shear at u = 1, what returns, and how much is dissipated?"""
    found: Found = {}
    for name, one_sided in (("both sides", False), ("one side", True)):
        _, recall = case.run(protocols.read_by_shear(one_sided=one_sided), observe=OBSERVED)
        p_sig = np.asarray(recall.p_sig)
        varying = p_sig - p_sig[..., :1]
        found |= {f"rms of p_sig (Pa), {name}": PASCAL * rms(p_sig[0]),
                  f"of it not constant (Pa), {name}": PASCAL * rms(varying[0])}  # fmt: skip
        for number, read in enumerate(recall.reads, 1):
            sample = recall.stages[read]
            for what, unit in (("moved", "R"), ("turned", "rad")):
                seen = np.asarray((sample.observed or {})[what]).mean(axis=1)
                found |= {f"largest {what} ({unit}), cycle {number}, {name}": float(seen.max()),
                          f"left of it, {what}, cycle {number}, {name}": float(seen[-1] / seen.max())}  # fmt: skip
            lengths, pressure = np.asarray(sample.lengths)[:, :, 0], np.asarray(sample.pressure)[:, :, 0]
            strain = np.log(lengths[:, 1] / lengths[:, 0])
            stress = pressure[:, 0] - pressure[:, 1]
            closed = np.append(np.diff(strain), strain[0] - strain[-1])
            middle = 0.5 * (stress + np.roll(stress, -1))
            work = 0.5 * float(np.sum(middle * closed))
            swing = float(np.ptp(strain) * np.ptp(stress))
            found[f"loop area over its box, cycle {number}, {name}"] = abs(2.0 * work) / swing
    return found


STUDIES: dict[str, Callable[[Case], Found]] = {
    "two-channels": two_channels,
    "twice": twice,
    "two-writes": two_writes,
    "partly": partly,
    "trained": trained,
    "sheared": sheared,
    "in-turn": in_turn,
    "several": several,
    "erased": erased,
    "capacity": held,
    "stored": stored,
}


def table(rows: list[dict[str, str]]) -> Iterator[str]:
    """Mean and standard error over packs, a line for each quantity and size."""
    places = dict.fromkeys((row["study"], row["quantity"], row["N"]) for row in rows)
    for study, quantity, grains in sorted(places, key=lambda place: (list(STUDIES).index(place[0]), int(place[2]))):
        values = [float(row["value"]) for row in rows
                  if (row["study"], row["quantity"], row["N"]) == (study, quantity, grains)]  # fmt: skip
        mean, _, error = spread(values)
        told = f" ± {error:.2g}" if len(values) > 1 else ""
        yield f"{study:13} {int(grains):6,} {quantity:60} {mean:9.4g}{told} ({len(values)})"


def main() -> None:
    """Run the missing studies, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("protocols"), help="folder to write to")
    parser.add_argument("--packs", type=called, default=FIVE)
    parser.add_argument("--studies", default=",".join(STUDIES))
    parser.add_argument("--t0", type=float, default=1.8e3)
    arguments = parser.parse_args()
    if unknown := set(arguments.studies.split(",")) - set(STUDIES):
        parser.error(f"--studies: there is no {', '.join(sorted(unknown))}; there are {', '.join(STUDIES)}")
    arguments.output.mkdir(parents=True, exist_ok=True)
    path = arguments.output / "protocols.csv"
    if other := {float(row["t0"]) for row in done(path)} - {arguments.t0}:
        parser.error(f"{path}: has studies of t0 = {min(other):g}; name another folder")
    cases = {name: Case(name, arguments.t0) for name in arguments.packs}
    for study in arguments.studies.split(","):
        for name, case in cases.items():
            if any(row["pack"] == name and row["study"] == study for row in done(path)):
                continue
            began, case.status = time.process_time(), 0
            found = STUDIES[study](case)
            seconds = f"{time.process_time() - began:.0f}"
            own = {"pack": name, "N": case.pack.grains, "t0": arguments.t0, "study": study, "seconds": seconds}
            note(path, COLUMNS, [own | {"quantity": key, "value": f"{value:.5g}"} for key, value in found.items()])
            print(f"{name} {study}: {gm.explain(case.status)}, {seconds} CPU s", flush=True)
    print(*table(done(path)), sep="\n")


if __name__ == "__main__":
    in_one_line(main)
