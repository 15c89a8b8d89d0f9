"""The steps of one bin in C++, behind jax.ffi: the numbers of `gmem_jax.physics.step.march`, several times faster.

One call into the library runs all steps of one bin for all replicas; walls, checks and samples are computed in JAX.
It works under `jax.jit`, `jax.vmap`, `jax.shard_map`, on sharded arrays, and in both modes of differentiation, whose
derivatives are computed in the library too; see `gmem_jax.native.calls`.

On CUDA GPUs the same C++ runs as kernels; see `gmem_jax.native.gpu` and docs/gpu.md. What follows is said of CPUs.

Numbers depend neither on threads nor on what else is in a batch, and are the same with AVX2 and AVX-512. CPUs without
fused multiply-add ("baseline" in `available`) differ from those in last digits, fidelities by some 1e-11. Calls at once
share out the CPUs; GMEM_THREADS limits the threads of each, and GMEM_CACHE (in MB) stands for the caches that are found
when it is not right about how many blocks of replicas fit into them. JAX does not survive os.fork: start processes by
"spawn".
"""

import ctypes
import functools
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
from jax.extend.backend import get_backend

from gmem_jax.native import calls, gpu
from gmem_jax.native.calls import Arrays, Call, Fixed, Results
from gmem_jax.native.search import searcher
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.laws import Entry, entry_of
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.pytree import Scalar
from gmem_jax.physics.search import Search
from gmem_jax.physics.state import Box, Grains, State
from gmem_jax.physics.step import System

March = Callable[[System, State, Box, Scalar, Scalar], tuple[State, jax.Array]]
"""The signature of `gmem_jax.physics.step.march`."""

Backend = Literal["auto", "jax", "native"]
Precision = Literal["double", "mixed"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)
PRECISIONS: tuple[Precision, ...] = get_args(Precision)

_LAW_NUMBERS = 5  # rows of the parameter array for a law's own, as in parameters.h
_VARIANTS = ("exact", "averaged", "paper")


def _path() -> Path:
    from gmem_jax.native.build import LIBRARY  # here, so that ``python -m gmem_jax.native.build`` loads it only once

    return Path(__file__).parent / LIBRARY


@functools.cache
def _load() -> tuple[str, str]:
    """Load and register the library, once; returns its instruction set, and why that failed ("" if it did not)."""
    from gmem_jax.native.build import SOURCES, is_stale  # here, as in `_path`

    path = _path()
    if not path.exists():
        return "", "it was not built (no C++ compiler when gmem_jax was installed?); python -m gmem_jax.native.build"
    try:
        library = ctypes.CDLL(str(path))
        if is_stale(library):
            return "", "its library is older than its sources; rebuild it: python -m gmem_jax.native.build"
        for target in calls.TARGETS:
            jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(library, target)), platform="cpu")
        gpu.register(library, SOURCES)
        library.gmem_instruction_set.restype = ctypes.c_char_p
        return library.gmem_instruction_set().decode(), ""
    except (OSError, AttributeError) as error:
        return "", f"its library could not be loaded: {error}"


def available() -> tuple[bool, str]:
    """Whether the native backend can run on this machine's CPU, and the instruction set it uses (or why not)."""
    instructions, reason = _load()
    return not reason, reason or instructions


@functools.cache
def search() -> Search | None:
    """The search for candidate contacts in the library; None where it is not available."""
    return searcher(_path()) if available()[0] else None


def supports(law: FrictionLaw) -> bool:
    """Whether the native backend knows this friction law (a user's own runs in plain JAX)."""
    return entry_of(law) is not None


def needs(law: FrictionLaw, architecture: str, *, tangent: bool = False) -> dict[str, gpu.Needs]:
    """What the kernels of a law take of a GPU, compiled for its architecture ("sm_90") on this machine.

    Args:
        law: one that the backend knows.
        architecture: as NVRTC calls it.
        tangent: of numbers that carry derivatives.

    Raises:
        RuntimeError: if there is no NVRTC, or it does not know the architecture.
        ValueError: if the backend is not available.
    """
    _require_library()
    numbers = _entry(law).native, _variant(law)
    return gpu.needs(ctypes.CDLL(str(_path())), *numbers, architecture, tangent=tangent)


