"""`advance` in C++ for CPUs, behind jax.ffi: the numbers of `gmem_jax.physics.step.advance`, several times faster.

One call into the library runs all steps of one bin for all replicas; walls, checks and samples are computed in JAX,
as in `dynamics.advance`. It works under `jax.jit`, `jax.vmap` and both modes of differentiation, whose derivatives
are computed in the library too; see `gmem_jax.native.derivatives`.
"""

import ctypes
import functools
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.experiment import checkpoint
from gmem_jax.experiment.protocol import Motion
from gmem_jax.native import derivatives
from gmem_jax.native.derivatives import Call
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.state import Box, Grains, Scalar, State
from gmem_jax.physics.step import Sample, System

Advance = Callable[..., tuple[State, Sample]]
"""The signature of `gmem_jax.physics.step.advance`."""

BACKENDS = ("auto", "jax", "native")

_LAWS: tuple[type, ...] = (Frictionless, Hooke, MindlinRescaled, Mindlin)  # numbered as in parameters.h
_VARIANTS = ("exact", "averaged", "paper")
_PART = 32  # steps per call where their number is not known when the program is compiled


def _path() -> Path:
    from gmem_jax.native.build import LIBRARY  # here, so that ``python -m gmem_jax.native.build`` loads it only once

    return Path(__file__).parent / LIBRARY


@functools.cache
def _load() -> str:
    """Load and register the library, once; returns why that failed ("" if it did not)."""
    from gmem_jax.native.build import is_stale  # here, as in `_path`

    path = _path()
    if not path.exists():
        return "it was not built (no C++ compiler when gmem_jax was installed?); python -m gmem_jax.native.build"
    try:
        library = ctypes.CDLL(str(path))
        if is_stale(library):
            reason = "its library is older than its sources; rebuild it: python -m gmem_jax.native.build"
            warnings.warn(f"the native backend is not used: {reason}", RuntimeWarning, stacklevel=2)
            return reason
        for target in derivatives.TARGETS:
            jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(library, target)), platform="cpu")
    except (OSError, AttributeError) as error:
        return f"its library could not be loaded: {error}"
    return ""


def available() -> tuple[bool, str]:
    """Whether the native backend can run here, and why not (or the instruction set it uses)."""
    if reason := _load():
        return False, reason
    if jax.default_backend() != "cpu":
        return False, f"it runs on CPUs, and JAX's default device is a {jax.default_backend()}"
    library = ctypes.CDLL(str(_path()))
    library.gmem_instruction_set.restype = ctypes.c_char_p
    return True, library.gmem_instruction_set().decode()


def supports(law: FrictionLaw) -> bool:
    """Whether the native backend knows this friction law (a user's own runs in plain JAX)."""
    return type(law) in _LAWS


def name(backend: str, law: FrictionLaw) -> str:
    """What "auto" means here for this friction law: "jax" or "native"; the other names are themselves."""
    if backend != "auto":
        return backend
    return "native" if available()[0] and supports(law) else "jax"


