"""One time step and `advance`, the primitive that moves time: the definition of the physics, in plain JAX."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.experiment import checkpoint
from gmem_jax.experiment.protocol import Motion
from gmem_jax.physics.contact.friction import FrictionLaw, largest_overlap
from gmem_jax.physics.contact.kinematics import kinematics
from gmem_jax.physics.contact.normal import hertz
from gmem_jax.physics.contact.wall import wall_forces
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import Pairs, slack, sphere_centres, sphere_offsets
from gmem_jax.physics.rotation import cross, dot, matrix, turn
from gmem_jax.physics.state import Box, Grains, Scalar, State, Status


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class System:
    """What does not change during a run.

    Attributes:
        clump: the grain.
        friction: the friction law.
        pairs: candidate contacts.
        material: the elastic solid.
    """

    clump: Clump
    friction: FrictionLaw
    pairs: Pairs
    material: Material = field(default=Material(), metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Sample:
    """What is recorded of one bin of steps; a leading time axis is added by `advance`.

    Attributes:
        pressure: (p_x, p_y, p_z), mean of the two opposite walls at their instantaneous area, averaged over the
            steps of the bin, [3, B], in E.
        lengths: box edges at the end of the bin, [3, B], in R.
        kinetic_energy: at the end of the bin, translation and rotation, [B], in E R^3.
        largest_speed: at the end of the bin, [B], in R / t_c.
        coordination: Z, touching grain pairs per grain times two, rattlers included, walls not, [B].
        contacts: touching sphere pairs per grain times two, [B].
        filling: phi, volume of the grains over that of the box, [B].
        largest_overlap: deepest sphere-sphere contact at the end of the bin, [B], in R.
        inertial_number: I = (strain rate of the x axis) sqrt(m / (D p)), p the mean of p_x and p_y, [B]; 0 without p.
    """

    pressure: jax.Array
    lengths: jax.Array
    kinetic_energy: jax.Array
    largest_speed: jax.Array
    coordination: jax.Array
    contacts: jax.Array
    filling: jax.Array
    largest_overlap: jax.Array
    inertial_number: jax.Array


def _apart(alive: jax.Array, function: Callable[..., Any], *args: Any) -> Any:
    """`function(*args)`, compiled apart from its surroundings.

    XLA's CPU backend fuses a producer into each of its consumers and so computes shared intermediates of the contact
    law many times over; it drops `lax.optimization_barrier` before it fuses. A conditional that is always taken
    (`alive` is true, which the compiler cannot know) makes it store them once, and halves the time of a step.
    """
    shapes = jax.eval_shape(function, *args)
    return lax.cond(alive, function, lambda *_: jax.tree.map(jnp.zeros_like, shapes), *args)


def together(tree: Any) -> Any:
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


def _sphere_table(clump: Clump, grains: Grains) -> tuple[jax.Array, jax.Array]:
    """Sphere centres, their velocities and spins as rows [S, 9, B], and the arms from the grain centre [N, K, 3, B]."""
    arms = sphere_offsets(grains.quaternion, clump)
    spin = jnp.broadcast_to(grains.spin[:, None], arms.shape)
    rows = jnp.concatenate(
        [grains.position[:, None] + arms, grains.velocity[:, None] + cross(spin, arms), spin], axis=2
    )
    return rows.reshape(-1, *rows.shape[2:]), arms


def contact_forces(
    system: System, table: jax.Array, history: Any, dt: jax.Array, alive: jax.Array
) -> tuple[jax.Array, Any]:
    """Force and tangential torque (about the sphere centre) on every sphere from the others.

    Args:
        system: the system.
        table: rows of `_sphere_table`, [S, 9, B].
        history: the friction law's.
        dt: time step.
        alive: see `_apart`.

    Returns:
        [S, 6, B], and the new history.
    """
    pairs, material = system.pairs, system.material

    def gather(table: jax.Array) -> tuple[jax.Array, ...]:
        one, other = table[pairs.first], table[pairs.second]
        difference = other[:, :6] - one[:, :6]
        return difference[:, :3], difference[:, 3:], other[:, 6:] + one[:, 6:]

    def law(separation: jax.Array, velocity: jax.Array, spin_sum: jax.Array, history: Any) -> tuple[jax.Array, Any]:
        kin = kinematics(separation, velocity, spin_sum, pairs.valid, dt)
        normal_force = hertz(
            kin.safe_overlap, kin.closing, kin.touching, material.normal_stiffness, material.normal_damping
        )
        tangential, new_history = system.friction(kin, normal_force, history)
        force = tangential - normal_force * kin.normal
        # The surface force on j is opposite and so is its arm: the tangential torque is the same on both.
        torque = kin.arm * cross(kin.normal, tangential)
        nothing = jnp.zeros((1, 6, force.shape[-1]), force.dtype)
        stack = [jnp.concatenate([force, torque], axis=1), jnp.concatenate([-force, torque], axis=1), nothing]
        return jnp.concatenate(stack, axis=0), new_history

    stack, history = _apart(alive, law, *_apart(alive, gather, table), history)
    return _apart(alive, lambda rows: jnp.sum(rows[pairs.incidence], axis=1), stack), history


def _forces(
    system: System, grains: Grains, history: Any, box: Box, dt: jax.Array, alive: jax.Array
) -> tuple[jax.Array, jax.Array, Any, jax.Array]:
    """Total force and torque on every grain [N, 3, B], the new history, and the wall forces [2, 3, B]."""
    material = system.material
    table, arms = _apart(alive, lambda grains: _sphere_table(system.clump, grains), grains)
    contact, history = contact_forces(system, table, history, dt, alive)
    lower, upper = wall_forces(table[:, :3], table[:, 3:6], box, material.wall_stiffness, material.normal_damping)
    per_sphere = (*arms.shape[:2], -1, contact.shape[-1])
    force = (contact[:, :3] + lower - upper).reshape(per_sphere)
    torque = contact[:, 3:].reshape(per_sphere) + cross(arms, force)
    walls = jnp.stack([jnp.sum(lower, axis=0), jnp.sum(upper, axis=0)])
    return jnp.sum(force, axis=1), jnp.sum(torque, axis=1), history, walls


def _angular_acceleration(clump: Clump, grains: Grains, torque: jax.Array) -> jax.Array:
    """d(spin)/dt: torque / I, with the gyroscopic term for grains whose moments differ."""
    if clump.isotropic:
        return torque / clump.inertia[0]
    rotation = matrix(grains.quaternion)
    inertia = clump.inertia.reshape(3, -1)
    body_spin = jnp.sum(rotation * grains.spin[:, :, None], axis=1)
    body_torque = jnp.sum(rotation * torque[:, :, None], axis=1)
    body_rate = (body_torque - cross(body_spin, inertia * body_spin)) / inertia
    return jnp.sum(rotation * body_rate[:, None], axis=2)


def step(
    system: System, state: State, box: Box, dt: jax.Array, drag: Scalar, alive: jax.Array
) -> tuple[State, jax.Array]:
    """One velocity-Verlet step (spec: forces use velocities predicted to the end of the step).

    Args:
        system: the system.
        state: at time t.
        box: the walls at t + dt.
        dt: scalar or [B].
        drag: rate of a viscous drag on velocities and spins, 1 / t_c; 0 for the physics of the paper.
        alive: any true scalar that the compiler cannot fold (see `_apart`).

    Returns:
        The state at t + dt, and the forces on the lower and upper walls, [2, 3, B].
    """
    old = state.grains
    half_velocity = old.velocity + (0.5 * dt) * old.acceleration
    half_spin = old.spin + (0.5 * dt) * old.spin_rate
    predicted = Grains(
        position=old.position + dt * half_velocity,
        quaternion=turn(old.quaternion, dt * half_spin),
        velocity=old.velocity + dt * old.acceleration,
        spin=old.spin + dt * old.spin_rate,
        acceleration=old.acceleration,
        spin_rate=old.spin_rate,
    )
    force, torque, history, walls = _forces(system, predicted, state.history, box, dt, alive)
    acceleration = force / system.clump.mass - drag * predicted.velocity
    spin_rate = _angular_acceleration(system.clump, predicted, torque) - drag * predicted.spin
    grains = replace(
        predicted,
        velocity=half_velocity + (0.5 * dt) * acceleration,
        spin=half_spin + (0.5 * dt) * spin_rate,
        acceleration=acceleration,
        spin_rate=spin_rate,
    )
    return replace(state, grains=grains, history=history), walls


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
    for name, walls in vars(boxes).items():
        if jnp.shape(walls)[1:] not in ((3, 1), (3, replicas)) or len(walls) != len(boxes.lower):
            raise ValueError(f"boxes.{name} must be [steps, 3, {replicas}], got {jnp.shape(walls)}")


def march(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """One step for each of the boxes.

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
    require_shapes(state, boxes, dt=dt, drag=drag, mass=system.clump.mass)
    numbers: tuple[jax.Array, jax.Array] = (jnp.asarray(dt), jnp.asarray(drag))
    system, state, boxes, numbers = together((system, state, boxes, numbers))

    def one_step(carry: tuple[State, jax.Array], xs: tuple[jax.Array, Box]) -> tuple[tuple[State, jax.Array], None]:
        state, total = carry
        index, box = xs
        state, walls = step(system, state, box, numbers[0], numbers[1], index >= 0)
        return (state, total + wall_pressure(walls, box)), None

    total = jnp.zeros_like(state.grains.position, shape=(3, state.replicas))
    count = jnp.arange(boxes.lower.shape[0])
    (state, total), _ = lax.scan(jax.checkpoint(one_step), (state, total), (count, boxes))
    return state, total


