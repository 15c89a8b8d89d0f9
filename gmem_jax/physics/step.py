"""One time step, and `march`, a step for each of some boxes: the definition of the physics, in plain JAX."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.physics.boundary import WALLS, boundary_of
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.kinematics import Kinematics, Unequal, kinematics
from gmem_jax.physics.contact.normal import hertz
from gmem_jax.physics.contact.wall import PLANES, wall_forces, wall_friction, wall_kinematics
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import Pairs, image_shifts, sphere_offsets
from gmem_jax.physics.pytree import Scalar, pytree, typed
from gmem_jax.physics.rotation import cross, matrix, turn
from gmem_jax.physics.state import Box, Grains, State

_Histories = tuple[Any, Any]  # of the candidates, and of the walls


@pytree
@dataclass(frozen=True)
class System:
    """What does not change during a run.

    Attributes:
        clump: the grain.
        friction: the friction law.
        pairs: candidate contacts.
        material: the elastic solid.
        gravity: acceleration of every grain along -z, in R / t_c^2; scalar or [B], None for none.
        wall_mu: friction coefficient of the walls; scalar or [B], None for smooth walls.
    """

    clump: Clump
    friction: FrictionLaw
    pairs: Pairs
    material: Material = Material()
    gravity: Scalar | None = None
    wall_mu: Scalar | None = None

    def weighed(self, acceleration: jax.Array) -> jax.Array:
        """Accelerations [N, 3, B] with that of gravity."""
        if self.gravity is None:
            return acceleration
        return acceleration.at[:, 2].add(-jnp.asarray(self.gravity, acceleration.dtype))


def _fusion_barrier(alive: jax.Array, function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)`, compiled apart from its surroundings.

    XLA's CPU backend fuses a producer into each of its consumers and so computes shared intermediates of the contact
    law many times over; it drops `lax.optimization_barrier` before it fuses. A conditional that is always taken
    (`alive` is true, which the compiler cannot know) makes it store them once, and halves the time of a step.
    """
    shapes = jax.eval_shape(function, *args)
    return lax.cond(alive, function, lambda *_: jax.tree.map(jnp.zeros_like, shapes), *args)


def mark_varying(tree: Any) -> Any:
    """`tree`, each leaf marked as varying over the axes of a `jax.shard_map` that any of them varies over.

    What the devices have in common becomes part of what they have not, in a loop at the latest; said at the start, the
    types of the loop agree. Outside a shard_map there is nothing to mark.
    """

    def axes(leaf: Any) -> frozenset[str]:
        kind: Any = jax.typeof(leaf)
        varying: frozenset[str] = kind.vma if hasattr(kind, "vma") else kind.manual_axis_type.varying  # jax < 0.11
        return varying

    union = frozenset[str]().union(*map(axes, jax.tree.leaves(tree)))
    return jax.tree.map(lambda leaf: lax.pcast(leaf, tuple(sorted(union - axes(leaf))), to="varying"), tree)


def sphere_table(clump: Clump, grains: Grains, cell: Box | None = None) -> tuple[jax.Array, jax.Array]:
    """Sphere centres, their velocities and spins as rows [S, 9, B], and the arms from the grain centre [N, K, 3, B].

    Grains of a periodic `cell` move with it, and beside that with their own velocities.
    """
    arms = sphere_offsets(grains.quaternion, clump)
    spin = jnp.broadcast_to(grains.spin[:, None], arms.shape)
    velocity = grains.velocity if cell is None else grains.velocity + _flow(cell, grains.position)
    rows = jnp.concatenate([grains.position[:, None] + arms, velocity[:, None] + cross(spin, arms), spin], axis=2)
    return rows.reshape(-1, *rows.shape[2:]), arms


