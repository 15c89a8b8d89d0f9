"""Calls into the library as operations of JAX: their arguments, shapes and lowering on each device.

Which code runs is decided when a program is lowered: the library on CPUs and, if it has kernels for the call (see
`cuda`), on CUDA GPUs; the definition in plain JAX elsewhere. Replicas do not interact, so a call on arrays that are
sharded by replicas runs on each device by itself.
"""

import functools
import itertools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax._src import dispatch
from jax.experimental.custom_partitioning import custom_partitioning
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jax.sharding import NamedSharding, PartitionSpec

from gmem_jax.native import cuda
from gmem_jax.physics.step import mark_varying

TARGETS = ("gmem_advance", "gmem_tangent", "gmem_adjoint", "gmem_second_adjoint", "gmem_census")


class Call(NamedTuple):
    """Attributes of a call; see src/physics/parameters.h.

    Attributes:
        law: number of the friction law.
        variant: number of the Mindlin law's variant.
        points: Q of the Mindlin law.
        isotropic: whether all moments of inertia are equal.
        leaves: number of arrays in the history of the candidates.
        mixed: whether contacts are computed in single precision.
        periodic: bits of the periodic axes.
        unequal: whether spheres differ in radius.
        rubs: whether walls have friction.
    """

    law: int
    variant: int
    points: int
    isotropic: int
    leaves: int
    mixed: int = 0
    periodic: int = 0
    unequal: int = 0
    rubs: int = 0


class Fixed(NamedTuple):
    """The arguments with respect to which the steps cannot be differentiated.

    Attributes:
        first: see `Pairs`, [P]; so for the next five.
        second: [P].
        valid: [P].
        incidence: [S, C].
        reference: that of the first replica, [S, 3].
        smallest: [3].
        images: `Pairs.image`, [P, 3]; [P, 0] without periodic axes.
        radii: radii of the spheres of a grain of size 1, [K, 1], in R; [K, 0] if all spheres of the pack have radius 1.
        sizes: sizes of the grains, [N, 1]; [N, 0] likewise.
    """

    first: jax.Array
    second: jax.Array
    valid: jax.Array
    incidence: jax.Array
    reference: jax.Array
    smallest: jax.Array
    images: jax.Array
    radii: jax.Array
    sizes: jax.Array


class Arrays(NamedTuple):
    """The arguments with respect to which the steps can be differentiated.

    Attributes:
        fields: leaves of `Grains`, [N, 3 or 4, B].
        parameters: rows of src/physics/parameters.h's parameter array, [rows, B].
        walls: lower planes, upper planes and their velocities after every step, [steps, 12, B].
        offsets: sphere centres of a grain, [K, 3, B], in R; equal in all replicas, but their derivatives may differ.
        history: leaves of the candidates' history, [P, ..., B]; then leaves of the history of walls with friction,
            [6 S, ..., B].
    """

    fields: list[jax.Array]
    parameters: jax.Array
    walls: jax.Array
    offsets: jax.Array
    history: list[jax.Array]


class StepOutput(NamedTuple):
    """The results of the steps: fields and histories as in `Arrays`, and the sum of the wall pressures, [3, B]."""

    fields: list[jax.Array]
    pressure: jax.Array
    history: list[jax.Array]


class Definition(Protocol):
    """A call in plain JAX, for devices without the library; hashable, since it is part of a program.

    Attributes:
        anywhere: whether it may run in the place of the library; if not, devices without the library are refused.
    """

    @property
    def anywhere(self) -> bool:
        """See above."""

    def __call__(self, common: Any, own: Any, /) -> Any:
        """The results, from what replicas share and what each has of its own: for steps, `Fixed` and `Arrays`."""


def bind(primitive: Primitive, call: Call, definition: Definition, *parts: Any) -> list[jax.Array]:
    """The leaves of the results of a primitive for the arguments `parts`."""
    leaves, tree = jax.tree.flatten(mark_varying(parts))
    found: list[jax.Array] = primitive.bind(*leaves, tree=tree, call=call, definition=definition)
    return found


def results_of(arrays: Arrays, found: list[Any]) -> StepOutput:
    """A `StepOutput` made of its leaves."""
    count = len(arrays.fields)
    return StepOutput(found[:count], found[count], found[count + 1 :])


# Shapes. All arguments have equally many leading axes (none or more), of size one where an argument does not vary.


def _leading(parts: Any) -> tuple[int, ...]:
    """The leading axes of the results of a call."""
    axes = parts[1].fields[0].ndim - 3
    return np.broadcast_shapes(*(leaf.shape[:axes] for leaf in jax.tree.leaves(parts)))


def with_leading(parts: Any, likes: Any) -> Any:
    """The shapes of `likes`, with their leading axes replaced by those of the results of a call."""
    leading = _leading(parts)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((*leading, *leaf.shape[len(leading) :]), leaf.dtype), likes)


