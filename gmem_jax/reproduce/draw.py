"""The figures as pictures: ours and the published points in two colours."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.analysis import BACKGROUNDS
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.record import values_of
from gmem_jax.experiment.signals import Bumps, six_signals, words
from gmem_jax.physics.material import Material
from gmem_jax.physics.numbers import plural
from gmem_jax.reading.readers import stored_words
from gmem_jax.reproduce.compare import Compared, Conditions, Estimate, counted
from gmem_jax.show.recalls import MEAN, PALE, mean_over_ringing
from gmem_jax.show.render_matplotlib import pyplot, save_picture
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
STYLES = ("-", "--", ":", "-.")
VECTOR = (".svg",)
OURS, THEIRS, EITHER = "#1f5fa8", "#d1491b", "0.35"
MARKER_SPACING = 6.0  # printer's points between markers at one place, so that none hides another
LINE = 0.062  # height of a line of the legend, over that of its panel


def _panel(measure: str) -> str:
    return PANELS[measure.split()[0]]


def _written(name: str, value: Any) -> str:
    if not isinstance(value, float | int):
        return str(value).upper() if value in BACKGROUNDS else str(value)
    symbol = LABELS[name].split()[-1] if name in ("mu", "delta0", "gamma0") else LABELS.get(name, name)
    return f"{symbol} = {value:g}"


def _series(row: Compared, varied: Sequence[str]) -> str:
    """The name of a row's curve: the conditions that differ between curves, and the reader."""
    at = asdict(row.conditions)
    reader = row.measure.partition(" ")[2]
    return ", ".join(filter(None, [*(_written(name, at[name]) for name in varied), reader]))


def _sizes(sizes: Iterable[int]) -> str:
    return "N = " + ", ".join(f"{size:,}" for size in sorted(set(sizes)))


def said_of(rows: Sequence[Compared], rate: str) -> str:
    """The line below a title: our N, t0 (`rate`, in t_c) and number of packs, and the meaning of error bars."""
    counts = sorted({row.ours.packs for row in rows})
    over = f"{counts[0]} to {counts[-1]} packs" if len(counts) > 1 else plural(counts[0], "pack")
    own = "one pack" if counts == [1] else f"mean ± SE over {over}"
    sizes = sorted({row.conditions.grains for row in rows})
    size = _sizes(sizes) if len(sizes) < 3 else f"N = {sizes[0]:,} to {sizes[-1]:,}"
    return f"gmem_jax: {size}, $t_0$ = {rate} $t_c$, {own}"


def draw_comparison(path: Path, rows: Sequence[Compared], across: Sequence[str], title: str) -> None:
    """Draw G and F against a condition, ours and the published points in two colours; a symbol for each curve.

    Args:
        path: file to write.
        rows: the measures to show.
        across: the condition; or several, each with a line of panels for the curves that vary it.
        title: title above the picture.

    Raises:
        OSError: if it cannot be written.
    """
    lines = {name: rows if len(across) == 1 else _varying(rows, name) for name in across}
    lines = {name: found for name, found in lines.items() if found} or {across[0]: rows}
    panels = list(dict.fromkeys(_panel(row.measure) for row in rows))
    shape = len(lines), len(panels)
    figure, axes = pyplot().subplots(*shape, figsize=(5.2 * shape[1], 4.3 * shape[0]), squeeze=False)
    for line, (name, shown) in zip(axes, lines.items(), strict=True):
        for axis, panel in zip(line, panels, strict=True):
            _curves(axis, [row for row in shown if _panel(row.measure) == panel], name, panel)
    beside = "; published: mean ± SE" if any(row.theirs for row in rows) else ""
    figure.suptitle(title + beside, fontsize=10)
    save_picture(path, figure, also=VECTOR)


def _others(across: str) -> list[str]:
    """The conditions that distinguish curves against `across`; if that is the overlap, not the shape (1: a sphere)."""
    same = {across, "shape"} if across == "overlap" else {across}
    return [name for name in Conditions.__dataclass_fields__ if name not in same]


