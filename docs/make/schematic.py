"""The schematic of docs/experiment.md: the box from above, its motion, one stored waveform and its recall.

python docs/make/schematic.py
"""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

OUTPUT = Path(__file__).parents[1] / "experiment.png"
STAGES = (  # name, u before and after, length in t0
    ("rest", 0, 0, 0.2),
    ("compress", 0, 1, 1.0),
    ("hold", 1, 1, 0.2),
    ("decompress", 1, 0, 1.0),
    ("rest", 0, 0, 0.2),
    ("encode", 0, 1, 1.0),
    ("store", 1, 1, 2.0),
    ("readout", 1, 0, 1.0),
)
COLOURS = {"encode": "C3", "readout": "C0"}
CENTRES, HEIGHTS, WIDTH = (0.25, 0.6), (1.0, 0.6), 0.2


def waveform(u: np.ndarray) -> np.ndarray:
    """I(u): two bumps."""
    places = [(u - centre) / WIDTH for centre in CENTRES]
    bumps = [np.where(np.abs(x) < 0.5, np.cos(np.pi * x), 0.0) for x in places]
    return np.asarray(HEIGHTS) @ bumps


def integral(u: np.ndarray) -> np.ndarray:
    """J(u)."""
    fine = np.linspace(0.0, 1.0, 4001)
    return np.asarray(np.interp(u, fine, np.cumsum(waveform(fine)) * (fine[1] - fine[0])))


def grains(axis: Axes, half: Sequence[float]) -> None:
    """Clumps of circles on a disturbed lattice within a box of half lengths."""
    random = np.random.default_rng(3)
    side = 5
    places = (np.stack(np.meshgrid(*[np.arange(side)] * 2), -1).reshape(-1, 2) + 0.5) / side * 2.0 - 1.0
    for place, turn in zip(places, random.uniform(0.0, 2.0 * np.pi, len(places)), strict=True):
        for angle in turn + np.arange(3) * 2.0 * np.pi / 3.0:
            offset = 0.095 * np.array([np.cos(angle), np.sin(angle)])
            axis.add_patch(
                Circle(tuple(place * half + offset), 0.125, facecolor="0.82", edgecolor="0.6", linewidth=0.4)
            )


def box(axis: Axes, title: str, half: tuple[float, float], arrows: float, shear: float) -> None:
    """The box from above: grey as it was, black as it is; arrows inwards or outwards, and those of the shear."""
    axis.add_patch(Rectangle((-1, -1), 2, 2, facecolor="none", edgecolor="0.6", linestyle=":"))
    grains(axis, half)
    axis.add_patch(Rectangle((-half[0], -half[1]), 2 * half[0], 2 * half[1], facecolor="none", edgecolor="k", lw=1.6))
    for along, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        for size, start, colour in ((arrows, 1.1, "0.35"), (shear * (1, -1)[along], 1.55, "C3")):
            if size:
                axis_ends = np.zeros((2, 2))
                axis_ends[:, along] = sign * start, sign * (start + 0.4)
                tail, head = axis_ends[::-1] if size > 0.0 else axis_ends
                arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
                axis.annotate("", head, tail, arrowprops=arrow)
    axis.set(xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), aspect="equal", title=title)
    axis.title.set_fontsize(10)
    axis.axis("off")


def timeline(axis: Axes) -> None:
    """u(t) with the names of the stages."""
    time = 0.0
    for name, start, stop, length in STAGES:
        axis.plot([time, time + length], [start, stop], color=COLOURS.get(name, "0.3"), lw=2.4)
        if name in COLOURS:
            axis.axvspan(time, time + length, color=COLOURS[name], alpha=0.12, lw=0)
        rotation = 90 if length < 0.5 else 0
        axis.text(time + 0.5 * length, 1.13, name, ha="center", va="bottom", fontsize=8, rotation=rotation)
        time += length
    axis.set(xlabel="time / $t_0$", ylabel="compression $u$", xlim=(0, time), ylim=(-0.05, 1.6), yticks=(0, 1))
    axis.spines[["top", "right"]].set_visible(False)


def curves(axis: Axes, title: str, u: np.ndarray, values: np.ndarray, colour: str, backwards: bool) -> None:
    """A curve over the time of a stage."""
    axis.axhline(0.0, color="0.8", lw=0.8)
    axis.plot(u, values, color=colour, lw=2.0)
    axis.set(title=title, xlabel="$u$  (time runs to the right)", yticks=[], xlim=(1, 0) if backwards else (0, 1))
    axis.title.set_fontsize(10)
    axis.spines[["top", "right"]].set_visible(False)


def main() -> None:
    """Draw it."""
    figure = plt.figure(figsize=(9.6, 7.0))
    grid = figure.add_gridspec(3, 6, height_ratios=(1.7, 0.8, 0.8), hspace=0.5, wspace=0.5, left=0.06, right=0.98)
    box(figure.add_subplot(grid[0, :2]), "encode: squeeze, and shear by $\\gamma_0 I(u)$", (0.9, 0.97), 1.0, 1.0)
    box(figure.add_subplot(grid[0, 2:4]), "store: hold at $u = 1$, unsheared", (0.93, 0.93), 0.0, 0.0)
    box(figure.add_subplot(grid[0, 4:]), "readout: open, and measure $p_x - p_y$", (0.97, 0.97), -1.0, 0.0)
    timeline(figure.add_subplot(grid[1, :]))
    u = np.linspace(0.0, 1.0, 600)
    curves(figure.add_subplot(grid[2, :2]), "stored: $I(u)$", u, waveform(u), "C3", False)
    curves(figure.add_subplot(grid[2, 2:4]), "its integral $J(u)$", u, integral(u), "0.3", False)
    recalled = "recalled: $p_{sig} \\approx G E \\delta_0 \\gamma_0 J$"
    curves(figure.add_subplot(grid[2, 4:]), recalled, u, integral(u), "C0", True)
    figure.savefig(OUTPUT, bbox_inches="tight", dpi=110)


if __name__ == "__main__":
    main()
