"""The figures as pictures: ours with error bars, the published points as stars."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.analysis import BACKGROUNDS
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.signals import Bumps, six_signals
from gmem_jax.experiment.signals import words as all_words
from gmem_jax.physics.material import Material
from gmem_jax.reading.readers import stored_words
from gmem_jax.reproduce.compare import Compared, Conditions, Estimate, counted
from gmem_jax.show.figures import pyplot, save
from gmem_jax.simulation.sample import Sample

LABELS = {
    "mu": "friction coefficient $\\mu$",
    "law": "friction law",
    "delta0": "compression $\\delta_0$",
    "gamma0": "shear amplitude $\\gamma_0$",
    "grains": "number of grains N",
    "bits": "length of words L (bits)",
    "overlap": "overlap of the spheres of a grain $O$ (1: a sphere)",
}
PANELS = {"F": "fidelity F", "G": "gain G", "accuracy": "part of the words read right"}
LOGARITHMIC = ("gamma0", "grains")
SYMBOLS = "osD^v<>pPX"
VECTOR = (".svg",)
TINT = 0.3  # of the stars of the same N; those of another are empty


def _panel(measure: str) -> str:
    return PANELS[measure.split()[0]]


def _written(value: str) -> str:
    return value.upper() if value in BACKGROUNDS else value


def _series(row: Compared, varied: Sequence[str]) -> str:
    """What tells a row's curve from the others."""
    at = asdict(row.conditions)
    shown = [f"{name} = {at[name]:g}" if isinstance(at[name], float | int) else _written(at[name]) for name in varied]
    reader = [" ".join(row.measure.split()[1:])]
    return ", ".join(filter(None, [*shown, *reader])) or "gmem_jax"


def against(path: Path, rows: Sequence[Compared], across: Sequence[str], title: str) -> None:
    """G and F against a condition, with the published points; a curve for each combination of the others that vary.

    Args:
        path: file to write.
        rows: what to show.
        across: the condition; or several, each with a line of panels for the rows that only it varies.
        title: over the picture.

    Raises:
        OSError: if it cannot be written.
    """
    lines = {name: rows if len(across) == 1 else _varying(rows, name) for name in across}
    lines = {name: found for name, found in lines.items() if found} or {across[0]: rows}
    panels = list(dict.fromkeys(_panel(row.measure) for row in rows))
    shape = len(lines), len(panels)
    figure, axes = pyplot().subplots(*shape, figsize=(5.2 * shape[1], 4.0 * shape[0]), squeeze=False)
    for line, (name, shown) in zip(axes, lines.items(), strict=True):
        for axis, panel in zip(line, panels, strict=True):
            _curves(axis, [row for row in shown if _panel(row.measure) == panel], name, panel)
    figure.suptitle(title, fontsize=10)
    save(path, figure, also=VECTOR)


def _others(across: str) -> list[str]:
    """The conditions that tell curves against one from each other. With an overlap of 1 a grain is a sphere."""
    same = {across, "shape"} if across == "overlap" else {across}
    return [name for name in Conditions.__dataclass_fields__ if name not in same]


def _varying(rows: Sequence[Compared], across: str) -> list[Compared]:
    """The rows of curves that have more than one place along a condition."""
    curves: dict[tuple[Any, ...], list[Compared]] = {}
    for row in rows:
        curves.setdefault((row.measure, *(getattr(row.conditions, name) for name in _others(across))), []).append(row)
    return [row for members in curves.values() if len(members) > 1 for row in members]


def _curves(axis: Any, rows: Sequence[Compared], across: str, panel: str) -> None:
    at = [asdict(row.conditions) for row in rows]
    varied = [name for name in _others(across) if len({one[name] for one in at}) > 1]
    words = sorted({one[across] for one in at}) if across == "law" else []
    curves: dict[str, list[Compared]] = {}
    for row in rows:
        curves.setdefault(_series(row, varied), []).append(row)
    for place, (label, members) in enumerate(curves.items()):
        _curve(axis, members, across, words, label, place)
    _say_published(axis, rows, across)
    _axis(axis, across, words, panel)
    if across == "grains" and panel == PANELS["G"]:
        _power_law(axis, rows)
    axis.legend(fontsize=7, frameon=False)


