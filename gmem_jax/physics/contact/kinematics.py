"""The geometry and motion of sphere-sphere contacts, computed once for every law."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from gmem_jax.physics.pytree import Scalar, pytree
from gmem_jax.physics.rotation import cross, dot


@pytree
@dataclass(frozen=True)
class Kinematics:
    """Relative position and motion at P candidate contacts; [P, 3, B] vectors, [P, 1, B] scalars.

    The contact point is at x_i + n (R - p/2); "relative" means surface j minus surface i there.

    Attributes:
        normal: unit vector n from sphere i to sphere j.
        overlap: p = 2 R - r_ij; negative where the spheres are apart.
        safe_overlap: the overlap where they touch and 1 elsewhere, so that roots and their derivatives stay finite.
        touching: whether p > 0.
        closing: dp/dt.
        sliding: tangential relative velocity.
        twist: half the sum of the two spins along n, the rate at which the contact itself turns about n.
        arm: R - p/2.
        dt: the time step, scalar or [B].
    """

    normal: jax.Array
    overlap: jax.Array
    safe_overlap: jax.Array
    touching: jax.Array
    closing: jax.Array
    sliding: jax.Array
    twist: jax.Array
    arm: jax.Array
    dt: jax.Array


def kinematics(
    separation: jax.Array, velocity: jax.Array, spin_sum: jax.Array, valid: jax.Array, dt: jax.Array
) -> Kinematics:
    """Kinematics of candidate contacts between unit spheres.

    Args:
        separation: x_j - x_i of the sphere centres, [P, 3, B].
        velocity: the same difference of the sphere-centre velocities.
        spin_sum: sum of the two grains' spins.
        valid: [P], False for padding.
        dt: time step.
    """
    # Padding pairs sphere 0 with itself; a distance of 4 R keeps them apart and every root finite.
    square = jnp.where(valid[:, None, None], dot(separation, separation), 16.0)
    distance = jnp.sqrt(square)
    normal = separation / distance
    overlap = 2.0 - distance
    arm = 1.0 - 0.5 * overlap
    relative = velocity - cross(spin_sum, arm * normal)
    along = dot(relative, normal)
    touching = overlap > 0.0
    return Kinematics(
        normal=normal,
        overlap=overlap,
        safe_overlap=jnp.where(touching, overlap, 1.0),
        touching=touching,
        closing=-along,
        sliding=relative - along * normal,
        twist=0.5 * dot(spin_sum, normal),
        arm=arm,
        dt=dt,
    )


def transport(force: jax.Array, kin: Kinematics, spinning: Scalar = 1.0) -> jax.Array:
    """Carry a tangential force [P, 3, B] along with its contact through one step.

    Tumbling: project on the new tangent plane and restore the magnitude. Spinning: turn about n by twist * dt
    (Cayley map, right to third order in the angle of one step), times `spinning`: 1, or 0 to leave it out.
    """
    flat = force - dot(force, kin.normal) * kin.normal
    before, after = dot(force, force), dot(flat, flat)
    alive = after > 0.0
    stretch = jnp.where(alive, jnp.sqrt(jnp.where(alive, before, 1.0) / jnp.where(alive, after, 1.0)), 1.0)
    half = 0.5 * spinning * kin.twist * kin.dt
    shrink = 1.0 / (1.0 + half * half)
    cosine, sine = (1.0 - half * half) * shrink, 2.0 * half * shrink
    flat = stretch * flat
    return cosine * flat + sine * cross(kin.normal, flat)
