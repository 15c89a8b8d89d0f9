"""The geometry and motion of sphere-sphere contacts, computed once for all laws."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gmem_jax.physics.pytree import Scalar, pytree
from gmem_jax.physics.rotation import cross, dot


class Unequal(NamedTuple):
    """Further data of the candidates, needed where spheres differ in radius.

    Attributes:
        first: R_i, [P, 1, 1], in R.
        second: R_j, likewise.
        spin_difference: spin of the grain of sphere j minus that of i, [P, 3, B], in 1 / t_c.
    """

    first: jax.Array
    second: jax.Array
    spin_difference: jax.Array


@pytree
@dataclass(frozen=True)
class Kinematics:
    """Relative position and motion at P candidate contacts; vectors are [P, 3, B], scalars [P, 1, B].

    The contact point is at x_i + n (R_i - p/2). Relative velocities are those of surface j minus surface i there. For
    contacts with walls see `gmem_jax.physics.contact.wall.wall_kinematics`.

    Attributes:
        normal: unit vector n from sphere i to sphere j.
        overlap: p = R_i + R_j - r_ij, in R; negative if the spheres are apart.
        safe_overlap: the overlap where the spheres touch and 1 elsewhere, so that roots and their derivatives stay
            finite.
        touching: whether p > 0.
        closing: dp/dt, in R / t_c.
        sliding: tangential relative velocity, in R / t_c.
        twist: half the sum of the two spins along n: the rate at which the contact turns about n, in 1 / t_c.
        arm: distance of the contact point from the centre of sphere i, R_i - p/2, in R.
        dt: the time step, in t_c; scalar or [B].
        other_arm: the same for sphere j, R_j - p/2; None if all radii are 1, since it is then `arm`.
        radius: harmonic mean of the two radii, 2 R_i R_j / (R_i + R_j), [P, 1, 1], in R; None if all radii are 1.
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
    other_arm: jax.Array | None = None
    radius: jax.Array | None = None

    @property
    def root(self) -> jax.Array:
        """sqrt(radius p), [P, 1, B]: the stiffness of a Mindlin contact is proportional to it.

        It is the radius of the contact area times sqrt(2), and sqrt(p) between spheres of radius 1. Where the spheres
        do not touch, `safe_overlap` stands for p.
        """
        return jnp.sqrt(self.safe_overlap if self.radius is None else self.radius * self.safe_overlap)


def kinematics(
    separation: jax.Array,
    velocity: jax.Array,
    spin_sum: jax.Array,
    valid: jax.Array,
    dt: jax.Array,
    unequal: Unequal | None = None,
) -> Kinematics:
    """Kinematics of candidate contacts.

    Args:
        separation: x_j - x_i of the sphere centres, [P, 3, B].
        velocity: the same difference of the sphere-centre velocities.
        spin_sum: sum of the two grains' spins.
        valid: [P], False for padding.
        dt: time step.
        unequal: given where spheres differ in radius; if None, all are of radius 1.
    """
    reach = 2.0 if unequal is None else unequal.first + unequal.second
    # Padding pairs sphere 0 with itself; twice the distance of touching keeps them apart and every root finite.
    square = jnp.where(valid[:, None, None], dot(separation, separation), 4.0 * reach**2)
    distance = jnp.sqrt(square)
    normal = separation / distance
    overlap = reach - distance
    other_arm = radius = None
    if unequal is None:
        arm = 1.0 - 0.5 * overlap
        relative = velocity - cross(spin_sum, arm * normal)
    else:
        arm, other_arm = unequal.first - 0.5 * overlap, unequal.second - 0.5 * overlap
        radius = 2.0 * unequal.first * unequal.second / reach
        # arm spin_i + other_arm spin_j; the arms are half the distance, minus and plus (R_j - R_i) / 2.
        relative = velocity - cross(spin_sum, 0.5 * separation)
        relative -= cross(unequal.spin_difference, 0.5 * (unequal.second - unequal.first) * normal)
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
        other_arm=other_arm,
        radius=radius,
    )


def transport(force: jax.Array, kin: Kinematics, spinning: Scalar = 1.0) -> jax.Array:
    """Carry a tangential force along with its contact through one step.

    Tumbling: the force is projected on the new tangent plane, and its magnitude restored. Spinning: it is turned about
    n by spinning * twist * dt (Cayley map, right to third order in the angle of one step).

    Args:
        force: the force of the step before, [P, 3, B].
        kin: geometry and motion of the contacts now.
        spinning: 1, or 0 to leave out the turn about n; scalar or [B].
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
