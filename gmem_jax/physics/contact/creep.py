"""Creep: the elastic tangential forces of contacts relax with time, as in viscoelastic grains."""

from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from gmem_jax.physics.pytree import Scalar


@runtime_checkable
class RelaxingLaw(Protocol):
    """A friction law that can say what a history becomes when its elastic forces relax."""

    def relaxed(self, history: Any, factor: jax.Array) -> Any:
        """The history whose elastic force is `factor` [B] times as large."""
        ...


def relaxation(rate: Scalar, fades: Scalar | None, begun: jax.Array, ended: jax.Array) -> jax.Array:
    """The factor by which an elastic force f changes between two times of a stage, where df/dt = -r(t) f.

    Args:
        rate: r at the beginning of the stage, 1 / t_c; scalar or [B].
        fades: time tau after which the rate falls as 1 / t, in t_c: r(t) = rate / (1 + t / tau), so that forces fall as
            (1 + t / tau)^(-rate tau), a logarithm of time while they fall little. None for a constant rate, that of a
            Maxwell solid.
        begun: time since the stage began, in t_c.
        ended: later time.

    Returns:
        The factor, scalar or [B].
    """
    if fades is None:
        return jnp.exp(-rate * (ended - begun))
    # tau log((1 + ended / tau) / (1 + begun / tau)), without differences of numbers that are nearly equal at large tau
    slowed = (ended - begun) / (1.0 + begun / fades)
    return jnp.exp(-rate * slowed * _log_over(slowed / fades))


def _log_over(x: jax.Array) -> jax.Array:
    """log(1 + x) / x for x >= 0, whose value and derivatives keep their digits at small x."""
    small = x < 1e-4
    near, far = jnp.where(small, x, 0.0), jnp.where(small, 1.0, x)
    series = 1.0 - near * (1 / 2 - near * (1 / 3 - near * (1 / 4 - near / 5)))
    return jnp.where(small, series, jnp.log1p(far) / far)
