"""Pictures. Matplotlib is imported on first use, and without a display."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.design.waveforms import Design
from gmem_jax.experiment.recall import Recall
from gmem_jax.files.atomic import atomic
from gmem_jax.physics.material import Material
from gmem_jax.physics.pytree import Scalar
from gmem_jax.show.recalls import signals_drawing


def pyplot() -> Any:
    """Matplotlib's pyplot, drawing to files."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams["text.usetex"] = False
    return plt


def save(path: Path, figure: Any, *, also: Sequence[str] = (), caption: str = "") -> None:
    """Write a figure whole, and close it.

    Args:
        path: in the format of its suffix.
        figure: of matplotlib.
        also: further suffixes to write it under.
        caption: what is seen, in words under it.

    Raises:
        OSError: if it cannot be written.
    """
    lines = textwrap.wrap(caption, int(14 * figure.get_figwidth()))
    below = 0.2 * len(lines) / figure.get_figheight()
    figure.tight_layout(rect=(0.0, below, 1.0, 1.0))
    if lines:
        figure.text(0.02, 0.3 * below / len(lines), "\n".join(lines), va="bottom", fontsize=9)
    for target in (path, *(path.with_suffix(suffix) for suffix in also)):
        with atomic(target) as temporary:
            figure.savefig(temporary, format=target.suffix.removeprefix("."), dpi=130)
    pyplot().close(figure)


def recall_figure(
    path: Path, recall: Recall, scale: Scalar, title: str, names: Sequence[str] | None = None, t0: Any = None
) -> None:
    """p_sig of every signal, its scaled integral G E delta0 gamma0 J, and I(u), like the paper's Fig. 6.

    Args:
        path: file to write.
        recall: what to draw.
        scale: delta0 gamma0, scalar or [S, 1].
        title: over the picture.
        names: of the signals; default their numbers.
        t0: duration of one compression in t_c: see `signals_drawing`.

    Raises:
        OSError: if the path cannot be written.
    """
    called = names or [f"signal {number + 1}" for number in range(len(recall.J))]
    signals_drawing(recall, called, title, scale, t0).save(path)


def confusion_figure(path: Path, table: np.ndarray, title: str) -> None:
    """A confusion matrix [S, S]: word stored down, word read across, rows normalised.

    Raises:
        OSError: if the path cannot be written.
    """
    plt = pyplot()
    count = len(table)
    bits = count.bit_length() - 1
    figure, axes = plt.subplots(figsize=(5.6, 5.0))
    share = table / table.sum(axis=1, keepdims=True)
    image = axes.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0, interpolation="nearest")
    if count <= 32:
        names = [f"{word:0{bits}b}" for word in range(count)]
        size = 9 if count <= 8 else 6
        axes.set_xticks(range(count), names, rotation=90, fontsize=size)
        axes.set_yticks(range(count), names, fontsize=size)
    if count <= 16:
        for row, column in np.argwhere(share > 0.0):
            tone = "white" if share[row, column] > 0.5 else "black"
            axes.text(column, row, f"{share[row, column]:.2g}", ha="center", va="center", fontsize=7, color=tone)
    axes.set_xlabel("word read")
    axes.set_ylabel("word stored")
    axes.set_title(title, fontsize=10)
    figure.colorbar(image, label="part of the readings", shrink=0.8)
    save(path, figure)


def gradient_figure(path: Path, rows: Sequence[tuple[np.ndarray, np.ndarray]], title: str) -> None:
    """dF / da of every signal's heights against where in u they act; a pair (places, slopes) for each signal.

    Raises:
        OSError: if the path cannot be written.
    """
    figure, axis = pyplot().subplots(figsize=(6.4, 3.6))
    for number, (place, slope) in enumerate(rows):
        axis.plot(place, slope, "o-", markersize=4, linewidth=0.8, label=f"signal {number + 1}")
    axis.axhline(0.0, color="0.8", linewidth=0.8)
    axis.set(xlabel="compression variable u", ylabel="dF / d amplitude", title=title)
    axis.legend(fontsize=7, frameon=False)
    save(path, figure)


def kernel_figure(path: Path, kernel: MemoryKernel, noise: float, title: str) -> None:
    """M(u, v), and its singular values beside the noise.

    Raises:
        OSError: if the path cannot be written.
    """
    figure, (left, right) = pyplot().subplots(1, 2, figsize=(9.6, 3.9))
    values = kernel.kernel() / kernel.delta0
    limit = float(np.abs(values).max())
    image = left.pcolormesh(kernel.centres, kernel.u, values, cmap="RdBu_r", vmin=-limit, vmax=limit, shading="nearest")
    figure.colorbar(image, ax=left, label=r"$M(u, v) / E \delta_0$")
    left.plot([0, 1], [0, 1], color="0.3", linewidth=0.8)
    left.set(xlabel="v (where the shear acts)", ylabel="u (where it is read)", title=title)
    singular = kernel.singular_values() * Material().modulus
    right.semilogy(np.arange(1, singular.size + 1), singular, "o-", markersize=4)
    right.axhline(noise * Material().modulus, color="C3", linestyle="--", linewidth=0.8, label="noise")
    right.set(xlabel="number", ylabel="singular value (Pa)", title="recall of the n-th best waveform")
    right.legend(frameon=False, fontsize=8)
    save(path, figure)


def history_figure(path: Path, histories: Mapping[str, Sequence[float]]) -> None:
    """1 - F against iterations.

    Raises:
        OSError: if the path cannot be written.
    """
    figure, axis = pyplot().subplots(figsize=(5.2, 3.6))
    for name, history in histories.items():
        axis.semilogy(range(len(history)), 1.0 - np.asarray(history), "o-", markersize=4, label=name)
    axis.set(xlabel="iteration", ylabel="1 - F")
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.legend(frameon=False, fontsize=8)
    save(path, figure)


def design_figure(path: Path, design: Design, unit: float, title: str) -> None:
    """Designed waveforms, and their recall beside the targets and what the untouched waveforms gave.

    Args:
        path: file to write.
        design: the design, of S signals.
        unit: delta0 gamma0.
        title: over the picture.

    Raises:
        OSError: if the path cannot be written.
    """
    shown = min(len(design.target), 6)
    u = (np.arange(design.target.shape[1]) + 0.5) / design.target.shape[1]
    pascal = Material().modulus
    figure, axes = pyplot().subplots(2, shown, figsize=(2.6 * shown, 4.8), sharex=True, sharey="row", squeeze=False)
    nodes = np.linspace(0.0, 1.0, design.signals.nodes.shape[1])
    for number in range(shown):
        axes[0, number].plot(nodes, np.asarray(design.signals.nodes[number]), color="C2")
        axes[0, number].set_title(f"signal {number + 1}", fontsize=9)
        low = axes[1, number]
        low.plot(u, pascal * design.untouched[number], color="0.7", label="recall, untouched")
        low.plot(u, pascal * design.p_sig[number], color="C0", label="recall, designed")
        low.plot(u, pascal * design.gain * unit * design.target[number], "--", color="C3", label="target")
        low.set_xlabel("u")
    axes[0, 0].set_ylabel("designed I(u)")
    axes[1, 0].set_ylabel("stress (Pa)")
    axes[1, 0].legend(fontsize=6, frameon=False)
    figure.suptitle(f"{title}: F {design.before:.3f} -> {design.fidelity:.3f}", fontsize=10)
    save(path, figure)