def _varying(rows: Sequence[Compared], across: str) -> list[Compared]:
    """The rows of curves with more than one point along a condition."""
    curves: dict[tuple[Any, ...], list[Compared]] = {}
    for row in rows:
        curves.setdefault((row.measure, *(getattr(row.conditions, name) for name in _others(across))), []).append(row)
    return [row for members in curves.values() if len(members) > 1 for row in members]


def _curves(axis: Any, rows: Sequence[Compared], across: str, panel: str) -> None:
    if panel == PANELS["G"] and across == "mu":
        rows = _with_friction(axis, rows)
    at = [asdict(row.conditions) for row in rows]
    varied = [name for name in _others(across) if len({one[name] for one in at}) > 1]
    words = sorted({one[across] for one in at}) if across == "law" else []
    curves: dict[str, list[Compared]] = {}
    for row in rows:
        curves.setdefault(_series(row, varied), []).append(row)
    for place, members in enumerate(curves.values()):
        _curve(axis, members, across, words, place, 2.0 * place - len(curves) + 0.5)
    _axis(axis, across, words, panel)
    if across == "grains" and panel == PANELS["G"]:
        _power_law(axis, rows)
    _legend(axis, rows, across, [label for label in curves if label])


def _with_friction(axis: Any, rows: Sequence[Compared]) -> Sequence[Compared]:
    """The rows with friction, if there are both kinds. G without friction may be any number: it is a text."""
    kept = [row for row in rows if row.conditions.mu]
    without = [row for row in rows if not row.conditions.mu]
    if not kept or not without:
        return rows
    told = [("gmem_jax", without[0].ours)] + ([("published", theirs)] if (theirs := without[0].theirs) else [])
    said = ", ".join(f"{whose} {one.mean:.2f}{'' if one.packs < 2 else f' ± {one.error:.2f}'}" for whose, one in told)
    axis.text(0.02, 0.03, f"not drawn: $\\mu$ = 0, {said}", transform=axis.transAxes, fontsize=7, color=EITHER)
    return kept


def _place(row: Compared, across: str, words: Sequence[str]) -> float:
    value = getattr(row.conditions, across)
    return float(words.index(value) if words else value)


def _curve(axis: Any, rows: Sequence[Compared], across: str, words: Sequence[str], place: int, shifted: float) -> None:
    """Draw our points and the published ones beside them, `shifted` by this number of marker spacings."""
    symbol, style = SYMBOLS[place % len(SYMBOLS)], STYLES[place % len(STYLES)]
    rows = sorted(rows, key=lambda row: _place(row, across, words))
    ours = [(_place(row, across, words), row.ours) for row in rows]
    joined = style if len(rows) > 1 and not words else "none"
    _points(axis, ours, shifted, color=OURS, marker=symbol, ls=joined)
    for (_, own), theirs in _published(rows, across).items():
        places = [(row.grains if across == "grains" else _place(row, across, words), one) for row, one in theirs]
        _points(axis, places, shifted + 1.0, color=THEIRS, marker=symbol, ls="none", mfc=THEIRS if own else "white")


def _points(axis: Any, points: Sequence[tuple[float, Estimate]], shifted: float, **style: Any) -> None:
    from matplotlib.transforms import ScaledTranslation

    aside = ScaledTranslation(shifted * MARKER_SPACING / 72.0, 0.0, axis.figure.dpi_scale_trans)
    x, estimates = [place for place, _ in points], [estimate for _, estimate in points]
    y, error = [one.mean for one in estimates], [np.nan_to_num(one.error) for one in estimates]
    fixed = {"markersize": 5, "capsize": 2, "linewidth": 1}
    axis.errorbar(x, y, error, transform=axis.transData + aside, **fixed, **style)
    low, high = np.subtract(y, error), np.add(y, error)
    axis.update_datalim(np.column_stack([[*x, *x], [*low, *high]]))  # shifted points do not update them
    axis.autoscale_view()