def _place(row: Compared, across: str, words: Sequence[str]) -> float:
    value = getattr(row.conditions, across)
    return float(words.index(value) if words else value)


def _curve(axis: Any, rows: Sequence[Compared], across: str, words: Sequence[str], label: str, place: int) -> None:
    colour, symbol = f"C{place % 10}", SYMBOLS[place % len(SYMBOLS)]
    rows = sorted(rows, key=lambda row: _place(row, across, words))
    x = [_place(row, across, words) for row in rows]
    y, error = [row.ours.mean for row in rows], [np.nan_to_num(row.ours.error) for row in rows]
    joined = "-" if len(rows) > 1 and not words else "none"
    axis.errorbar(
        x, y, error, color=colour, marker=symbol, markersize=4, capsize=3, linewidth=1, ls=joined, label=label
    )
    for grains, theirs in _published(rows, across).items():
        axis.errorbar(
            [row.grains if across == "grains" else _place(row, across, words) for row, _ in theirs],
            [estimate.mean for _, estimate in theirs],
            [np.nan_to_num(estimate.error) for _, estimate in theirs],
            color=colour,
            marker="*",
            markersize=10,
            markeredgecolor=colour,
            markerfacecolor=(colour, TINT) if _same_size(grains, theirs) else "none",
            capsize=2,
            ls="none",
            zorder=1.9,  # ours over it
        )


def _say_published(axis: Any, rows: Sequence[Compared], across: str) -> None:
    """One line of the legend for the stars of all curves, whatever their colour."""
    for grains, theirs in _published(rows, across).items():
        face = ("0.4", TINT) if _same_size(grains, theirs) else "none"
        said = f"published, N = {grains:,} (mean ± SE)" if grains else "published (mean ± SE)"
        axis.plot([], [], "*", color="0.4", markersize=10, markeredgecolor="0.4", markerfacecolor=face, label=said)


def _same_size(grains: int, theirs: Sequence[tuple[Compared, Estimate]]) -> bool:
    return not grains or all(row.conditions.grains == grains for row, _ in theirs)


def _published(rows: Sequence[Compared], across: str) -> dict[int, list[tuple[Compared, Estimate]]]:
    """The published points of a curve by their N; where N is the axis, each once, under 0."""
    known = [(row, row.theirs) for row in rows if row.theirs]
    if across == "grains":
        return {0: list({row.grains: (row, theirs) for row, theirs in known}.values())} if known else {}
    sizes = sorted({row.grains for row, _ in known})
    return {grains: [pair for pair in known if pair[0].grains == grains] for grains in sizes}


def _axis(axis: Any, across: str, words: Sequence[str], label: str) -> None:
    axis.set_xlabel(LABELS[across])
    axis.set_ylabel(label)
    if label != PANELS["G"]:
        axis.set_ylim(0.0, 1.03)
    elif across != "grains" and axis.get_ylim()[0] > 0.0:  # a gain without friction has either sign
        axis.set_ylim(0.0, 1.08 * axis.get_ylim()[1])
    if words:
        axis.set_xticks(range(len(words)), words)
        axis.margins(x=0.2)
    if across == "bits":
        low, high = axis.dataLim.intervalx
        axis.set_xticks(np.arange(low, high + 1.0))
        axis.set_xlim(low - 0.5, high + 0.5)
    if across in LOGARITHMIC:
        axis.set_xscale("log")
        # Few places, less than decades apart: each is named, where matplotlib would write 3 x 10^2 over 4 x 10^2.
        places = sorted({float(x) for line in axis.get_lines() for x in np.atleast_1d(line.get_xdata())})
        axis.set_xticks(places, [f"{x:,.0f}" if x >= 1.0 else f"{x:g}" for x in places])
        axis.set_xticks([], minor=True)