def of_results(parts: Any) -> list[Any]:
    """Shapes of the leaves of the results of steps with these arguments."""
    arrays: Arrays = parts[1]
    *leading, _, replicas = arrays.parameters.shape
    pressure = jax.ShapeDtypeStruct((*leading, 3, replicas), arrays.parameters.dtype)
    return jax.tree.leaves(with_leading(parts, StepOutput(arrays.fields, pressure, arrays.history)))  # type: ignore[arg-type]


def of_arrays(parts: Any) -> list[Any]:
    """Shapes of the leaves of derivatives with respect to the `Arrays` of these arguments."""
    return jax.tree.leaves(with_leading(parts, parts[1]))


Names = tuple[str | None, ...]
"""Names of the axes of an array: one for each leading axis, "replicas", or None for axes that are not split."""


def _names(leading: tuple[int, ...], shape: Sequence[int], replicas: bool = True) -> Names:
    outer = (f"leading{axis}" if shape[axis] == size else None for axis, size in enumerate(leading))
    inner = [None] * (len(shape) - len(leading))
    return (*outer, *inner[:-1], "replicas") if replicas else (*outer, *inner)


def _names_of_arguments(parts: Any) -> list[Names]:
    """The names of the axes of all leaves of the arguments, in their order."""
    fixed, *others = parts
    leading = _leading(parts)
    own = jax.tree.leaves(others)
    return [_names(leading, leaf.shape, False) for leaf in fixed] + [_names(leading, leaf.shape) for leaf in own]


# The call in the library, and in plain JAX.


def call_library(
    target: str, outputs: Callable[[Any], list[Any]], call: Call, in_place: bool, parts: Any
) -> Sequence[jax.Array]:
    """The call itself, `jax.ffi.ffi_call`: arguments `parts`, results of the shapes `outputs`."""
    fixed, arrays, *slopes = parts
    pack = {**fixed._asdict(), "offsets": arrays.offsets[..., 0]}
    del pack["incidence"]
    before = [*arrays.fields, *pack.values(), arrays.parameters, arrays.walls]
    shapes = outputs(parts)
    aliases = cuda.aliases_of(before, arrays, shapes) if in_place else {}
    run = jax.ffi.ffi_call(target, shapes, input_output_aliases=aliases)
    found: Sequence[jax.Array] = run(*before, *arrays.history, *jax.tree.leaves(slopes), **call._asdict())
    return found


def over(function: Callable[..., Any], leading: tuple[int, ...]) -> Callable[..., Any]:
    """`function` mapped over leading axes."""
    if not leading:
        return function

    def each(*trees: Any) -> Any:
        leaves, structure = jax.tree.flatten(trees)
        places = [0 if leaf.shape[0] == leading[0] else None for leaf in leaves]

        def one(*leaves: jax.Array) -> Any:
            return over(function, leading[1:])(*jax.tree.unflatten(structure, leaves))

        single = [leaf if place == 0 else leaf[0] for leaf, place in zip(leaves, places, strict=True)]
        return jax.vmap(one, in_axes=tuple(places))(*single)

    return each


