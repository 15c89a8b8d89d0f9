"""Contacts of spheres with the rigid, frictionless walls of the box."""

import jax
import jax.numpy as jnp

from gmem_jax.physics.contact.normal import hertz
from gmem_jax.physics.pytree import Scalar
from gmem_jax.physics.state import Box


def wall_forces(
    position: jax.Array, velocity: jax.Array, box: Box, stiffness: Scalar, damping_time: Scalar
) -> tuple[jax.Array, jax.Array]:
    """Damped Hertz contact of unit spheres with the planes; damping acts on the velocity relative to the plane.

    Args:
        position: sphere centres, [S, 3, B].
        velocity: sphere-centre velocities, [S, 3, B].
        box: the planes.
        stiffness: k_w, in E R^0.5.
        damping_time: gamma_w / k_w, in t_c.

    Returns:
        The forces from the lower and from the upper planes (both as magnitudes >= 0), each [S, 3, B]; 0 along periodic
        axes, which have no walls.
    """
    lower = 1.0 - (position - box.lower)
    upper = 1.0 - (box.upper - position)
    forces = []
    for overlap, closing in ((lower, box.lower_velocity - velocity), (upper, velocity - box.upper_velocity)):
        touching = (overlap > 0.0) & ~box.images if any(box.periodic) else overlap > 0.0
        forces.append(hertz(jnp.where(touching, overlap, 1.0), closing, touching, stiffness, damping_time))
    return forces[0], forces[1]