def power(sizes: Mapping[int, Estimate]) -> tuple[float, float]:
    """The exponent k of G ~ N^k by least squares, and its standard error.

    Args:
        sizes: G by N. If all have a standard error they count by it; else alike, and the exponent has none (NaN).

    Returns:
        Exponent and error; NaN for fewer than two sizes.
    """
    if len(sizes) < 2:
        return math.nan, math.nan
    size, mean = np.log(list(sizes)), np.array([estimate.mean for estimate in sizes.values()])
    relative = np.array([estimate.error for estimate in sizes.values()]) / mean
    weighed = bool(np.all(relative > 0.0))
    weights = 1.0 / relative if weighed else np.ones_like(mean)
    centred = size - np.average(size, weights=weights**2)
    spread = np.sum((weights * centred) ** 2)
    slope = np.sum(weights**2 * centred * np.log(mean)) / spread
    return float(slope), float(1.0 / np.sqrt(spread)) if weighed else math.nan


def _power_law(axis: Any, rows: Sequence[Compared]) -> None:
    from matplotlib.ticker import MaxNLocator

    of_both = {"ours": {row.conditions.grains: row.ours for row in rows}}
    of_both["published"] = {row.grains: row.theirs for row in rows if row.theirs}
    said = []
    for whose, sizes in of_both.items():
        exponent, error = power(sizes)
        said.append(f"{whose} $N^{{{exponent:.3f}}}$" + ("" if math.isnan(error) else f" (± {error:.3f})"))
    axis.set_yscale("log")
    axis.set_yticks(ticks := MaxNLocator(5).tick_values(*axis.get_ylim()), [f"{tick:g}" for tick in ticks])
    axis.set_yticks([], minor=True)
    axis.set_title(", ".join(said), fontsize=8)


def through_time(path: Path, recall: Recall, signal: int, title: str) -> None:
    """phi, Z, contacts, pressures and p_xy of every stage, with a signal and with none, like the paper's Fig. 4.

    Raises:
        OSError: if it cannot be written.
    """
    plt = pyplot()
    unit = Material().modulus / 1e3
    stages = list(recall.stages.items())
    rows = [
        ("filling $\\phi$", lambda s: s.filling, 1.0),
        ("Z", lambda s: s.coordination, 1.0),
        ("contacts per grain", lambda s: s.contacts_per_grain, 1.0),
        ("$p_x$ (kPa)", lambda s: s.pressure[:, 0], unit),
        ("$p_y$ (kPa)", lambda s: s.pressure[:, 1], unit),
        ("$p_z$ (kPa)", lambda s: s.pressure[:, 2], unit),
        ("$p_{xy}$ (Pa)", lambda s: s.pressure[:, 0] - s.pressure[:, 1], 1e3 * unit),
    ]
    figure, axes = plt.subplots(len(rows), 1, figsize=(8.0, 10.8), sharex=True)

    def column(stage: Sample, get: Any, replica: int) -> np.ndarray:
        values = np.asarray(get(stage))
        return values[:, min(replica, values.shape[1] - 1)]

    starts = np.cumsum([0, *(len(np.asarray(stage.filling)) for _, stage in stages)]) / 256.0
    for axis, (label, get, scale) in zip(axes, rows, strict=True):
        for replica, style, name in ((0, "C7-", "no signal"), (signal, "C0-", f"signal {signal}")):
            y = scale * np.concatenate([column(stage, get, replica) for _, stage in stages])
            axis.plot((np.arange(len(y)) + 0.5) / 256.0, y, style, linewidth=1.0, label=name)
        for start in starts[1:-1]:
            axis.axvline(start, color="0.85", linewidth=0.7, zorder=0)
        axis.set_ylabel(label)
    for (name, _), start, end in zip(stages, starts, starts[1:], strict=False):
        axes[0].text(0.5 * (start + end), 1.02, name, transform=axes[0].get_xaxis_transform(), ha="center", fontsize=6)
    axes[0].legend(fontsize=7, frameon=False)
    axes[-1].set_xlabel("time ($t_0$)")
    figure.suptitle(title, fontsize=10)
    save(path, figure, also=VECTOR)


