"""Warnings: a recall is doubtful where the model or the drive leaves the range in which it was tested.

The numbers stand and bits of `Status` say why not to believe them blindly. Each threshold has its reason beside it;
what was measured on either side of it is in docs/trust.md. All follows from the samples and the parameters, so that
traced runs are judged too.
"""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.experiment.analysis import compare
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.physics.contact.friction import CoulombLaw, SpringLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.state import Status
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.stage import BINS, bin_centres

DEEPEST = 0.2  # R; there a contact's radius is 0.32 R, which Hertz takes for small. delta0 = 0.05 makes 0.14 to 0.17
FASTEST = 5e-3  # inertial number; at 7e-3 (t0 = 180) F is 0.20 to 0.33 on packs that have 0.66 to 0.88 when not hurried
RINGING = 0.03  # what averaging over T_1 may add to F: at N = 325 up to 0.005 at t0 = 1.8e3, 0.06 to 0.15 at 360
LARGEST_SHEAR = 0.25  # of delta0; gains are 1.3 to 1.7 times as large at 0.2, 2.0 to 2.5 at 0.3
LARGEST_WAVEFORM = 2.0  # |I|; the paper's signals have 1 at most, and gains are per gamma0
LARGEST_FRICTION = 10.0  # no pair of materials has it; beyond it G changes by 4 % up to 1e6: hardly a contact slides
FASTEST_GRAIN = 3.5  # wall speeds, for a quarter of a stage; 1.3 to 2.8 in sound runs with friction; 14 if too long
NOISE = {  # of p_sig, over mean pressure and root of steps; measured, in these units: 1 to 3 (H), 15 (M1); 0.4 to 1.2
    "double": 5.0 * 2.0**-53,
    "mixed": 0.01 * 2.0**-24,
}
OVERSHOOT = 1.5  # times 1 / dt; damping drives from 2 on, and with the springs of 27 grains from 1.4 to 1.6 on
LARGEST_NOISE = 0.01  # of p_sig; G and F then change in the third digit
LARGEST_STIFFNESS = 1.5  # of friction, in k_n: d f_n / dp is 1.5 k_n sqrt(p), which Mindlin's contacts do not reach


def validity(
    experiment: Experiment, stages: Mapping[str, Sample], raw: jax.Array, windowed: jax.Array, noise: jax.Array
) -> jax.Array:
    """The bits of `Status` that leave the numbers as they are, but for NOT_AT_REST.

    Args:
        experiment: what was run.
        stages: samples of its stages by name, leading axis bins; one replica where all are alike.
        raw: F.
        windowed: F averaged over the ringing period.
        noise: round-off in p_sig over its size, of every signal, [S]; see `rounding`.

    Returns:
        int32, broadcasts against [S + 1].
    """
    deepest = _most([sample.largest_overlap for sample in stages.values()])
    fastest = _most([sample.inertial_number for sample in stages.values()])
    waveform = _largest_waveforms(experiment)
    shear = jnp.asarray(experiment.gamma0) * waveform / experiment.compression
    law: Any = experiment.friction
    friction = jnp.asarray(law.mu if isinstance(law, CoulombLaw) else 0.0)
    of_walls = jnp.asarray(0.0 if experiment.wall_mu is None else experiment.wall_mu)
    rubs = friction > 0.0 if isinstance(law, CoulombLaw) else not isinstance(law, Frictionless)
    least = -_most([-(sample.pressure[:, 0] + sample.pressure[:, 1]) for sample in stages.values()])
    stiffness = jnp.asarray(law.stiffness if isinstance(law, SpringLaw) else 0.0)
    found = {
        Status.DEEP_OVERLAP: deepest > DEEPEST,
        Status.NOT_QUASI_STATIC: fastest > FASTEST,
        Status.RINGING: jnp.any(windowed - raw > RINGING),
        Status.SHEAR_BEYOND_COMPRESSION: shear > LARGEST_SHEAR,
        Status.LARGE_WAVEFORM: waveform > LARGEST_WAVEFORM,
        Status.LARGE_FRICTION: (friction > LARGEST_FRICTION) | (of_walls > LARGEST_FRICTION),
        Status.LARGE_STIFFNESS: stiffness > LARGEST_STIFFNESS * experiment.material.normal_stiffness,
        Status.RESTLESS: (rubs & (_restlessness(experiment, stages) > FASTEST_GRAIN))
        | (rubs & (_dashpots(experiment, stages, deepest) * experiment.timing.dt > OVERSHOOT))
        | (jnp.asarray(experiment.drag) * experiment.timing.dt > OVERSHOOT),
        Status.ROUNDED: jnp.concatenate([jnp.zeros(1, bool), noise >= LARGEST_NOISE]),
        Status.UNLOADED: least <= 0.0,
        Status.OTHER_COMPRESSION: ~jnp.isclose(jnp.asarray(experiment.compression), experiment.pack.delta0),
    }
    bits = jnp.zeros(1, jnp.int32)
    for bit, doubtful in found.items():
        bits |= jnp.where(doubtful, int(bit), 0).astype(jnp.int32)
    return bits


