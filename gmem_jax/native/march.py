"""The steps of a bin by the library, with the signature of `gmem_jax.physics.step.march`; their tangents and adjoints.

Here a system and a state become the arrays and numbers of a call, and its results a state again. How a call is made is
in `gmem_jax.native.calls` and `gmem_jax.native.primitives`.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.backend import get_backend

from gmem_jax.errors import warn_caller
from gmem_jax.native import library, primitives
from gmem_jax.native.calls import Arrays, Call, Fixed, StepOutput
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.boundary import WALLS, PeriodicAxes
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.laws import LAWS, entry_of
from gmem_jax.physics.forces import Histories
from gmem_jax.physics.pytree import Scalar
from gmem_jax.physics.state import Box, Grains, State
from gmem_jax.physics.system import System

March = Callable[[System, State, Box, Scalar, Scalar], tuple[State, jax.Array]]
"""The signature of `gmem_jax.physics.step.march`."""

_LAW_NUMBERS = max(len(entry.numbers) for entry in LAWS)  # rows of the parameter array for the numbers of a law


def march(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """`gmem_jax.physics.step.march` on the native backend.

    Args:
        system: the system; parameters of its friction law are scalars or [B].
        state: at time t.
        boxes: the walls at t + dt, t + 2 dt, ...; leaves [steps, 3, B], in R and R / t_c.
        dt: scalar or [B], in t_c.
        drag: scalar or [B], in 1 / t_c.

    Returns:
        The state after all steps, and the sum of the wall pressures over the steps, [3, B], in E.

    Raises:
        ValueError: if the backend is not available, does not know the friction law, or the state is not float64; or if
            an argument does not fit the number of replicas.
        NotImplementedError: if it is compiled for anything but a CPU or a CUDA GPU, or for a GPU without NVRTC.
    """
    return _march(system, state, boxes, dt, drag, _Mode())


def march_mixed(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """`march` with contacts in single precision: their forces, torques and histories.

    Positions, orientations, velocities and the sums of forces are in double precision. The gaps of contacts are
    computed in double precision, and then rounded. Only many replicas side by side are faster so; a single replica runs
    in double precision.

    Raises:
        ValueError: as in `march` and `require_mixed`.
    """
    require_mixed(system.friction, boxes.periodic, system.clump.equal, system.wall_mu is None)
    return _march(system, state, boxes, dt, drag, _Mode(mixed=state.replicas > 1))


def require_mixed(law: FrictionLaw, periodic: PeriodicAxes, equal: bool, smooth: bool) -> None:
    """Refuse what cannot be done with contacts in single precision.

    Raises:
        ValueError: if the law is kept in double precision or unknown, JAX's default device is no CPU, the box has
            periodic axes, spheres differ in radius, or walls are not `smooth`.
    """
    if any(periodic):
        raise ValueError("precision='mixed' is not for periodic boxes; use 'double'")
    if not equal:
        raise ValueError("precision='mixed' is not for spheres of unequal radii; use 'double'")
    if not smooth:
        raise ValueError("precision='mixed' is not for walls with friction; use 'double'")
    if get_backend().platform != "cpu":
        raise ValueError("precision='mixed' is a mode of CPUs so far; use 'double' on a GPU")
    if library.entry(law).layered:
        raise ValueError("precision='mixed' is not for the Mindlin law, whose rings are kept in double precision")


def march_anywhere(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """`march` on CPUs and CUDA GPUs, if the library is available and knows the friction law; else plain JAX."""
    if entry_of(system.friction) is None:
        return dynamics.march(system, state, boxes, dt, drag)
    built, reason = library.available()
    if not built:
        warn_no_library(reason)
        return dynamics.march(system, state, boxes, dt, drag)
    return _march(system, state, boxes, dt, drag, _Mode(anywhere=True))


@functools.cache
def warn_no_library(reason: str) -> None:
    """Warn that plain JAX runs because the library is not available; once for each reason."""
    warn_caller(f"plain JAX runs, and slowly: the native backend is not available: {reason}")


class _Mode(NamedTuple):
    """How the steps of a bin are run.

    Attributes:
        anywhere: whether plain JAX may run on devices without the library.
        mixed: whether contacts are in single precision.
    """

    anywhere: bool = False
    mixed: bool = False


def _march(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar, mode: _Mode) -> tuple[State, jax.Array]:
    library.require_library()
    library.entry(system.friction)
    if state.grains.position.dtype != jnp.float64:
        raise ValueError(f"the native backend needs float64, got {state.grains.position.dtype}")
    law = {field.name: getattr(system.friction, field.name) for field in fields(system.friction)}  # type: ignore[arg-type]
    if system.wall_mu is not None:
        law["wall_mu"] = system.wall_mu
    dynamics.require_shapes(state, boxes, dt=dt, drag=drag, mass=system.clump.mass, **law)
    dynamics.require_wall_history(system, state)
    boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leaf.shape[:-1], state.replicas)), boxes)
    system, state, boxes, dt, drag = dynamics.mark_varying((system, state, boxes, jnp.asarray(dt), jnp.asarray(drag)))
    histories = state.history, state.wall_history
    grains, (history, walls), total = _bin(mode, system, state.grains, histories, boxes, (dt, drag), state.cell)
    cell = jax.tree.map(lambda leaf: leaf[-1], boxes) if state.cell is not None and len(boxes.lower) else state.cell
    return replace(state, grains=grains, history=history, cell=cell, wall_history=walls), total


_Result = tuple[Grains, Histories, jax.Array]
_Numbers = tuple[jax.Array, jax.Array]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _bin(
    mode: _Mode, system: System, grains: Grains, histories: Histories, boxes: Box, numbers: _Numbers, cell: Box | None
) -> _Result:
    """The steps with walls `boxes` ([steps, 3, B]), which begin in the periodic `cell`; `numbers` are (dt, drag).

    Returns:
        The grains, the histories, and the sum of the wall pressures over the steps, [3, B].
    """
    arrays = arrays_of(system, grains, histories, boxes, numbers, cell)
    definition = PlainDefinition.of(system, histories, mode.anywhere, boxes.periodic)
    call = call_of(system, boxes.periodic)._replace(mixed=int(mode.mixed))
    return _result(grains, histories, primitives.advance(call, definition, fixed_of(system), arrays))


@functools.partial(_bin.defjvp, symbolic_zeros=True)
def _bin_jvp(mode: _Mode, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[_Result, _Result]:
    """The tangent of `_bin`, computed only for the arguments whose tangents are not zero."""
    if mode.mixed:  # the adjoint does not know about the rounding: docs/decisions/computing.md
        raise NotImplementedError("there are no derivatives in mixed precision; use precision='double'")
    leaves, structure = jax.tree.flatten(primals)
    slopes = jax.tree.leaves(tangents)
    active = [place for place, slope in enumerate(slopes) if not _is_zero(slope)]
    varied, directions = [leaves[place] for place in active], [slopes[place] for place in active]

    def filled(varied: Sequence[jax.Array]) -> tuple[Any, ...]:
        whole = list(leaves)
        for place, leaf in zip(active, varied, strict=True):
            whole[place] = leaf
        rebuilt: tuple[Any, ...] = jax.tree.unflatten(structure, whole)
        return rebuilt

    system, _, histories, boxes, *_ = primals
    shape = tangents[0].clump
    if not all(map(_is_zero, jax.tree.leaves((shape.radii, shape.sizes)))):
        # The library has no derivatives with respect to radii and sizes. (The lists, which depend on these too, have
        # none: they only say where contacts can be.)
        _, slope = jax.jvp(lambda *varied: _plain(*filled(varied)), varied, directions)
        return _bin(mode, *primals), slope
    arrays, along = jax.jvp(lambda *varied: arrays_of(*filled(varied)), varied, directions)
    definition = PlainDefinition.of(system, histories, mode.anywhere, boxes.periodic)
    change = primitives.tangent(call_of(system, boxes.periodic), definition, fixed_of(system), arrays, along)
    return _bin(mode, *primals), _result(primals[1], histories, change)


def _is_zero(slope: Any) -> bool:
    return isinstance(slope, jax.custom_derivatives.SymbolicZero)


def _plain(
    system: System, grains: Grains, histories: Histories, boxes: Box, numbers: _Numbers, cell: Box | None
) -> _Result:
    """`_bin` in plain JAX."""
    history, walls = histories
    state = State(grains, history, jnp.zeros(grains.position.shape[-1], jnp.int32), cell=cell, wall_history=walls)
    state, total = dynamics.march(system, state, boxes, *numbers)
    return state.grains, (state.history, state.wall_history), total


class _Solid(NamedTuple):
    """The properties of a `Material` that a step uses."""

    normal_stiffness: jax.Array
    normal_damping: jax.Array
    wall_stiffness: jax.Array


@dataclass(frozen=True)
class PlainDefinition:
    """`_plain` on the arguments of a call; a `gmem_jax.native.calls.Definition`.

    Attributes:
        system: structure of the `System`.
        history: structure of the histories of candidates and of walls with friction.
        anywhere: see `gmem_jax.native.calls.Definition`.
        periodic: the periodic axes of the box.
    """

    system: Any
    history: Any
    anywhere: bool = True
    periodic: PeriodicAxes = WALLS

    @classmethod
    def of(
        cls, system: System, histories: Histories, anywhere: bool = True, periodic: PeriodicAxes = WALLS
    ) -> "PlainDefinition":
        """The definition for a system with these histories, of the candidates and of the walls."""
        return cls(jax.tree.structure(system), jax.tree.structure(histories), anywhere, periodic)

    def __call__(self, fixed: Fixed, arrays: Arrays) -> StepOutput:
        """The results of the steps."""
        empty: System = jax.tree.unflatten(self.system, [None] * self.system.num_leaves)
        dt, drag, mass, *inertia = arrays.parameters[:6]
        own, (gravity, *_, wall_mu) = arrays.parameters[9:-8], arrays.parameters[-8:]
        edges = jnp.split(arrays.parameters[-7:-1], 2)
        clump = replace(empty.clump, offsets=arrays.offsets, mass=mass, inertia=jnp.stack(inertia))
        if fixed.sizes.shape[-1]:
            clump = replace(clump, radii=fixed.radii[:, 0], sizes=fixed.sizes[:, 0])
        law: Any = empty.friction
        law = library.entry(law).with_numbers(law, own)
        material: Any = _Solid(*arrays.parameters[6:9])
        lists = ("first", "second", "valid", "incidence")
        pairs = replace(empty.pairs, **{field: getattr(fixed, field) for field in lists})
        lower, upper, *speeds = jnp.split(arrays.walls, 4, axis=1)
        boxes, cell = Box(lower, upper, speeds[0], speeds[1], self.periodic), None
        if any(self.periodic):
            pairs = replace(pairs, image=fixed.images)
            still = jnp.zeros_like(edges[0])
            cell = Box(edges[0], edges[1], still, still, self.periodic)
        histories = jax.tree.unflatten(self.history, arrays.history)
        system = replace(empty, clump=clump, friction=law, pairs=pairs, material=material, gravity=gravity)
        if histories[1] is not None:
            system = replace(system, wall_mu=wall_mu)
        grains, histories, total = _plain(system, Grains(*arrays.fields), histories, boxes, (dt, drag), cell)
        return StepOutput(jax.tree.leaves(grains), total, jax.tree.leaves(histories))


def call_of(system: System, periodic: PeriodicAxes = WALLS) -> Call:
    """The attributes of a call for a system in a box with these periodic axes."""
    law = system.friction
    row = library.entry(law)
    return Call(
        law=row.native,
        variant=row.variant(law),
        points=row.points(law),
        isotropic=int(system.clump.isotropic),
        leaves=len(row.history),
        periodic=bits_of(periodic),
        unequal=int(not system.clump.equal),
        rubs=int(system.wall_mu is not None),
    )


def bits_of(periodic: PeriodicAxes) -> int:
    """The periodic axes as an integer for the library, one bit for each axis."""
    return sum(int(is_periodic) << axis for axis, is_periodic in enumerate(periodic))


def fixed_of(system: System) -> Fixed:
    """The arguments of a call with respect to which it cannot be differentiated."""
    pairs, clump = system.pairs, system.clump
    candidates = (pairs.first, pairs.second, pairs.valid, pairs.incidence, pairs.reference[..., 0], pairs.smallest)
    images = jnp.zeros((pairs.capacity, 0), jnp.int8) if pairs.image is None else pairs.image
    counts, columns = (clump.spheres, len(pairs.reference) // clump.spheres), int(not clump.equal)
    lengths = zip((clump.radii, clump.sizes), counts, strict=True)
    radii, sizes = (jnp.ones((count, columns)) if own is None else own[:, None] for own, count in lengths)
    return Fixed(*candidates, images, radii, sizes)


def arrays_of(
    system: System, grains: Grains, histories: Histories, boxes: Box, numbers: _Numbers, cell: Box | None = None
) -> Arrays:
    """The arguments of a call with respect to which it can be differentiated, from the arguments of `_bin`."""
    walls = jnp.concatenate([boxes.lower, boxes.upper, boxes.lower_velocity, boxes.upper_velocity], axis=1)
    replicas = grains.position.shape[-1]
    parameters, offsets = _parameters(system, numbers, cell, replicas), system.clump.offsets
    centres = jnp.broadcast_to(offsets[..., None], (*offsets.shape, replicas))
    return Arrays(jax.tree.leaves(grains), parameters, walls, centres, jax.tree.leaves(histories))


def _result(grains: Grains, histories: Histories, results: StepOutput) -> _Result:
    moved = jax.tree.unflatten(jax.tree.structure(grains), results.fields)
    return moved, jax.tree.unflatten(jax.tree.structure(histories), results.history), results.pressure


def _parameters(system: System, numbers: _Numbers, cell: Box | None, replicas: int) -> jax.Array:
    """The parameter array, [rows, B]; its rows are those of src/physics/parameters.h."""
    law, clump, material = system.friction, system.clump, system.material
    own = [getattr(law, number) for number in library.entry(law).numbers]
    own += [1.0] * (_LAW_NUMBERS - len(own))
    solid = (material.normal_stiffness, material.normal_damping, material.wall_stiffness)
    edges = (0.0,) * 6 if cell is None else (*cell.lower, *cell.upper)
    gravity = 0.0 if system.gravity is None else system.gravity
    wall_mu = 0.0 if system.wall_mu is None else system.wall_mu
    rows = (*numbers, clump.mass, *clump.inertia, *solid, *own, gravity, *edges, wall_mu)
    return jnp.stack([jnp.broadcast_to(jnp.asarray(row, jnp.float64), (replicas,)) for row in rows])