def start(system: System, position: jax.Array, quaternion: jax.Array, box: Box) -> State:
    """Grains at rest at `position` [N, 3, B], `quaternion` [N, 4, B], with blank histories and their accelerations."""
    still = jnp.zeros_like(position)
    grains = Grains(position, quaternion, still, still, still, still)
    replicas = position.shape[-1]
    history = system.friction.init(system.pairs.capacity, replicas, position.dtype)
    state = State(grains, history, jnp.zeros(replicas, jnp.int32))
    return accelerate(system, state, box)


def accelerate(system: System, state: State, box: Box) -> State:
    """Recompute the accelerations of `state`, its histories untouched (after velocities or the law were changed)."""
    zero, alive = jnp.zeros(()), jnp.asarray(True)
    force, torque, _, _ = _forces(system, state.grains, state.history, box, zero, alive)
    grains = replace(
        state.grains,
        acceleration=force / system.clump.mass,
        spin_rate=_angular_acceleration(system.clump, state.grains, torque),
    )
    return replace(state, grains=grains)


def check(system: System, state: State, box: Box) -> State:
    """Set the status bits for what can be seen in one configuration: stale list, escaped grain, non-finite number."""
    grains = state.grains
    spheres = sphere_centres(grains, system.clump)
    outside = jnp.any((spheres < box.lower) | (spheres > box.upper), axis=(0, 1))
    numbers = grains.position.sum((0, 1)) + grains.acceleration.sum((0, 1)) + grains.spin_rate.sum((0, 1))
    bits = (
        jnp.where(slack(system.pairs, spheres, box) <= 0.0, int(Status.STALE_PAIRS), 0)
        | jnp.where(outside, int(Status.OUTSIDE_BOX), 0)
        | jnp.where(jnp.isfinite(numbers), 0, int(Status.NOT_FINITE))
    ).astype(jnp.int32)
    return replace(state, status=state.status | bits)