def pick(backend: str = "auto") -> Advance:
    """The `advance` of a backend.

    Args:
        backend: "jax"; "native"; or "auto", native where it is available and knows the friction law.

    Raises:
        ValueError: if the backend is unknown or not available.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    possible, reason = (False, "") if backend == "jax" else available()
    if backend == "native" and not possible:
        raise ValueError(f"the native backend is not available: {reason}")
    if backend == "native":
        return advance
    return _where_supported if possible else dynamics.advance


def _where_supported(system: System, state: State, *args: Any, **options: Any) -> tuple[State, Sample]:
    chosen = advance if supports(system.friction) else dynamics.advance
    return chosen(system, state, *args, **options)


def _require(system: System, state: State) -> None:
    """Raise if this backend cannot run them.

    Raises:
        ValueError: if the backend is not available, does not know the friction law, or the state is not float64.
    """
    possible, reason = available()
    if not possible:
        raise ValueError(f"the native backend is not available: {reason}")
    if not supports(system.friction):
        raise ValueError(f"the native backend does not know the friction law {type(system.friction).__name__}")
    if state.grains.position.dtype != jnp.float64:
        raise ValueError(f"the native backend needs float64, got {state.grains.position.dtype}")


def march(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """`gmem_jax.physics.step.march` on the native backend; arguments, results and errors as of `advance`."""
    _require(system, state)
    numbers = (jnp.asarray(dt), jnp.asarray(drag))
    grains, history, total = _bin(system, state.grains, state.history, boxes, numbers, None, jnp.asarray(0))
    return State(grains, history, state.status), total


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
        boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, 3, replicas)), boxes)
        numbers = (dt, jnp.asarray(drag))
        limits = None if limit is None else jnp.broadcast_to(jnp.asarray(limit, jnp.int32), (replicas,))
        grains, history, total = _bin(system, state.grains, state.history, boxes, numbers, limits, begun)
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


_Result = tuple[Grains, Any, jax.Array]


@functools.partial(jax.custom_jvp)
def _bin(
    system: System,
    grains: Grains,
    history: Any,
    boxes: Box,
    numbers: tuple[jax.Array, jax.Array],
    limits: jax.Array | None,
    begun: jax.Array,
) -> _Result:
    """The steps whose walls are `boxes` ([steps, 3, B]), or the first `limits` [B] of them; `numbers` are (dt, drag).

    Returns:
        The grains, the history, and the sum over the steps of the wall pressures, [3, B].
    """
    steps, replicas = boxes.lower.shape[0], grains.position.shape[-1]
    counts = jnp.full(replicas, steps, jnp.int32) if limits is None else limits
    call = _call(system, history)
    fixed = _fixed(system, counts)
    return _result(grains, history, derivatives.forward(call, fixed, _moving(system, grains, history, boxes, numbers)))


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


def _fixed(system: System, steps: jax.Array) -> tuple[jax.Array, ...]:
    """Arguments without derivatives."""
    pairs = system.pairs
    candidates = (pairs.first, pairs.second, pairs.valid, pairs.reference[..., 0], pairs.smallest)
    return (*candidates, system.clump.offsets, steps)


def _moving(
    system: System, grains: Grains, history: Any, boxes: Box, numbers: tuple[jax.Array, jax.Array]
) -> derivatives.Arrays:
    """Arguments with derivatives."""
    walls = jnp.concatenate([boxes.lower, boxes.upper, boxes.lower_velocity, boxes.upper_velocity], axis=1)
    parameters = _parameters(system, numbers, grains.position.shape[-1])
    return derivatives.Arrays(jax.tree.leaves(grains), parameters, walls, jax.tree.leaves(history))


def _result(grains: Grains, history: Any, results: derivatives.Results) -> _Result:
    moved = jax.tree.unflatten(jax.tree.structure(grains), results.fields)
    return moved, jax.tree.unflatten(jax.tree.structure(history), results.history), results.pressure


def _parameters(system: System, numbers: tuple[jax.Array, jax.Array], replicas: int) -> jax.Array:
    """What parameters.h calls the rows of the parameter array, [rows, B]."""
    law, clump, material = system.friction, system.clump, system.material
    own: tuple[Any, ...] = (0.0, 0.0, 0.0, 1.0)
    if isinstance(law, Hooke | MindlinRescaled | Mindlin):
        own = (law.mu, law.stiffness, law.damping_time, law.spacing if isinstance(law, Mindlin) else 1.0)
    solid = (material.normal_stiffness, material.normal_damping, material.wall_stiffness)
    rows = (*numbers, clump.mass, *clump.inertia, *solid, *own)
    return jnp.stack([jnp.broadcast_to(jnp.asarray(row, jnp.float64), (replicas,)) for row in rows])


def _plain_bin(
    system: System,
    grains: Grains,
    history: Any,
    boxes: Box,
    numbers: tuple[jax.Array, jax.Array],
    limits: jax.Array | None,
    begun: jax.Array,
) -> _Result:
    """The definition of `_bin`, for derivatives that the library does not have."""
    dt, drag = numbers
    alive = jnp.asarray(begun) >= 0
    replicas = grains.position.shape[-1]

    def one_step(carry: tuple[State, jax.Array], xs: tuple[jax.Array, Box]) -> tuple[tuple[State, jax.Array], None]:
        state, total = carry
        index, box = xs
        moved, walls = dynamics.step(system, state, box, dt, drag, alive & (index >= 0))
        after = moved, total + dynamics.wall_pressure(walls, box)
        going = True if limits is None else index < limits
        return jax.tree.map(lambda new, old: jnp.where(going, new, old), after, carry), None

    state = State(grains, history, jnp.zeros(replicas, jnp.int32))
    total = jnp.zeros((3, replicas), grains.position.dtype)
    steps = jnp.arange(boxes.lower.shape[0])
    (state, total), _ = lax.scan(jax.checkpoint(one_step), (state, total), (steps, boxes))
    return state.grains, state.history, total


@functools.partial(_bin.defjvp, symbolic_zeros=True)
def _bin_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[_Result, _Result]:
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

    system, limits = primals[0], primals[5]
    of_system = tangents[0]
    known = limits is None and all(map(_is_zero, jax.tree.leaves((of_system.pairs, of_system.clump.offsets))))
    if not known:
        _, slope = jax.jvp(lambda *varied: _plain_bin(*filled(varied)), varied, directions)
        return _bin(*primals), slope
    moving, along = jax.jvp(lambda *varied: _moving(*filled(varied)[:5]), varied, directions)
    counts = jnp.full(moving.parameters.shape[-1], moving.walls.shape[0], jnp.int32)
    change = derivatives.tangent(_call(system, primals[2]), _fixed(system, counts), moving, along)
    return _bin(*primals), _result(primals[1], primals[2], change)


def _is_zero(slope: Any) -> bool:
    return isinstance(slope, jax.custom_derivatives.SymbolicZero)
