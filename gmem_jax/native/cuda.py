"""The native backend on CUDA GPUs: the arrays of a call, and whether it is supported.

The kernels (src/cuda) are the physics of the CPU's library, compiled where they run by NVRTC. A step is two launches: a
thread is a candidate of a replica in the first, and a grain in the second. Reverse mode keeps what it needs of each
step, and then goes back through the steps (src/cuda/back.h). Arrays that are kept, or needed from one step to the next,
are further results of the call, so that XLA manages all memory.
"""

import ctypes
import functools
import math
import os
import re
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp

from gmem_jax.home import cache_folder

CUDA_TARGETS = {
    "gmem_advance": "gmem_cuda_advance",
    "gmem_tangent": "gmem_cuda_tangent",
    "gmem_adjoint": "gmem_cuda_adjoint",
}
"""Symbols of the library by the names of calls; see `serves`."""

Task = Literal["forward", "tangent", "adjoint"]
"""The task that kernels are compiled for, in the order of src/physics/parameters.h."""

_NAMES = ("libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so")
_registered: list[ctypes.CDLL] = []  # the library, once it is loaded


def _nvrtc() -> str:
    """Paths where NVRTC may be, joined by ":": those of Python packages, the newest first, then names of the system."""
    spec = find_spec("nvidia")
    roots = [] if spec is None else list(spec.submodule_search_locations or ())
    found = [path for root in roots for path in Path(root).glob("*/lib/libnvrtc.so.*") if path.suffix[1:].isdigit()]
    newest_first = sorted(found, key=lambda path: int(path.suffix[1:]), reverse=True)
    return ":".join([*map(str, newest_first), *_NAMES])


def _architectures() -> set[str]:
    """The architectures of the GPUs of this process, like "sm_90"."""
    try:
        devices = jax.local_devices(backend="cuda")
    except RuntimeError:
        return set()
    capabilities = {getattr(device, "compute_capability", "") for device in devices}
    return {"sm_" + one.replace(".", "") for one in capabilities if one}


@functools.cache
def missing() -> str:
    """Why GPUs run plain JAX; "" if the kernels can run, as far as that is known before a program runs."""
    if not _registered:
        return "the native library is not there"
    said = ctypes.create_string_buffer(1 << 10)
    for architecture in sorted(_architectures()) or [""]:
        if _registered[-1].gmem_cuda_missing(architecture.encode(), said, len(said)):
            return said.value.decode()
    return ""


@functools.cache
def warn_no_nvrtc(reason: str) -> None:
    """Warn that plain JAX runs on the GPU, and say why; once for each reason."""
    warnings.warn(f"plain JAX runs on the GPU, and slowly: {reason}", stacklevel=2)


def serves(target: str, call: Any) -> bool:
    """Whether there are kernels for a call; if not, GPUs run it in plain JAX.

    Reverse mode has kernels for equal spheres between smooth walls, under any law but M2. Second derivatives have none.

    Args:
        target: name of the call in XLA.
        call: its attributes, `gmem_jax.native.calls.Call`.
    """
    beyond = call.points or call.periodic or call.unequal or call.rubs
    return target in CUDA_TARGETS and not (target == "gmem_adjoint" and beyond)


def _cache() -> str:
    """The folder for compiled kernels; "" if they are not kept."""
    chosen = os.environ.get("GMEM_COMPILE_CACHE", "")
    if chosen == "off":
        return ""
    if chosen:
        return str(Path(chosen) / "kernels")
    folder = cache_folder()
    return str(folder / "kernels") if folder else ""


def initializing(symbol: str) -> str:
    """The symbol of the function that loads the kernels of a call before it is made."""
    return f"{symbol}_load"


def register(library: ctypes.CDLL, sources: Path) -> None:
    """Register the calls on GPUs with XLA, and tell the library where NVRTC, its sources and its cache are."""
    for target, symbol in CUDA_TARGETS.items():
        stages = {"initialize": initializing(symbol), "execute": symbol}
        handlers = {stage: jax.ffi.pycapsule(getattr(library, name)) for stage, name in stages.items()}
        jax.ffi.register_ffi_target(target, handlers, platform="CUDA")
    library.gmem_cuda_paths(*(ctypes.c_char_p(path.encode()) for path in (_nvrtc(), str(sources), _cache())))
    _registered.append(library)


