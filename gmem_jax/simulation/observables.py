"""Ready observers, `gm.observables`: quantities that are measured on the pack at the end of each bin.

    gm.Experiment(pack, signals, observe=[gm.observables.stress(), gm.observables.fabric()])

Each is a function of (simulation, state) with a name, a unit and a description. It is plain JAX on the state, the same
for every backend. Contact forces are computed from the state, with dashpots at the velocities of the end of the bin
(steps take those of their middle). Whether a contact slides is decided as if one more step were made: a sliding contact
is then at its limit to round-off. The compiler evaluates the contacts once for all observers.

"The mark" is the beginning of the stage with `mark`, or of the first sheared stage if no stage has it.
"""

import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.census import overlaps
from gmem_jax.physics.contact.friction import CoulombLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.kinematics import Kinematics
from gmem_jax.physics.contact.normal import hertz
from gmem_jax.physics.contact.wall import PLANES, wall_forces
from gmem_jax.physics.forces import contact_loads, relative_motion, sphere_table, wall_loads
from gmem_jax.physics.pairs import image_shifts
from gmem_jax.physics.pytree import Scalar
from gmem_jax.physics.rotation import cross, dot
from gmem_jax.physics.state import State
from gmem_jax.simulation.loop import Simulation

AT_LIMIT = 1.0 - 1e-6  # of mu f_n: a force that was scaled back to the limit is there to round-off
LONGEST_LINE = 200  # letters of name, unit and words

T = TypeVar("T")
SpherePairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Observable:
    """An observer: a function with a name, a unit and a description. A function of your own becomes one, too.

    Attributes:
        name: name in results and files.
        unit: unit of the values, with R = E = rho = 1.
        words: description of the values.
        reduce: function of (simulation, state, *arguments) in plain JAX that returns an array [..., B]. It must be
            hashable, as functions of a module are; programs are compiled for it.
        arguments: further arguments of `reduce`, hashable.

    Raises:
        ValueError: for a name, unit or description that is not one printable line of up to 200 letters.
    """

    name: str
    unit: str
    words: str
    reduce: Callable[..., jax.Array]
    arguments: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        for text in (self.name, self.unit, self.words):
            if not (isinstance(text, str) and text.isprintable() and len(text) <= LONGEST_LINE):
                raise ValueError(
                    f"name, unit and words must each be one line of at most {LONGEST_LINE} letters, got {text!r}"
                )

    def __call__(self, simulation: Simulation, state: State) -> jax.Array:
        """The values at the end of a bin, [..., B]."""
        return self.reduce(simulation, state, *self.arguments)


# ---------------------------------------------------------------- stress and fabric


def stress() -> Observable:
    """The stress tensor of the contacts, [3, 3, B], in E; pressure is positive.

    sigma_ij = sum_c f_i l_j / V over contacts of spheres and contacts with walls, each counted once. f is the force of
    a grain on the other grain, or on the wall; l is the branch vector from its centre to the centre of the other grain
    (in a periodic box, of the image that it touches), or to the contact point at the wall. V is the volume of the box.
    Where grains accelerate it differs from the stress on the walls. The stress of a periodic box also contains the
    momentum flux of moving grains, which is left out here.
    """
    return Observable("stress", "E", "stress tensor of the contacts, by branches between grain centres", _stress)


