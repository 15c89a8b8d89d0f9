"""What makes a recall doubtful though nothing broke: the model or the drive has left where it is known to hold.

The numbers stand and bits of `Status` say why not to believe them blindly. Each threshold has its reason beside it;
what was measured on either side of it is in docs/trust.md. All follows from the samples and the parameters, so that
traced runs are judged too.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.signals import BINS
from gmem_jax.physics.contact.friction import CoulombLaw
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.sample import Sample
from gmem_jax.physics.state import Status

DEEPEST = 0.2  # R; there a contact's radius is 0.32 R, which Hertz takes for small. delta0 = 0.05 makes 0.14 to 0.17
FASTEST = 5e-3  # inertial number; at 6e-3 (t0 = 180) F is 0.25 to 0.29 on packs that have 0.68 to 0.87 when not hurried
RINGING = 0.03  # what averaging over T_1 may add to F: at N = 325 up to 0.005 at t0 = 1.8e3, 0.04 to 0.08 at 360
LARGEST_SHEAR = 0.25  # of delta0; gains are 1.4 to 1.7 times as large at 0.2, 2.1 to 2.6 at 0.3; the paper ends at 0.1
LARGEST_WAVEFORM = 2.0  # |I|; the paper's signals have 1 at most, and gains are per gamma0
LARGEST_FRICTION = 10.0  # no pair of materials has it; beyond it G changes by 2 % up to 1e6: hardly a contact slides
LARGEST_STIFFNESS = 1.5  # of friction, in k_n: d f_n / dp is 1.5 k_n sqrt(p), which Mindlin's contacts do not reach


def doubts(experiment: Experiment, stages: Mapping[str, Sample], raw: jax.Array, windowed: jax.Array) -> jax.Array:
    """The bits of `Status` that leave the numbers as they are, but for NOT_AT_REST.

    Args:
        experiment: what was run.
        stages: samples of its stages by name, leading axis bins; one replica where all are alike.
        raw: F.
        windowed: F averaged over the ringing period.

    Returns:
        int32, broadcasts against [S + 1].
    """
    deepest = _most([sample.largest_overlap for sample in stages.values()])
    fastest = _most([sample.inertial_number for sample in stages.values()])
    waveform = _largest_waveforms(experiment)
    shear = jnp.asarray(experiment.gamma0) * waveform / experiment.compression
    law: Any = experiment.friction
    friction = jnp.asarray(law.mu if isinstance(law, CoulombLaw) else 0.0)
    stiffness = jnp.asarray(law.stiffness if isinstance(law, Hooke | MindlinRescaled | Mindlin) else 0.0)
    found = {
        Status.DEEP_OVERLAP: deepest > DEEPEST,
        Status.NOT_QUASI_STATIC: fastest > FASTEST,
        Status.RINGING: windowed - raw > RINGING,
        Status.SHEAR_BEYOND_COMPRESSION: shear > LARGEST_SHEAR,
        Status.LARGE_WAVEFORM: waveform > LARGEST_WAVEFORM,
        Status.LARGE_FRICTION: friction > LARGEST_FRICTION,
        Status.LARGE_STIFFNESS: stiffness > LARGEST_STIFFNESS * experiment.material.normal_stiffness,
        Status.OTHER_COMPRESSION: ~jnp.isclose(experiment.compression, experiment.pack.delta0),
    }
    bits = jnp.zeros(1, jnp.int32)
    for bit, doubtful in found.items():
        bits |= jnp.where(doubtful, int(bit), 0).astype(jnp.int32)
    return bits


def _most(values: list[jax.Array]) -> jax.Array:
    """The largest of each replica over all bins of all stages, [B]."""
    largest = jnp.asarray(0.0)
    for value in values:
        largest = jnp.maximum(largest, jnp.max(value, axis=0))
    return largest


def _largest_waveforms(experiment: Experiment) -> jax.Array:
    """max |I| of every replica, [S + 1], the zero signal's first."""
    values = experiment.signals.shear((jnp.arange(BINS) + 0.5) / BINS)
    return jnp.concatenate([jnp.zeros(1), jnp.max(jnp.abs(values), axis=0)])
