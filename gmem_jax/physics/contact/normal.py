"""The normal force: Hertz's elastic contact with viscous damping."""

import jax
import jax.numpy as jnp

from gmem_jax.physics.pytree import Scalar


def hertz(
    overlap: jax.Array,
    closing: jax.Array,
    touching: jax.Array,
    stiffness: Scalar,
    damping_time: Scalar,
    radius: jax.Array | None = None,
) -> jax.Array:
    """f_n = max(0, k p^1.5 + gamma p^0.5 dp/dt) with gamma = damping_time k (paper, Sec. II).

    Here k = stiffness radius^0.5.

    Args:
        overlap: p where touching, any positive number elsewhere, in R.
        closing: dp/dt, in R / t_c.
        touching: mask; the force is zero elsewhere.
        stiffness: k for radius 1, in E R^0.5.
        damping_time: gamma / k, in t_c.
        radius: radius of a sphere on a plane, or harmonic mean of the radii of two spheres, in R; None for 1.

    Returns:
        The repulsive force, in E R^2, in the shape of `overlap`.
    """
    force = stiffness * jnp.sqrt(overlap if radius is None else radius * overlap) * (overlap + damping_time * closing)
    return jnp.where(touching & (force > 0.0), force, 0.0)
