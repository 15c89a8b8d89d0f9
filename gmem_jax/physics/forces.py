"""Forces and torques on grains by contacts and walls, and the stress on sections of a periodic cell."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.physics.contact.kinematics import Kinematics, Unequal, kinematics
from gmem_jax.physics.contact.normal import hertz
from gmem_jax.physics.contact.wall import PLANES, wall_forces, wall_friction, wall_kinematics
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.pairs import image_shifts, sphere_offsets
from gmem_jax.physics.rotation import cross
from gmem_jax.physics.state import Box, Grains
from gmem_jax.physics.system import System

Histories = tuple[Any, Any]  # those of the candidate contacts, and those of contacts with walls


def _fusion_barrier(alive: jax.Array, function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)`, compiled apart from its surroundings.

    XLA's CPU backend fuses a producer into each of its consumers and so computes shared intermediates of the contact
    law many times over; it drops `lax.optimization_barrier` before it fuses. A conditional that is always taken
    (`alive` is true, which the compiler cannot know) makes it store them once, and halves the time of a step.
    """
    shapes = jax.eval_shape(function, *args)
    return lax.cond(alive, function, lambda *_: jax.tree.map(jnp.zeros_like, shapes), *args)


def sphere_table(clump: Clump, grains: Grains, cell: Box | None = None) -> tuple[jax.Array, jax.Array]:
    """Sphere centres, their velocities and spins as rows [S, 9, B], and the arms from the grain centre [N, K, 3, B].

    In a periodic `cell`, `grains.velocity` is relative to its affine motion; the velocities in the table contain both.
    """
    arms = sphere_offsets(grains.quaternion, clump)
    spin = jnp.broadcast_to(grains.spin[:, None], arms.shape)
    velocity = grains.velocity if cell is None else grains.velocity + _flow(cell, grains.position)
    rows = jnp.concatenate([grains.position[:, None] + arms, velocity[:, None] + cross(spin, arms), spin], axis=2)
    return rows.reshape(-1, *rows.shape[2:]), arms


def relative_motion(
    system: System, table: jax.Array, cell: Box | None = None
) -> tuple[jax.Array, jax.Array, jax.Array, Unequal | None]:
    """Separations and relative velocities of candidates, sums of their spins, [P, 3, B] each; and `Unequal` or None.

    In a periodic `cell` the second sphere of a pair is its listed image. `Unequal` is None if all radii are 1.
    """
    pairs, radii = system.pairs, system.clump.sphere_radii(len(table))
    one, other = table[pairs.first], table[pairs.second]
    difference = other[:, :6] - one[:, :6]
    separation, velocity, spin_sum = difference[:, :3], difference[:, 3:], other[:, 6:] + one[:, 6:]
    if cell is not None:
        separation += image_shifts(pairs, cell.lengths)
        velocity += image_shifts(pairs, cell.growth)
    if radii is None:
        return separation, velocity, spin_sum, None
    first, second = (radii[side][:, None, None] for side in (pairs.first, pairs.second))
    return separation, velocity, spin_sum, Unequal(first, second, other[:, 6:] - one[:, 6:])


def strain_rate(cell: Box) -> jax.Array:
    """Rate of strain of a periodic cell along each axis, [3, B], in 1 / t_c; 0 along axes with walls."""
    return jnp.where(cell.images, cell.growth / cell.lengths, 0.0)


def _flow(cell: Box, position: jax.Array) -> jax.Array:
    """Velocity of the affine motion of a periodic cell at positions [..., 3, B]; 0 along axes with walls."""
    return jnp.where(cell.images, cell.lower_velocity, 0.0) + strain_rate(cell) * (position - cell.lower)


