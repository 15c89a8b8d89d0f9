"""The census of a configuration by the library, with the signature of `gmem_jax.physics.census.take_census`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.native import calls, library
from gmem_jax.native.march import bits_of, fixed_of
from gmem_jax.physics.boundary import WALLS, PeriodicAxes
from gmem_jax.physics.census import Census, take_census
from gmem_jax.physics.state import Box, Grains, State
from gmem_jax.physics.system import System


class Listed(NamedTuple):
    """The arguments that replicas share.

    Attributes:
        first: see `Pairs`, [P]; so for the next three.
        second: [P].
        valid: [P].
        grain_pair: [P].
        images: see `gmem_jax.native.calls.Fixed`, [P, 3] or [P, 0]; so for the next two.
        radii: [K, 1] or [K, 0].
        sizes: [N, 1] or [N, 0].
        offsets: sphere centres of a grain, [K, 3], in R.
        reference: `Pairs.reference`, [S, 3, 1], if replicas share it; else [S, 3, 0].
    """

    first: jax.Array
    second: jax.Array
    valid: jax.Array
    grain_pair: jax.Array
    images: jax.Array
    radii: jax.Array
    sizes: jax.Array
    offsets: jax.Array
    reference: jax.Array


class Seen(NamedTuple):
    """The arguments that each replica has of its own.

    Attributes:
        fields: leaves of `Grains`, [N, 3 or 4, B].
        walls: lower and upper planes, [6, B].
        edges: edges of the periodic cell, or of the box, [3, B].
        reference: `Pairs.reference`, [S, 3, B], if replicas do not share it; else [0, 3, B].
    """

    fields: list[jax.Array]
    walls: jax.Array
    edges: jax.Array
    reference: jax.Array


def census_by_library(system: System, state: State, box: Box) -> Census:
    """`take_census` on the native backend.

    Raises:
        ValueError: if the backend is not available.
        NotImplementedError: if it is compiled for anything but a CPU or a CUDA GPU.
    """
    library.require_library()
    return _census(system, state, box, anywhere=False)


def census_anywhere(system: System, state: State, box: Box) -> Census:
    """`census_by_library` in programs for CPUs, if the library is available; else `take_census`."""
    if state.grains.position.dtype != jnp.float64 or not library.available()[0]:
        return take_census(system, state, box)
    return _census(system, state, box, anywhere=True)


def _census(system: System, state: State, box: Box, anywhere: bool) -> Census:
    system, state, box = lax.stop_gradient((system, state, box))
    replicas, reference, fixed = state.replicas, system.pairs.reference, fixed_of(system)
    shared = reference.shape[-1] == 1
    offsets = system.clump.offsets
    listed = Listed(
        *(fixed.first, fixed.second, fixed.valid, system.pairs.grain_pair),
        *(fixed.images, fixed.radii, fixed.sizes),
        offsets.reshape(*offsets.shape[:2], -1)[..., 0],
        reference[..., : int(shared)],
    )
    edges = box.lengths if state.cell is None else state.cell.lengths
    seen = Seen(
        jax.tree.leaves(state.grains),
        jnp.broadcast_to(jnp.concatenate([box.lower, box.upper]), (6, replicas)),
        jnp.broadcast_to(edges, (3, replicas)),
        jnp.broadcast_to(reference[: 0 if shared else None], (0 if shared else len(reference), 3, replicas)),
    )
    definition = PlainCensus(jax.tree.structure(system), anywhere, box.periodic)
    call = calls.Call(0, 0, 0, 0, 0, periodic=bits_of(box.periodic), unequal=int(not system.clump.equal))  # for any law
    (found,) = calls.bind(_census_p, call, definition, listed, seen)
    return Census(*found)


@dataclass(frozen=True)
class PlainCensus:
    """`take_census` on the arguments of a call; a `gmem_jax.native.calls.Definition`.

    Attributes:
        system: structure of the `System`.
        anywhere: see `gmem_jax.native.calls.Definition`.
        periodic: the periodic axes of the box.
    """

    system: Any
    anywhere: bool = True
    periodic: PeriodicAxes = WALLS

    def __call__(self, listed: Listed, seen: Seen) -> jax.Array:
        """The rows of a `Census`, [rows, B]."""
        empty: System = jax.tree.unflatten(self.system, [None] * self.system.num_leaves)
        clump = replace(empty.clump, offsets=listed.offsets[..., None])
        if listed.sizes.shape[-1]:
            clump = replace(clump, radii=listed.radii[:, 0], sizes=listed.sizes[:, 0])
        reference = listed.reference if listed.reference.shape[-1] else seen.reference
        pairs = replace(
            empty.pairs,
            **{name: getattr(listed, name) for name in ("first", "second", "valid", "grain_pair")},
            reference=reference,
            incidence=jnp.zeros((len(reference), 1), jnp.int32),
        )
        still = jnp.zeros_like(seen.edges)
        lower, upper = jnp.split(seen.walls, 2)
        box = Box(lower, upper, still, still, self.periodic)
        replicas = seen.edges.shape[-1]
        state = State(Grains(*seen.fields), None, jnp.zeros(replicas, jnp.int32))
        if any(self.periodic):
            pairs = replace(pairs, image=listed.images)
            state = replace(state, cell=Box(still, seen.edges, still, still, self.periodic))
        return jnp.stack(take_census(replace(empty, clump=clump, pairs=pairs), state, box))


def _rows(parts: tuple[Listed, Seen]) -> list[jax.ShapeDtypeStruct]:
    edges = parts[1].edges
    rows = jax.ShapeDtypeStruct((*edges.shape[:-2], len(Census._fields), edges.shape[-1]), edges.dtype)
    found: list[jax.ShapeDtypeStruct] = calls.with_leading(parts, [rows])
    return found


def _call(
    target: str, outputs: Callable[[Any], list[Any]], call: calls.Call, in_place: bool, parts: Any
) -> Sequence[jax.Array]:
    """`gmem_jax.native.calls.call_library` for a census; `in_place` is not used."""
    run = jax.ffi.ffi_call(target, outputs(parts))
    found: Sequence[jax.Array] = run(*jax.tree.leaves(parts), periodic=call.periodic, unequal=call.unequal)
    return found


_census_p = calls.make_primitive("gmem_census", _rows, make=_call)
