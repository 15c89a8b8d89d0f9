"""Fig. 5: the six waveforms I(u) and their integrals J(u); below them some binary words.

python experiments/fig05_signals.py [--bits 5] [-o fig05]
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import gmem_jax as gm

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def draw(path: Path, rows: list[tuple[gm.Signals, list[int], list[str]]]) -> None:
    """A row of panels for each set: the chosen signals, I solid and J dashed."""
    u = jnp.linspace(0.0, 1.0, 2001)
    columns = max(len(chosen) for _, chosen, _ in rows)
    figure, axes = plt.subplots(len(rows), columns, figsize=(2.1 * columns, 2.2 * len(rows)), sharex=True, sharey="row")
    for line, (signals, chosen, names) in zip(axes, rows, strict=True):
        shear, integral = np.asarray(signals.shear(u)), np.asarray(signals.integral(u))
        scale = np.abs(shear).max() / np.abs(integral).max()
        for axis, number, name in zip(line, chosen, names, strict=True):
            axis.axhline(0.0, color="0.8", linewidth=0.8)
            axis.plot(u, shear[:, number], linewidth=1.2, label="I(u)")
            axis.plot(u, scale * integral[:, number], linewidth=1.2, linestyle="--", label=f"{scale:.3g} J(u)")
            axis.set_title(name, fontsize=9)
        line[0].legend(fontsize=7, frameon=False)
    for axis in axes[-1]:
        axis.set_xlabel("u")
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def main() -> None:
    """Draw the signals; nothing is simulated."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bits", type=int, default=5, help="length of the words shown")
    parser.add_argument("-o", "--output", type=Path, default=Path("fig05"), help="folder to write to")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    arguments.output.mkdir(parents=True, exist_ok=True)

    words = gm.words(arguments.bits)
    shown = np.unique(np.linspace(0, words.count - 1, 6).round().astype(int)).tolist()
    shown = (shown * 6)[:6]  # fewer than six words: some twice
    names = [f"word {number:0{arguments.bits}b}" for number in shown]
    six = [f"signal {number + 1}" for number in range(6)]
    draw(arguments.output / "fig05.png", [(gm.six_signals(), list(range(6)), six), (words, shown, names)])


if __name__ == "__main__":
    main()
