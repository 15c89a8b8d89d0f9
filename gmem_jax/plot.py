"""Pictures. Matplotlib is imported on first use, and without a display."""

from pathlib import Path

import numpy as np

from gmem_jax.material import Material
from gmem_jax.memory import Recall
from gmem_jax.storage import atomic


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