def relative_motion(
    system: System, table: jax.Array, cell: Box | None = None
) -> tuple[jax.Array, jax.Array, jax.Array, Unequal | None]:
    """Separations and relative velocities of candidates, and the sums of their spins, [P, 3, B] each.

    Of the second sphere of a pair it is the listed image in the periodic `cell` that counts. Where spheres differ in
    radius, what is to be known of that.
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


def _strain_rate(cell: Box) -> jax.Array:
    """Of each axis, [3, B], in 1 / t_c; 0 where there are walls."""
    return jnp.where(cell.images, cell.growth / cell.lengths, 0.0)


def _flow(cell: Box, position: jax.Array) -> jax.Array:
    """Velocity of the affine motion of a periodic cell at positions [..., 3, B]; 0 along axes with walls."""
    return jnp.where(cell.images, cell.lower_velocity, 0.0) + _strain_rate(cell) * (position - cell.lower)


def _carried(before: Box, cell: Box, position: jax.Array, displacement: jax.Array) -> jax.Array:
    """Positions [N, 3, B] after a step in which a periodic cell went from `before` to `cell`.

    They keep their places in the cell, but for a displacement of their own, which is stretched on its way by half.
    """
    stretch = jnp.where(cell.images, cell.lengths / before.lengths, 1.0)
    moved = cell.lower + stretch * (position - before.lower)
    return jnp.where(cell.images, moved, position) + 0.5 * (1.0 + stretch) * displacement


def contact_loads(
    system: System,
    separation: jax.Array,
    velocity: jax.Array,
    spin_sum: jax.Array,
    unequal: Unequal | None,
    history: Any,
    dt: jax.Array,
) -> tuple[Kinematics, jax.Array, jax.Array, Any]:
    """The law of a contact: of every candidate its kinematics, the repulsive normal force [P, 1, B], the tangential
    force on the first sphere [P, 3, B], and the new history.

    Args:
        system: the system.
        separation: see `relative_motion`.
        velocity: likewise.
        spin_sum: likewise.
        unequal: likewise.
        history: the friction law's.
        dt: time step; 0 leaves the histories as they are.
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
    """Force and tangential torque (about the sphere centre) on every sphere from the others.

    Args:
        system: the system.
        table: rows of `sphere_table`, [S, 9, B].
        history: the friction law's.
        dt: time step.
        alive: see `_fusion_barrier`.
        cell: the box, if any of its axes is periodic.

    Returns:
        [S, 6, B], the new history, and the forces that act through the faces of the cell, [3, B] (None without it).
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
    system: System, grains: Grains, histories: _Histories, box: Box, dt: jax.Array, alive: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array | None, _Histories, jax.Array | None]:
    """Of every sphere: its arm [N, K, 3, B], contact forces and torques [S, 6, B], wall forces, friction of walls as of
    contacts (None if they are smooth); the new histories; and forces through the faces of a periodic cell.
    """
    material, cell = system.material, box if any(box.periodic) else None
    with jax.named_scope("spheres"):
        table, arms = _fusion_barrier(
            alive, lambda grains, cell: sphere_table(system.clump, grains, cell), grains, cell
        )
    with jax.named_scope("contacts"):
        contact, history, through = contact_forces(system, table, histories[0], dt, alive, cell)
    with jax.named_scope("walls"):
        solid, radii = (material.wall_stiffness, material.normal_damping), system.clump.sphere_radii(len(table))
        lower, upper = wall_forces(table[:, :3], table[:, 3:6], box, *solid, radii)
        rubbing, walls = None, histories[1]
        if system.wall_mu is not None:
            _, force, torque, walls = _fusion_barrier(alive, wall_loads, system, grains, box, lower, upper, walls, dt)
            rows = jnp.concatenate([force, torque], axis=1)
            rubbing = jnp.sum(rows.reshape(-1, PLANES, *rows.shape[1:]), axis=1)
    return arms, contact, lower, upper, rubbing, (history, walls), through


def wall_loads(
    system: System, grains: Grains, box: Box, lower: jax.Array, upper: jax.Array, history: Any, dt: jax.Array
) -> tuple[Kinematics, jax.Array, jax.Array, Any]:
    """The friction of walls that have it: the kinematics of all spheres at all planes, in the order of
    `wall_kinematics`; tangential forces on the spheres and their torques about their centres, [6 S, 3, B] each; and the
    new history.

    The walls of a box that is periodic along other axes are strained with it: under each grain as its centre is.

    Args:
        system: the system, with a `wall_mu`.
        grains: the grains.
        box: the planes.
        lower: normal forces of the lower planes on spheres, [S, 3, B], of `wall_forces`.
        upper: of the upper ones.
        history: `State.wall_history`.
        dt: time step; 0 leaves the history as it is.
    """
    table, _ = sphere_table(system.clump, grains)
    kin = wall_kinematics(table, box, system.material, dt, system.clump.sphere_radii(len(table)))
    force, history = wall_friction(system.friction, system.wall_mu, kin, lower, upper, history)  # type: ignore[arg-type]
    return kin, force, kin.arm * cross(kin.normal, force), history


def _forces(
    system: System, grains: Grains, histories: _Histories, box: Box, dt: jax.Array, alive: jax.Array
) -> tuple[jax.Array, jax.Array, _Histories, jax.Array]:
    """Total force and torque on every grain [N, 3, B], the new histories, and the wall forces [2, 3, B].

    Wall forces are normal ones. In the place of a periodic axis' two walls stand its sections; see `section_force`.
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
    vanish at rest. Velocities v are those beside the cell's own motion.

    Args:
        clump: the grain.
        grains: the grains.
        force: of the contacts on them, without the friction of walls, [N, 3, B].
        through: of those contacts that go through the face of the axis, [3, B].
        cell: the periodic box.
    """
    place = grains.position - cell.lower
    return through + jnp.sum(force * place + clump.masses * grains.velocity**2, axis=0) / cell.lengths


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

    In a periodic box velocities are those beside its affine motion, v = dx/dt - (dL/dt / L) x, and
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
        state, slowing = replace(state, cell=_wide(box, state.replicas)), drag + _strain_rate(box)
    histories = state.history, state.wall_history
    force, torque, (history, wall_history), walls = _forces(system, midway, histories, box, dt, alive)
    # Of drag on the velocities at the end, which are found with it.
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
    """Raise if a state does not remember the walls of a system that has friction there, or remembers those of none.

    Raises:
        ValueError: saying what to do.
    """
    if (system.wall_mu is None) != (state.wall_history is None):
        raise ValueError("wall_mu and State.wall_history belong together: make the state by `start`, of this system")


def march(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """One step for each of the boxes: what a backend does with a bin.

    Args:
        system: the system.
        state: at time t.
        boxes: the walls at t + dt, t + 2 dt, ...; leaves [steps, 3, B].
        dt: scalar or [B].
        drag: see `step`.

    Returns:
        The state after them, and the sum over the steps of the wall pressures, [3, B].

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
    """Grains at rest at `position` [N, 3, B], `quaternion` [N, 4, B], with blank histories and their accelerations."""
    still = jnp.zeros_like(position)
    grains = Grains(position, quaternion, still, still, still, still)
    replicas = position.shape[-1]
    history = system.friction.init(system.pairs.capacity, replicas, position.dtype)
    cell = _wide(box, replicas) if any(box.periodic) else None
    walls = wall_histories(system, replicas, len(position), position.dtype)
    return accelerate(system, State(grains, history, jnp.zeros(replicas, jnp.int32), None, cell, walls), box)


def wall_histories(system: System, replicas: int, grains: int, dtype: Any = float) -> Any:
    """Blank histories of all spheres of some grains at all planes; None where walls are smooth."""
    if system.wall_mu is None:
        return None
    return system.friction.init(PLANES * grains * system.clump.spheres, replicas, dtype)


def accelerate(system: System, state: State, box: Box) -> State:
    """Recompute the accelerations of `state`, its histories untouched (after velocities or the law were changed)."""
    zero, alive = jnp.zeros(()), system.pairs.reach > 0.0
    histories = state.history, state.wall_history
    force, torque, _, _ = _forces(typed(system), state.grains, histories, box, zero, alive)
    slowing = 0.0 if state.cell is None else _strain_rate(box) * state.grains.velocity
    grains = replace(
        state.grains,
        acceleration=system.weighed(force / system.clump.masses - slowing),
        spin_rate=_angular_acceleration(system.clump, state.grains, torque),
    )
    return replace(state, grains=grains)