def observe(system: System, state: State, box: Box, pressure: jax.Array) -> Sample:
    """The instantaneous quantities of a `Sample`, beside the given bin-averaged pressure."""
    grains, clump, pairs = state.grains, system.clump, system.pairs
    spheres = sphere_centres(grains, clump)
    square = dot(spheres[pairs.second] - spheres[pairs.first], spheres[pairs.second] - spheres[pairs.first])[:, 0]
    overlap = jnp.where(pairs.valid[:, None], 2.0 - jnp.sqrt(jnp.where(pairs.valid[:, None], square, 1.0)), -1.0)
    touching = (overlap > 0.0).astype(jnp.int32)
    count = grains.position.shape[0]
    touching_pairs = jax.ops.segment_max(touching, pairs.grain_pair, num_segments=pairs.capacity)
    body_spin = jnp.sum(matrix(grains.quaternion) * grains.spin[:, :, None], axis=1)
    energy = clump.mass * jnp.sum(grains.velocity**2, axis=1) + jnp.sum(clump.inertia[:, None] * body_spin**2, axis=1)
    lengths = jnp.broadcast_to(box.lengths, pressure.shape)
    rate = jnp.abs(box.upper_velocity[0] - box.lower_velocity[0]) / lengths[0]
    squeezing = 0.5 * (pressure[0] + pressure[1])
    loaded = squeezing > 0.0
    inertial = rate * jnp.sqrt(clump.mass / (clump.diameter * jnp.where(loaded, squeezing, 1.0)))
    return Sample(
        pressure=pressure,
        lengths=lengths,
        kinetic_energy=0.5 * jnp.sum(energy, axis=0),
        largest_speed=jnp.sqrt(jnp.max(jnp.sum(lax.stop_gradient(grains.velocity) ** 2, axis=1), axis=0)),
        coordination=2.0 * jnp.sum(jnp.maximum(touching_pairs, 0), axis=0) / count,
        contacts=2.0 * jnp.sum(touching, axis=0) / count,
        filling=count * clump.mass / jnp.prod(lengths, axis=0),
        largest_overlap=jnp.max(lax.stop_gradient(overlap), axis=0),
        inertial_number=jnp.where(loaded, inertial, 0.0),
    )