def contact_loads(
    system: System,
    separation: jax.Array,
    velocity: jax.Array,
    spin_sum: jax.Array,
    unequal: Unequal | None,
    history: Any,
    dt: jax.Array,
) -> tuple[Kinematics, jax.Array, jax.Array, Any]:
    """Forces at every candidate: its kinematics, the repulsive normal force [P, 1, B], the tangential force on the
    first sphere [P, 3, B], and the new history.

    Args:
        system: the system.
        separation: see `relative_motion`.
        velocity: likewise.
        spin_sum: likewise.
        unequal: likewise.
        history: the history of the friction law.
        dt: time step; with 0 the contacts slide no further.
    """
    kin = kinematics(separation, velocity, spin_sum, system.pairs.valid, dt, unequal)
    material = system.material
    normal_force = hertz(
        kin.safe_overlap, kin.closing, kin.touching, material.normal_stiffness, material.normal_damping, kin.radius
    )
    tangential, new_history = system.friction(kin, normal_force, history)
    return kin, normal_force, tangential, new_history


def contact_forces(
    system: System, table: jax.Array, history: Any, dt: jax.Array, alive: jax.Array, cell: Box | None = None
) -> tuple[jax.Array, Any, jax.Array | None]:
    """Force and tangential torque (about the sphere centre) on every sphere from its contacts with other spheres.

    Args:
        system: the system.
        table: rows of `sphere_table`, [S, 9, B].
        history: the history of the friction law.
        dt: time step.
        alive: see `_fusion_barrier`.
        cell: the box, if any of its axes is periodic.

    Returns:
        Forces and torques, [S, 6, B]; the new history; and the forces that act through the faces of the cell, [3, B]
        (None without a cell).
    """
    pairs = system.pairs

    def law(
        separation: jax.Array, velocity: jax.Array, spin_sum: jax.Array, unequal: Unequal | None, history: Any
    ) -> tuple[Any, ...]:
        motion = separation, velocity, spin_sum, unequal
        kin, normal_force, tangential, new_history = contact_loads(system, *motion, history, dt)
        force = tangential - normal_force * kin.normal
        # The surface force on j is opposite and so is its arm: the tangential torque is the same on both equal spheres.
        torque = kin.arm * cross(kin.normal, tangential)
        other = torque if kin.other_arm is None else kin.other_arm * cross(kin.normal, tangential)
        nothing = jnp.zeros((1, 6, force.shape[-1]), force.dtype)
        stack = [jnp.concatenate([force, torque], axis=1), jnp.concatenate([-force, other], axis=1), nothing]
        through = None if pairs.image is None else -jnp.sum(pairs.image[..., None] * force, axis=0)
        return jnp.concatenate(stack, axis=0), new_history, through

    motion = _fusion_barrier(alive, lambda table, cell: relative_motion(system, table, cell), table, cell)
    stack, history, through = _fusion_barrier(alive, law, *motion, history)
    return _fusion_barrier(alive, lambda rows: jnp.sum(rows[pairs.incidence], axis=1), stack), history, through


@jax.jit
def _loads(
    system: System, grains: Grains, histories: Histories, box: Box, dt: jax.Array, alive: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array | None, Histories, jax.Array | None]:
    """Arms of all spheres [N, K, 3, B]; forces and torques on them by contacts [S, 6, B]; normal forces by the lower
    and by the upper walls [S, 3, B]; forces and torques by the friction of walls [S, 6, B] (None if they are smooth);
    the new histories; and forces through the faces of a periodic cell [3, B] (None without a cell).
    """
    material, cell = system.material, box if any(box.periodic) else None
    with jax.named_scope("spheres"):
        table, arms = _fusion_barrier(
            alive, lambda grains, cell: sphere_table(system.clump, grains, cell), grains, cell
        )
    with jax.named_scope("contacts"):
        contact, history, through = contact_forces(system, table, histories[0], dt, alive, cell)
    with jax.named_scope("walls"):
        radii = system.clump.sphere_radii(len(table))
        lower, upper = wall_forces(table, box, material, material.normal_damping, radii)
        rubbing, walls = None, histories[1]
        if system.wall_mu is not None:
            _, force, torque, walls = _fusion_barrier(alive, wall_loads, system, grains, box, lower, upper, walls, dt)
            rows = jnp.concatenate([force, torque], axis=1)
            rubbing = jnp.sum(rows.reshape(-1, PLANES, *rows.shape[1:]), axis=1)
    return arms, contact, lower, upper, rubbing, (history, walls), through