def name(backend: str, law: FrictionLaw) -> Backend:
    """What "auto" means for this friction law on JAX's default device, "jax" or "native"; others are themselves.

    Raises:
        ValueError: if there is no such backend.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    if backend != "auto":
        return cast(Backend, backend)
    if not available()[0] or not supports(law):
        return "jax"
    client = get_backend()
    on_gpu = client.platform == "gpu" and "cuda" in client.platform_version and not gpu.missing()
    return "native" if client.platform == "cpu" or on_gpu else "jax"


def require_precision(precision: str, backend: str, law: FrictionLaw) -> None:
    """Refuse a precision that is unknown, or not to be had.

    Raises:
        ValueError: saying why.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}; got {precision!r}")
    if precision == "mixed" and name(backend, law) != "native":
        why = "" if backend == "jax" or available()[0] else f", which is not available: {available()[1]}"
        raise ValueError(f"precision='mixed' is a mode of the native backend{why}; here plain JAX would run")
    if precision == "mixed" and get_backend().platform != "cpu":
        raise ValueError("precision='mixed' is a mode of CPUs so far; use 'double' on a GPU")
    if precision == "mixed" and isinstance(law, Mindlin):
        raise ValueError("precision='mixed' is not for the Mindlin law, whose rings are kept in double precision")


def marcher(backend: str = "auto", precision: str = "double") -> March:
    """The `march` of a backend.

    Args:
        backend: "jax", the definition; "native", this library, which is refused where there is none; or "auto": native
            in what is compiled for CPUs and CUDA GPUs, where the library is at hand and knows the friction law, else
            plain JAX.
        precision: "double", or "mixed": contacts and their histories in single precision, on the native backend; see
            `_march_mixed`.

    Raises:
        ValueError: if the backend is unknown or not available, or the precision is not its own.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")
    if precision not in PRECISIONS or (precision == "mixed" and backend == "jax"):
        raise ValueError(f"precision {precision!r} is not one of the backend {backend!r}")
    if backend == "native" or precision == "mixed":
        _require_library()
    if precision == "mixed":
        return _march_mixed
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
        NotImplementedError: if it is compiled for anything but a CPU or a CUDA GPU, or for that without NVRTC.
    """
    return _march(system, state, boxes, dt, drag, _Mode())


def _march_mixed(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """`march` with contacts in single precision: their forces, torques and histories.

    Positions, orientations, velocities, the sums of forces and the gaps of contacts are in double precision, and the
    gaps rounded. It pays from many replicas side by side, so that a lone one runs in double precision.
    """
    require_precision("mixed", "native", system.friction)
    return _march(system, state, boxes, dt, drag, _Mode(mixed=state.replicas > 1))


def _march_anywhere(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar) -> tuple[State, jax.Array]:
    """`march` on CPUs and CUDA GPUs, its definition elsewhere."""
    if not supports(system.friction):
        return dynamics.march(system, state, boxes, dt, drag)
    if not available()[0]:
        _warn_once(available()[1])
        return dynamics.march(system, state, boxes, dt, drag)
    return _march(system, state, boxes, dt, drag, _Mode(anywhere=True))


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


class _Mode(NamedTuple):
    """How the steps of a bin are done.

    Attributes:
        anywhere: their definition stands for them where there is no library.
        mixed: contacts in single precision.
    """

    anywhere: bool = False
    mixed: bool = False


def _march(system: System, state: State, boxes: Box, dt: Scalar, drag: Scalar, mode: _Mode) -> tuple[State, jax.Array]:
    _require(system, state)
    law = {field.name: getattr(system.friction, field.name) for field in fields(system.friction)}  # type: ignore[arg-type]
    dynamics.require_shapes(state, boxes, dt=dt, drag=drag, mass=system.clump.mass, **law)
    boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leaf.shape[:-1], state.replicas)), boxes)
    system, state, boxes, dt, drag = dynamics.together((system, state, boxes, jnp.asarray(dt), jnp.asarray(drag)))
    grains, history, total = _bin(mode, system, state.grains, state.history, boxes, (dt, drag))
    return State(grains, history, state.status), total


_Result = tuple[Grains, Any, jax.Array]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _bin(
    mode: _Mode, system: System, grains: Grains, history: Any, boxes: Box, numbers: tuple[jax.Array, jax.Array]
) -> _Result:
    """The steps whose walls are `boxes` ([steps, 3, B]); `numbers` are (dt, drag).

    Returns:
        The grains, the history, and the sum over the steps of the wall pressures, [3, B].
    """
    arrays = _arrays(system, grains, history, boxes, numbers)
    definition = _Definition.of(system, history, mode.anywhere)
    call = _call(system, history)._replace(mixed=int(mode.mixed))
    return _result(grains, history, calls.forward(call, definition, _fixed(system), arrays))