def _stress(simulation: Simulation, state: State) -> jax.Array:
    system, position, box = simulation.system, state.grains.position, _known(simulation.box)
    seen, spheres, pairs = _contacts(simulation, state), system.clump.spheres, system.pairs
    push = seen.normal_force * seen.kin.normal - seen.friction
    branch = position[pairs.second // spheres] - position[pairs.first // spheres]
    branch += image_shifts(pairs, box.lengths)
    lower, upper = seen.walls(simulation)
    arms = seen.table[:, :3] - jnp.repeat(position, spheres, axis=0)
    total = _tensor(push, branch) + _tensor(upper - lower, arms)
    place = seen.table[:, :3]
    across = jnp.sum(upper * (box.upper - place) + lower * (place - box.lower), axis=0)
    total += _diagonal(across)
    if (rubbed := seen.rubbed(simulation, state)) is not None:
        kin, friction = rubbed
        to_plane = (kin.arm - jnp.where(kin.touching, kin.overlap, 0.0)) * kin.normal
        total += _tensor(-friction, jnp.repeat(arms, PLANES, axis=0) + to_plane)
    return total / jnp.prod(box.lengths, axis=0)


def wall_stress() -> Observable:
    """The normal stress on the walls, [3, 3, B], in E: p_x, p_y, p_z, averaged over the bin, on the diagonal.

    Friction of the walls is not in it. Along periodic axes it is the mean over all sections of the box; see
    `gmem_jax.physics.forces.section_force`.
    """
    return Observable("wall_stress", "E", "stress on the walls, averaged over the steps of the bin", _wall_stress)


def _wall_stress(simulation: Simulation, state: State) -> jax.Array:
    return _diagonal(_known(simulation.sample).pressure)


def fabric() -> Observable:
    """The fabric tensor <n_i n_j> over touching pairs of spheres, [3, 3, B]; its trace is 1, or 0 if none touch."""
    return Observable("fabric", "1", "fabric tensor, mean of n n over touching pairs of spheres", _fabric)


def _fabric(simulation: Simulation, state: State) -> jax.Array:
    kin = _contacts(simulation, state).kin
    normal = jnp.where(kin.touching, kin.normal, 0.0)
    return _tensor(normal, normal) / jnp.maximum(jnp.sum(kin.touching, axis=(0, 1)), 1)


# ---------------------------------------------------------------- friction


def sliding() -> Observable:
    """The fraction of contacts whose tangential force is at its limit mu f_n, [B].

    Only contacts of spheres whose limit is above 0 count; without any it is 0. The law must have a mu, or be
    `Frictionless`.
    """
    return Observable("sliding", "1", "share of contacts at the Coulomb limit", _sliding)


def _sliding(simulation: Simulation, state: State) -> jax.Array:
    size, limit = _rubbing(simulation, state)
    return _mean(size >= AT_LIMIT * limit, limit > 0.0)


def mobilisation() -> Observable:
    """The mean of |f_t| / (mu f_n) over the contacts that `sliding` counts, [B]."""
    return Observable("mobilisation", "1", "mean of the tangential force over its Coulomb limit", _mobilisation)


def _mobilisation(simulation: Simulation, state: State) -> jax.Array:
    size, limit = _rubbing(simulation, state)
    loaded = limit > 0.0
    return _mean(size / jnp.where(loaded, limit, 1.0), loaded)


def _rubbing(simulation: Simulation, state: State) -> tuple[jax.Array, jax.Array]:
    """|f_t| and mu f_n of every candidate, [P, 1, B]."""
    law, seen = simulation.system.friction, _contacts(simulation, state, ahead=True)
    if not isinstance(law, CoulombLaw | Frictionless):
        raise ValueError(f"sliding and mobilisation compare with mu f_n, and {type(law).__name__} has no mu")
    mu: Scalar = law.mu if isinstance(law, CoulombLaw) else 0.0
    return _root(dot(seen.friction, seen.friction)), mu * seen.normal_force


# ---------------------------------------------------------------- since the mark


def contacts_made() -> Observable:
    """Number of pairs of spheres that touch now and did not at the mark, [B]."""
    return Observable("contacts_made", "1", "pairs of spheres that touch, and did not at the mark", _made)


def _made(simulation: Simulation, state: State) -> jax.Array:
    now, kept = _touching(simulation, state)
    return now - kept


def contacts_lost() -> Observable:
    """Number of pairs of spheres that touched at the mark and do not now, [B]."""
    return Observable("contacts_lost", "1", "pairs of spheres that touched at the mark, and do not now", _lost)


def _lost(simulation: Simulation, state: State) -> jax.Array:
    return _known(simulation.mark).touching - _touching(simulation, state)[1]


def _touching(simulation: Simulation, state: State) -> tuple[jax.Array, jax.Array]:
    """Numbers of pairs that touch now, and of pairs that touch now and touched at the mark, [B] each.

    The present list holds all of these pairs.
    """
    now = overlaps(simulation.system, state) > 0.0
    mark = _known(simulation.mark)
    cell = None if state.cell is None else mark.box
    then = overlaps(simulation.system, replace(state, grains=mark.grains, cell=cell)) > 0.0
    return jnp.sum(now, axis=0, dtype=float), jnp.sum(now & then, axis=0, dtype=float)


def nonaffine() -> Observable:
    """Root mean square of the non-affine displacements of grains since the mark, [B], in R.

    A grain that moves affinely with the box keeps its position in units of the edges. The derivative at zero
    displacement is set to 0.
    """
    return Observable("nonaffine", "R", "rms displacement of grains since the mark, beyond that of the box", _nonaffine)


def _nonaffine(simulation: Simulation, state: State) -> jax.Array:
    mark, box = _known(simulation.mark), _known(simulation.box)
    place = (mark.grains.position - mark.box.lower) / mark.box.lengths
    beyond = state.grains.position - (box.lower + place * box.lengths)
    return _root(jnp.mean(dot(beyond, beyond), axis=(0, 1)))


def rotation() -> Observable:
    """Root mean square of the angles by which grains have turned since the mark, [B], in rad.

    Each is the angle of the rotation from then to now, 0 to pi, not the length of the path. The derivative at zero
    angle is set to 0.
    """
    return Observable("rotation", "rad", "rms angle by which grains have turned since the mark", _rotation)


def _rotation(simulation: Simulation, state: State) -> jax.Array:
    now, then = state.grains.quaternion, _known(simulation.mark).grains.quaternion
    axis = then[:, :1] * now[:, 1:] - now[:, :1] * then[:, 1:] - cross(now[:, 1:], then[:, 1:])
    angle = 2.0 * jnp.arctan2(_root(dot(axis, axis)), jnp.abs(dot(now, then)))  # q and -q are one rotation
    return _root(jnp.mean(angle**2, axis=(0, 1)))


# ---------------------------------------------------------------- power


def friction_power() -> Observable:
    """Power that goes into tangential forces at the end of the bin, walls included, [B], in E R^3 / t_c.

    It is the sum over contacts of f_t v_t, where v_t is the sliding velocity. It contains the power that tangential
    springs store and return; over a closed cycle this cancels, and the work of friction and tangential dashpots
    remains. It is one moment of each bin: a sum over bins times their duration misses what changes within a bin.
    """
    return Observable("friction_power", "E R^3/t_c", "power into tangential forces, at the end of the bin", _rub_power)


def _rub_power(simulation: Simulation, state: State) -> jax.Array:
    seen = _contacts(simulation, state)
    power = jnp.sum(seen.friction * seen.kin.sliding, axis=(0, 1))
    if (rubbed := seen.rubbed(simulation, state)) is None:
        return power
    kin, friction = rubbed
    return power + jnp.sum(friction * kin.sliding, axis=(0, 1))


def normal_power() -> Observable:
    """Power that normal damping dissipates at the end of the bin, walls included, [B], in E R^3 / t_c.

    It is the sum over contacts of (f_n less Hertz's elastic force) times the closing velocity, and never below 0. It is
    one moment of each bin; see `friction_power`.
    """
    words = "power dissipated by normal damping, at the end of the bin"
    return Observable("normal_power", "E R^3/t_c", words, _normal_power)


def _normal_power(simulation: Simulation, state: State) -> jax.Array:
    seen, box = _contacts(simulation, state), _known(simulation.box)
    kin, velocity = seen.kin, seen.table[:, 3:6]
    stiffness = simulation.system.material.normal_stiffness
    elastic = hertz(kin.safe_overlap, kin.closing, kin.touching, stiffness, 0.0, kin.radius)
    between = jnp.sum((seen.normal_force - elastic) * kin.closing, axis=(0, 1))
    lower, upper = (
        force - spring for force, spring in zip(seen.walls(simulation), seen.walls(simulation, 0.0), strict=True)
    )
    at_walls = lower * (box.lower_velocity - velocity) + upper * (velocity - box.upper_velocity)
    return between + jnp.sum(at_walls, axis=(0, 1))


def drag_power() -> Observable:
    """Power that the viscous drag dissipates at the end of the bin, [B], in E R^3 / t_c; 0 in stages without drag.

    It is twice the drag times the kinetic energy, at one moment of each bin; see `friction_power`.
    """
    return Observable("drag_power", "E R^3/t_c", "power dissipated by the drag, at the end of the bin", _drag_power)


def _drag_power(simulation: Simulation, state: State) -> jax.Array:
    return 2.0 * simulation.drag * _known(simulation.sample).kinetic_energy


# ---------------------------------------------------------------- chosen contacts


def normal_forces(pairs: Iterable[tuple[int, int]]) -> Observable:
    """Normal forces of n chosen contacts, [n, B], in E R^2; repulsion is positive, and 0 is no contact.

    Args:
        pairs: two spheres for each contact: sphere k of grain g, both from 0, has the number g K + k, where K is the
            number of spheres of a grain.

    Raises:
        ValueError: if these are no pairs of different numbers from 0. That the spheres exist and belong to different
            grains is checked when the experiment runs.
    """
    return Observable("normal_forces", "E R^2", "normal forces of chosen contacts", _normal_forces, (_pairs(pairs),))


def _normal_forces(simulation: Simulation, state: State, pairs: SpherePairs) -> jax.Array:
    return _chosen(simulation, _contacts(simulation, state).normal_force, pairs)[:, 0]


def tangential_forces(pairs: Iterable[tuple[int, int]]) -> Observable:
    """Tangential forces of n chosen contacts on the first sphere of each pair, [n, 3, B], in E R^2.

    Args:
        pairs: see `normal_forces`.

    Raises:
        ValueError: as `normal_forces`.
    """
    words = "tangential forces of chosen contacts, on the first sphere"
    return Observable("tangential_forces", "E R^2", words, _tangential_forces, (_pairs(pairs),))


def _tangential_forces(simulation: Simulation, state: State, pairs: SpherePairs) -> jax.Array:
    on_lower = _chosen(simulation, _contacts(simulation, state).friction, pairs)
    return on_lower * np.asarray([1.0 if one < other else -1.0 for one, other in pairs])[:, None, None]


def _pairs(pairs: Iterable[tuple[int, int]]) -> SpherePairs:
    try:
        found = tuple((operator.index(one), operator.index(other)) for one, other in pairs)
    except (TypeError, ValueError):
        raise ValueError(f"pairs are numbers of two spheres each, as in [(0, 5)]; got {pairs!r}") from None
    if not found or any(one == other or min(one, other) < 0 for one, other in found):
        raise ValueError(f"pairs are numbers of two spheres each, from 0 and different; got {pairs!r}")
    return found


def _chosen(simulation: Simulation, values: jax.Array, pairs: SpherePairs) -> jax.Array:
    """The values of chosen pairs, [n, k, B], out of those of all candidates, [P, k, B]; 0 for pairs not listed."""
    listed, each = simulation.system.pairs, simulation.system.clump.spheres
    spheres = listed.reference.shape[-3]
    for pair in pairs:
        if max(pair) >= spheres or pair[0] // each == pair[1] // each:
            raise ValueError(f"spheres {pair[0]} and {pair[1]}: must be of two grains, and below {spheres}")
    one, other = np.sort(np.asarray(pairs), axis=1).T[:, :, None]
    rows = (listed.first == one) & (listed.second == other) & listed.valid
    found = values[jnp.argmax(rows, axis=1)]
    return jnp.where(jnp.any(rows, axis=1)[:, None, None], found, 0.0)


# ---------------------------------------------------------------- what they share


class _Seen(NamedTuple):
    """The contacts of a state: see `contact_loads` and `sphere_table`."""

    table: jax.Array
    kin: Kinematics
    normal_force: jax.Array
    friction: jax.Array

    def walls(self, simulation: Simulation, damping_time: Scalar | None = None) -> tuple[jax.Array, jax.Array]:
        """Normal forces of the lower and upper walls on spheres, [S, 3, B] each; default the material's damping."""
        material = simulation.system.material
        damping = material.normal_damping if damping_time is None else damping_time
        radii = simulation.system.clump.sphere_radii(len(self.table))
        return wall_forces(self.table, _known(simulation.box), material, damping, radii)

    def rubbed(self, simulation: Simulation, state: State) -> tuple[Kinematics, jax.Array] | None:
        """Kinematics of spheres at walls, and friction forces of walls on them, [6 S, ...]; None at smooth walls."""
        if simulation.system.wall_mu is None:
            return None
        forces, box = self.walls(simulation), _known(simulation.box)
        histories = state.wall_history, jnp.zeros(())
        kin, friction, _, _ = wall_loads(simulation.system, state.grains, box, *forces, *histories)
        return kin, friction


def _contacts(simulation: Simulation, state: State, *, ahead: bool = False) -> _Seen:
    """The present contacts; with `ahead`, tangential forces are those after one more step of sliding."""
    system = simulation.system
    table, _ = sphere_table(system.clump, state.grains, state.cell)
    dt = jnp.asarray(simulation.dt) if ahead else jnp.zeros(())  # dt = 0: contacts slide no further
    motion = relative_motion(system, table, state.cell)
    kin, normal_force, friction, _ = contact_loads(system, *motion, state.history, dt)
    return _Seen(table, kin, normal_force, friction)


def _known(part: T | None) -> T:
    if part is None:
        raise ValueError("observers are called at the end of a bin, when walls, sample and mark are there")
    return part


def _tensor(one: jax.Array, other: jax.Array) -> jax.Array:
    """The sum over n of the outer products of vectors [n, 3, B], [3, 3, B]."""
    return jnp.einsum("nib,njb->ijb", one, other)


def _diagonal(values: jax.Array) -> jax.Array:
    """The diagonal tensor [3, 3, B] of values [3, B]."""
    return jnp.eye(3)[:, :, None] * values


def _root(square: jax.Array) -> jax.Array:
    """The square root, with derivative 0 at 0."""
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def _mean(values: jax.Array, which: jax.Array) -> jax.Array:
    """The mean of values [P, 1, B] over the rows where `which` is True, [B]; 0 where there are none."""
    return jnp.sum(jnp.where(which, values, 0.0), axis=(0, 1)) / jnp.maximum(jnp.sum(which, axis=(0, 1)), 1)
