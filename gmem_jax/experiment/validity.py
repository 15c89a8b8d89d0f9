"""Warnings: a recall is doubtful where the model or the drive leaves the range in which it was tested.

The numbers stay as they are; bits of `Status` say why they are doubtful. Each threshold has its reason beside it;
docs/trust.md has the measurements on either side. The bits follow from samples and parameters only, so that traced
runs have them too.
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

DEEPEST = 0.2  # R; the radius of such a contact is 0.32 R, and Hertz assumes it small. delta0 = 0.05 makes 0.14 to 0.17
FASTEST = 5e-3  # inertial number; at 7e-3 (t0 = 180) F is 0.20 to 0.33 on packs with 0.66 to 0.88 in slow drives
RINGING = 0.03  # largest gain of F by averaging over T_1: at N = 325 up to 0.005 at t0 = 1.8e3, 0.06 to 0.15 at 360
LARGEST_SHEAR = 0.25  # of delta0; gains are 1.3 to 1.7 times as large at 0.2, 2.0 to 2.5 at 0.3
LARGEST_WAVEFORM = 2.0  # |I|; the paper's signals have 1 at most, and gains are per gamma0
LARGEST_FRICTION = 10.0  # no pair of materials has more; from there to 1e6 G changes by 4 %, as hardly a contact slides
FASTEST_GRAIN = 3.5  # wall speeds, for a quarter of a stage; 1.3 to 2.8 in sound runs with friction, 14 if dt is long
NOISE = {  # round-off in p_sig over mean pressure and root of steps; measured factors: 1 to 3 (H), 15 (M1); 0.4 to 1.2
    "double": 5.0 * 2.0**-53,
    "mixed": 0.01 * 2.0**-24,
}
OVERSHOOT = 1.5  # damping rate times dt; damping drives grains above 2; with the springs of 27 grains, above 1.4 to 1.6
LARGEST_NOISE = 0.01  # round-off over p_sig; G and F then change in the third digit
LARGEST_STIFFNESS = 1.5  # tangential stiffness in k_n: the normal one is 1.5 k_n sqrt(p), and Mindlin's is below it


def validity(
    experiment: Experiment, stages: Mapping[str, Sample], raw: jax.Array, windowed: jax.Array, noise: jax.Array
) -> jax.Array:
    """The bits of `Status` that only warn, except NOT_AT_REST.

    Args:
        experiment: the experiment that was run.
        stages: samples of its stages by name, leading axis bins; one replica where all are alike.
        raw: F.
        windowed: F after a running mean over the ringing period.
        noise: round-off in p_sig over the size of p_sig, for every signal, [S]; see `rounding` and `readable`.

    Returns:
        The bits, int32, of a shape that broadcasts against [S + 1].
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
    """The largest value of each replica over all bins of all stages, [B]."""
    largest = jnp.asarray(-jnp.inf)
    for value in values:
        largest = jnp.maximum(largest, jnp.max(value, axis=0))
    return largest


def compression_speed(experiment: Experiment) -> jax.Array:
    """Speed of a wall across the x axis during a compression, in R / t_c; scalar or [S + 1]."""
    pack, shrinks = experiment.pack, 1.0 - jnp.sqrt(1.0 - jnp.asarray(experiment.compression))
    return 0.5 * (pack.upper - pack.lower)[0] * shrinks / experiment.t0


def _restlessness(experiment: Experiment, stages: Mapping[str, Sample]) -> jax.Array:
    """Speed of the fastest grain over the walls', exceeded in a quarter of a stage in which the walls move, [B]."""
    slow, bin_time = compression_speed(experiment), jnp.asarray(experiment.t0) / BINS
    moving = [stage.name for stage in experiment.protocol if stage.moves]
    found = [jnp.zeros((1, 1))]
    for sample in (stages[name] for name in moving if name in stages and len(stages[name].filling) > 1):
        walls = 0.5 * jnp.max(jnp.abs(jnp.diff(sample.lengths, axis=0)), axis=(0, 1)) / bin_time
        found.append(jnp.quantile(sample.largest_speed, 0.75, axis=0) / jnp.maximum(walls, slow)[None])
    return _most(found)


def _dashpots(experiment: Experiment, stages: Mapping[str, Sample], deepest: jax.Array) -> jax.Array:
    """Rate at which the dashpots of friction damp the rotation (or translation) of a grain, in 1 / t_c, [B].

    It is that of the fastest mode: neighbours move oppositely, so that the relative speed at each contact is twice a
    grain's. A dashpot acts along two of three axes, and on rotation with the outer radius of the grain as its arm.
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
    """Estimate of the round-off in p_sig, root mean square over the bins of each signal, [S], in E.

    Each replica is rounded in its own way in every step, and its contacts remember that. The round-off was measured as
    the difference from the p_sig of a larger gamma0, scaled; it does not depend on the number of grains.
    """
    readout = stages[experiment.protocol.reads[0]].pressure[:, :2, 1:]
    steps = experiment.steps_per_bin * experiment.protocol.bins
    noise: jax.Array = lax.stop_gradient(NOISE[experiment.precision] * steps**0.5 * jnp.mean(readout, axis=(0, 1)))
    return noise


def readable(experiment: Experiment, p_sig: jax.Array) -> jax.Array:
    """Root mean square of each p_sig [S, 256] or of its projection on J, whichever is less, [S].

    With several reads and channels it is the smallest of them. It is infinite for a waveform that is zero, since
    nothing is read there.
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
    """max |I| of every replica with the amplitudes of the stages, [S + 1]; the zero signal comes first."""
    own = {
        name: jnp.max(jnp.abs(one.shear(jnp.asarray(bin_centres()))), axis=0) for name, one in experiment.sets.items()
    }
    drives = [drive for stage in experiment.protocol for drive in stage.own]
    largest = [abs(drive.amplitude) * own[str(drive.waveform)] for drive in drives]
    return jnp.concatenate([jnp.zeros(1), functools.reduce(jnp.maximum, largest)])
