"""The native backend on CUDA GPUs: which arrays a call has there, and whether it can be made at all.

The kernels (src/cuda) are the physics of the CPU's library, compiled where they run by NVRTC. A thread is a grain of a
replica and goes through its own sides of the candidates; what is needed from one step to the next are further results
of the call, so that XLA manages all memory.
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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

CUDA_TARGETS = {"gmem_advance": "gmem_cuda_advance", "gmem_tangent": "gmem_cuda_tangent"}
"""Symbols of the library by the names of calls; reverse mode is in plain JAX."""

_NAMES = ("libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so")


def _packaged() -> str:
    """NVRTC as a Python package brings it; "" if none does."""
    spec = find_spec("nvidia")
    roots = [] if spec is None else list(spec.submodule_search_locations or ())
    found = [path for root in roots for path in Path(root).glob("*/lib/libnvrtc.so.*") if path.suffix[1:].isdigit()]
    return str(max(found, default=""))


@functools.cache
def missing() -> str:
    """Why GPUs run plain JAX; "" if they need not."""
    for name in [path] if (path := _packaged()) else _NAMES:
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return ""
    return "NVRTC was not found; pip install 'gmem-jax[cuda13]'"


@functools.cache
def warn_no_nvrtc(reason: str) -> None:
    """Say that a GPU could be faster, and how."""
    warnings.warn(f"plain JAX runs on the GPU, and slowly: {reason}", stacklevel=2)


def _cache() -> str:
    """The folder for compiled kernels; "" where nothing is to be kept."""
    chosen = os.environ.get("GMEM_COMPILE_CACHE", "")
    if chosen == "off":
        return ""
    if chosen:
        return str(Path(chosen) / "kernels")
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # a user without a home
        return ""
    return str(home / "gmem_jax" / "kernels")


def register(library: ctypes.CDLL, sources: Path) -> None:
    """Tell XLA of the library's calls on GPUs, and the library where its sources are."""
    for target, symbol in CUDA_TARGETS.items():
        jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(library, symbol)), platform="CUDA")
    nvrtc = ":".join([_packaged(), *_NAMES]).lstrip(":")
    library.gmem_cuda_paths(*(ctypes.c_char_p(path.encode()) for path in (nvrtc, str(sources), _cache())))


class Needs(NamedTuple):
    """What a kernel takes of a multiprocessor.

    Attributes:
        registers: of a thread.
        spilt: bytes of a thread that go to memory and back, because it has no more registers.
    """

    registers: int
    spilt: int


def kernel_needs(
    library: ctypes.CDLL, law: int, variant: int, architecture: str, *, tangent: bool = False
) -> dict[str, Needs]:
    """The kernels, compiled for an architecture without a GPU, by their names.

    Args:
        library: the native library.
        law: its number, as of `gmem_jax.native.primitives.Call`.
        variant: alike.
        architecture: as "sm_90".
        tangent: of numbers that carry derivatives.

    Raises:
        RuntimeError: if there is no NVRTC, or it fails.
    """
    said = ctypes.create_string_buffer(1 << 16)
    failed = library.gmem_cuda_compile(architecture.encode(), law, variant, int(tangent), said, len(said))
    text = said.value.decode()
    if failed:
        raise RuntimeError(text)
    found = {}
    for part in text.split("Compiling entry function '")[1:]:
        spilt = sum(map(int, re.findall(r"(\d+) bytes spill", part)))
        found[part.split("'")[0]] = Needs(int(re.findall(r"Used (\d+) registers", part)[0]), spilt)
    return found


class Sides(NamedTuple):
    """The candidates as each of their two grains sees them.

    Attributes:
        start: where the sides of each grain begin, int32 [N + 1].
        side: own sphere, other sphere - as ~s where it is the one listed first -, candidate; int32 [2 P, 3].
        place: number of each candidate's side that is listed first; -1 for padding, int32 [P].
    """

    start: jax.Array
    side: jax.Array
    place: jax.Array


