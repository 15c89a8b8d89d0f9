"""How good superposition is: recalls predicted from a pack's memory kernel beside simulated recalls.

python experiments/superposition.py [-o superposition] [--packs tetra-325-a,tetra-325-b,tetra-325-c] [--t0 1800]

The signals are the six at several gamma0, all words of 3 to 5 bits, and on the first pack all words of 8 bits, which
are also classified. "Linear" uses only the odd part of the kernel, "both" also the even part. It takes some twenty
minutes on two cores.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from console import in_one_line, new_folder

import gmem_jax as gm
from gmem_jax import classify
from gmem_jax.experiment.run import Prefix, prefix_of, run
from gmem_jax.experiment.signals import bit_width
from gmem_jax.physics.material import Material
from gmem_jax.show.render_matplotlib import pyplot, save_picture
from gmem_jax.simulation.stage import bin_centres

GAMMAS = (1e-4, 3e-4, 1e-3, 3e-3)
BITS = (3, 4, 5)
LONG = 8


def error(predicted: np.ndarray, simulated: np.ndarray) -> float:
    """|predicted - simulated| / |simulated| over a set."""
    return float(np.linalg.norm(predicted - simulated) / np.linalg.norm(simulated))


def compare(experiment: gm.Experiment, prefix: Prefix, n: int, width: float) -> dict[str, Any]:
    """Predictions of an experiment's signals from a kernel on n bumps, of which they are sums; and their simulation."""
    kernel = gm.memory_kernel(experiment, n, width, prefix=prefix)
    simulated = np.asarray(run(experiment, prefix=prefix).p_sig)
    both, linear = kernel.predict(experiment.waveforms), kernel.predict(experiment.waveforms, even=False)
    return {
        "both": both,
        "linear": linear,
        "simulated": simulated,
        "error_both": error(both, simulated),
        "error_linear": error(linear, simulated),
        "asymmetry": kernel.asymmetry(),
    }


def of_words(bits: int) -> tuple[int, float]:
    """Number and width of bumps half a width apart; the bumps of words are among them."""
    width = bit_width(bits)
    return round(2.0 / width) - 1, width


def draw(path: Path, rows: list[list[Any]], six: dict[str, Any], title: str) -> None:
    """Draw the six recalls beside their predictions, and errors against gamma0 and against the number of bits."""
    figure, axes = pyplot().subplots(2, 4, figsize=(14, 6))
    pascal, u = Material().modulus, bin_centres()
    for number, axis in enumerate((*axes[0, :3], *axes[1, :3])):
        axis.plot(u, pascal * six["simulated"][number], color="C0", label="simulated")
        axis.plot(u, pascal * six["both"][number], "--", color="C3", label="superposition")
        axis.plot(u, pascal * six["linear"][number], ":", color="0.5", label="odd part alone")
        axis.set_title(f"signal {number + 1}", fontsize=9)
    axes[0, 0].legend(fontsize=7, frameon=False)
    axes[0, 0].set_ylabel("p_sig (Pa)")
    axes[1, 0].set_ylabel("p_sig (Pa)")
    for name in dict.fromkeys(row[0] for row in rows):
        for axis, label, column in ((axes[0, 3], "six", 2), (axes[1, 3], "words", 1)):
            chosen = [row for row in rows if row[0] == name and row[1].startswith(label)]
            if label == "words":
                axis.plot([int(row[1].split()[1]) for row in chosen], [row[4] for row in chosen], "o-", label=name)
            else:
                axis.loglog([row[column] for row in chosen], [row[4] for row in chosen], "o-", label=name)
    axes[0, 3].set(xlabel="gamma0", ylabel="error of superposition, six signals")
    axes[1, 3].set(xlabel="bits of the words", ylabel="error of superposition")
    axes[1, 3].legend(fontsize=7, frameon=False)
    figure.suptitle(title, fontsize=10)
    save_picture(path, figure)


def main() -> None:
    """Measure, predict, simulate, classify and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=new_folder, default="superposition", help="folder to write to")
    parser.add_argument("--packs", default="tetra-325-a,tetra-325-b,tetra-325-c")
    parser.add_argument("--t0", type=float, default=1.8e3)
    parser.add_argument("--long", type=int, default=LONG, help="bits of the long words; 0 for none")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    rows: list[list[Any]] = []
    shown: dict[str, Any] = {}

    def note(name: str, what: str, gamma0: float, found: dict[str, Any]) -> None:
        rows.append([name, what, gamma0, found["error_linear"], found["error_both"], found["asymmetry"]])
        print(f"{name}  {what:9}  gamma0 {gamma0:g}  error: linear {found['error_linear']:.4f}, "
              f"both {found['error_both']:.4f}; |even| / |odd| {found['asymmetry']:.4f}", flush=True)  # fmt: skip

    names = arguments.packs.split(",")
    for name in names:
        experiment = gm.Experiment(gm.load_pack(name), gm.six_signals(), t0=arguments.t0)
        prefix = prefix_of(experiment)
        for gamma0 in GAMMAS:
            found = compare(gm.replace(experiment, gamma0=gamma0), prefix, 17, 0.2)
            note(name, "six", gamma0, found)
            if name == names[0] and gamma0 == 1e-3:
                shown = found
        for bits in BITS:
            found = compare(gm.replace(experiment, signals=gm.words(bits)), prefix, *of_words(bits))
            note(name, f"words {bits}", 1e-3, found)
        if name == names[0] and arguments.long:
            bits = arguments.long
            found = compare(gm.replace(experiment, signals=gm.words(bits)), prefix, *of_words(bits))
            note(name, f"words {bits}", 1e-3, found)
            began = time.perf_counter()
            net = classify.train(classify.TrainingConfig(bits=bits)).net
            right = {key: float(classify.accuracy(net, found[key])) for key in ("simulated", "both", "linear")}
            print(f"net of {bits} bits, trained in {time.perf_counter() - began:.0f} s; words recognised: "
                  + ", ".join(f"{key} {value:.3f}" for key, value in right.items()), flush=True)  # fmt: skip
            miss = np.linalg.norm(found["simulated"][:, None] - found["both"][None], axis=2)
            template = float(np.mean(miss.argmin(axis=1) == np.arange(2**bits)))
            print(f"nearest predicted recall of a simulated one is the right word: {template:.3f}", flush=True)
    with (arguments.output / "superposition.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["pack", "signals", "gamma0", "error_linear", "error_both", "even_over_odd"])
        writer.writerows(rows)
    draw(arguments.output / "superposition.png", rows, shown, names[0])


if __name__ == "__main__":
    in_one_line(main)