def waveforms(path: Path, bits: int = 5) -> None:
    """The six waveforms and some words of a length: I solid, J dashed, like the paper's Fig. 5.

    Raises:
        OSError: if it cannot be written.
    """
    u = jnp.linspace(0.0, 1.0, 2001)
    six = [f"signal {number + 1}" for number in range(6)]
    chosen = np.linspace(0, (1 << bits) - 1, len(six)).round().astype(int).tolist()
    words_ = [f"word {word:0{bits}b}" for word in chosen]
    rows: list[tuple[Bumps, Sequence[int], list[str]]] = [
        (six_signals(), range(6), six),
        (all_words(bits), chosen, words_),
    ]
    figure, axes = pyplot().subplots(2, len(six), figsize=(2.1 * len(six), 4.6), sharex=True, sharey="row")
    for line, (signals, numbers, names) in zip(axes, rows, strict=True):
        shear, integral = np.asarray(signals.shear(u)), np.asarray(signals.integral(u))
        scale = np.abs(shear).max() / np.abs(integral).max()
        for axis, number, name in zip(line, numbers, names, strict=True):
            axis.axhline(0.0, color="0.8", linewidth=0.8)
            axis.plot(u, shear[:, number], linewidth=1.2, label="I(u)")
            axis.plot(u, scale * integral[:, number], "--", linewidth=1.2, label=f"{scale:.3g} J(u)")
            axis.set_title(name, fontsize=9)
        line[0].legend(fontsize=7, frameon=False)
    for axis in axes[-1]:
        axis.set_xlabel("u")
    save(path, figure, also=VECTOR)


def words(
    path: Path, recalls: Sequence[tuple[Recall, dict[str, Any]]], shown: Sequence[Sequence[int]], title: str
) -> None:
    """Recalled words (SUB2-BL) beside their scaled integrals, a line of panels for each length, like Fig. 13.

    Args:
        path: file to write.
        recalls: of all words of a length, with their configurations.
        shown: which words of each to draw.
        title: over the picture.

    Raises:
        OSError: if it cannot be written.
    """
    plt = pyplot()
    columns = max(map(len, shown))
    figure, axes = plt.subplots(
        len(recalls), columns, figsize=(1.9 * columns, 2.1 * len(recalls) + 0.5), sharex=True, squeeze=False
    )
    unit = Material().modulus
    for line, (recall, configuration), chosen in zip(axes, recalls, shown, strict=True):
        stored = stored_words(recall)
        gain, fidelity = (float(getattr(recall, name)) for name in counted(configuration["t0"]))
        scale = unit * gain * configuration["delta0"] * configuration["gamma0"]
        for axis, word in zip(line, chosen, strict=False):
            axis.axhline(0.0, color="0.8", linewidth=0.8)
            axis.plot(recall.u, unit * stored.signals[word], linewidth=1.0, label="recalled, SUB2-BL")
            axis.plot(
                recall.u, scale * stored.templates[word], "C3--", linewidth=1.0, label=r"$G E \delta_0 \gamma_0 J$"
            )
            axis.set_title(f"{word:0{stored.bits}b}", fontsize=8)
        for axis in line[len(chosen) :]:
            axis.set_visible(False)
        line[0].set_ylabel(f"L = {stored.bits}\nF = {fidelity:.2f}\nstress (Pa)", fontsize=8)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=7, frameon=False, loc="upper right", ncols=2)
    for axis in axes[-1]:
        axis.set_xlabel("u")
    figure.suptitle(title, fontsize=10)
    save(path, figure, also=VECTOR)