def sides_of(pairs: Any, spheres: int) -> tuple[Sides, jax.Array]:
    """The sides of a list of candidates, and whether it is sound.

    Args:
        pairs: with `first`, `second`, `valid`, [P], and `incidence`, [S, C], as of `Pairs`.
        spheres: of a grain, K.
    """
    capacity, (count, columns) = len(pairs.first), pairs.incidence.shape
    rows = pairs.incidence.reshape(-1)
    mine = jnp.repeat(jnp.arange(count, dtype=jnp.int32), columns)
    as_first, row = rows < capacity, rows % capacity
    listed, other = pairs.first[row], pairs.second[row]
    listed, other = jnp.where(as_first, listed, other), jnp.where(as_first, other, listed)
    # What leads outside of the arrays must not get to the kernels, which do not look.
    real = (rows >= 0) & (rows < 2 * capacity) & pairs.valid[row] & (listed == mine) & (other >= 0) & (other < count)
    slot = jnp.where(real, jnp.cumsum(real, dtype=jnp.int32) - 1, 2 * capacity)
    side = jnp.stack([mine, jnp.where(as_first, other, ~other), row], axis=1)
    ends = jnp.cumsum(jnp.sum(real.reshape(-1, spheres * columns), axis=1, dtype=jnp.int32), dtype=jnp.int32)
    start = jnp.minimum(jnp.concatenate([jnp.zeros(1, jnp.int32), ends]), 2 * capacity)
    sides = jnp.zeros((2 * capacity, 3), jnp.int32).at[slot].set(side, mode="drop")
    place = jnp.full(capacity, -1, jnp.int32).at[jnp.where(real & as_first, row, capacity)].set(slot, mode="drop")
    whole = (ends[-1] == 2 * jnp.sum(pairs.valid, dtype=jnp.int32)) & jnp.all(real | (rows == 2 * capacity))
    return Sides(start, sides, place), whole


def between_steps(fixed: Any, history: Sequence[Any], points: int, kinds: int, lanes: int) -> list[Any]:
    """Shapes of what the kernels need from one step to the next; see src/cuda/arguments.h.

    Args:
        fixed: of the call.
        history: of the call, leaves [1, P, ..., B].
        points: Q of the Mindlin law, or 0.
        kinds: one for values, two for values and derivatives.
        lanes: replicas of all entries, L.
    """
    spheres, sides = fixed.incidence.shape[1], 2 * fixed.first.shape[1]
    grains = spheres // fixed.offsets.shape[1]
    remembered = sum(leaf.shape[2] for leaf in history if leaf.ndim == 4) + (6 if points else 0)  # ... and `Layers`
    shapes = [(2, kinds, grains, 9), (2, kinds, spheres, 3), (kinds, grains, 4), (kinds, grains, 3)]
    shapes += [(kinds, sides, remembered), *([(kinds, sides, points, 3)] if points else [])]
    found = [jax.ShapeDtypeStruct((1, *shape, lanes), jnp.float64) for shape in shapes]
    return [*found, jax.ShapeDtypeStruct((1, sides, lanes), jnp.int32)] if points else found


def call_kernels(target: str, call: Any, in_place: bool, parts: Any, shapes: Sequence[Any]) -> Sequence[jax.Array]:
    """A call of the library, with results of the given shapes, and what was needed between its steps.

    Args:
        target: what XLA knows it by.
        call: its attributes, `gmem_jax.native.primitives.Call`.
        in_place: whether histories may take the place of those that were given.
        parts: `Fixed` and `Arrays` of `gmem_jax.native.primitives`, and the tangent's `Arrays`.
        shapes: of the results.
    """
    outer = shapes[0].shape[:-3]
    entries = math.prod(outer)

    def flat(leaf: jax.Array) -> jax.Array:
        """With one leading axis, of size one or of that of all."""
        inner = leaf.shape[len(outer) :]
        if math.prod(leaf.shape[: len(outer)]) == 1:
            return leaf.reshape(1, *inner)
        return jnp.broadcast_to(leaf, (*outer, *inner)).reshape(entries, *inner)

    fixed, arrays, *slopes = jax.tree.map(flat, parts)
    lists = {name: getattr(fixed, name) for name in ("first", "second", "valid", "incidence")}
    many = max(map(len, lists.values()))
    lists = {name: jnp.broadcast_to(leaf, (many, *leaf.shape[1:])) for name, leaf in lists.items()}
    sides, sound = jax.vmap(lambda **lists: sides_of(fixed._replace(**lists), fixed.offsets.shape[1]))(**lists)
    arm = jnp.sqrt(jnp.max(jnp.sum(fixed.offsets**2, axis=2), axis=1))
    numbers = jnp.where(sound[:, None, None], arrays.parameters, jnp.nan)  # there is no other way to refuse a list
    before = [*arrays.fields, *sides, fixed.offsets, arm, numbers, arrays.walls]
    results = [jax.ShapeDtypeStruct((entries, *shape.shape[len(outer) :]), shape.dtype) for shape in shapes]
    aliases = {}
    if in_place:
        for number, leaf in enumerate(arrays.history):
            argument, result = len(before) + number, len(arrays.fields) + 1 + number
            if leaf.shape == results[result].shape:
                aliases[argument] = result
    lanes = entries * arrays.fields[0].shape[-1]
    between = between_steps(fixed, arrays.history, call.points, 2 if slopes else 1, lanes)
    ffi = jax.ffi.ffi_call(target, [*results, *between], input_output_aliases=aliases)
    found = ffi(*before, *arrays.history, *jax.tree.leaves(slopes), **call._asdict())
    moved = [leaf.reshape(shape.shape) for leaf, shape in zip(found, shapes, strict=False)]
    return [*moved, *found[len(shapes) :]]
