"""Pictures. Matplotlib is imported on first use, and without a display."""

from pathlib import Path

import numpy as np

from gmem_jax.experiment.recall import Recall
from gmem_jax.files.storage import atomic
from gmem_jax.physics.material import Material


def recall_figure(path: Path, recall: Recall, delta0: float, gamma0: float, title: str) -> None:
    """p_sig of every signal and its scaled integral G E delta0 gamma0 J, like the paper's Fig. 6; at most 12 panels.

    Raises:
        OSError: if the path cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    unit = Material().modulus
    u, signals, integrals = (np.asarray(x) for x in (recall.u, recall.p_sig, recall.J))
    shown = min(len(signals), 12)
    columns = min(shown, 3)
    lines = -(-shown // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3.4 * columns, 2.5 * lines + 0.6), sharex=True, sharey=True, squeeze=False
    )
    for number, axis in enumerate(axes.flat):
        if number >= shown:
            axis.set_visible(False)
            continue
        axis.axhline(0.0, color="0.8", linewidth=0.8)
        axis.plot(u, unit * signals[number], color="C0", linewidth=1.2, label="recalled $p_{sig}$")
        scaled = float(recall.gain) * delta0 * gamma0 * integrals[number]
        axis.plot(u, unit * scaled, color="C3", linewidth=1.2, linestyle="--", label=r"$G E \delta_0 \gamma_0 J$")
        axis.set_title(f"signal {number + 1}", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("compression variable u")
    for axis in axes[:, 0]:
        axis.set_ylabel("stress (Pa)")
    axes[0, 0].legend(fontsize=7, frameon=False)
    figure.suptitle(f"{title}: G = {float(recall.gain):.3f}, F = {float(recall.fidelity):.3f}", fontsize=10)
    figure.tight_layout()
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)
    plt.close(figure)


def confusion_figure(path: Path, table: np.ndarray, title: str) -> None:
    """A confusion matrix [S, S]: word stored down, word read across, rows normalised.

    Raises:
        OSError: if the path cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

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
    figure.tight_layout()
    with atomic(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)
    plt.close(figure)
