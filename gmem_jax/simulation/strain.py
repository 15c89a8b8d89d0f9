"""How the walls move: compression u(t), shear gamma(u) (paper, Sec. II)."""

from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.pytree import Scalar, pytree
from gmem_jax.physics.state import Box
from gmem_jax.simulation.protocol import Bin, Numbers


class Waveforms(Protocol):
    """What drives a shear: a pytree."""

    def shear(self, u: jax.Array) -> jax.Array:
        """I_s(u) of S waveforms, [..., S], for u of shape [...]."""
        ...


@pytree
@dataclass(frozen=True)
class StrainPath:
    """Prescribed walls: u runs linearly during a stage, the shear follows a waveform of u (of time, if u stands still).

    L_x = X (1 - share gamma), L_y = Y (1 + share gamma) with X, Y = L0 (1 - (1 - sqrt(1 - delta0)) u); z does not
    move. The box stays centred.

    Attributes:
        lower: lower planes at u = 0, [3, 1].
        upper: upper planes at u = 0, [3, 1].
        delta0: areal compression at u = 1, scalar or [B].
        gamma0: shear amplitude, scalar or [B].
        signals: the waveforms of the replicas, or None for no shear; replica 0 is always the zero signal.
        share: of gamma on each axis, scalar or [B]. The paper does not say; a half is this project's reading.
    """

    lower: jax.Array
    upper: jax.Array
    delta0: Scalar
    gamma0: Scalar = 0.0
    signals: Waveforms | None = None
    share: Scalar = 0.5

    def _shear(self, u: Numbers, sheared: Numbers) -> jax.Array:
        if self.signals is None:
            return jnp.zeros(1)
        u = jnp.asarray(u)
        shapes = jnp.concatenate([jnp.zeros((*u.shape, 1)), self.signals.shear(u)], axis=-1)
        own = shapes if u.ndim == 0 else jnp.diagonal(shapes)  # each replica at its own u, where t0 differs
        return jnp.where(sheared, self.gamma0 * own, 0.0)

    def box_at(self, row: Bin, time: jax.Array, duration: Numbers) -> Box:
        """Planes and their velocities, [3, B] (or [3, 1] without shear).

        Args:
            row: a bin of the stage; only what is common to the stage counts.
            time: since the start of the stage, in t_c.
            duration: of the stage, in t_c.
        """

        def lengths(moment: jax.Array) -> jax.Array:
            passed = moment / duration
            u = row.start + (row.stop - row.start) * passed
            squeeze = 1.0 - (1.0 - jnp.sqrt(1.0 - self.delta0)) * u
            sheared = self.share * self._shear(jnp.where(row.start == row.stop, passed, u), row.sheared)
            scale = jnp.stack(jnp.broadcast_arrays(squeeze * (1.0 - sheared), squeeze * (1.0 + sheared), jnp.ones(1)))
            return (self.upper - self.lower) * scale

        now, rate = jax.jvp(lengths, (time,), (jnp.ones_like(time),))
        centre = 0.5 * (self.lower + self.upper)
        return Box(centre - 0.5 * now, centre + 0.5 * now, -0.5 * rate, 0.5 * rate)


def smallest_box(lower: np.ndarray, upper: np.ndarray, delta0: float) -> np.ndarray:
    """Edge lengths of the box at u = 1, [3]."""
    shrink = np.sqrt(1.0 - delta0)
    lengths: np.ndarray = (np.asarray(upper) - np.asarray(lower)) * np.array([shrink, shrink, 1.0])
    return lengths
