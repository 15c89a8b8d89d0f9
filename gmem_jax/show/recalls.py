"""Figures of recalled signals, and `gm.plot`."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.analysis import running_mean
from gmem_jax.experiment.arguments import require_kind, require_several
from gmem_jax.experiment.experiment import PAPER_T0
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.record import values_of
from gmem_jax.files.configuration import recorded_material
from gmem_jax.files.measures import relative_scale
from gmem_jax.files.validation import is_number
from gmem_jax.physics.pytree import Scalar
from gmem_jax.show import tables
from gmem_jax.show.figure import Curve, Figure, Image, Panel, grid, shown_part, u_label
from gmem_jax.show.render_matplotlib import Drawing, to_matplotlib
from gmem_jax.show.stages import AGAINST, QUANTITIES, ZERO, observed_quantities, stages_figure

MOST_PANELS = 64  # most panels of a picture
MOST_OF_PAGE = 12  # most panels of a figure of a page
MEAN, PALE = "its mean over the ringing period $T_1$", "#a9c6e6"
SHEAR = r"$I(u) = \gamma / \gamma_0$"

OF_SIGNALS = ("signals", "waveforms", "all")
PICTURES = (*OF_SIGNALS, *QUANTITIES)
"""Names of the pictures of a recall."""


def plot(
    recall: Recall,
    what: str = "signals",
    *,
    against: str = "time",
    signals: Sequence[int] = (),
) -> Drawing:
    """A picture of a recall.

    All reads and channels are in one picture; `gm.plot(recall.at(read, channel))` draws one of them.

    Args:
        recall: the recall.
        what: "signals", the recalled signals; "waveforms", the stored ones; "all", an image with a row for each signal;
            a quantity of the stages, like "pressure", "p_xy", "Z" or "phi" (docs/glossary.md lists them); or the values
            of an observer, like "observed:sliding".
        against: horizontal axis of quantities of the stages, "time" or "u".
        signals: numbers of the signals to draw, from 1; 0 is the zero signal, for quantities of the stages only.
            Default all.

    Returns:
        A drawing that a notebook shows; its method `save(path)` writes it, and its `figure` is matplotlib's.

    Raises:
        ValueError: if there is no such picture or signal; the message names those that exist.
    """
    require_kind("plot", recall, Recall)
    require_several(signals, "signals")
    return to_matplotlib(recall_figure(recall, what, against=against, signals=signals))


def recall_figure(
    recall: Recall,
    what: str = "signals",
    *,
    against: str = "time",
    signals: Sequence[int] = (),
) -> Figure:
    """A figure of a recall; see `plot`.

    Args:
        recall: the recall.
        what: one of `PICTURES`, or "observed:NAME".
        against: "time" or "u", for the stages.
        signals: numbers of the signals to draw; default all.

    Raises:
        ValueError: if there is no such picture, or no such signal.
    """
    known, names = recall.configuration, recall.names
    title = tables.heading(known) if known else "recall"
    quantities = QUANTITIES | observed_quantities(recall.stages, known.get("observed", {}))
    pictures = dict.fromkeys((*PICTURES, *quantities))
    found = {name.lower(): name for name in pictures}.get(what.lower())
    if found is None or against not in AGAINST:
        raise ValueError(
            f"{what!r} against {against!r}: pictures of a recall are {', '.join(pictures)}, against time or u"
        )
    _refuse_unknown(signals, len(names), lowest=0 if found in quantities else 1)
    t0 = values_of(known).get("t0")
    if found in quantities:
        chosen = {names[number - 1] if number else ZERO: number for number in signals}
        own: dict[str, Any] = {"against": against, "begins": recall.protocol.begins, "t0": t0, "chosen": chosen}
        return stages_figure(recall.stages, quantities[found], title, material=recorded_material(known), **own)
    scale = relative_scale(known) if known else None
    if signals:
        rows = np.asarray(signals) - 1
        title += f"; G and F are of all {len(names)} signals"
        names = [names[row] for row in rows]
        if scale is not None and np.ndim(scale):
            scale = np.asarray(scale)[rows]
        curves: dict[str, Any] = {
            name: np.asarray(getattr(recall, name))[..., rows, :] for name in ("p_sig", "J", "shear")
        }
        recall = replace(recall, **curves)

    def of(one: Recall, title: str) -> Figure:
        if found == "signals":
            return signals_figure(one, names, title, scale, t0)
        return waveforms_figure(one, names, title) if found == "waveforms" else image_figure(one, names, title)

    parts = [*recall.each()]
    if len(parts) == 1:
        return of(recall, title)
    return joined_figure([(place_of(recall, one).removeprefix(", "), of(one, "")) for one in parts], title)


def place_of(recall: Recall, one: Recall) -> str:
    """The read and channel of `one`, a part of a recall, as ", second, xy"; each is named only if there are several."""
    several = [name for name in ("reads", "channels") if len(getattr(recall, name)) > 1]
    return "".join(f", {getattr(one, name)[0]}" for name in several)


def joined_figure(parts: Sequence[tuple[str, Figure]], title: str) -> Figure:
    """Join the figures of all reads and channels into one of at most 64 panels, whose titles name read and channel.

    Args:
        parts: pairs of a name, of read and channel, and a figure.
        title: title above all.
    """
    first, most = parts[0][1], max(1, MOST_PANELS // len(parts))
    panels = [
        replace(panel, title=", ".join(filter(None, (place, panel.title))), behind_label="")
        for place, figure in parts
        for panel in figure.panels[:most]
    ]
    told = "; ".join(f"{place}: {line}" for place, figure in parts for line in figure.title if line)
    told += shown_part(most, len(first.panels))
    rows = -(-len(panels) // first.columns)
    size = (first.size[0], first.size[1] * rows / first.rows)
    return replace(first, panels=tuple(panels), size=size, title=(title, told), shared=("x",))


def _refuse_unknown(signals: Sequence[int], count: int, lowest: int) -> None:
    for number in signals:
        if not lowest <= number <= count:
            more = ", and 0, the zero signal" if lowest == 0 else ""
            raise ValueError(f"signal {number}: this picture can show 1 to {count}{more}")


def mean_over_ringing(recall: Recall, signals: np.ndarray, t0: Any) -> np.ndarray | None:
    """Signals [S, 256] after a running mean over the ringing period; None if t0 is the paper's or longer, or unknown.

    Args:
        recall: the recall, for its ringing period.
        signals: p_sig, with any background.
        t0: duration of one compression, in t_c.
    """
    if not is_number(t0) or t0 >= PAPER_T0 or not np.isfinite(recall.window):
        return None
    return np.asarray(running_mean(jnp.asarray(signals), recall.windows(t0)[0] * signals.shape[-1]))


def signals_figure(
    recall: Recall,
    names: Sequence[str],
    title: str = "",
    scale: Scalar | np.ndarray | None = None,
    t0: Any = None,
    *,
    target: np.ndarray | None = None,
    page: bool = False,
) -> Figure:
    """p_sig of every signal, its scaled integral, and the waveform, like the paper's Fig. 6; at most 64 panels.

    If t0 is shorter than the paper's, the pack rings: the running mean over the ringing period is drawn, too.

    Args:
        recall: the recall.
        names: names of its S signals.
        title: title above the picture.
        scale: delta0 gamma0, scalar or [S, 1]; without it J is fitted to p_sig, which is the same if all signals have
            one scale.
        t0: duration of one compression in t_c, if it is known and the same for all.
        target: J of the targets of designed waveforms, [S, 256].
        page: whether the figure is for a page: at most 12 panels, without the waveforms.
    """
    pascal = float(recorded_material(recall.configuration).modulus)
    u, signals, integrals, waves = (np.asarray(x) for x in (recall.u, recall.p_sig, recall.J, recall.shear))
    if scale is None:
        fitted = integrals * np.sum(integrals * signals) / (np.sum(integrals * integrals) or np.nan)
    else:
        fitted = float(recall.gain) * np.asarray(scale) * integrals
    smooth = mean_over_ringing(recall, signals, t0)
    curves = [("recalled $p_{sig}$", signals, "C0" if smooth is None else PALE, "-")]
    curves += [] if smooth is None else [(MEAN, smooth, "C0", "-")]
    curves.append((r"$G E \delta_0 \gamma_0 J$", fitted, "C3", "--"))
    if target is not None:
        wanted = np.asarray(1.0 if scale is None else scale) * target
        gain = np.sum(wanted * signals) / np.sum(wanted * wanted)
        curves.append(("the same of the target", gain * wanted, "C2", ":"))
    shown = min(len(signals), MOST_OF_PAGE if page else MOST_PANELS)
    columns, size = grid(shown)
    largest = 1.05 * pascal * max(float(np.nanmax(np.abs(each[:shown]), initial=0.0)) for _, each, *_ in curves) or 1.0
    area: dict[str, Any] = {"behind_label": SHEAR}
    area["behind_limit"] = 1.05 * float(np.nanmax(np.abs(waves[:shown]), initial=0.0)) or 1.0
    panels = tuple(
        Panel(
            tuple(Curve(u, pascal * each[number], label, colour, style) for label, each, colour, style in curves),
            names[number],
            u_label(columns, of_time=recall.of_time),
            "stress (Pa)",
            (0.0, 1.0),
            (-largest, largest),  # both zeros lie in the middle
            zero=True,
            behind=None if page else Curve(u, waves[number], "waveform $I(u)$", "0.88"),
            **area,
        )
        for number in range(shown)
    )
    lines = () if page else (title, _measures(recall, shown, len(signals)))
    return Figure(panels, columns, size, lines, "below", shared=("x", "y"))


def waveforms_figure(recall: Recall, names: Sequence[str], title: str) -> Figure:
    """I(u) as applied, and J(u), of every signal; at most 64 panels."""
    shown = min(len(recall.J), MOST_PANELS)
    columns, size = grid(shown)
    u, curves = np.asarray(recall.u), ((recall.shear, "$I(u)$", "C2", "-"), (recall.J, "$J(u)$", "C3", "--"))
    panels = tuple(
        Panel(
            tuple(Curve(u, np.asarray(row[number]), name, tone, style) for row, name, tone, style in curves),
            names[number],
            u_label(columns),
            zero=True,
        )
        for number in range(shown)
    )
    return Figure(panels, columns, size, (f"{title}{shown_part(shown, len(recall.J))}",), "panel", shared=("x", "y"))


def image_figure(recall: Recall, names: Sequence[str], title: str) -> Figure:
    """p_sig and J of all signals as two images with a row for each signal, however many there are."""
    count, u = len(recall.J), np.asarray(recall.u)
    pairs = (
        (
            float(recorded_material(recall.configuration).modulus) * np.asarray(recall.p_sig),
            "recalled $p_{sig}$ (Pa)",
            recall.of_time,
        ),
        (np.asarray(recall.J), "$J(u)$", False),
    )
    panels = tuple(
        Panel((Image(values, u, np.arange(count), label),), x=u_label(1, of_time=of_time), down=True, y_names=names)
        for values, label, of_time in pairs
    )
    size = (9.6, min(9.0, 3.0 + 0.12 * count))
    return Figure(panels, 2, size, (title, _measures(recall, count, count)), shared=("y",))


def _measures(recall: Recall, shown: int, count: int) -> str:
    gain, fidelity = (tables.decimal(float(value)) for value in (recall.gain, recall.fidelity))
    return f"G = {gain}, F = {fidelity}{shown_part(shown, count)}"