def _most(values: list[jax.Array]) -> jax.Array:
    """The largest of each replica over all bins of all stages, [B]."""
    largest = jnp.asarray(-jnp.inf)
    for value in values:
        largest = jnp.maximum(largest, jnp.max(value, axis=0))
    return largest


def compression_speed(experiment: Experiment) -> jax.Array:
    """Of a wall of the x axis while the pack is compressed, in R / t_c; scalar or [S + 1]."""
    pack, shrinks = experiment.pack, 1.0 - jnp.sqrt(1.0 - jnp.asarray(experiment.compression))
    return 0.5 * (pack.upper - pack.lower)[0] * shrinks / experiment.t0


def _restlessness(experiment: Experiment, stages: Mapping[str, Sample]) -> jax.Array:
    """Speed of the fastest grain over that of the walls, for a quarter of a stage in which these move, [B]."""
    slow, bin_time = compression_speed(experiment), jnp.asarray(experiment.t0) / BINS
    moving = [stage.name for stage in experiment.protocol if stage.moves]
    found = [jnp.zeros((1, 1))]
    for sample in (stages[name] for name in moving if name in stages and len(stages[name].filling) > 1):
        walls = 0.5 * jnp.max(jnp.abs(jnp.diff(sample.lengths, axis=0)), axis=(0, 1)) / bin_time
        found.append(jnp.quantile(sample.largest_speed, 0.75, axis=0) / jnp.maximum(walls, slow)[None])
    return _most(found)


def _dashpots(experiment: Experiment, stages: Mapping[str, Sample], deepest: jax.Array) -> jax.Array:
    """How fast friction's dashpots slow the turning (or the moving) of a grain among others, in 1 / t_c, [B].

    The fastest mode: neighbours move oppositely, so that twice the speed is at each of its contacts; a dashpot acts
    along two of three axes, and turns a grain by the arm of its outer radius.
    """
    law: Any = experiment.friction
    if not isinstance(law, SpringLaw):
        return jnp.zeros(1)
    clump, contacts = experiment.pack.clump, _most([sample.contacts for sample in stages.values()])
    spring = law.stiffness * (1.0 if isinstance(law, Hooke) else jnp.sqrt(jnp.maximum(deepest, 0.0)))
    inverse = jnp.maximum(1.0 / clump.mass, 0.25 * clump.diameter**2 / jnp.min(clump.inertia))
    inverse = inverse if clump.sizes is None else inverse / clump.smallest**3
    rate: jax.Array = 2.0 * (2.0 / 3.0) * contacts * spring * law.damping_time * inverse
    return rate


def rounding(experiment: Experiment, stages: Mapping[str, Sample]) -> jax.Array:
    """What round-off makes of p_sig, root mean square over the bins of each signal, [S], in E.

    Each replica is rounded in its own way in every step, and its contacts remember that. What was measured (the
    difference from a larger gamma0's p_sig, scaled) does not depend on the number of grains.
    """
    readout = stages[experiment.protocol.reads[0]].pressure[:, :2, 1:]
    steps = experiment.steps_per_bin * experiment.protocol.bins
    noise: jax.Array = lax.stop_gradient(NOISE[experiment.precision] * steps**0.5 * jnp.mean(readout, axis=(0, 1)))
    return noise


def readable(experiment: Experiment, p_sig: jax.Array) -> jax.Array:
    """Root mean square of recalled signals [S, 256], or of the part of them that is like J, whichever is less: [S].

    Of several reads and channels the smallest. Infinite for waveforms that are zero: nothing is read there.
    """
    scale = jnp.asarray(experiment.scale)

    def of_one(p_sig: jax.Array, integral: jax.Array) -> jax.Array:
        template = scale / jnp.max(scale) * integral
        alike = compare(p_sig, template, 1.0).gain * template
        size = jnp.sqrt(jnp.min(jnp.mean(jnp.stack([p_sig, alike]) ** 2, axis=-1), axis=0))
        return jnp.where(jnp.any(integral, axis=-1), size, jnp.inf)

    curves = (each.reshape(-1, *each.shape[-2:]) for each in (p_sig, experiment.integral()))
    sizes = [of_one(*each) for each in zip(*curves, strict=True)]
    return lax.stop_gradient(functools.reduce(jnp.minimum, sizes))


def _largest_waveforms(experiment: Experiment) -> jax.Array:
    """max |I| of every replica as it is applied, [S + 1], the zero signal's first."""
    own = {
        name: jnp.max(jnp.abs(one.shear(jnp.asarray(bin_centres()))), axis=0) for name, one in experiment.sets.items()
    }
    drives = [drive for stage in experiment.protocol for drive in stage.own]
    largest = [abs(drive.amplitude) * own[str(drive.waveform)] for drive in drives]
    return jnp.concatenate([jnp.zeros(1), functools.reduce(jnp.maximum, largest)])
