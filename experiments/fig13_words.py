"""Fig. 13: recalled binary words beside their scaled integrals, and what the second readout still holds of them.

python experiments/fig13_words.py [--scale laptop|paper] [--pack tetra-325-a] [--bits 3 5] [-o fig13]
"""

from pathlib import Path

import jax
import matplotlib
import numpy as np
from capacity import announce, chosen, parser, recall

import gmem_jax as gm
from gmem_jax.reading.readers import stored_words
from gmem_jax.show.tables import published

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def draw(path: Path, rows: list[dict], pack: str) -> None:
    """Four words of each length."""
    figure, axes = plt.subplots(len(rows), 4, figsize=(10.5, 2.4 * len(rows)), sharex=True, squeeze=False)
    for line, row in zip(axes, rows, strict=True):
        kept, configuration = gm.load_recall(row["path"])
        stored, bits = stored_words(kept), row["bits"]
        found = row["backgrounds"]["sub2-bl"]
        scale = 1e7 * found["gain"] * configuration["delta0"] * configuration["gamma0"]
        for axis, number in zip(line, np.linspace(0.15, 0.85, 4) * (2**bits - 1), strict=True):
            word = round(float(number))
            axis.axhline(0.0, color="0.8", linewidth=0.8)
            axis.plot(kept.u, 1e7 * stored.signals[word], linewidth=1.0, label="recalled, SUB2-BL")
            axis.plot(kept.u, scale * stored.templates[word], "C3--", linewidth=1.0, label=r"$G E \delta_0 \gamma_0 J$")
            axis.set_title(f"{word:0{bits}b}", fontsize=9)
        line[0].set_ylabel(f"L = {bits}, F = {found['fidelity']:.2f}\nstress (Pa)", fontsize=8)
    axes[0, 0].legend(fontsize=6, frameon=False)
    for axis in axes[-1]:
        axis.set_xlabel("compression variable u")
    figure.suptitle(f"{pack}: recalled words", fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def main() -> None:
    """Recall the words of the first pack and draw some of each length."""
    options = parser(__doc__, "fig13").parse_args()
    jax.config.update("jax_enable_x64", True)
    options.output.mkdir(parents=True, exist_ok=True)
    packs, bits, t0 = chosen(options)
    announce(packs[:1], bits, t0)
    rows = [recall(packs[0], length, t0, options.output) for length in bits]
    draw(options.output / "fig13.png", rows, packs[0].name)
    for row in rows:
        for point in published("binary_words.csv", word_bits=float(row["bits"])):
            said = ", ".join(f"{name} {point['fidelity_' + name.replace('-', '_')]:.3f}" for name in row["backgrounds"])
            print(f"L = {row['bits']}, published (N = 10,240): F by {said}")


if __name__ == "__main__":
    main()
