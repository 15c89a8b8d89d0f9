"""Pictures of packs, kernels, waveforms, nets, tuned drives and sweeps."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.signals import Signals
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import sphere_centres
from gmem_jax.physics.state import Grains
from gmem_jax.show.drawing import Drawing, blank
from gmem_jax.show.tables import cell

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


def sweep_drawing(rows: Sequence[Mapping[str, Any]], names: Sequence[str], measure: str, title: str) -> Drawing:
    """A measure of every point against the first number that varies, else the first name that does; means at each."""
    done = [row for row in rows if row["state"] == "done"]
    varying = [name for name in names if len({row[name] for row in done}) > 1] or list(names[:1])
    counted = [name for name in varying if all(isinstance(row[name], int | float) for row in done)]
    along, numbers = (counted or varying)[0], bool(counted)
    values = sorted({row[along] for row in done}, key=lambda value: value if numbers else str(value))
    place = {value: value if numbers else number for number, value in enumerate(values)}
    drawing, ((axis,),) = blank(size=(6.4, 4.0))
    axis.plot([place[row[along]] for row in done], [row[measure] for row in done], "o", color="C0", alpha=0.5)
    means = [np.mean([row[measure] for row in done if row[along] == value]) for value in values]
    axis.plot([place[value] for value in values], means, "-", color="C0", label="mean of the points there")
    if not numbers:
        axis.set_xticks(range(len(values)), [cell(value)[:24] for value in values], rotation=30, ha="right")
    axis.set(xlabel=along, ylabel=_LABELS[measure])
    axis.set_title(f"{title}: {len(done)} of {len(rows)} points", fontsize=10)
    axis.legend(fontsize=7, frameon=False)
    return drawing