class Needs(NamedTuple):
    """The resources that a kernel needs.

    Attributes:
        registers: registers of a thread.
        spilt: bytes that a thread stores in memory and loads again, because it has no more registers.
    """

    registers: int
    spilt: int


def kernel_needs(
    library: ctypes.CDLL, law: int, variant: int, architecture: str, task: Task = "forward"
) -> dict[str, Needs]:
    """The needs of the kernels of a law by their names, compiled for an architecture; no GPU need be present.

    Args:
        library: the native library.
        law: number of the law, as in `gmem_jax.native.calls.Call`.
        variant: number of its variant, likewise.
        architecture: the architecture, like "sm_90".
        task: the task of the kernels; "adjoint" for a law that has reverse mode on GPUs.

    Raises:
        RuntimeError: if there is no NVRTC, or it fails.
    """
    said = ctypes.create_string_buffer(1 << 16)
    failed = library.gmem_cuda_compile(architecture.encode(), law, variant, get_args(Task).index(task), said, len(said))
    text = said.value.decode()
    if failed:
        raise RuntimeError(text)
    found = {}
    for part in text.split("Compiling entry function '")[1:]:
        spilt = sum(map(int, re.findall(r"(\d+) bytes spill", part)))
        found[part.split("'")[0]] = Needs(int(re.findall(r"Used (\d+) registers", part)[0]), spilt)
    return found


def is_sound(pairs: Any) -> jax.Array:
    """Whether every candidate is listed once by each of its two spheres, and nothing else is.

    Args:
        pairs: an object with `first`, `second`, `valid`, [P], and `incidence`, [S, C], as in `Pairs`.
    """
    capacity, rows = len(pairs.first), pairs.incidence
    spheres = jnp.arange(len(rows), dtype=jnp.int32)[:, None]
    row = rows % capacity
    listed, other = pairs.first[row], pairs.second[row]
    listed, other = jnp.where(rows < capacity, listed, other), jnp.where(rows < capacity, other, listed)
    real = (rows >= 0) & (rows < 2 * capacity) & pairs.valid[row] & (listed == spheres)
    real &= (other >= 0) & (other < len(rows))
    count = jnp.sum(real, dtype=jnp.int32) == 2 * jnp.sum(pairs.valid, dtype=jnp.int32)
    return count & jnp.all(real | (rows == 2 * capacity))


