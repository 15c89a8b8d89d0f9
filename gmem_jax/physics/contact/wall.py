"""Contacts of spheres with the walls of the box: normal forces, and friction if the walls have it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.kinematics import Kinematics
from gmem_jax.physics.contact.normal import hertz
from gmem_jax.physics.material import Material
from gmem_jax.physics.pytree import Scalar, with_field
from gmem_jax.physics.rotation import cross, dot
from gmem_jax.physics.state import Box

PLANES = 6  # of a box: a sphere's contacts with them are the lower planes of x, y and z, then the upper ones


def wall_forces(
    table: jax.Array, box: Box, material: Material, damping_time: Scalar, radii: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Damped Hertz contact of spheres with the planes; damping acts on the velocity relative to the plane.

    Args:
        table: centres and velocities of the spheres, and more, [S, 6 or more, B].
        box: the planes.
        material: the elastic solid.
        damping_time: gamma_w / k_w, in t_c.
        radii: radii of the spheres, [S], in R; None where all are 1.

    Returns:
        The forces from the lower and from the upper planes (both as magnitudes >= 0), each [S, 3, B]; 0 along periodic
        axes, which have no walls.
    """
    position, velocity, stiffness = table[:, :3], table[:, 3:6], material.wall_stiffness
    wide = None if radii is None else radii[:, None, None]
    reach = 1.0 if wide is None else wide
    lower = reach - (position - box.lower)
    upper = reach - (box.upper - position)
    forces = []
    for overlap, closing in ((lower, box.lower_velocity - velocity), (upper, velocity - box.upper_velocity)):
        touching = (overlap > 0.0) & ~box.images if any(box.periodic) else overlap > 0.0
        forces.append(hertz(jnp.where(touching, overlap, 1.0), closing, touching, stiffness, damping_time, wide))
    return forces[0], forces[1]


def wall_kinematics(
    table: jax.Array, box: Box, material: Material, dt: jax.Array, radii: jax.Array | None = None
) -> Kinematics:
    """Kinematics of all spheres with all planes of the box, [6 S, ..., B]: row 6 s + w is sphere s at plane w.

    "Sphere j" of a `Kinematics` is the plane: it moves along its normal alone, and does not turn. The arm is R, as in
    LAMMPS' walls (between spheres it is R - p / 2 here). The radius is 8 wall_rigidity^2 R: two equal spheres of this
    radius have a contact as stiff as the contact with the wall at the same overlap. At the wall the effective radius is
    R instead of R / 2, and one body is compliant instead of two (docs/physics.md).

    Args:
        table: centres, velocities and spins of the spheres, [S, 9, B]; velocities relative to a periodic box's motion.
        box: the planes; those of periodic axes touch nothing.
        material: the elastic solid.
        dt: time step, scalar or [B].
        radii: radii of the spheres, [S], in R; None where all are 1.
    """
    planes = np.concatenate([-np.eye(3), np.eye(3)])

    def rows(of_planes: jax.Array) -> jax.Array:
        """[S, 6, ..., B] as [6 S, ..., B]."""
        return of_planes.reshape(-1, *of_planes.shape[2:])

    def both(lower: jax.Array, upper: jax.Array) -> jax.Array:
        """Numbers [S, 3, B] for the lower and the upper planes as [6 S, 1, B]."""
        return rows(jnp.concatenate([lower, upper], axis=1)[:, :, None])

    count, replicas = len(table), table.shape[-1]
    position, velocity, spin = table[:, :3], table[:, 3:6], table[:, 6:]
    normal = rows(jnp.broadcast_to(planes[None, :, :, None], (count, PLANES, 3, replicas)))
    velocity, spin = (jnp.repeat(vector, PLANES, axis=0) for vector in (velocity, spin))
    reach = 1.0 if radii is None else radii[:, None, None]
    overlap = both(reach - (position - box.lower), reach - (box.upper - position))
    closing = both(box.lower_velocity - table[:, 3:6], table[:, 3:6] - box.upper_velocity)
    touching = overlap > 0.0
    if any(box.periodic):
        touching &= np.tile(~np.asarray(box.periodic), 2 * count)[:, None, None]
    wide = 1.0 if radii is None else jnp.repeat(radii, PLANES)[:, None, None]
    arm = jnp.broadcast_to(wide, overlap.shape)
    along = dot(velocity, normal)
    return Kinematics(
        normal=normal,
        overlap=overlap,
        safe_overlap=jnp.where(touching, overlap, 1.0),
        touching=touching,
        closing=closing,
        sliding=along * normal - velocity - arm * cross(spin, normal),
        twist=0.5 * dot(spin, normal),
        arm=arm,
        dt=dt,
        radius=jnp.asarray((material.wall_stiffness / material.normal_stiffness) ** 2 * wide),
    )


def wall_friction(
    law: FrictionLaw, mu: Scalar, kin: Kinematics, lower: jax.Array, upper: jax.Array, history: Any
) -> tuple[jax.Array, Any]:
    """The tangential forces of the walls on spheres, by the friction law of the grains with the walls' coefficient.

    Args:
        law: friction law of contacts between grains; it has a coefficient `mu`.
        mu: friction coefficient of the walls, scalar or [B].
        kin: result of `wall_kinematics`.
        lower: normal forces of the lower planes, [S, 3, B], of `wall_forces`.
        upper: normal forces of the upper planes, likewise.
        history: what the law remembers of each sphere at each plane, leaves [6 S, ..., B].

    Returns:
        The forces [6 S, 3, B], and the new history.
    """
    normal_force = jnp.concatenate([lower, upper], axis=1).reshape(kin.overlap.shape)
    return with_field(law, "mu", mu)(kin, normal_force, history)
