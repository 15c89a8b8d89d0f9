"""Contacts of spheres with the rigid, frictionless walls of the box."""

import jax
import jax.numpy as jnp

from gmem_jax.physics.contact.normal import hertz
from gmem_jax.physics.pytree import Scalar
from gmem_jax.physics.state import Box


def wall_forces(
    position: jax.Array,
    velocity: jax.Array,
    box: Box,
    stiffness: Scalar,
    damping_time: Scalar,
    radii: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Damped Hertz contact of spheres with the planes; damping acts on the velocity relative to the plane.

    Args:
        position: sphere centres, [S, 3, B].
        velocity: sphere-centre velocities, [S, 3, B].
        box: the planes.
        stiffness: k_w of a sphere of radius 1, in E R^0.5.
        damping_time: gamma_w / k_w, in t_c.
        radii: of the spheres, [S], in R; None where all are 1.

    Returns:
        The forces from the lower and from the upper planes (both as magnitudes >= 0), each [S, 3, B]; 0 along periodic
        axes, which have no walls.
    """
    wide = None if radii is None else radii[:, None, None]
    reach = 1.0 if wide is None else wide
    lower = reach - (position - box.lower)
    upper = reach - (box.upper - position)
    forces = []
    for overlap, closing in ((lower, box.lower_velocity - velocity), (upper, velocity - box.upper_velocity)):
        touching = (overlap > 0.0) & ~box.images if any(box.periodic) else overlap > 0.0
        forces.append(hertz(jnp.where(touching, overlap, 1.0), closing, touching, stiffness, damping_time, wide))
    return forces[0], forces[1]
