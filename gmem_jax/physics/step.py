"""One time step in plain JAX, and `march`, a step for each of several successive boxes."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.physics.boundary import WALLS, boundary_of
from gmem_jax.physics.contact.wall import PLANES
from gmem_jax.physics.forces import forces_on_grains, strain_rate
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.pytree import Scalar, typed
from gmem_jax.physics.rotation import cross, matrix, turn
from gmem_jax.physics.state import Box, Grains, State
from gmem_jax.physics.system import System


def mark_varying(tree: Any) -> Any:
    """`tree`, each leaf marked as varying over the axes of a `jax.shard_map` that any of them varies over.

    A loop mixes values that all devices share with values that differ between devices. Marked before the loop, the
    types of its carry are the same before and after a pass. Outside a shard_map there is nothing to mark.
    """

    def axes(leaf: Any) -> frozenset[str]:
        kind: Any = jax.typeof(leaf)
        varying: frozenset[str] = kind.vma if hasattr(kind, "vma") else kind.manual_axis_type.varying  # jax < 0.11
        return varying

    union = frozenset[str]().union(*map(axes, jax.tree.leaves(tree)))
    return jax.tree.map(lambda leaf: lax.pcast(leaf, tuple(sorted(union - axes(leaf))), to="varying"), tree)


def _carried(before: Box, cell: Box, position: jax.Array, displacement: jax.Array) -> jax.Array:
    """Positions [N, 3, B] after a step in which a periodic cell went from `before` to `cell`.

    Positions keep their fractions of the edges. Added to this are the grains' own displacements, multiplied by the mean
    of 1 and the stretch of the cell.
    """
    stretch = jnp.where(cell.images, cell.lengths / before.lengths, 1.0)
    moved = cell.lower + stretch * (position - before.lower)
    return jnp.where(cell.images, moved, position) + 0.5 * (1.0 + stretch) * displacement


def _angular_acceleration(clump: Clump, grains: Grains, torque: jax.Array, ahead: Scalar = 0.0) -> jax.Array:
    """d(spin)/dt at a time `ahead` of that of the spins: torque / I, with the gyroscopic term where moments differ."""
    if clump.isotropic:
        return torque / clump.scaled(clump.inertia[0], 5)
    rotation = matrix(grains.quaternion)
    inertia = clump.scaled(clump.inertia.reshape(3, -1), 5)
    body_spin = jnp.sum(rotation * grains.spin[:, :, None], axis=1)
    body_torque = jnp.sum(rotation * torque[:, :, None], axis=1)

    def rate(spin: jax.Array) -> jax.Array:
        return (body_torque - cross(spin, inertia * spin)) / inertia

    return jnp.sum(rotation * rate(body_spin + ahead * rate(body_spin))[:, None], axis=2)


def step(
    system: System, state: State, box: Box, dt: jax.Array, drag: Scalar, alive: jax.Array
) -> tuple[State, jax.Array]:
    """One velocity-Verlet step; forces use the velocities of its middle (docs/physics.md, "Time integration").

    In a periodic box velocities are relative to its affine motion, v = dx/dt - (dL/dt / L) x, and
    dv/dt = F / m - (dL/dt / L) v: Newton's equation for dx/dt as long as the edges L grow steadily (docs/physics.md,
    "Periodic boxes").

    Args:
        system: the system.
        state: at time t.
        box: the walls at t + dt.
        dt: scalar or [B].
        drag: rate of a viscous drag on velocities and spins, 1 / t_c; 0 for the physics of the paper.
        alive: any true scalar that the compiler cannot fold (see `_fusion_barrier`).

    Returns:
        The state at t + dt, and the forces on the lower and upper walls, [2, 3, B].
    """
    old = state.grains
    velocity = old.velocity + (0.5 * dt) * old.acceleration
    spin = old.spin + (0.5 * dt) * old.spin_rate
    midway = replace(
        old,
        position=old.position + dt * velocity,
        quaternion=turn(old.quaternion, dt * spin),
        velocity=velocity,
        spin=spin,
    )
    slowing = drag
    if state.cell is not None:
        midway = replace(midway, position=_carried(state.cell, box, old.position, dt * velocity))
        state, slowing = replace(state, cell=_wide(box, state.replicas)), drag + strain_rate(box)
    histories = state.history, state.wall_history
    force, torque, (history, wall_history), walls = forces_on_grains(system, midway, histories, box, dt, alive)
    # Drag acts on the velocities at the end of the step, so these equations are implicit; they are solved here.
    acceleration = system.weighed(force / system.clump.masses - slowing * velocity) / (1.0 + 0.5 * dt * slowing)
    turning = _angular_acceleration(system.clump, midway, torque, 0.5 * dt)
    spin_rate = (turning - drag * spin) / (1.0 + 0.5 * dt * drag)
    grains = replace(
        midway,
        velocity=velocity + (0.5 * dt) * acceleration,
        spin=spin + (0.5 * dt) * spin_rate,
        acceleration=acceleration,
        spin_rate=spin_rate,
    )
    return replace(state, grains=grains, history=history, wall_history=wall_history), walls


def wall_pressure(walls: jax.Array, box: Box) -> jax.Array:
    """(p_x, p_y, p_z) = (F_lower + F_upper) / (2 A) from wall forces [2, 3, B], [3, B], in E."""
    lengths = box.lengths
    area = jnp.prod(lengths, axis=0) / lengths
    return (walls[0] + walls[1]) / (2.0 * area)


def require_shapes(state: State, boxes: Box, **numbers: Any) -> None:
    """Raise if the walls of a `march`, or numbers that are scalars or [B], do not fit the replicas of `state`.

    Raises:
        ValueError: naming the first that does not.
    """
    replicas = state.replicas
    for name, number in numbers.items():
        if jnp.shape(number) not in ((), (1,), (replicas,)):
            raise ValueError(f"{name} must be a number or one for each of {replicas} replicas, got {jnp.shape(number)}")
    for name in ("lower", "upper", "lower_velocity", "upper_velocity"):
        walls = getattr(boxes, name)
        if jnp.shape(walls)[1:] not in ((3, 1), (3, replicas)) or len(walls) != len(boxes.lower):
            raise ValueError(f"boxes.{name} must be [steps, 3, {replicas}], got {jnp.shape(walls)}")
    known = WALLS if state.cell is None else state.cell.periodic
    if boxes.periodic != known:
        raise ValueError(f"the boxes are {boundary_of(boxes.periodic)}, and the state is one of {boundary_of(known)}")


def require_wall_history(system: System, state: State) -> None:
    """Raise if walls have friction and the state has no history of them, or the other way round.

    Raises:
        ValueError: saying what to do.
    """
    if (system.wall_mu is None) != (state.wall_history is None):
        raise ValueError("wall_mu and State.wall_history belong together: make the state by `start`, of this system")


def march(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """One step for each of the boxes. This is how a backend runs the steps of a bin.

    Args:
        system: the system.
        state: at time t.
        boxes: the walls at t + dt, t + 2 dt, ...; leaves [steps, 3, B].
        dt: scalar or [B].
        drag: see `step`.

    Returns:
        The state after all steps, and the sum of the wall pressures over the steps, [3, B].

    Raises:
        ValueError: if an argument does not fit the number of replicas.
    """
    own = {} if system.wall_mu is None else {"wall_mu": system.wall_mu}
    require_shapes(state, boxes, dt=dt, drag=drag, mass=system.clump.mass, **own)
    require_wall_history(system, state)
    numbers: tuple[jax.Array, jax.Array] = (jnp.asarray(dt), jnp.asarray(drag))
    system, state, boxes, numbers = mark_varying((system, state, boxes, numbers))

    def one_step(carry: tuple[State, jax.Array], xs: tuple[jax.Array, Box]) -> tuple[tuple[State, jax.Array], None]:
        state, total = carry
        index, box = xs
        state, walls = step(system, state, box, numbers[0], numbers[1], index >= 0)
        return (state, total + wall_pressure(walls, box)), None

    total = jnp.zeros_like(state.grains.position, shape=(3, state.replicas))
    count = jnp.arange(boxes.lower.shape[0])
    (state, total), _ = lax.scan(jax.checkpoint(one_step), (state, total), (count, boxes))
    return state, total


def _wide(box: Box, replicas: int) -> Box:
    """A box with one entry for each replica."""
    wide: Box = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (3, replicas)), box)
    return wide


def start(system: System, position: jax.Array, quaternion: jax.Array, box: Box) -> State:
    """Grains at rest at `position` [N, 3, B], `quaternion` [N, 4, B], with blank histories and with accelerations."""
    still = jnp.zeros_like(position)
    grains = Grains(position, quaternion, still, still, still, still)
    replicas = position.shape[-1]
    history = system.friction.init(system.pairs.capacity, replicas, position.dtype)
    cell = _wide(box, replicas) if any(box.periodic) else None
    walls = wall_histories(system, replicas, len(position), position.dtype)
    return accelerate(system, State(grains, history, jnp.zeros(replicas, jnp.int32), None, cell, walls), box)


def wall_histories(system: System, replicas: int, grains: int, dtype: Any = float) -> Any:
    """Blank histories of all spheres of `grains` grains at all planes; None where walls are smooth."""
    if system.wall_mu is None:
        return None
    return system.friction.init(PLANES * grains * system.clump.spheres, replicas, dtype)


def accelerate(system: System, state: State, box: Box) -> State:
    """Recompute the accelerations of `state`, its histories untouched (after velocities or the law were changed)."""
    zero, alive = jnp.zeros(()), system.pairs.reach > 0.0
    histories = state.history, state.wall_history
    force, torque, _, _ = forces_on_grains(typed(system), state.grains, histories, box, zero, alive)
    slowing = 0.0 if state.cell is None else strain_rate(box) * state.grains.velocity
    grains = replace(
        state.grains,
        acceleration=system.weighed(force / system.clump.masses - slowing),
        spin_rate=_angular_acceleration(system.clump, state.grains, torque),
    )
    return replace(state, grains=grains)
