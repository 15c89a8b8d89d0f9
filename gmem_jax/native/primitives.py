"""Calls into the library that JAX can differentiate: the steps of a bin, their tangent, and its transpose.

The tangent is a primitive of JAX with a rule for its transpose, so that `jax.jvp`, `jax.linearize`, `jax.grad` and
their compositions with `jax.vmap` and `jax.checkpoint` all follow from the two calls. Forward mode runs the steps in
numbers that carry a derivative. Reverse mode runs the steps again, keeps each of them, and goes back through them
(src/cpu/adjoint.h). If that would take too much memory, it does so for one piece of the steps after the other. Second
derivatives are the derivative of the adjoint along a direction: reverse mode in numbers that carry a derivative.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.interpreters import ad

from gmem_jax.native.calls import (
    Arrays,
    Call,
    Definition,
    Fixed,
    StepOutput,
    bind,
    make_primitive,
    of_arrays,
    of_results,
    results_of,
)

# Bytes that reverse mode may keep of the steps of a call. The usual 12 steps of 10,240 grains keep 0.7 GB with law H.
# Going back in pieces costs one more forward run, so that only longer bins of large packs do it.
STEPS_ROOM = 2**30


def advance(call: Call, definition: Definition, fixed: Fixed, arrays: Arrays) -> StepOutput:
    """All steps of a call."""
    return results_of(arrays, bind(_forward_p, call, definition, fixed, arrays))


def tangent(call: Call, definition: Definition, fixed: Fixed, arrays: Arrays, along: Arrays) -> StepOutput:
    """The derivative of `advance` along a direction, linear in it."""
    return results_of(arrays, bind(_tangent_p, call, definition, fixed, arrays, along))


# The calls in plain JAX, for devices without the library.


def _plain_tangent(definition: Definition, fixed: Fixed, arrays: Arrays, along: Arrays) -> StepOutput:
    slope: StepOutput = jax.jvp(functools.partial(definition, fixed), (arrays,), (along,))[1]
    return slope


def _plain_adjoint(definition: Definition, fixed: Fixed, arrays: Arrays, slopes: StepOutput) -> Arrays:
    _, pull = jax.vjp(functools.partial(definition, fixed), arrays)
    found: Arrays = pull(slopes)[0]
    return found


def _plain_second_adjoint(
    definition: Definition, fixed: Fixed, arrays: Arrays, along: Arrays, slopes: StepOutput, changes: StepOutput
) -> Arrays:
    def adjoint(arrays: Arrays, slopes: StepOutput) -> Arrays:
        return _plain_adjoint(definition, fixed, arrays, slopes)

    found: Arrays = jax.jvp(adjoint, (arrays, slopes), (along, changes))[1]
    return found


def _no_second_tangent(*_: Any) -> StepOutput:
    raise NotImplementedError(
        "the native backend has second derivatives by jax.jvp of jax.grad, but not forward over forward, and no third "
        "ones; use backend='jax'"
    )


_forward_p = make_primitive("gmem_advance", of_results, in_place=True)
_tangent_p = make_primitive("gmem_tangent", of_results, _plain_tangent)
_adjoint_p = make_primitive("gmem_adjoint", of_arrays, _plain_adjoint)


_second_adjoint_p = make_primitive("gmem_second_adjoint", of_arrays, _plain_second_adjoint)
_second_tangent_p = make_primitive("gmem_second_tangent", of_results, _no_second_tangent)


def _sums(found: Sequence[jax.Array], places: Sequence[Any]) -> list[jax.Array | None]:
    """Derivatives with respect to the unknown arguments, summed over leading axes along which these have size one."""

    def fitted(slope: jax.Array, place: Any) -> jax.Array | None:
        if not ad.is_undefined_primal(place):
            return None
        shape = place.aval.shape
        repeated = [axis for axis, size in enumerate(shape) if size != slope.shape[axis]]
        return jnp.sum(slope, axis=repeated, keepdims=True) if repeated else slope

    return [fitted(slope, place) for slope, place in zip(found, places, strict=True)]


def _whole_slopes(slopes: Sequence[Any]) -> list[jax.Array]:
    return [ad.instantiate_zeros(slope) for slope in slopes]


def piece_count(call: Call, arrays: Arrays) -> int:
    """Number of pieces into which reverse mode cuts the steps of a call.

    T steps that would keep more than `STEPS_ROOM` are cut into about sqrt(T) pieces. There are fewer pieces if a state,
    which is kept before each piece, takes more memory than a step keeps (M2, with its rings). The memory is that for
    the replicas that a CPU takes side by side: 25 numbers for a grain (19 of its state, 6 of force and torque), and the
    histories, where a contact with rings keeps six numbers. In periodic boxes a piece would begin with its own edges;
    there the steps are one piece.
    """
    steps, _, replicas = arrays.walls.shape[-3:]
    inner = [leaf.shape[arrays.walls.ndim - 3 : -1] for leaf in arrays.history]  # [P, h], or [P, Q, 2] of rings
    remembered = sum(shape[0] * (shape[1] if len(shape) == 2 else 6) for shape in inner)
    kept = 8 * (4 if replicas <= 4 else 8) * steps * (25 * arrays.fields[0].shape[-3] + remembered)
    if kept <= STEPS_ROOM or call.periodic:
        return 1
    state = 8 * sum(leaf.size for leaf in (*arrays.fields, *arrays.history))
    return max(1, round(math.sqrt(min(steps, kept / state))))


def _adjoint(call: Call, definition: Definition, fixed: Fixed, arrays: Arrays, slopes: StepOutput) -> list[jax.Array]:
    """The leaves of derivatives with respect to `arrays`, from derivatives with respect to the results of the steps.

    The state before each piece is kept from the beginning. The steps of a piece are kept only while reverse mode goes
    back through it.
    """
    pieces = jnp.array_split(arrays.walls, piece_count(call, arrays), axis=-3)
    before = [arrays._replace(walls=pieces[0])]
    for piece in pieces[1:]:
        moved = results_of(arrays, bind(_forward_p, call, definition, fixed, before[-1]))
        before.append(arrays._replace(fields=moved.fields, walls=piece, history=moved.history))
    own = []
    while before:
        leaves = bind(_adjoint_p, call, definition, fixed, before.pop(), slopes)
        bars: Arrays = jax.tree.unflatten(jax.tree.structure(arrays), leaves)
        slopes = slopes._replace(fields=bars.fields, history=bars.history)
        own.append((bars.parameters, bars.offsets, bars.walls))
    parameters, offsets, walls = zip(*own, strict=True)
    parameters, offsets = (functools.reduce(jnp.add, some) for some in (parameters, offsets))
    whole = jnp.concatenate(walls[::-1], axis=-3)
    return jax.tree.leaves(bars._replace(parameters=parameters, walls=whole, offsets=offsets))


def _transpose_tangent(
    slopes: Sequence[Any], *arguments: Any, tree: Any, call: Call, definition: Definition
) -> list[Any]:
    """The transpose of the tangent: from derivatives by its results to derivatives by the direction."""
    fixed, arrays, _ = jax.tree.unflatten(tree, arguments)
    known = len(jax.tree.leaves((fixed, arrays)))
    on_results = results_of(arrays, _whole_slopes(slopes))
    found = _adjoint(call, definition, fixed, arrays, on_results)
    return [None] * known + _sums(found, arguments[known:])


def _transpose_second_tangent(
    slopes: Sequence[Any], *arguments: Any, tree: Any, call: Call, definition: Definition
) -> list[Any]:
    """The transpose of the second tangent, which is linear and symmetric in two directions, of which one is known."""
    fixed, arrays, *directions = jax.tree.unflatten(tree, arguments)
    known = len(jax.tree.leaves((fixed, arrays)))
    on_results = results_of(arrays, _whole_slopes(slopes))
    way = next(one for one in directions if not any(map(_is_open, jax.tree.leaves(one, is_leaf=_is_open))))
    found = bind(_second_adjoint_p, call, definition, fixed, arrays, way, on_results, _still(on_results))
    return [None] * known + _sums([*found, *found], arguments[known:])


def _transpose_second_adjoint(
    slopes: Sequence[Any], *arguments: Any, tree: Any, call: Call, definition: Definition
) -> list[Any]:
    """The transpose of the second adjoint, which is linear in `along`, where it is symmetric, and in `changes`."""
    fixed, arrays, _, on_results, _ = jax.tree.unflatten(tree, arguments)
    known = len(jax.tree.leaves((fixed, arrays)))
    way = jax.tree.unflatten(jax.tree.structure(arrays), _whole_slopes(slopes))
    by_along = bind(_second_adjoint_p, call, definition, fixed, arrays, way, on_results, _still(on_results))
    by_changes = bind(_tangent_p, call, definition, fixed, arrays, way)
    found = [*by_along, *jax.tree.leaves(on_results), *by_changes]
    return [None] * known + _sums(found, arguments[known:])


def _still(tree: Any) -> Any:
    return jax.tree.map(jnp.zeros_like, tree)


def _is_open(leaf: Any) -> bool:
    return isinstance(leaf, ad.UndefinedPrimal)


ad.primitive_transposes[_tangent_p] = _transpose_tangent
ad.primitive_transposes[_second_tangent_p] = _transpose_second_tangent
ad.primitive_transposes[_second_adjoint_p] = _transpose_second_adjoint


def _directions(tree: Any, leaves: Sequence[Any], slopes: Sequence[Any]) -> tuple[Any, bool]:
    """Tangents of the arguments after the first, and whether those of the arrays are all zero.

    Raises:
        NotImplementedError: if sizes or radii of spheres have a tangent.
    """
    fixed, arrays, *_ = jax.tree.unflatten(tree, range(len(leaves)))
    if any(type(slopes[place]) is not ad.Zero for place in (fixed.radii, fixed.sizes)):
        raise NotImplementedError("the native backend has no second derivatives by sizes and radii; use backend='jax'")
    first = len(fixed)  # lists of contacts have no derivatives
    whole = [None] * first + _whole_slopes(slopes[first:])
    still = all(type(slopes[place]) is ad.Zero for place in jax.tree.leaves(arrays))
    return jax.tree.unflatten(tree, whole)[1:], still


# `march._bin` has a rule of its own, which JAX leaves out where it takes a derivative apart (`jax.grad` of a scan).
def _jvp_forward(leaves: Any, tangents: Any, *, tree: Any, call: Call, definition: Definition) -> Any:
    fixed, arrays = jax.tree.unflatten(tree, leaves)
    (along,), _ = _directions(tree, leaves, tangents)
    found = bind(_forward_p, call, definition, fixed, arrays)
    return found, bind(_tangent_p, call, definition, fixed, arrays, along)


def _jvp_adjoint(leaves: Any, tangents: Any, *, tree: Any, call: Call, definition: Definition) -> Any:
    fixed, arrays, slopes = jax.tree.unflatten(tree, leaves)
    (along, changes), still = _directions(tree, leaves, tangents)
    found = bind(_adjoint_p, call, definition, fixed, arrays, slopes)
    if still:
        return found, bind(_adjoint_p, call, definition, fixed, arrays, changes)
    return found, bind(_second_adjoint_p, call, definition, fixed, arrays, along, slopes, changes)


def _jvp_tangent(leaves: Any, tangents: Any, *, tree: Any, call: Call, definition: Definition) -> Any:
    fixed, arrays, along = jax.tree.unflatten(tree, leaves)
    (other, change), still = _directions(tree, leaves, tangents)
    found = bind(_tangent_p, call, definition, fixed, arrays, along)
    turned = bind(_tangent_p, call, definition, fixed, arrays, change)
    if still:
        return found, turned
    bent = bind(_second_tangent_p, call, definition, fixed, arrays, along, other)
    return found, [one + more for one, more in zip(turned, bent, strict=True)]


def _no_third(*_: Any, **__: Any) -> Any:
    raise NotImplementedError("the native backend has no third derivatives; use backend='jax'")


ad.primitive_jvps[_forward_p] = _jvp_forward
ad.primitive_jvps[_adjoint_p] = _jvp_adjoint
ad.primitive_jvps[_tangent_p] = _jvp_tangent
ad.primitive_jvps[_second_adjoint_p] = ad.primitive_jvps[_second_tangent_p] = _no_third
