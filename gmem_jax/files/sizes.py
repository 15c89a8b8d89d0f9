"""Estimates of the time and disk space of runs, and texts for such amounts."""

from gmem_jax.experiment.experiment import Experiment
from gmem_jax.files.schemas import STAGE
from gmem_jax.simulation.stage import BINS

FIXED_BYTES = 1.0e5  # names, units and scales of a file; measured 1.0e5 on recalls, 2.5e5 on packs with their stages
PACK_BYTES = 408.0  # bytes per grain, with its candidates, measured on packs of 325 to 10,240
FRAME_BYTES = 460.0  # bytes per grain and configuration, with its ten contacts
STEP_SECONDS = {"native": (2e-7, 8e-8), "jax": (2e-6, 1.3e-6)}  # s per grain-step on two cores: one replica, several
_SAMPLE = 8 * sum(3 if "axis" in array.shape else 1 for array in STAGE.values())  # bytes per replica and bin


def sample_bytes(experiment: Experiment, *, written: bool = False) -> float:
    """Bytes of the samples of all stages in memory, or of the stages that are `written` to a file."""
    before, after = (
        sum(stage.bins for stage in stages if stage.recorded or not written) for stages in experiment.phases
    )
    return _SAMPLE * (before + after * experiment.replicas)


def recall_bytes(experiment: Experiment, frames: int = 0) -> float:
    """Approximate bytes of the file of a recall with `frames` configurations."""
    parts = len(experiment.readings.reads) * len(experiment.readings.channels)
    curves = 3 * 8 * BINS * parts * experiment.signals.count
    samples = sample_bytes(experiment, written=True)
    return FIXED_BYTES + curves + samples + FRAME_BYTES * experiment.pack.grains * frames


def pack_bytes(grains: int, frames: int = 0) -> float:
    """Approximate bytes of the file of a pack with `frames` configurations of its preparation."""
    return 2.5 * FIXED_BYTES + (PACK_BYTES + FRAME_BYTES * frames) * grains


def in_bytes(count: float) -> str:
    """A number of bytes as a text, like "1.2 GB"."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"


def in_time(seconds: float) -> str:
    """A duration as a text, like "some 3 min"."""
    units = (("days", 86400.0), ("hours", 3600.0), ("min", 60.0), ("s", 1.0))
    name, unit = next(pair for pair in units if seconds >= 2.0 * pair[1] or pair[1] == 1.0)
    return f"some {max(1, round(seconds / unit))} {name}"
