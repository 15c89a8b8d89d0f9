"""Fig. 14: fidelity by each background, and accuracy of the readers, against the length of the words.

python experiments/fig14_capacity.py [--scale laptop|paper] [--pack tetra-325-a ...] [--bits 3 4] [-o fig14]
"""

import csv
from pathlib import Path

import jax
import matplotlib
import numpy as np
from capacity import announce, chosen, parser, recall

import gmem_jax as gm
from gmem_jax.experiment.analysis import spread
from gmem_jax.reading.readers import stored_words
from gmem_jax.reading.report import reading
from gmem_jax.show.tables import published

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BACKGROUNDS = {"sub0": "C0", "sub2": "C1", "sub2-bl": "C2"}
READERS = {"net": "C3", "nearest template": "C4", "linear decoder": "C5"}


def measure(pack: gm.Pack, bits: int, t0: float, folder: Path, nets: list[gm.classify.Training]) -> dict:
    """Numbers of one pack and length, as a flat row."""
    row = recall(pack, bits, t0, folder)
    read = reading(stored_words(gm.load_recall(row["path"])[0]), nets)["readers"]
    print("    accuracy: " + ", ".join(f"{name} {values['accuracy']:.3f}" for name, values in read.items()), flush=True)
    flat = {"pack": pack.name, "grains": pack.grains, "bits": bits, "status": row["status"]}
    flat |= {f"fidelity {name}": row["backgrounds"][name]["fidelity"] for name in BACKGROUNDS}
    flat |= {f"accuracy {name}": read[name]["accuracy"] for name in READERS}
    flat |= {f"bitwise information {name}": read[name]["information"]["bitwise"] for name in READERS}
    return flat | {f"second readout {key}": row["second_readout"][key] for key in ("correlation", "gain")}


def draw(path: Path, rows: list[dict]) -> None:
    """Means and standard errors over the packs of each size, and the published points."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2))
    for axis, kind, names in ((left, "fidelity", BACKGROUNDS), (right, "accuracy", READERS)):
        for grains, style in zip(sorted({row["grains"] for row in rows}), ("o-", "s--", "^:"), strict=False):
            lengths = sorted({row["bits"] for row in rows if row["grains"] == grains})
            for place, (name, colour) in enumerate(names.items()):
                cells = [
                    spread([row[f"{kind} {name}"] for row in rows if (row["grains"], row["bits"]) == (grains, n)])
                    for n in lengths
                ]
                mean, error = np.array([cell[0] for cell in cells]), np.nan_to_num([cell[2] for cell in cells])
                label = f"{name.upper() if kind == 'fidelity' else name}, N = {grains}"
                axis.errorbar(
                    np.array(lengths) + 0.08 * (place - 1),
                    mean,
                    error,
                    fmt=style,
                    color=colour,
                    capsize=3,
                    markersize=4,
                    label=label,
                )
    points = published("binary_words.csv")
    length = [point["word_bits"] for point in points]
    for name, colour in BACKGROUNDS.items():
        values = [point[f"fidelity_{name.replace('-', '_')}"] for point in points]
        left.plot(length, values, "*", color=colour, markersize=11, label=f"{name.upper()}, published, N = 10240")
    accuracies = [point["classifier_accuracy"] for point in points]
    right.plot(length, accuracies, "*", color=READERS["net"], markersize=11, label="net, published, N = 10240")
    left.set_ylabel("fidelity F")
    right.set_ylabel("part of the words read right")
    for axis in (left, right):
        axis.set_ylim(0.0, 1.05)
        axis.set_xlabel("bits of a word L")
        axis.legend(fontsize=6, frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def main() -> None:
    """Recall and read the words of every pack."""
    options = parser(__doc__, "fig14")
    options.add_argument("--seeds", type=int, default=3, help="nets to train for each length")
    options.add_argument("--budget", type=float, default=300.0, help="longest training of one net, seconds")
    given = options.parse_args()
    jax.config.update("jax_enable_x64", True)
    given.output.mkdir(parents=True, exist_ok=True)
    packs, bits, t0 = chosen(given)
    announce(packs, bits, t0)
    rows = []
    for length in bits:
        nets = []
        for seed in range(given.seeds):
            file = given.output / f"words-{length}-seed-{seed}.msgpack"
            lessons = gm.classify.Lessons(length)
            nets.append(gm.classify.train(lessons, seed, budget=given.budget, checkpoint=file))
            print(f"L = {length}, net {seed}: {nets[-1].step} steps, held-out accuracy {nets[-1].validation:.4f}")
        rows += [measure(pack, length, t0, given.output, nets) for pack in packs]
        with (given.output / "fig14.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
        draw(given.output / "fig14.png", rows)
    for length in bits:
        cells = [row for row in rows if row["bits"] == length]
        for key in (key for key in rows[0] if key.startswith(("fidelity", "accuracy", "second"))):
            mean, _, error = spread([row[key] for row in cells])
            print(f"L = {length}  {key:28s} {mean:.4f} +- {error:.4f}  ({len(cells)} packs)")


if __name__ == "__main__":
    main()
