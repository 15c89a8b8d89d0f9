"""The steps of one bin in C++, behind jax.ffi: the numbers of `gmem_jax.physics.step.march`, several times faster.

One call into the library runs all steps of one bin for all replicas; walls, checks and samples are computed in JAX.
It works under `jax.jit`, `jax.vmap`, `jax.shard_map`, on sharded arrays, and in both modes of differentiation, whose
derivatives are computed in the library too; see `gmem_jax.native.calls`.
"""

import ctypes
import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.experiment import checkpoint
from gmem_jax.experiment.protocol import Motion
from gmem_jax.native import calls
from gmem_jax.native.calls import Arrays, Call, Fixed, Results
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.state import Box, Grains, Scalar, State
from gmem_jax.physics.step import Sample, System

March = Callable[[System, State, Box, Scalar, Scalar], tuple[State, jax.Array]]
"""The signature of `gmem_jax.physics.step.march`."""

Advance = Callable[..., tuple[State, Sample]]
"""The signature of `gmem_jax.physics.step.advance`."""

BACKENDS = ("auto", "jax", "native")

_LAWS: tuple[type, ...] = (Frictionless, Hooke, MindlinRescaled, Mindlin)  # numbered as in problem.h
_VARIANTS = ("exact", "averaged", "paper")
_PART = 32  # steps per call where their number is not known when the program is compiled


def _path() -> Path:
    from gmem_jax.native.build import LIBRARY  # here, so that ``python -m gmem_jax.native.build`` loads it only once

    return Path(__file__).parent / LIBRARY


@functools.cache
def _load() -> tuple[str, str]:
    """Load and register the library, once; returns its instruction set, and why that failed ("" if it did not)."""
    path = _path()
    if not path.exists():
        return "", "it was not built (no C++ compiler when gmem_jax was installed?); python -m gmem_jax.native.build"
    try:
        library = ctypes.CDLL(str(path))
        for target in calls.TARGETS:
            jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(library, target)), platform="cpu")
        library.gmem_instruction_set.restype = ctypes.c_char_p
        return library.gmem_instruction_set().decode(), ""
    except (OSError, AttributeError) as error:
        return "", f"its library could not be loaded: {error}"


def available() -> tuple[bool, str]:
    """Whether the native backend can run on this machine's CPU, and the instruction set it uses (or why not)."""
    instructions, reason = _load()
    return not reason, reason or instructions


def supports(law: FrictionLaw) -> bool:
    """Whether the native backend knows this friction law (a user's own runs in plain JAX)."""
    return type(law) in _LAWS


def name(backend: str, law: FrictionLaw) -> str:
    """What "auto" means for this friction law on JAX's default device, "jax" or "native"; others are themselves."""
    if backend != "auto":
        return backend
    return "native" if available()[0] and supports(law) and jax.default_backend() == "cpu" else "jax"


