"""Pictures of recalled signals."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.analysis import running_mean
from gmem_jax.experiment.experiment import PAPER_T0, Experiment
from gmem_jax.experiment.recall import Recall
from gmem_jax.files.checked import is_number
from gmem_jax.files.configuration import resolved
from gmem_jax.files.measures import relative_scale
from gmem_jax.files.recalls import signal_names
from gmem_jax.physics.material import Material
from gmem_jax.physics.pytree import Scalar
from gmem_jax.show import tables
from gmem_jax.show.drawing import Drawing, blank
from gmem_jax.show.stages import AGAINST, QUANTITIES, stages_drawing

MOST = 64  # panels of one picture
MEAN, PALE = "its mean over the ringing period $T_1$", "#a9c6e6"


PICTURES = ("signals", "waveforms", "all", *QUANTITIES)
"""What can be drawn of a recall."""


def recall_drawing(
    recall: Recall,
    what: str = "signals",
    configuration: Mapping[str, Any] | None = None,
    *,
    against: str = "time",
    signals: Sequence[int] = (),
) -> Drawing:
    """A picture of a recall.

    Args:
        recall: the recall.
        what: one of `PICTURES`: "signals", recalled; "waveforms", stored; "all", an image of all; or a quantity of the
            stages: "pressure", "p_x", "p_y", "p_z", "p_xy", "Z", "contacts", "phi", "energy", "speed", "overlap",
            "inertial".
        configuration: the resolved one, for names, conditions and t0.
        against: "time" or "u", for the stages.
        signals: numbers of those to draw, from 1; of the stages also 0, the zero signal. Default all.

    Raises:
        ValueError: if there is no such picture, or no such signal.
    """
    known = dict(configuration or {})
    names = signal_names(recall, known)
    title = tables.heading(known) if known else "recall"
    found = {name.lower(): name for name in PICTURES}.get(what.lower())
    if found is None or against not in AGAINST:
        raise ValueError(
            f"{what!r} against {against!r}: pictures of a recall are {', '.join(PICTURES)}, against time or u"
        )
    _refuse_unknown(signals, len(names), lowest=0 if found in QUANTITIES else 1)
    t0 = known.get("t0")
    if found in QUANTITIES:
        chosen = {names[number - 1] if number else "zero signal": number for number in signals}
        time = t0 if is_number(t0) else None
        return stages_drawing(recall.stages, found, title, against=against, t0=time, chosen=chosen)
    scale = relative_scale(known) if known else None
    if signals:
        rows = np.asarray(signals) - 1
        title += f"; G and F are of all {len(names)} signals"
        names = [names[row] for row in rows]
        if scale is not None and np.ndim(scale):
            scale = np.asarray(scale)[rows]
        recall = replace(recall, **{name: np.asarray(getattr(recall, name))[rows] for name in ("p_sig", "J", "shear")})
    if found == "signals":
        return signals_drawing(recall, names, title, scale, t0)
    if found == "waveforms":
        return waveforms_drawing(recall, names, title)
    return image_drawing(recall, names, title)


def _refuse_unknown(signals: Sequence[int], count: int, lowest: int) -> None:
    for number in signals:
        if not lowest <= number <= count:
            more = ", and 0, the zero signal" if lowest == 0 else ""
            raise ValueError(f"signal {number}: this picture can show 1 to {count}{more}")


def plot(recall: Recall, what: str, experiment: Experiment | None, against: str, signals: Sequence[int]) -> Drawing:
    """What `Recall.plot` calls."""
    known = None if experiment is None else resolved(experiment, 0.0)
    return recall_drawing(recall, what, known, against=against, signals=signals)


def mean_over_ringing(recall: Recall, signals: np.ndarray, t0: Any) -> np.ndarray | None:
    """Signals [S, 256] averaged over the ringing period; None at the paper's rate, or an unknown one.

    Args:
        recall: whose ringing period it is.
        signals: p_sig, by any background.
        t0: duration of one compression, in t_c.
    """
    if not is_number(t0) or t0 >= PAPER_T0 or not np.isfinite(recall.window):
        return None
    return np.asarray(running_mean(jnp.asarray(signals), float(recall.window) / t0 * signals.shape[-1]))


def signals_drawing(
    recall: Recall, names: Sequence[str], title: str, scale: Scalar | None = None, t0: Any = None
) -> Drawing:
    """p_sig of every signal, its scaled integral, and the waveform, like the paper's Fig. 6; at most 64 panels.

    Faster than the paper's rate the drive rings: the mean over the ringing period is drawn over what was recalled.

    Args:
        recall: what to draw.
        names: of its S signals.
        title: over the picture.
        scale: delta0 gamma0, scalar or [S, 1]; without it the integral that comes nearest is drawn, which is the same
            where all signals have one scale.
        t0: duration of one compression in t_c, if it is known and the same for all.
    """
    pascal = Material().modulus
    u, signals, integrals, waves = (np.asarray(x) for x in (recall.u, recall.p_sig, recall.J, recall.shear))
    if scale is None:
        fitted = integrals * np.sum(integrals * signals) / np.sum(integrals * integrals)
    else:
        fitted = float(recall.gain) * np.asarray(scale) * integrals
    smooth = mean_over_ringing(recall, signals, t0)
    shown = min(len(signals), MOST)
    drawing, axes = _panels(shown)
    rights = []
    for number, axis in enumerate(axes.flat[:shown]):
        right = axis.twinx()
        rights.append(right)
        wave = right.fill_between(u, waves[number], color="0.88", linewidth=0)
        axis.set_zorder(right.get_zorder() + 1)
        axis.patch.set_visible(False)
        axis.axhline(0.0, color="0.8", linewidth=0.6)
        colour = "C0" if smooth is None else PALE
        curves = [axis.plot(u, pascal * signals[number], color=colour, linewidth=1.2)[0]]
        if smooth is not None:
            curves += axis.plot(u, pascal * smooth[number], color="C0", linewidth=1.2)
        (scaled,) = axis.plot(u, pascal * fitted[number], color="C3", linewidth=1.2, linestyle="--")
        axis.set_title(names[number], fontsize=9 if shown <= 16 else 7, pad=3)
    highest = 1.05 * max(float(np.nanmax(np.abs(waves[:shown]), initial=0.0)), 1e-12)
    largest = 1.05 * pascal * float(np.nanmax(np.abs([signals[:shown], fitted[:shown]]), initial=0.0))
    axes[0, 0].set_ylim(-(largest or 1.0), largest or 1.0)  # both zeros lie in the middle
    for number, right in enumerate(rights):
        right.set_ylim(-highest, highest)
        last = (number + 1) % axes.shape[1] == 0 or number == shown - 1
        right.tick_params(labelright=last, labelsize=7, colors="0.5")
    for axis in axes[:, 0]:
        axis.set_ylabel("stress (Pa)", fontsize=9)
    _u_below(axes, shown)
    for right in {*rights[axes.shape[1] - 1 :: axes.shape[1]], rights[-1]}:
        right.set_ylabel(r"$I(u) = \gamma / \gamma_0$", fontsize=8, color="0.5")
    handles = [*curves, scaled, wave]
    said = ["recalled $p_{sig}$", MEAN][: len(curves)]
    labels = [*said, r"$G E \delta_0 \gamma_0 J$", "waveform $I(u)$"]
    drawing.figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8, frameon=False)
    drawing.title(title, _measures(recall, shown, len(signals)))
    return drawing


def waveforms_drawing(recall: Recall, names: Sequence[str], title: str) -> Drawing:
    """I(u) as applied, and J(u), of every signal; at most 64 panels."""
    shown = min(len(recall.J), MOST)
    drawing, axes = _panels(shown)
    for number, axis in enumerate(axes.flat[:shown]):
        axis.axhline(0.0, color="0.8", linewidth=0.6)
        axis.plot(recall.u, recall.shear[number], color="C2", linewidth=1.2, label="$I(u)$")
        axis.plot(recall.u, recall.J[number], color="C3", linewidth=1.2, linestyle="--", label="$J(u)$")
        axis.set_title(names[number], fontsize=9 if shown <= 16 else 7, pad=3)
    _u_below(axes, shown)
    axes[0, 0].legend(fontsize=7, frameon=False)
    drawing.title(f"{title}{_part(shown, len(recall.J))}")
    return drawing


def image_drawing(recall: Recall, names: Sequence[str], title: str) -> Drawing:
    """p_sig and J of all signals, however many, as a picture: a row for each."""
    count = len(recall.J)
    drawing, ((left, right),) = blank(1, 2, size=(9.6, min(9.0, 3.0 + 0.12 * count)), sharey=True)
    pairs = (
        (left, Material().modulus * np.asarray(recall.p_sig), "recalled $p_{sig}$ (Pa)"),
        (right, np.asarray(recall.J), "$J(u)$"),
    )
    for axis, values, label in pairs:
        limit = float(np.nanmax(np.abs(values), initial=0.0)) or 1.0
        image = axis.imshow(
            values,
            cmap="RdBu_r",
            vmin=-limit,
            vmax=limit,
            aspect="auto",
            interpolation="nearest",
            extent=(0.0, 1.0, count - 0.5, -0.5),
        )
        drawing.figure.colorbar(image, ax=axis, label=label)
        axis.set_xlabel("compression variable u")
    step = -(-count // 64)
    left.set_yticks(range(0, count, step), list(names)[::step], fontsize=8 if count <= 16 else 6)
    drawing.title(title, _measures(recall, count, count))
    return drawing


def _panels(count: int) -> tuple[Drawing, Any]:
    columns = min(count, 3) if count <= 12 else min(8, math.ceil(math.sqrt(count)))
    rows = -(-count // columns)
    width, height = (3.4, 2.4) if count <= 12 else (2.1, 1.7)
    size = (max(width * columns, 5.0) + 0.4, height * rows + 0.9)
    drawing, axes = blank(rows, columns, size=size, sharex=True, sharey=True)
    for axis in axes.flat[count:]:
        axis.set_visible(False)
    return drawing, axes


def _u_below(axes: Any, shown: int) -> None:
    """Label u under the lowest panel of each column."""
    columns = axes.shape[1]
    for number in range(max(0, shown - columns), shown):
        axis = axes[number // columns, number % columns]
        axis.tick_params(labelbottom=True)
        axis.set_xlabel("compression variable u" if columns <= 3 else "u", fontsize=9)


def _measures(recall: Recall, shown: int, count: int) -> str:
    return f"G = {float(recall.gain):.3f}, F = {float(recall.fidelity):.3f}{_part(shown, count)}"


def _part(shown: int, count: int) -> str:
    return f" (the first {shown} of {count} signals are shown)" if shown < count else ""