def between_steps(
    fixed: Any, history: Sequence[Any], grains: int, call: Any, kinds: int, lanes: int, kept: int | None = None
) -> list[Any]:
    """Shapes of the arrays that the kernels need from one step to the next; see src/cuda/arguments.h.

    Args:
        fixed: the `Fixed` arguments of the call.
        history: the histories of the call, leaves [1, P, ..., B], and [1, 6 S, ..., B] where walls have friction.
        grains: number of grains N.
        call: attributes of the call, `gmem_jax.native.calls.Call`.
        kinds: one for values, two for values and derivatives.
        lanes: number of replicas of all entries together, L.
        kept: number of steps that reverse mode keeps, T; None in a forward run.
    """
    spheres, rows = fixed.incidence.shape[1], fixed.first.shape[1]

    def array(*shape: int, dtype: Any = jnp.float64) -> Any:
        return jax.ShapeDtypeStruct((1, *shape, lanes), dtype)

    found = [array(kinds, grains, 9), array(kinds, spheres, 3), array(kinds, grains, 4)]
    found += [array(kinds, spheres, 12 if call.rubs or kept is not None else 6)]
    found += [array(kinds, rows, 6 if kept is None else 18)]
    found += [array(rows + spheres, dtype=jnp.uint8)]
    if kinds == 2 or kept is not None:  # in a forward run of values alone, the results hold the histories
        found += [array(kinds, *leaf.shape[1:3]) for leaf in history if leaf.ndim == 4]
    for count in (rows, 6 * spheres)[: 1 + call.rubs if call.points else 0]:
        found += [array(kinds, count, 6), array(kinds, count, call.points, 3), array(count, dtype=jnp.int32)]
    if kept is None:
        return found
    remembered, chunks = sum(leaf.shape[2] for leaf in history), -(-grains // 64)
    found += [array(kept, grains, 19), array(kept, grains, 6), array(kept, rows, remembered)]
    found += [array(grains, 19), array(grains, 12)]  # for the step that reverse mode is at; then sums
    return [*found, array(grains, 14 + 3 * (spheres // grains)), array(rows, 7), array(kept, chunks, 12)]


def aliases_of(before: Sequence[Any], arrays: Any, results: Sequence[Any]) -> dict[int, int]:
    """The fields of the grains and the histories, which a call updates in their own memory.

    Args:
        before: the arguments before the histories; the fields are the first of them.
        arrays: the arguments with respect to which a call can be differentiated.
        results: the shapes of the results.

    Returns:
        For the number of an argument, the number of the result that takes its memory.
    """
    fields, histories = len(arrays.fields), len(arrays.history)
    places = [*range(fields), *range(len(before), len(before) + histories)]
    numbers = [*range(fields), *range(fields + 1, fields + 1 + histories)]  # between them is the pressure
    found = zip(places, numbers, (*arrays.fields, *arrays.history), strict=True)
    return {argument: result for argument, result, leaf in found if leaf.shape == results[result].shape}


def call_kernels(target: str, call: Any, in_place: bool, parts: Any, shapes: Sequence[Any]) -> Sequence[jax.Array]:
    """A call of the library; returns the results, of the given shapes, and then the arrays of `between_steps`.

    Args:
        target: name of the call in XLA.
        call: attributes of the call, `gmem_jax.native.calls.Call`.
        in_place: whether new fields and histories may overwrite those that were given.
        parts: `Fixed` and `Arrays` of `gmem_jax.native.calls`; then the `Arrays` of the tangent or, for reverse mode,
            a `StepOutput`.
        shapes: shapes of the results.
    """
    outer = shapes[0].shape[:-3]
    entries = math.prod(outer)

    def flat(leaf: jax.Array) -> jax.Array:
        """A leaf with its leading axes joined in one, of size one or `entries`."""
        inner = leaf.shape[len(outer) :]
        if math.prod(leaf.shape[: len(outer)]) == 1:
            return leaf.reshape(1, *inner)
        return jnp.broadcast_to(leaf, (*outer, *inner)).reshape(entries, *inner)

    fixed, arrays, *slopes = jax.tree.map(flat, parts)
    lists = {name: getattr(fixed, name) for name in ("first", "second", "valid", "incidence")}
    many = max(map(len, lists.values()))
    whole = {name: jnp.broadcast_to(leaf, (many, *leaf.shape[1:])) for name, leaf in lists.items()}
    sound = jax.vmap(lambda **lists: is_sound(fixed._replace(**lists)))(**whole)
    blank, odd = 2 * fixed.first.shape[1], -fixed.incidence.shape[2] % 4
    lists["incidence"] = jnp.pad(fixed.incidence, ((0, 0), (0, 0), (0, odd)), constant_values=blank)  # read in fours
    numbers = jnp.where(sound[:, None, None], arrays.parameters, jnp.nan)  # a call cannot refuse a list otherwise
    before = [*arrays.fields, *lists.values(), fixed.images]
    before += [arrays.offsets[..., 0], fixed.radii, fixed.sizes]
    before += [numbers, arrays.walls]
    results = [jax.ShapeDtypeStruct((entries, *shape.shape[len(outer) :]), shape.dtype) for shape in shapes]
    aliases = aliases_of(before, arrays, results) if in_place else {}
    _, grains, _, replicas = arrays.fields[0].shape
    lanes = entries * replicas
    along = [type(one) is type(arrays) for one in slopes]  # else derivatives by the results: reverse mode
    kept = None if all(along) else arrays.walls.shape[1]
    kinds = 2 if any(along) else 1
    between = between_steps(fixed, arrays.history, grains, call, kinds, lanes, kept)
    ffi = jax.ffi.ffi_call(target, [*results, *between], input_output_aliases=aliases)
    found: list[jax.Array] = list(ffi(*before, *arrays.history, *jax.tree.leaves(slopes), **call._asdict()))
    if kept is not None:  # some derivatives do not depend on the parameters where nothing touches
        for number, bar in enumerate(found[: len(arrays.fields) + 3]):
            known = jnp.expand_dims(sound, tuple(range(1, bar.ndim)))
            found[number] = jnp.where(known, bar, jnp.full_like(bar, jnp.nan))
    moved = [leaf.reshape(shape.shape) for leaf, shape in zip(found, shapes, strict=False)]
    return [*moved, *found[len(shapes) :]]
