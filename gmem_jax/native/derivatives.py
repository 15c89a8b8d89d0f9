"""Calls into the library as JAX operations: the steps of a bin, their tangent, and the transpose of that, the adjoint.

The tangent is a primitive of JAX with a rule for its transpose, so that `jax.jvp`, `jax.linearize`, `jax.grad` and
their compositions with `jax.vmap` and `jax.checkpoint` all come out of the two calls. Forward mode runs the steps in
numbers that carry a derivative; reverse mode redoes them, remembers each step, and goes back (src/cpu/adjoint.h).
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

TARGETS = ("gmem_advance", "gmem_tangent", "gmem_adjoint")
_FIELDS = 6  # leaves of a State's grains


class Call(NamedTuple):
    """Attributes of a call; see src/cpu/problem.h.

    Attributes:
        law: number of the friction law.
        variant: number of the Mindlin law's variant.
        points: Q of the Mindlin law.
        isotropic: whether all moments of inertia are equal.
        leaves: arrays of the history.
    """

    law: int
    variant: int
    points: int
    isotropic: int
    leaves: int


class Arrays(NamedTuple):
    """What the steps can be differentiated by.

    Attributes:
        fields: leaves of `Grains`, [N, 3 or 4, B].
        parameters: rows of src/physics/parameters.h's parameter array, [rows, B].
        walls: lower, upper and their velocities of every step, [steps, 12, B].
        history: leaves of the history.
    """

    fields: Sequence[jax.Array]
    parameters: jax.Array
    walls: jax.Array
    history: Sequence[jax.Array]


class Results(NamedTuple):
    """What the steps give: `Arrays` that moved, and the sum of the wall pressures, [3, B]."""

    fields: Sequence[jax.Array]
    pressure: jax.Array
    history: Sequence[jax.Array]


Fixed = tuple[jax.Array, ...]
"""Candidates (first, second, valid, reference, smallest), sphere offsets, and steps [B]."""


def _arguments(fixed: Fixed, arrays: Arrays) -> list[jax.Array]:
    *pack, steps = fixed
    return [*arrays.fields, *pack, arrays.parameters, arrays.walls, steps, *arrays.history]


def _shapes(call: Call, arguments: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """Shapes and types of what a call is differentiated by, and of its results, with the leading axes of all."""
    fields, parameters, walls = arguments[:_FIELDS], arguments[_FIELDS + 6], arguments[_FIELDS + 7]
    history = arguments[_FIELDS + 9 : _FIELDS + 9 + call.leaves]
    axes = len(fields[0].shape) - 3
    leading = np.broadcast_shapes(*(argument.shape[:axes] for argument in arguments))

    def whole(leaf: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((*leading, *leaf.shape[axes:]), leaf.dtype)

    moving = [*map(whole, fields)], [*map(whole, history)]
    pressure = jax.ShapeDtypeStruct((*leading, 3, fields[0].shape[-1]), fields[0].dtype)
    return [*moving[0], whole(parameters), whole(walls), *moving[1]], [*moving[0], pressure, *moving[1]]


def forward(call: Call, fixed: Fixed, arrays: Arrays) -> Results:
    """All steps; not differentiable by itself."""
    return _results(_forward_p.bind(*_arguments(fixed, arrays), call=call))


def tangent(call: Call, fixed: Fixed, arrays: Arrays, along: Arrays) -> Results:
    """The derivative of `forward` along a direction, linear in it; the steps of all replicas are those of `walls`."""
    direction = [*along.fields, along.parameters, along.walls, *along.history]
    return _results(_tangent_p.bind(*_arguments(fixed, arrays), *direction, call=call))


def _results(arrays: Sequence[jax.Array]) -> Results:
    return Results(arrays[:_FIELDS], arrays[_FIELDS], arrays[_FIELDS + 1 :])


def _primitive(
    target: str, outputs: Callable[[Call, Sequence[Any]], list[Any]], aliases: Callable[[Call], dict[int, int]]
) -> Primitive:
    """A call into the library; its arguments may have leading axes, of size one where there is nothing to share out."""
    primitive = Primitive(target)
    primitive.multiple_results = True

    def run(*arguments: Any, call: Call) -> Any:
        shapes = outputs(call, arguments)
        return jax.ffi.ffi_call(target, shapes, input_output_aliases=aliases(call))(*arguments, **call._asdict())

    def abstract(*arguments: Any, call: Call) -> list[Any]:
        return [jax.core.ShapedArray(output.shape, output.dtype) for output in outputs(call, arguments)]

    def batch(arguments: Sequence[Any], axes: Sequence[int | None], *, call: Call) -> tuple[Any, list[int]]:
        moved = [
            jnp.expand_dims(argument, 0) if axis is None else jnp.moveaxis(argument, axis, 0)
            for argument, axis in zip(arguments, axes, strict=True)
        ]
        results = primitive.bind(*moved, call=call)
        return results, [0] * len(results)

    compiled = functools.cache(lambda call: jax.jit(functools.partial(run, call=call)))
    primitive.def_impl(lambda *arguments, call: compiled(call)(*arguments))
    primitive.def_abstract_eval(abstract)
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(run, multiple_results=True), platform="cpu")
    return primitive


def _of_results(call: Call, arguments: Sequence[Any]) -> list[Any]:
    return _shapes(call, arguments)[1]


def _of_arrays(call: Call, arguments: Sequence[Any]) -> list[Any]:
    return _shapes(call, arguments)[0]


def _in_place(call: Call) -> dict[int, int]:
    """Histories, much the largest arrays, are updated where they are."""
    return {_FIELDS + 9 + leaf: _FIELDS + 1 + leaf for leaf in range(call.leaves)}


_forward_p = _primitive("gmem_advance", _of_results, _in_place)
_tangent_p = _primitive("gmem_tangent", _of_results, lambda _: {})
_adjoint_p = _primitive("gmem_adjoint", _of_arrays, lambda _: {})


def _transpose(slopes: Sequence[Any], *arguments: Any, call: Call) -> list[Any]:
    """From derivatives by the results to derivatives by what the tangent was linear in."""
    known = len(arguments) - (_FIELDS + 2 + call.leaves)
    values, linear = arguments[:known], arguments[known:]
    on_results = [ad.instantiate_zeros(slope) for slope in slopes]
    found = _adjoint_p.bind(*values, *on_results, call=call)

    def fitted(slope: jax.Array, place: Any) -> jax.Array | None:
        """Summed over leading axes that an argument did not have."""
        if not ad.is_undefined_primal(place):
            return None
        shape = place.aval.shape
        repeated = [axis for axis, size in enumerate(shape) if size != slope.shape[axis]]
        return jnp.sum(slope, axis=repeated, keepdims=True) if repeated else slope

    return [None] * known + [fitted(slope, place) for slope, place in zip(found, linear, strict=True)]


ad.primitive_transposes[_tangent_p] = _transpose


# The library has the derivative of the steps and not that of the derivative, which plain JAX has.
def _no_second(primals: Any, tangents: Any, **_: Any) -> Any:
    raise NotImplementedError("second derivatives are not in the native backend; use backend='jax'")


for _primitive_p in (_forward_p, _tangent_p, _adjoint_p):
    ad.primitive_jvps[_primitive_p] = _no_second