def make_primitive(
    target: str,
    outputs: Callable[[Any], list[Any]],
    plain: Callable[..., Any] = operator.call,
    in_place: bool = False,
    make: Callable[..., Sequence[jax.Array]] = call_library,
) -> Primitive:
    """The primitive of a call whose results have the shapes `outputs`.

    Args:
        target: name of the call in XLA.
        outputs: function from the arguments to the shapes of the results.
        plain: the call in plain JAX, a function of the definition and the arguments; default the definition itself.
        in_place: whether fields and histories are updated in their own memory.
        make: makes the call of the library, with the arguments of `call_library`.
    """
    primitive = Primitive(target)
    primitive.multiple_results = True

    def abstract(*leaves: Any, tree: Any, **_: Any) -> list[Any]:
        parts = jax.tree.unflatten(tree, leaves)
        # If types contain the mesh, an axis of a result is split as in the first argument in which it is split.
        mesh, split = leaves[0].sharding.mesh, {}
        for leaf, names in zip(leaves, _names_of_arguments(parts), strict=True):
            for name, axes in zip(names, leaf.sharding.spec, strict=True):
                if name and axes and name not in split:
                    mesh, split[name] = leaf.sharding.mesh, axes

        def aval(output: Any) -> Any:
            places = PartitionSpec(*(split.get(name or "") for name in _names(_leading(parts), output.shape)))
            sharding = NamedSharding(mesh, places)
            return leaves[0].update(shape=output.shape, dtype=output.dtype, weak_type=False, sharding=sharding)

        return [aval(output) for output in outputs(parts)]

    def batch(arguments: Sequence[Any], axes: Sequence[int | None], **static: Any) -> tuple[Any, list[int]]:
        moved = [
            jnp.expand_dims(argument, 0) if axis is None else jnp.moveaxis(argument, axis, 0)
            for argument, axis in zip(arguments, axes, strict=True)
        ]
        results = primitive.bind(*moved, **static)
        return results, [0] * len(results)

    def library(
        context: mlir.LoweringRuleContext, *values: Any, tree: Any, call: Call, on_gpu: bool = False, **_: Any
    ) -> Any:
        def here(*leaves: jax.Array) -> Sequence[jax.Array]:
            parts = jax.tree.unflatten(tree, leaves)
            if on_gpu:
                shapes = outputs(parts)
                return cuda.call_kernels(target, call, in_place, parts, shapes)[: len(shapes)]
            return make(target, outputs, call, in_place, parts)

        def shared_out(*leaves: jax.Array) -> Any:
            return _sharded(here, jax.tree.unflatten(tree, leaves), outputs)(*leaves)

        # A program for one device stays free of `custom_partitioning`, which JAX's persistent cache cannot hold.
        alone = getattr(context.module_context.axis_context, "num_devices", None) == 1
        return mlir.lower_fun(here if alone else shared_out, multiple_results=True)(context, *values)

    def elsewhere(*leaves: jax.Array, tree: Any, call: Call, definition: Definition) -> Any:
        parts = jax.tree.unflatten(tree, leaves)
        return jax.tree.leaves(over(functools.partial(plain, definition), _leading(parts))(*parts))

    in_plain_jax = mlir.lower_fun(elsewhere, multiple_results=True)

    def on_cuda(context: mlir.LoweringRuleContext, *values: Any, definition: Definition, **static: Any) -> Any:
        if static["call"].mixed:
            raise NotImplementedError("precision='mixed' is a mode of CPUs so far; use 'double' on a GPU")
        serves = cuda.serves(target, static["call"])
        if serves and not cuda.missing():
            return library(context, *values, on_gpu=True, **static)
        if serves and not definition.anywhere:
            raise NotImplementedError(f"the native backend does not run on this GPU: {cuda.missing()}")
        if serves:
            cuda.warn_no_nvrtc(cuda.missing())
        return in_plain_jax(context, *values, definition=definition, **static)

    def on_others(context: mlir.LoweringRuleContext, *values: Any, definition: Definition, **static: Any) -> Any:
        if not definition.anywhere:
            raise NotImplementedError("the native backend runs on CPUs and CUDA GPUs; use backend='auto' or 'jax'")
        return in_plain_jax(context, *values, definition=definition, **static)

    compiled = jax.jit(primitive.bind, static_argnames=("tree", "call", "definition"))

    def alone(*leaves: Any, **static: Any) -> Any:
        with jax.disable_jit(False):  # with jit disabled, `compiled` would call itself
            return compiled(*leaves, **static)

    primitive.def_impl(alone)
    primitive.def_abstract_eval(abstract)
    batching.primitive_batchers[primitive] = batch
    if target not in TARGETS:
        mlir.register_lowering(primitive, in_plain_jax)
        return primitive
    mlir.register_lowering(primitive, library, platform="cpu")
    mlir.register_lowering(primitive, on_cuda, platform="cuda")
    mlir.register_lowering(primitive, on_others)
    # `custom_partitioning` needs to know the devices, and JAX has no public way to ask for them.
    dispatch.prim_requires_devices_during_lowering.add(primitive)
    return primitive


def _sharded(here: Callable[..., Any], parts: Any, outputs: Callable[[Any], list[Any]]) -> Callable[..., Any]:
    """`here`, each device running the replicas and leading axes that it holds."""
    leading = _leading(parts)
    arguments = _names_of_arguments(parts)
    results = [_names(leading, output.shape) for output in outputs(parts)]
    own = itertools.count()
    words = [[name or f"own{next(own)}" for name in names] for names in (*arguments, *results)]
    operands, found = (", ".join(map(" ".join, some)) for some in (words[: len(arguments)], words[len(arguments) :]))

    def partition(mesh: Any, argument_shapes: Any, result_shapes: Any) -> tuple[Any, ...]:
        first = result_shapes[0]
        split = {}
        for name, size, axes in zip(results[0], first.shape, first.sharding.spec, strict=True):
            parts = math.prod(mesh.shape[axis] for axis in (axes if isinstance(axes, tuple) else (axes,)) if axis)
            # An axis is split only into equal parts: padding holds arbitrary numbers, which may break the library.
            split[name] = axes if name and size % parts == 0 else None

        def placed(names: Names) -> NamedSharding:
            return NamedSharding(mesh, PartitionSpec(*(split.get(name or "") for name in names)))

        return mesh, here, [placed(names) for names in results], tuple(map(placed, arguments))

    whole = custom_partitioning(here)
    rule = f"{operands} -> {found}"
    alone = tuple(f"own{number}" for number in range(next(own)))
    whole.def_partition(partition, sharding_rule=rule, need_replication_factors=alone)
    return whole