def end_bin(system: System, state: State, box: Box, pressure: jax.Array) -> tuple[State, Sample]:
    """Check the state at the end of a bin and take its sample; `pressure` is the bin's average, [3, B]."""
    state = check(system, state, box)
    sample = observe(system, state, box, pressure)
    beyond = sample.largest_overlap > largest_overlap(system.friction)
    bits = jnp.where(beyond, int(Status.OVERLAP_RANGE), 0).astype(jnp.int32)
    return replace(state, status=state.status | bits), sample


def advance(
    system: System,
    state: State,
    motion: Motion,
    dt: jax.Array,
    *,
    first_bin: Scalar = 0,
    bins: int,
    steps: Scalar,
    drag: Scalar = 0.0,
) -> tuple[State, Sample]:
    """Advance by `bins` bins of `steps` steps under prescribed walls.

    Args:
        system: the system.
        state: at the start of bin `first_bin` of the stage.
        motion: the walls as a function of the time since the start of the stage.
        dt: time step, in t_c.
        first_bin: number of bins of this stage already done.
        bins: number of bins to advance (static).
        steps: steps per bin; a Python int where reverse-mode differentiation is wanted.
        drag: see `step`.

    Returns:
        The state, and samples with a leading axis [bins].
    """
    dt = jnp.asarray(dt)
    alive = jnp.asarray(first_bin) >= 0

    def one_step(index: jax.Array, carry: tuple[State, jax.Array, jax.Array]) -> tuple[State, jax.Array, jax.Array]:
        state, total, done = carry
        box = motion.box_at((done + index + 1) * dt)
        state, walls = step(system, state, box, dt, drag, alive & (index >= 0))
        return state, total + wall_pressure(walls, box), done

    def one_bin(state: State, bin_index: jax.Array) -> tuple[State, Sample]:
        done = bin_index * steps
        empty = jnp.zeros((3, state.replicas), state.grains.position.dtype)
        state, total, _ = lax.fori_loop(0, steps, jax.checkpoint(one_step), (state, empty, done))
        return end_bin(system, state, motion.box_at((done + steps) * dt), total / steps)

    return checkpoint.scan(one_bin, state, first_bin + jnp.arange(bins))
