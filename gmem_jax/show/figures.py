"""Figures of packs, kernels, gradients, designs, nets and tuned drives."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.design.waveforms import Design
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.record import names_of
from gmem_jax.experiment.signals import Signals
from gmem_jax.physics.grain import radii_of_spheres
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import sphere_places
from gmem_jax.show.figure import Curve, Discs, Figure, Image, Panel, U, grid, ramp, shown_part, u_label
from gmem_jax.show.recalls import MOST_OF_PAGE, SHEAR
from gmem_jax.simulation.stage import BINS

PASCAL = float(Material().modulus)


def lines_figure(lines: Mapping[str, tuple[Any, Any]], x: str, y: str, title: str = "", **more: Any) -> Figure:
    """Several curves by name in one panel.

    Args:
        lines: places and values by name.
        x: label of the horizontal axis.
        y: label of the vertical axis.
        title: title above the panel.
        more: further fields of the `Panel`.
    """
    curves = tuple(
        Curve(np.asarray(place, float), np.asarray(values, float), name, f"C{number % 10}", "o-")
        for number, (name, (place, values)) in enumerate(lines.items())
    )
    return Figure((Panel(curves, title, x, y, **more),), legend="panel")


def grains_figure(pack: Pack) -> Figure:
    """The spheres of all grains, seen from above along z; higher ones are brighter."""
    clump = pack.clump
    centres = sphere_places(pack.position, pack.quaternion, clump.offsets, clump.sizes)
    order = np.argsort(centres[:, 2])
    radii = radii_of_spheres(pack.grains, clump.spheres, clump.radii, clump.sizes)
    centres = centres[order]
    (left, right), (front, back) = zip(*(np.asarray(each)[:2] for each in (pack.lower, pack.upper)), strict=True)
    limits = {"x_limits": (left, right), "y_limits": (front, back), "equal": True}
    discs = Discs(centres[:, :2], centres[:, 2], "z ($R$)", radii[order])
    title = f"{pack.name}: {pack.grains} {pack.clump.shape}"
    return Figure((Panel((discs,), title, "x ($R$)", "y ($R$)", **limits),), size=(6.4, 5.4))  # type: ignore[arg-type]


def kernel_figure(kernel: MemoryKernel, noise: float, title: str = "", modulus: float = PASCAL) -> Figure:
    """M(u, v), and its singular values beside the noise, in Pa; `modulus` is E in Pa."""
    diagonal = Curve(np.array([0.0, 1.0]), np.array([0.0, 1.0]), colour="0.3", width=0.8)
    image = Image(kernel.kernel() / kernel.delta0, kernel.centres, kernel.u, r"$M(u, v) / E \delta_0$")
    left = Panel((image, diagonal), title, "v (where the shear acts)", "u (where it is read)")
    singular = kernel.singular_values() * modulus
    number = np.arange(1, singular.size + 1)
    values = Curve(number, singular, "singular values", style="o-")
    floor = Curve(number[[0, -1]], np.full(2, noise), "noise", "C3", "--", 0.8)
    labels = ("recall of the n-th best waveform", "number n", "singular value (Pa)")
    return Figure((left, Panel((values, floor), *labels, log=True)), 2, (9.6, 3.9), legend="below")


def bumps_figure(kernel: MemoryKernel, title: str, modulus: float = PASCAL) -> Figure:
    """Odd and even part of the recall of every bump, in Pa; `modulus` is E in Pa."""
    colours = ramp(len(kernel.centres))
    parts = {"odd part": kernel.odd, "even part, 0 for a linear memory": kernel.even}
    panels = []
    for name, values in parts.items():
        rows = zip(values, kernel.centres, colours, strict=True)
        curves = [Curve(kernel.u, modulus * row, f"{centre:.2g}", tone, width=0.9) for row, centre, tone in rows]
        panels.append(Panel(tuple(curves), name, U, "recall of a bump (Pa)"))
    over = (f"{title}, gamma0 = {kernel.gamma0:g}",)
    return Figure(tuple(panels), 2, (9.6, 3.9), over, "right", legend_title="v", shared=("y",))


def confusion_figure(counts: Mapping[str, np.ndarray]) -> Figure:
    """Confusion matrices by title, from counts [stored word, read word]; each row is divided by its sum."""
    panels = []
    for title, table in counts.items():
        count = len(table)
        places, bits = np.arange(count), count.bit_length() - 1
        share = table / table.sum(axis=1, keepdims=True)
        image = Image(share, places, places, "part of the readings", (0.0, 1.0), "Blues", written=count <= 16)
        names = [f"{word:0{bits}b}" for word in range(count)]
        axes = {"down": True, "equal": True, "x_names": names, "y_names": names}
        panels.append(Panel((image,), title, "word read", "word stored", **axes))  # type: ignore[arg-type]
    return Figure(tuple(panels), len(panels), (5.6 * len(panels), 5.0))


def bits_figure(readers: Mapping[str, Any], title: str) -> Figure:
    """Error rate of each bit by each reader."""
    lines = {
        f"{name}: accuracy {row['accuracy']:.3f}": (range(len(row["bit_errors"])), row["bit_errors"])
        for name, row in readers.items()
    }
    return lines_figure(lines, "bit, the first at small u", "error rate", title, whole=True)


def gradient_figure(places: Sequence[Sequence[float]], slopes: Sequence[Sequence[float]], title: str = "") -> Figure:
    """Derivatives dF / da by the heights a of each signal, against the places in u where these act."""
    rows = enumerate(zip(places, slopes, strict=True), 1)
    lines = {f"signal {number}": row for number, row in rows}
    return lines_figure(lines, U, "dF / d amplitude", title, zero=True)


def history_figure(histories: Mapping[str, Sequence[float]]) -> Figure:
    """1 - F against iterations."""
    lines = {name: (range(len(way)), 1.0 - np.asarray(way)) for name, way in histories.items()}
    return lines_figure(lines, "iteration", "1 - F", log=True, whole=True)


def values_figure(history: Sequence[Mapping[str, float]], title: str) -> Figure:
    """The values of a tuned drive after every iteration, over the first ones."""
    lines = {
        f"{name}: {first:.3g} to {history[-1][name]:.3g}": (range(len(history)), [one[name] / first for one in history])
        for name, first in history[0].items()
        if name != "fidelity"
    }
    return lines_figure(lines, "iteration", "over the first value", title, whole=True)


def weights_figure(weights: np.ndarray, title: str) -> Figure:
    """Weights of the first layer of a net, [256, hidden]."""
    u, units = ((np.arange(count) + 0.5) for count in weights.shape)
    image = Image(weights, units, u / len(u), "weight of the first layer")
    return Figure((Panel((image,), title, "hidden unit", U, down=True),), size=(8.0, 4.0))


def waves_figure(signals: Signals, target: Signals | None, title: str = "") -> Figure:
    """I(u) of waveforms, and of the targets of their design, if there are any."""
    u = np.linspace(0.0, 1.0, 2 * BINS + 1)
    names, waves = names_of(signals), np.asarray(signals.shear(jnp.asarray(u))).T
    wanted = None if target is None else np.asarray(target.shear(jnp.asarray(u))).T
    shown = min(len(waves), MOST_OF_PAGE)
    columns, size = grid(shown)
    panels = []
    for number in range(shown):
        curves = [] if wanted is None else [Curve(u, wanted[number], "target $I(u)$", "0.5", "--", 1.0)]
        curves.append(Curve(u, waves[number], "$I(u)$", "C2"))
        panels.append(Panel(tuple(curves), names[number], u_label(columns), SHEAR, zero=True))
    over = (f"{title}{shown_part(shown, len(waves))}",)
    return Figure(tuple(panels), columns, size, over, "panel", shared=("x", "y"))


def design_figure(design: Design, unit: float, title: str) -> Figure:
    """Designed waveforms, and their recalls beside the targets and the recalls of the original waveforms.

    Args:
        design: the design of S signals; at most six are shown, some of each channel.
        unit: delta0 gamma0.
        title: title above the picture.
    """
    channels, bins = len(design.sets), design.target.shape[-1]
    gain = np.diag(np.atleast_2d(design.gain))[:, None, None]
    target, p_sig, untouched = (
        np.reshape(rows, (channels, -1, bins)) for rows in (design.target, design.p_sig, design.untouched)
    )
    waves = np.stack([np.asarray(one.nodes) for one in design.sets.values()])
    each = min(target.shape[1], 6 // channels)
    shown = [(channel, number) for channel in range(channels) for number in range(each)]
    u, nodes = (np.arange(bins) + 0.5) / bins, np.linspace(0.0, 1.0, waves.shape[-1])
    curves = (
        (untouched, "recall, untouched", "0.7", "-"),
        (p_sig, "recall, designed", "C0", "-"),
        (gain * unit * target, "target", "C3", "--"),
    )
    on = [f"{name} " if channels > 1 else "" for name in design.sets]
    above = [
        Panel((Curve(nodes, waves[at], colour="C2"),), f"{on[at[0]]}signal {at[1] + 1}", "", "designed I(u)")
        for at in shown
    ]
    below = [
        Panel(
            tuple(Curve(u, PASCAL * row[at], name, tone, style) for row, name, tone, style in curves),
            x="u",
            y="stress (Pa)",
        )
        for at in shown
    ]
    before, after = (", ".join(f"{one:.3f}" for one in np.atleast_1d(f)) for f in (design.before, design.fidelity))
    size = max(2.6 * len(shown), 4.0), 4.8
    return Figure(
        (*above, *below), len(shown), size, (f"{title}: F {before} -> {after}",), "below", shared=("x", "row")
    )
