"""Pictures of packs, kernels, waveforms, nets, tuned drives and sweeps."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.signals import Signals
from gmem_jax.files.checked import is_number
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import sphere_centres
from gmem_jax.physics.state import Grains
from gmem_jax.show.drawing import Drawing, blank
from gmem_jax.show.tables import cell
from gmem_jax.sweeps.curves import axes_of, lines_of

FEW_LINES = 6  # whose names fit inside the axes
_LABELS = {
    "gain": "gain G",
    "fidelity": "fidelity F",
    "windowed_gain": "G after a mean over T1",
    "windowed_fidelity": "F after a mean over T1",
}


def grains_drawing(pack: Pack) -> Drawing:
    """The spheres of all grains, seen along z; the higher, the brighter."""
    from matplotlib.collections import EllipseCollection

    still = jnp.zeros((*pack.position.shape, 1))
    grains = Grains(pack.position[..., None], pack.quaternion[..., None], still, still, still, still)
    centres = np.asarray(sphere_centres(grains, pack.clump))[..., 0]
    centres = centres[np.argsort(centres[:, 2])]
    drawing, ((axis,),) = blank(size=(6.4, 5.4))
    width = np.full(len(centres), 2.0)
    spheres = EllipseCollection(
        width, width, 0.0 * width, units="xy", offsets=centres[:, :2], transOffset=axis.transData, array=centres[:, 2]
    )
    spheres.set(cmap="viridis", edgecolor="0.2", linewidth=0.2)
    axis.add_collection(spheres)
    lower, upper = np.asarray(pack.lower), np.asarray(pack.upper)
    axis.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal", xlabel="x ($R$)", ylabel="y ($R$)")
    axis.set_title(f"{pack.name}: {pack.grains} {pack.clump.shape}", fontsize=10)
    drawing.figure.colorbar(spheres, ax=axis, label="z ($R$)")
    return drawing


def bumps_drawing(kernel: MemoryKernel, title: str) -> Drawing:
    """Odd and even part of the recall of every bump."""
    drawing, ((odd, even),) = blank(1, 2, size=(9.6, 3.9), sharey=True)
    pascal = Material().modulus
    for axis, values, name in ((odd, kernel.odd, "odd part"), (even, kernel.even, "even part, 0 for a linear memory")):
        for number, centre in enumerate(kernel.centres):
            tone = number / max(1, len(kernel.centres) - 1)
            axis.plot(
                kernel.u, pascal * values[number], color=(tone, 0.3, 1.0 - tone), linewidth=0.9, label=f"{centre:.2g}"
            )
        axis.set(xlabel="compression variable u", title=name)
    odd.set_ylabel("recall of a bump (Pa)")
    drawing.figure.legend(*odd.get_legend_handles_labels(), loc="outside right", fontsize=6, title="v", frameon=False)
    drawing.figure.suptitle(f"{title}, gamma0 = {kernel.gamma0:g}", fontsize=10)
    return drawing


def bits_drawing(readers: Mapping[str, Any], title: str) -> Drawing:
    """Error rate of each bit by each reader."""
    drawing, ((axis,),) = blank(size=(6.4, 3.6))
    for name, row in readers.items():
        errors = row["bit_errors"]
        axis.plot(range(len(errors)), errors, "o-", markersize=4, label=f"{name}: accuracy {row['accuracy']:.3f}")
    axis.set(xlabel="bit, the first at small u", ylabel="error rate", title=title)
    axis.set_xticks(range(len(errors)))
    axis.legend(fontsize=7, frameon=False)
    return drawing


def values_drawing(history: Sequence[Mapping[str, float]], title: str) -> Drawing:
    """The values of a tuned drive after every iteration, in parts of the first."""
    drawing, ((axis,),) = blank(size=(6.4, 3.6))
    for name, first in history[0].items():
        if name != "fidelity":
            way = [one[name] / first for one in history]
            axis.plot(way, "o-", markersize=4, label=f"{name}: {first:.3g} to {history[-1][name]:.3g}")
    axis.set(xlabel="iteration", ylabel="over the first value", title=title)
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.legend(fontsize=8, frameon=False)
    return drawing


def weights_drawing(weights: np.ndarray, title: str) -> Drawing:
    """Weights of the first layer of a net, [256, hidden]."""
    drawing, ((axis,),) = blank(size=(8.0, 4.0))
    limit = float(np.abs(weights).max()) or 1.0
    image = axis.imshow(
        weights, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto", extent=(0, weights.shape[1], 1.0, 0.0)
    )
    axis.set(xlabel="hidden unit", ylabel="compression variable u", title=title)
    drawing.figure.colorbar(image, ax=axis, label="weight of the first layer")
    return drawing


def waves_drawing(signals: Signals, target: Signals | None, title: str) -> Drawing:
    """I(u) of waveforms, and of those whose recall they imitate."""
    u = jnp.linspace(0.0, 1.0, 513)
    waves = np.asarray(signals.shear(u)).T
    shown = min(len(waves), 12)
    columns = min(shown, 3)
    lines = -(-shown // columns)
    drawing, axes = blank(lines, columns, size=(3.2 * columns + 0.6, 2.2 * lines + 0.6), sharex=True, sharey=True)
    wanted = None if target is None else np.asarray(target.shear(u)).T
    for number, axis in enumerate(axes.flat):
        axis.set_visible(number < shown)
        if number < shown:
            axis.axhline(0.0, color="0.8", linewidth=0.6)
            if wanted is not None:
                axis.plot(u, wanted[number], "--", color="0.5", linewidth=1.0, label="target $I(u)$")
            axis.plot(u, waves[number], color="C2", linewidth=1.2, label="$I(u)$")
            axis.set_title(f"signal {number + 1}", fontsize=9)
    axes[0, 0].legend(fontsize=7, frameon=False)
    drawing.figure.supxlabel("compression variable u", fontsize=9)
    drawing.figure.supylabel(r"$I(u) = \gamma / \gamma_0$", fontsize=9)
    part = f" (the first {shown} of {len(waves)} signals are shown)" if shown < len(waves) else ""
    drawing.figure.suptitle(f"{title}{part}", fontsize=10)
    return drawing


def sweep_drawing(
    rows: Sequence[Mapping[str, Any]], names: Sequence[str], measure: str, title: str, **chosen: Any
) -> Drawing:
    """A measure of the points of a sweep; several at one place as dots, their mean and its standard error.

    Args:
        rows: of the points (`gmem_jax.sweeps.table.rows`).
        names: that vary.
        measure: one of `MEASURES`.
        title: of the picture.
        **chosen: `x`, `by` and `over` of `axes_of`.

    Raises:
        ValueError: if no point is done, or the choice cannot be (see `axes_of`).
    """
    from matplotlib import colormaps

    done = [row for row in rows if row["state"] == "done"]
    if not done:
        raise ValueError(f"{title}: no point is done, so there is nothing to draw")
    axes = axes_of(done, names, **chosen)
    lines = lines_of(done, axes, measure)
    places = {value for line in lines for value in line.x}
    ticks = [] if all(map(is_number, places)) else sorted(places, key=str)
    few = len(lines) <= FEW_LINES
    drawing, ((axis,),) = blank(size=(6.4 if few else 8.6, 4.0))
    for number, line in enumerate(lines):
        colour: Any = f"C{number}" if len(lines) <= 10 else colormaps["viridis"](number / len(lines))
        label = ", ".join(f"{name} = {cell(value)}" for name, value in line.values.items())
        at = [ticks.index(value) if ticks else value for value in line.x]
        look = {"fmt": "o" if ticks else "o-", "color": colour, "markersize": 4, "capsize": 3}
        axis.errorbar(at, line.mean, line.error if line.most > 1 else None, **look, label=label)
        if line.most > 1:
            dots = [(place, value) for place, values in zip(at, line.each, strict=True) for value in values]
            axis.plot(*np.transpose(dots), ".", color=colour, alpha=0.35, markersize=5)
    if ticks:
        axis.set_xticks(range(len(ticks)), [cell(value)[:24] for value in ticks], rotation=30, ha="right")
    axis.set(xlabel=axes.x, ylabel=_LABELS[measure])
    counts = [len(values) for line in lines for values in line.each]
    samples = f"n = {min(counts)}" + (f" to {max(counts)}" if max(counts) > min(counts) else "")
    several = f"mean ± SE over {', '.join(axes.over) or 'points'}, {samples}" if max(counts) > 1 else ""
    drawing.title(f"{title}: {len(done)} of {len(rows)} points", several)
    if axes.by:
        where: dict[str, Any] = {"frameon": False, "fontsize": 7}
        axis.legend(**where) if few else drawing.figure.legend(loc="outside right", **where)
    return drawing