@functools.partial(_bin.defjvp, symbolic_zeros=True)
def _bin_jvp(mode: _Mode, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[_Result, _Result]:
    """The tangent with respect to what is being differentiated and no more."""
    if mode.mixed:
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

    system, _, history, *_ = primals
    if not all(map(_is_zero, jax.tree.leaves((tangents[0].pairs, tangents[0].clump.offsets)))):
        # The library has no derivatives by these.
        _, slope = jax.jvp(lambda *varied: _plain(*filled(varied)), varied, directions)
        return _bin(mode, *primals), slope
    arrays, along = jax.jvp(lambda *varied: _arrays(*filled(varied)), varied, directions)
    definition = _Definition.of(system, history, mode.anywhere)
    change = calls.tangent(_call(system, history), definition, _fixed(system), arrays, along)
    return _bin(mode, *primals), _result(primals[1], history, change)


def _is_zero(slope: Any) -> bool:
    return isinstance(slope, jax.custom_derivatives.SymbolicZero)


def _plain(system: System, grains: Grains, history: Any, boxes: Box, numbers: tuple[jax.Array, jax.Array]) -> _Result:
    """The definition of `_bin`."""
    state = State(grains, history, jnp.zeros(grains.position.shape[-1], jnp.int32))
    state, total = dynamics.march(system, state, boxes, *numbers)
    return state.grains, state.history, total


class _Solid(NamedTuple):
    """What a step asks of a `Material`."""

    normal_stiffness: jax.Array
    normal_damping: jax.Array
    wall_stiffness: jax.Array


def _entry(law: FrictionLaw) -> Entry:
    entry = entry_of(law)
    assert entry is not None  # `_require` has seen to it
    return entry


@dataclass(frozen=True)
class _Definition:
    """`_plain` on the arguments of a call, `gmem_jax.native.calls.Definition`.

    Attributes:
        system: structure of the `System`.
        history: structure of the history.
        anywhere: see `gmem_jax.native.calls.Definition`.
    """

    system: Any
    history: Any
    anywhere: bool = True

    @classmethod
    def of(cls, system: System, history: Any, anywhere: bool = True) -> "_Definition":
        return cls(jax.tree.structure(system), jax.tree.structure(history), anywhere)

    def __call__(self, fixed: Fixed, arrays: Arrays) -> Results:
        empty: System = jax.tree.unflatten(self.system, [None] * self.system.num_leaves)
        dt, drag, mass, *inertia = arrays.parameters[:6]
        clump = replace(empty.clump, offsets=fixed.offsets, mass=mass, inertia=jnp.stack(inertia))
        law: Any = empty.friction
        own = dict(zip(_entry(law).numbers, arrays.parameters[9:], strict=False))
        if (spacing := own.pop("spacing", None)) is not None:
            own["p_max"] = (spacing * (law.points - 1)) ** 2
        law = replace(law, **own)
        material: Any = _Solid(*arrays.parameters[6:9])
        lists = ("first", "second", "valid", "incidence")
        pairs = replace(empty.pairs, **{field: getattr(fixed, field) for field in lists})
        boxes = Box(*jnp.split(arrays.walls, 4, axis=1))
        history = jax.tree.unflatten(self.history, arrays.history)
        system = replace(empty, clump=clump, friction=law, pairs=pairs, material=material)
        grains, history, total = _plain(system, Grains(*arrays.fields), history, boxes, (dt, drag))
        return Results(jax.tree.leaves(grains), total, jax.tree.leaves(history))


def _variant(law: FrictionLaw) -> int:
    return _VARIANTS.index(law.variant) if isinstance(law, Mindlin) else 0


def _call(system: System, history: Any) -> Call:
    """What the library is told beside arrays."""
    law = system.friction
    return Call(
        law=_entry(law).native,
        variant=_variant(law),
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
    """What parameters.h calls the rows of the parameter array, [rows, B]."""
    law, clump, material = system.friction, system.clump, system.material
    own = [getattr(law, number) for number in _entry(law).numbers]
    own += [1.0] * (_LAW_NUMBERS - len(own))
    solid = (material.normal_stiffness, material.normal_damping, material.wall_stiffness)
    rows = (*numbers, clump.mass, *clump.inertia, *solid, *own)
    return jnp.stack([jnp.broadcast_to(jnp.asarray(row, jnp.float64), (replicas,)) for row in rows])


# Now, and not when a march is first asked for: a program that `jax.export` wrote calls the library by name, in a
# process that may have imported the package and no more. It starts no backend. While Python looks for the module of
# ``python -m gmem_jax.native.build``, which compiles the library, it must not be imported yet.
if getattr(sys, "argv", [""])[:1] != ["-m"]:
    _load()
