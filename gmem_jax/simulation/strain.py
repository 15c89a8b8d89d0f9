"""The motion of the walls: compression u(t), waveforms on channels of shear (paper, Sec. II), pressure servo."""

from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.boundary import WALLS, PeriodicAxes
from gmem_jax.physics.pytree import Scalar, pytree, static
from gmem_jax.physics.state import Box, HeldWalls
from gmem_jax.simulation.channels import CHANNELS
from gmem_jax.simulation.stage import Bin, Lane, Numbers

COMPRESSIONS = "[1e-9, 0.5)"  # delta0 of a compression; a smaller one would be lost in round-off
SERVO_GAIN = 2.5e-4  # strain in a bin for a relative error of 1: stresses follow within some 20 bins, and do not ring
SERVO_STRAIN = 2.5e-4  # strain in a bin at most: some times that of a compression


class Waveforms(Protocol):
    """The waveforms of a shear: a pytree."""

    def shear(self, u: jax.Array) -> jax.Array:
        """I_s(u) of S waveforms, [..., S], for u of shape [...]."""
        ...


@pytree
@dataclass(frozen=True)
class Sine:
    """One waveform: sin(2 pi n u).

    Attributes:
        periods: n.
    """

    periods: Scalar

    def shear(self, u: jax.Array) -> jax.Array:
        """I(u), [..., 1]."""
        return jnp.sin(2.0 * jnp.pi * self.periods * u)[..., None]


@pytree
@dataclass(frozen=True)
class StrainPath:
    """Prescribed walls: u runs linearly during a stage; waveforms follow u or time.

    L_i = X_i (1 + 2 m_i share gamma), summed over the lanes, with X, Y = L0 (1 - (1 - sqrt(1 - delta0)) u), Z = L0, and
    m the mode of the lane's channel: L_x = X (1 - share gamma), L_y = Y (1 + share gamma) for "xy". The box stays
    centred.

    Attributes:
        lower: lower planes at u = 0, [3, 1].
        upper: upper planes at u = 0, [3, 1].
        delta0: areal compression at u = 1, scalar or [B].
        gamma0: shear amplitude, scalar or [B].
        waveforms: waveforms of each lane: one for all replicas, or one for each but replica 0, which has none.
        share: share of gamma on each axis, scalar or [B]. The paper does not say; a half is this project's reading.
        lanes: which waveforms are applied on which channel; the table of bins says when.
        periodic: the periodic axes of the box, whose edges are strained alike.
    """

    lower: jax.Array
    upper: jax.Array
    delta0: Scalar
    gamma0: Scalar = 0.0
    waveforms: tuple[Waveforms, ...] = ()
    share: Scalar = 0.5
    lanes: tuple[Lane, ...] = static(())
    periodic: PeriodicAxes = static(WALLS)

    def _shear(self, lane: int, at: jax.Array, amplitude: Numbers) -> jax.Array:
        """share gamma of one lane, [B] or [1]."""
        shapes = self.waveforms[lane].shear(at)
        if not self.lanes[lane].drive.fixed:
            shapes = jnp.concatenate([jnp.zeros((*at.shape, 1)), shapes], axis=-1)
        elif at.ndim:
            shapes = jnp.broadcast_to(shapes, (*at.shape, at.shape[-1]))
        own = shapes if at.ndim == 0 else jnp.diagonal(shapes)  # each replica at its own u, where t0 differs
        return self.share * jnp.where(jnp.asarray(amplitude) != 0.0, (amplitude * self.gamma0) * own, 0.0)

    def box_at(self, row: Bin, time: jax.Array, duration: Numbers) -> Box:
        """Planes and their velocities, [3, B] (or [3, 1] without shear).

        Args:
            row: any bin of the stage; its `number` does not matter.
            time: time since the start of the stage, in t_c.
            duration: duration of the stage, in t_c.
        """

        def lengths(moment: jax.Array) -> jax.Array:
            passed = moment / duration
            u = row.start + (row.stop - row.start) * passed
            at = jnp.asarray(jnp.where(row.timed, passed, u))
            squeeze = 1.0 - (1.0 - jnp.sqrt(1.0 - self.delta0)) * u
            strains = [self._shear(lane, at, amplitude) for lane, amplitude in enumerate(row.amplitudes)]
            scale = []
            for axis, base in enumerate((squeeze, squeeze, jnp.ones(1))):
                stretch: Scalar = 1.0
                for lane, strain in zip(self.lanes, strains, strict=True):
                    if part := 2.0 * CHANNELS[lane.channel].mode[axis]:
                        stretch = stretch + part * strain
                scale.append(base * stretch)
            return (self.upper - self.lower) * jnp.stack(jnp.broadcast_arrays(*scale))

        now, rate = jax.jvp(lengths, (time,), (jnp.ones_like(time),))
        centre = 0.5 * (self.lower + self.upper)
        return Box(centre - 0.5 * now, centre + 0.5 * now, -0.5 * rate, 0.5 * rate, self.periodic)


def stretched(box: Box, stretch: jax.Array, rate: Scalar = 0.0) -> Box:
    """A box with its edges multiplied by 1 + stretch, [3, B]; `rate` is d(stretch)/dt, in 1 / t_c."""
    lengths, growth = box.lengths, box.growth
    half = 0.5 * lengths * (1.0 + stretch)
    speed = 0.5 * (growth * (1.0 + stretch) + lengths * rate)
    centre = 0.5 * (box.lower + box.upper)
    return Box(centre - half, centre + half, -speed, speed, box.periodic)


def servo_rate(pressure: jax.Array, target: Scalar | jax.Array, gain: Scalar, fastest: Scalar) -> jax.Array:
    """Outward rate of a wall under a servo: `gain` times its relative excess of pressure, at most `fastest` either way.

    It moves the piston of a preparation in each block of steps, and walls held at a pressure in each bin.
    """
    return jnp.clip(gain * (pressure / target - 1.0), -fastest, fastest)


def servo_strain(servo: HeldWalls, target: jax.Array) -> jax.Array:
    """Strain of each axis in the next bin, [3, B], by which its pressure is brought to `target` [3, 1].

    The strain is 0 where the target is 0. Walls move outwards where the pressure is too large.
    """
    held = target > 0.0
    return jnp.where(held, servo_rate(servo.pressure, jnp.where(held, target, 1.0), SERVO_GAIN, SERVO_STRAIN), 0.0)


def smallest_box(lower: np.ndarray, upper: np.ndarray, delta0: float) -> np.ndarray:
    """Edge lengths of the box at u = 1, [3]."""
    shrink = np.sqrt(1.0 - delta0)
    lengths: np.ndarray = (np.asarray(upper) - np.asarray(lower)) * np.array([shrink, shrink, 1.0])
    return lengths
