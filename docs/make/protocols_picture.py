"""The picture of docs/protocols.md: u and shear against time, of every protocol of the shelf.

python docs/make/protocols_picture.py
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from gmem_jax.experiment import protocols
from gmem_jax.files.protocols import ready_protocols
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stage import Drive

OUTPUT = Path(__file__).parents[1] / "protocols.png"
SETS = {"first": 0.35, "second": 0.65, "xy": 0.35, "z": 0.65}  # where the bump of a set is
COLOURS = {"xy": "C3", "z": "C0"}
ROLES = {"write": "C3", "read": "C0"}


def shape(drive: Drive, at: np.ndarray) -> np.ndarray:
    """What a drive applies: its own waveform, or a bump for that of a set."""
    if drive.periods:
        curve = np.sin(2.0 * np.pi * drive.periods * at)
    elif drive.fixed:
        samples = np.concatenate([[0.0], np.asarray(drive.waveform, float), [0.0]])
        curve = np.interp(at, np.linspace(0.0, 1.0, len(samples)), samples)
    else:
        x = (at - SETS[str(drive.waveform)]) / 0.5
        curve = np.where(np.abs(x) < 0.5, np.cos(np.pi * x), 0.0)
    return np.asarray(drive.amplitude * curve)


def draw(axis: Axes, name: str, protocol: Protocol) -> None:
    """One protocol: u in grey, shear by channel below it."""
    drives = [abs(drive.amplitude) for stage in protocol for drive in stage.drives]
    time, largest = 0.0, max(drives)
    for stage in protocol:
        at = np.linspace(0.0, 1.0, 200)
        u = stage.ends[0] + (stage.ends[1] - stage.ends[0]) * at
        moments = time + stage.length * at
        axis.plot(moments, u, color="0.3", lw=1.6)
        if stage.role in ROLES:
            axis.axvspan(moments[0], moments[-1], color=ROLES[stage.role], alpha=0.12, lw=0)
        for drive in stage.drives:
            curve = -0.75 + 0.45 * shape(drive, at if stage.timed else u) / largest
            axis.plot(moments, curve, color=COLOURS[drive.channel], lw=1.2)
        time += stage.length
    axis.axhline(-0.75, color="0.8", lw=0.6, zorder=0)
    axis.set(xlim=(0, time), ylim=(-1.3, 1.15), yticks=(0, 1))
    axis.set_title(name, fontsize=9, family="monospace")
    axis.tick_params(labelsize=7)
    axis.spines[["top", "right"]].set_visible(False)


def main() -> None:
    """Draw it."""
    figure, axes = plt.subplots(4, 3, figsize=(10.5, 9.0))
    for axis, build in zip(axes.flat, ready_protocols().values(), strict=True):
        named = ("first", "second") if build is protocols.write_read_write_read else ("xy",)
        if build in (protocols.two_channels, protocols.two_channels_in_turn):
            named = ("xy", "z")
        draw(axis, build.__name__, build().with_sets(named))
    for axis in axes[-1]:
        axis.set_xlabel("time / $t_0$", fontsize=8)
    figure.tight_layout()
    figure.savefig(OUTPUT, dpi=100)


if __name__ == "__main__":
    main()
