"""What a run costs in steps and memory, and how many signals may run together."""

import jax
import jax.numpy as jnp

from gmem_jax.experiment.experiment import Experiment

COPIES = 4  # copies of a replica's arrays at one time: arguments, results and scratch of a call, and one to spare
GRAIN_BYTES = 800  # bytes for the numbers of a grain and of its spheres
LARGEST_BATCH = 63  # signals; with the zero signal they fill whole vectors on every CPU


def replica_bins(experiment: Experiment, batch: int) -> int:
    """Bins times replicas of a run: the prefix has one replica, and each batch one more than signals."""
    before, after = (sum(stage.bins for stage in some) for some in experiment.phases)
    count = experiment.signals.count
    return before + after * (count + -(-count // batch))


def steps_of_grains(experiment: Experiment, batch: int) -> int:
    """Steps of a run times grains times replicas."""
    return experiment.pack.grains * experiment.timing.steps * replica_bins(experiment, batch)


def _replica_bytes(experiment: Experiment) -> int:
    """Memory that a replica takes while it runs, in bytes."""
    pairs = experiment.pack.pairs
    history = jax.eval_shape(lambda: experiment.friction.init(pairs.capacity, 1, jnp.zeros(()).dtype))
    contacts: int = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(history))
    return COPIES * (contacts + GRAIN_BYTES * experiment.pack.grains)


def run_bytes(experiment: Experiment, batch: int) -> int:
    """Memory that a run of `batch` signals and the zero signal will take, in bytes."""
    return (batch + 1) * _replica_bytes(experiment)


def default_batch(experiment: Experiment, available: int) -> int:
    """Number of signals that may run together in half of the `available` bytes; at most `LARGEST_BATCH`."""
    return int(max(1, min(LARGEST_BATCH, 0.5 * available / _replica_bytes(experiment) - 1)))