def wall_loads(
    system: System, grains: Grains, box: Box, lower: jax.Array, upper: jax.Array, history: Any, dt: jax.Array
) -> tuple[Kinematics, jax.Array, jax.Array, Any]:
    """Friction of walls: the kinematics of all spheres at all planes, in the order of `wall_kinematics`; tangential
    forces on the spheres and their torques about the sphere centres, [6 S, 3, B] each; and the new history.

    If the box is periodic along other axes, its walls strain with it: the wall under a grain moves with the affine
    velocity at the centre of the grain.

    Args:
        system: the system, with a `wall_mu`.
        grains: the grains.
        box: the planes.
        lower: normal forces of the lower planes on spheres, [S, 3, B], of `wall_forces`.
        upper: normal forces of the upper planes, likewise.
        history: `State.wall_history`.
        dt: time step; 0 leaves the history as it is.
    """
    table, _ = sphere_table(system.clump, grains)
    kin = wall_kinematics(table, box, system.material, dt, system.clump.sphere_radii(len(table)))
    force, history = wall_friction(system.friction, system.wall_mu, kin, lower, upper, history)  # type: ignore[arg-type]
    return kin, force, kin.arm * cross(kin.normal, force), history


def forces_on_grains(
    system: System, grains: Grains, histories: Histories, box: Box, dt: jax.Array, alive: jax.Array
) -> tuple[jax.Array, jax.Array, Histories, jax.Array]:
    """Total force and torque on every grain [N, 3, B], the new histories, and the wall forces [2, 3, B].

    Wall forces are normal forces. Along a periodic axis both are the mean force across its sections; see
    `section_force`.
    """
    arms, contact, lower, upper, rubbing, histories, through = _loads(system, grains, histories, box, dt, alive)
    per_sphere = (*arms.shape[:2], -1, contact.shape[-1])
    force = (contact[:, :3] + lower - upper).reshape(per_sphere)
    torque = contact[:, 3:].reshape(per_sphere) + cross(arms, force)
    walls = jnp.stack([jnp.sum(lower, axis=0), jnp.sum(upper, axis=0)])
    on_grains = jnp.sum(force, axis=1)
    by_contacts = on_grains
    if rubbing is not None:
        friction = rubbing[:, :3].reshape(per_sphere)
        on_grains = on_grains + jnp.sum(friction, axis=1)
        torque = torque + rubbing[:, 3:].reshape(per_sphere) + cross(arms, friction)
    if through is not None:
        walls = jnp.where(box.images, section_force(system.clump, grains, by_contacts, through, box), walls)
    return on_grains, jnp.sum(torque, axis=1), histories, walls


def section_force(clump: Clump, grains: Grains, force: jax.Array, through: jax.Array, cell: Box) -> jax.Array:
    """The force that a periodic cell transmits across each axis, mean over all sections, [3, B].

    It is the virial V p = sum_c f l + sum_g m v^2 of the axis over its edge L. With branch vectors l between centres of
    grains, the sum over contacts is L times the force through the face, and sum_g x F over the forces on grains, which
    vanish at rest. Velocities v are relative to the affine motion of the cell.

    Args:
        clump: the grain.
        grains: the grains.
        force: total force of contacts on each grain, without the friction of walls, [N, 3, B].
        through: force of the contacts that act through the face of each axis, [3, B].
        cell: the periodic box.
    """
    place = grains.position - cell.lower
    return through + jnp.sum(force * place + clump.masses * grains.velocity**2, axis=0) / cell.lengths