def _legend(axis: Any, rows: Sequence[Compared], across: str, labels: Sequence[str]) -> None:
    """Draw a legend above all points: the colours, ours and published, with their N; and the symbols of curves."""
    on_axis = across == "grains"
    size = "" if on_axis else f", {_sizes(row.conditions.grains for row in rows)}"
    axis.plot([], [], "s", color=OURS, label=f"gmem_jax{size}")
    for grains, own in _published(rows, across):
        face = THEIRS if own else "white"
        said = "published" if on_axis or not grains else f"published, N = {grains:,}"
        axis.plot([], [], "s", color=THEIRS, mfc=face, label=said)
    for place, label in enumerate(labels):
        style = STYLES[place % len(STYLES)]
        axis.plot([], [], SYMBOLS[place % len(SYMBOLS)], ls=style, color=EITHER, mfc="white", ms=5, lw=1, label=label)
    count = len(axis.get_legend_handles_labels()[1])
    room = LINE * -(-count // 2) + 0.03
    low, high = axis.get_ylim()
    if axis.get_yscale() == "log":
        axis.set_ylim(low, low * (high / low) ** (1.0 / (1.0 - room)))
    else:
        axis.set_ylim(low, low + (high - low) / (1.0 - room))
    axis.legend(fontsize=7, frameon=False, loc="upper left", ncols=2)


def _published(rows: Sequence[Compared], across: str) -> dict[tuple[int, bool], list[tuple[Compared, Estimate]]]:
    """The published points of a curve, by N and whether it is our N; all under (0, True) if N is the axis."""
    known = [(row, row.theirs) for row in rows if row.theirs]
    if across == "grains":
        return {(0, True): list({row.grains: (row, theirs) for row, theirs in known}.values())} if known else {}
    found: dict[tuple[int, bool], list[tuple[Compared, Estimate]]] = {}
    for row, theirs in known:
        found.setdefault((row.grains, row.grains == row.conditions.grains), []).append((row, theirs))
    return dict(sorted(found.items()))


def _axis(axis: Any, across: str, words: Sequence[str], label: str) -> None:
    axis.set_xlabel(LABELS[across])
    axis.set_ylabel(label)
    axis.margins(x=0.1)
    if label != PANELS["G"]:
        axis.set_ylim(0.0, 1.03)
        axis.set_yticks(np.linspace(0.0, 1.0, 6))
    elif across != "grains" and axis.get_ylim()[0] > 0.0:  # a gain without friction has either sign
        axis.set_ylim(0.0, 1.04 * axis.get_ylim()[1])
    if words:
        axis.set_xticks(range(len(words)), words)
        axis.margins(x=0.2)
    if across == "bits":
        low, high = axis.dataLim.intervalx
        axis.set_xticks(np.arange(low, high + 1.0))
        axis.set_xlim(low - 0.5, high + 0.5)
    if across in LOGARITHMIC:
        axis.set_xscale("log")
        # There are few places, less than a decade apart: matplotlib's labels would overlap, so that each gets its own.
        places = sorted({float(x) for line in axis.get_lines() for x in np.atleast_1d(line.get_xdata())})
        axis.set_xticks(places, [f"{x:,.0f}" if x >= 1.0 else f"{x:g}" for x in places])
        axis.set_xticks([], minor=True)


def power(sizes: Mapping[int, Estimate]) -> tuple[float, float]:
    """The exponent k of G ~ N^k by least squares, and its standard error.

    Args:
        sizes: G by N. If all have a standard error, they are weighted by it; else all count alike, and the exponent has
            no error (NaN).

    Returns:
        Exponent and error; NaN for fewer than two sizes, or if a G is not positive.
    """
    if len(sizes) < 2 or min(estimate.mean for estimate in sizes.values()) <= 0.0:
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

    of_each: dict[str, dict[int, Estimate]] = {}
    for row in rows:
        boundary = row.conditions.boundary
        whose = "ours" if boundary == "walls" else f"ours, {boundary}"
        of_each.setdefault(whose, {})[row.conditions.grains] = row.ours
    of_each["published"] = {row.grains: row.theirs for row in rows if row.theirs}
    said = []
    for whose, sizes in of_each.items():
        exponent, error = power(sizes)
        if math.isnan(exponent):
            continue
        said.append(f"{whose} $N^{{{exponent:.3f}}}$" + ("" if math.isnan(error) else f" (± {error:.3f})"))
    axis.set_title(", ".join(said), fontsize=8)
    if min(estimate.mean for sizes in of_each.values() for estimate in sizes.values()) <= 0.0:
        return  # such a G has no place on a logarithmic axis
    axis.set_yscale("log")
    axis.set_yticks(ticks := MaxNLocator(5).tick_values(*axis.get_ylim()), [f"{tick:g}" for tick in ticks])
    axis.set_yticks([], minor=True)


def through_time(path: Path, recall: Recall, signal: int, title: str) -> None:
    """Draw phi, Z, contacts, pressures and p_xy of every stage, with and without a signal, like the paper's Fig. 4.

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
    save_picture(path, figure, also=VECTOR)


def waveforms(path: Path, bits: int = 5) -> None:
    """Draw the six waveforms and some words of a length: I solid, J dashed, like the paper's Fig. 5.

    Raises:
        OSError: if it cannot be written.
    """
    u = jnp.linspace(0.0, 1.0, 2001)
    six = [f"signal {number + 1}" for number in range(6)]
    chosen = np.linspace(0, (1 << bits) - 1, len(six)).round().astype(int).tolist()
    rows: list[tuple[Bumps, Sequence[int], list[str]]] = [
        (six_signals(), range(6), six),
        (words(bits), chosen, [f"word {word:0{bits}b}" for word in chosen]),
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
    caption = (
        "What is stored and what is remembered. Solid: the waveform I(u), the shear while the pack is compressed from "
        f"u = 0 to 1; dashed: its integral J(u), scaled. Above the six signals, below six of the {1 << bits} words of "
        f"{bits} bits."
    )
    save_picture(path, figure, also=VECTOR, caption=caption)


def words_figure(path: Path, recalls: Sequence[Recall], shown: Sequence[Sequence[int]], title: str) -> None:
    """Draw recalled words (SUB2-BL) beside their scaled integrals, a line of panels for each length, like Fig. 13.

    If t0 is below the paper's, the running mean over the ringing period is drawn over the recall.

    Args:
        path: file to write.
        recalls: recalls of all words of a length, one for each length.
        shown: numbers of the words to draw, for each recall.
        title: title above the picture.

    Raises:
        OSError: if it cannot be written.
    """
    plt = pyplot()
    columns = max(map(len, shown))
    figure, axes = plt.subplots(
        len(recalls),
        columns,
        figsize=(1.9 * columns, 2.1 * len(recalls) + 0.5),
        sharex=True,
        sharey=True,
        squeeze=False,
    )
    unit, ringing = Material().modulus, False
    for line, recall, chosen in zip(axes, recalls, shown, strict=True):
        stored, known = stored_words(recall), values_of(recall.configuration)
        gain, fidelity = (float(getattr(recall, name)) for name in counted(known["t0"]))
        scale = unit * gain * known["delta0"] * known["gamma0"]
        smooth = mean_over_ringing(recall, np.asarray(stored.signals), known["t0"])
        ringing |= smooth is not None
        for axis, word in zip(line, chosen, strict=False):
            axis.axhline(0.0, color="0.8", linewidth=0.8)
            strong = stored.signals if smooth is None else smooth
            if smooth is not None:
                axis.plot(recall.u, unit * stored.signals[word], color=PALE, linewidth=0.8)
            axis.plot(recall.u, unit * strong[word], color=OURS, linewidth=1.1)
            axis.plot(recall.u, scale * stored.templates[word], "--", color=THEIRS, linewidth=1.1)
            axis.set_title(f"{word:0{stored.bits}b}", fontsize=8)
        for axis in line[len(chosen) :]:
            axis.set_visible(False)
        line[0].set_ylabel(f"L = {stored.bits}\nF = {fidelity:.2f}\nstress (Pa)", fontsize=8)
        line[0].tick_params(labelleft=True)
    for column in axes.T:
        lowest = [axis for axis in column if axis.get_visible()][-1]
        lowest.tick_params(labelbottom=True)
        lowest.set_xlabel("u")
    figure.suptitle(title, fontsize=10)
    drawn = f"Pale: recalled, SUB2-BL; blue: {MEAN}" if ringing else "Blue: recalled, SUB2-BL"
    caption = rf"{drawn}; red: $G E \delta_0 \gamma_0 J$. All panels have one scale."
    save_picture(path, figure, also=VECTOR, caption=caption)