def marcher(backend: str = "auto") -> March:
    """The `march` of a backend.

    Args:
        backend: "jax", the definition; "native", this library, which is refused where there is none; or "auto": native
            in what is compiled for CPUs, where the library is at hand and knows the friction law, else plain JAX.

    Raises:
        ValueError: if the backend is unknown or not available.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    if backend == "native":
        _require_library()
    return {"jax": dynamics.march, "native": march, "auto": _march_anywhere}[backend]


def march(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """`gmem_jax.physics.step.march` on the native backend.

    Args:
        system: the system; parameters of its friction law are scalars or [B].
        state: at time t.
        boxes: the walls at t + dt, t + 2 dt, ...; leaves [steps, 3, B], in R and R / t_c.
        dt: scalar or [B], in t_c.
        drag: scalar or [B], in 1 / t_c.

    Returns:
        The state after them, and the sum over the steps of the wall pressures, [3, B], in E.

    Raises:
        ValueError: if the backend is not available, does not know the friction law, or the state is not float64; or if
            an argument does not fit the number of replicas.
        NotImplementedError: if it is compiled for anything but a CPU.
    """
    return _march(system, state, boxes, dt, drag, anywhere=False)


def _march_anywhere(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """`march` on CPUs, its definition elsewhere."""
    if not supports(system.friction):
        return dynamics.march(system, state, boxes, dt, drag)
    if not available()[0]:
        _warn_once(available()[1])
        return dynamics.march(system, state, boxes, dt, drag)
    return _march(system, state, boxes, dt, drag, anywhere=True)


@functools.cache
def _warn_once(reason: str) -> None:
    warnings.warn(f"plain JAX runs, and slowly: the native backend is not available: {reason}", stacklevel=4)


def _require_library() -> None:
    possible, reason = available()
    if not possible:
        raise ValueError(f"the native backend is not available: {reason}")


def _require(system: System, state: State) -> None:
    """Raise if this backend cannot run them.

    Raises:
        ValueError: if the backend is not available, does not know the friction law, or the state is not float64.
    """
    _require_library()
    if not supports(system.friction):
        raise ValueError(f"the native backend does not know the friction law {type(system.friction).__name__}")
    if state.grains.position.dtype != jnp.float64:
        raise ValueError(f"the native backend needs float64, got {state.grains.position.dtype}")


def _march(
    system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar, *, anywhere: bool
) -> tuple[State, jax.Array]:
    _require(system, state)
    law = {field.name: getattr(system.friction, field.name) for field in fields(system.friction)}  # type: ignore[arg-type]
    dynamics.require_shapes(state, boxes, dt=dt, drag=drag, mass=system.clump.mass, **law)
    boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leaf.shape[:-1], state.replicas)), boxes)
    system, state, boxes, dt, drag = dynamics.together((system, state, boxes, jnp.asarray(dt), jnp.asarray(drag)))
    grains, history, total = _bin(anywhere, system, state.grains, state.history, boxes, (dt, drag))
    return State(grains, history, state.status), total


_Result = tuple[Grains, Any, jax.Array]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _bin(
    anywhere: bool, system: System, grains: Grains, history: Any, boxes: Box, numbers: tuple[jax.Array, jax.Array]
) -> _Result:
    """The steps whose walls are `boxes` ([steps, 3, B]); `numbers` are (dt, drag).

    Returns:
        The grains, the history, and the sum over the steps of the wall pressures, [3, B].
    """
    arrays = _arrays(system, grains, history, boxes, numbers)
    definition = _Definition.of(system, history) if anywhere else None
    return _result(grains, history, calls.forward(_call(system, history), definition, _fixed(system), arrays))


@functools.partial(_bin.defjvp, symbolic_zeros=True)
def _bin_jvp(anywhere: bool, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[_Result, _Result]:
    """The tangent with respect to what is being differentiated and no more."""
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

    system, _, history, *_ = primals
    if not all(map(_is_zero, jax.tree.leaves((tangents[0].pairs, tangents[0].clump.offsets)))):
        # The library has no derivatives by these.
        _, slope = jax.jvp(lambda *varied: _plain(*filled(varied)), varied, directions)
        return _bin(anywhere, *primals), slope
    arrays, along = jax.jvp(lambda *varied: _arrays(*filled(varied)), varied, directions)
    definition = _Definition.of(system, history) if anywhere else None
    change = calls.tangent(_call(system, history), definition, _fixed(system), arrays, along)
    return _bin(anywhere, *primals), _result(primals[1], history, change)


def _is_zero(slope: Any) -> bool:
    return isinstance(slope, jax.custom_derivatives.SymbolicZero)


def _plain(system: System, grains: Grains, history: Any, boxes: Box, numbers: tuple[jax.Array, jax.Array]) -> _Result:
    """The definition of `_bin`."""
    state = State(grains, history, jnp.zeros(grains.position.shape[-1], jnp.int32))
    state, total = dynamics.march(system, state, boxes, *numbers)
    return state.grains, state.history, total


@dataclass(frozen=True)
class _Definition:
    """`_plain` on the arguments of a call, `gmem_jax.native.calls.Definition`.

    Attributes:
        system: structure of the `System`.
        history: structure of the history.
    """

    system: Any
    history: Any

    @classmethod
    def of(cls, system: System, history: Any) -> "_Definition":
        return cls(jax.tree.structure(system), jax.tree.structure(history))

    def __call__(self, fixed: Fixed, arrays: Arrays) -> Results:
        empty: System = jax.tree.unflatten(self.system, [None] * self.system.num_leaves)
        dt, drag, mass, *others = arrays.parameters
        clump = replace(empty.clump, offsets=fixed.offsets, mass=mass, inertia=jnp.stack(others[:3]))
        law: Any = empty.friction
        if not isinstance(law, Frictionless):
            law = replace(law, mu=others[6], stiffness=others[7], damping_time=others[8])
        if isinstance(law, Mindlin):
            law = replace(law, p_max=(others[9] * (law.points - 1)) ** 2)
        lists = ("first", "second", "valid", "incidence")
        pairs = replace(empty.pairs, **{field: getattr(fixed, field) for field in lists})
        boxes = Box(*jnp.split(arrays.walls, 4, axis=1))
        history = jax.tree.unflatten(self.history, arrays.history)
        system = replace(empty, clump=clump, friction=law, pairs=pairs)
        grains, history, total = _plain(system, Grains(*arrays.fields), history, boxes, (dt, drag))
        return Results(jax.tree.leaves(grains), total, jax.tree.leaves(history))


def _call(system: System, history: Any) -> Call:
    """What the library is told beside arrays."""
    law = system.friction
    return Call(
        law=_LAWS.index(type(law)),
        variant=_VARIANTS.index(law.variant) if isinstance(law, Mindlin) else 0,
        points=law.points if isinstance(law, Mindlin) else 0,
        isotropic=int(system.clump.isotropic),
        leaves=len(jax.tree.leaves(history)),
    )


def _fixed(system: System) -> Fixed:
    """Arguments without derivatives."""
    pairs = system.pairs
    candidates = (pairs.first, pairs.second, pairs.valid, pairs.incidence, pairs.reference[..., 0], pairs.smallest)
    return Fixed(*candidates, system.clump.offsets)


def _arrays(system: System, grains: Grains, history: Any, boxes: Box, numbers: tuple[jax.Array, jax.Array]) -> Arrays:
    """Arguments with derivatives."""
    walls = jnp.concatenate([boxes.lower, boxes.upper, boxes.lower_velocity, boxes.upper_velocity], axis=1)
    parameters = _parameters(system, numbers, grains.position.shape[-1])
    return Arrays(jax.tree.leaves(grains), parameters, walls, jax.tree.leaves(history))


def _result(grains: Grains, history: Any, results: Results) -> _Result:
    moved = jax.tree.unflatten(jax.tree.structure(grains), results.fields)
    return moved, jax.tree.unflatten(jax.tree.structure(history), results.history), results.pressure


def _parameters(system: System, numbers: tuple[jax.Array, jax.Array], replicas: int) -> jax.Array:
    """What problem.h calls the rows of the parameter array, [rows, B]."""
    law, clump, material = system.friction, system.clump, system.material
    own: tuple[Any, ...] = (0.0, 0.0, 0.0, 1.0)
    if isinstance(law, Hooke | MindlinRescaled | Mindlin):
        own = (law.mu, law.stiffness, law.damping_time, law.spacing if isinstance(law, Mindlin) else 1.0)
    solid = (material.normal_stiffness, material.normal_damping, material.wall_stiffness)
    rows = (*numbers, clump.mass, *clump.inertia, *solid, *own)
    return jnp.stack([jnp.broadcast_to(jnp.asarray(row, jnp.float64), (replicas,)) for row in rows])


# `advance`: bins, samples and numbers of steps that are known only at run time.


def pick(backend: str = "auto") -> Advance:
    """The `advance` of a backend.

    Args:
        backend: "jax"; "native"; or "auto", native where it is available and knows the friction law.

    Raises:
        ValueError: if the backend is unknown or not available.
    """
    if marcher(backend) is march:
        return advance
    possible = backend == "auto" and available()[0] and jax.default_backend() == "cpu"
    return _where_supported if possible else dynamics.advance


def _where_supported(system: System, state: State, *args: Any, **options: Any) -> tuple[State, Sample]:
    chosen = advance if supports(system.friction) else dynamics.advance
    return chosen(system, state, *args, **options)


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
    """`gmem_jax.physics.step.advance` on the native backend; arguments and results as there.

    Raises:
        ValueError: if the backend is not available, does not know the friction law, or the state is not float64.
    """
    _require(system, state)
    dt = jnp.asarray(dt)
    replicas = state.replicas

    def part(state: State, begun: jax.Array, count: int, limit: Scalar | None) -> tuple[State, jax.Array]:
        """The next `count` steps, or only `limit` of them, and the sum of their wall pressures."""
        times = (jnp.reshape(begun + 1 + jnp.arange(count), (-1, *(1 for _ in dt.shape))) * dt).astype(dt.dtype)
        boxes = jax.vmap(motion.box_at)(times)
        if limit is None:
            return march(system, state, boxes, dt, drag)
        boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, 3, replicas)), boxes)
        limits = jnp.broadcast_to(jnp.asarray(limit, jnp.int32), (replicas,))
        numbers = (dt, jnp.asarray(drag))
        grains, history, total = _part(system, state.grains, state.history, boxes, numbers, limits)
        return State(grains, history, state.status), total

    def one_bin(state: State, bin_index: jax.Array) -> tuple[State, Sample]:
        begun = bin_index * steps
        if isinstance(steps, jax.core.Tracer):

            def next_part(index: jax.Array, carry: tuple[State, jax.Array]) -> tuple[State, jax.Array]:
                state, total = carry
                state, more = part(state, begun + index * _PART, _PART, jnp.minimum(steps - index * _PART, _PART))
                return state, total + more

            nothing = jnp.zeros((3, replicas), state.grains.position.dtype)
            state, total = lax.fori_loop(0, (steps + _PART - 1) // _PART, next_part, (state, nothing))
        else:
            state, total = part(state, begun, int(steps), None)
        return dynamics.end_bin(system, state, motion.box_at((begun + steps) * dt), total / steps)

    return checkpoint.scan(one_bin, state, first_bin + jnp.arange(bins))


@jax.custom_jvp
def _part(
    system: System,
    grains: Grains,
    history: Any,
    boxes: Box,
    numbers: tuple[jax.Array, jax.Array],
    limits: jax.Array,
) -> _Result:
    """`_bin`, of which every replica takes its first `limits` [B] steps only."""
    arrays = _arrays(system, grains, history, boxes, numbers)
    fixed = _fixed(system)._replace(limits=limits)
    return _result(grains, history, calls.forward(_call(system, history), None, fixed, arrays))


def _plain_part(
    system: System,
    grains: Grains,
    history: Any,
    boxes: Box,
    numbers: tuple[jax.Array, jax.Array],
    limits: jax.Array,
) -> _Result:
    """The definition of `_part`."""
    dt, drag = numbers

    def one_step(carry: tuple[State, jax.Array], xs: tuple[jax.Array, Box]) -> tuple[tuple[State, jax.Array], None]:
        state, total = carry
        index, box = xs
        moved, walls = dynamics.step(system, state, box, dt, drag, index >= 0)
        after = moved, total + dynamics.wall_pressure(walls, box)
        return jax.tree.map(lambda new, old: jnp.where(index < limits, new, old), after, carry), None

    replicas = grains.position.shape[-1]
    state = State(grains, history, jnp.zeros(replicas, jnp.int32))
    total = jnp.zeros((3, replicas), grains.position.dtype)
    steps = jnp.arange(boxes.lower.shape[0])
    (state, total), _ = lax.scan(jax.checkpoint(one_step), (state, total), (steps, boxes))
    return state.grains, state.history, total


@_part.defjvp
def _part_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[_Result, _Result]:
    _, slope = jax.jvp(_plain_part, primals, tangents)
    return _part(*primals), slope
