"""What reverse mode is to forward mode, without a derivative of plain JAX, which compiles for tens of seconds."""

from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.native import calls, primitives
from gmem_jax.native.march import PlainDefinition, arrays_of, call_of, fixed_of
from gmem_jax.physics.state import Box, State
from gmem_jax.physics.system import System

# Round-off of a sum of a thousand numbers; more where steps magnify it, as 3e-12 in a periodic box with law M2.
TOLERANCE = 1e-10
# Second derivatives by differences. Forces go as a power 1.5 of overlaps that have just begun, and histories bend: in
# these scenes steps of 1e-9 are too long. Over 1e-10 round-off leaves 4e-6 of the largest.
STEP, BY_DIFFERENCES = 1e-10, 1e-4
# Round-off of derivatives in pieces of the steps: 4e-13 seen, and 1e-11 of second ones, both with law M2.
IN_PIECES = 1e-12


def assert_transposed(system: System, state: State, boxes: Box, dt: float = 0.3, drag: float = 0.01) -> Any:
    """The library's adjoint is the transpose of its tangent: w . (J d) = (J^T w) . d, for every argument of a call.

    And the derivative of the adjoint is one. Both are the same in pieces of the steps.

    J is the derivative of the steps, w weights of all that they give, d a direction along one argument, or along one
    row of the parameters.

    Returns:
        J^T w, `calls.Arrays`.
    """
    boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leaf.shape[:-1], state.replicas)), boxes)
    numbers, histories = (jnp.asarray(dt), jnp.asarray(drag)), (state.history, state.wall_history)
    arrays = arrays_of(system, state.grains, histories, boxes, numbers, state.cell)
    call, fixed = call_of(system, boxes.periodic), fixed_of(system)
    definition = PlainDefinition.of(system, histories, True, boxes.periodic)

    def forwards(along: Any) -> Any:
        return primitives.tangent(call, definition, fixed, arrays, along)

    push = jax.jit(forwards)
    pull = jax.jit(lambda weights: jax.linear_transpose(forwards, arrays)(weights)[0])
    draws = np.random.default_rng(0)
    weights = jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), jax.eval_shape(push, arrays))
    assert "@gmem_adjoint" in pull.lower(weights).as_text()  # not plain JAX
    bars = pull(weights)
    for name, along in _directions(arrays, draws):
        forwards_by = np.concatenate([np.ravel(term) for term in _products(weights, push(along))])
        backwards_by = np.concatenate([np.ravel(term) for term in _products(bars, along)])
        assert abs(backwards_by.sum() - forwards_by.sum()) <= TOLERANCE * np.linalg.norm(forwards_by), name
    with in_pieces():
        by_pieces = jax.jit(lambda weights: jax.linear_transpose(forwards, arrays)(weights)[0])
        assert by_pieces.lower(weights).as_text().count("@gmem_adjoint") == (1 if call.periodic else 3)
        _assert_same(by_pieces(weights), bars, IN_PIECES)
    _assert_derivative_of_the_adjoint(call, definition, fixed, arrays, weights, draws)
    return bars


def in_pieces() -> Any:
    """A context in which reverse mode cuts any steps. (Compiled programs do not hear of it.)"""
    return mock.patch.object(primitives, "piece_count", lambda call, _: 1 if call.periodic else 3)


def _assert_same(found: Any, expected: Any, tolerance: float) -> None:
    """Of two trees: in parts of the largest number of each array, or of each row of the parameters."""
    leaves = jax.tree_util.tree_flatten_with_path(found)[0]
    for (path, one), other in zip(leaves, jax.tree.leaves(expected), strict=True):
        name = jax.tree_util.keystr(path)
        rows = (leaf if "parameters" in name else leaf[None] for leaf in (one, other))
        for row, whole in zip(*rows, strict=True):
            largest = np.abs(whole).max(initial=0.0)
            np.testing.assert_allclose(row, whole, rtol=0.0, atol=tolerance * largest, err_msg=name)


def _assert_derivative_of_the_adjoint(
    call: calls.Call,
    definition: PlainDefinition,
    fixed: Any,
    arrays: Any,
    weights: Any,
    draws: np.random.Generator,
) -> None:
    """Of J^T w along a direction of the arguments and one of w: it is that of differences, and symmetric.

    With w held, d . D(J^T w)[e] = e . D(J^T w)[d] for any two directions.
    """

    def adjoint(arrays: Any, weights: Any) -> Any:
        return jax.vjp(lambda arrays: primitives.advance(call, definition, fixed, arrays), arrays)[1](weights)[0]

    def random(tree: Any) -> Any:
        drawn = jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), tree)
        if isinstance(tree, calls.Arrays):
            # Offsets are alike in all replicas. Histories that are zero stay so: magnitudes have a bend there.
            known = [jnp.where(leaf != 0.0, way, 0.0) for leaf, way in zip(tree.history, drawn.history, strict=True)]
            alike = jnp.broadcast_to(drawn.offsets[..., :1], drawn.offsets.shape)
            drawn = drawn._replace(offsets=alike, history=known)
        return drawn

    first = jax.jit(adjoint)
    second = jax.jit(lambda along, change: jax.jvp(adjoint, (arrays, weights), (along, change))[1])
    one, other, change = random(arrays), random(arrays), random(weights)
    assert "@gmem_second_adjoint" in second.lower(one, change).as_text()
    found = second(one, change)
    with in_pieces():
        by_pieces = jax.jit(lambda *ways: jax.jvp(adjoint, (arrays, weights), ways)[1])
        _assert_same(by_pieces(one, change), found, TOLERANCE)
    up, down = (
        first(
            *(jax.tree.map(lambda at, way, by=by: at + by * way, *pair) for pair in ((arrays, one), (weights, change)))
        )
        for by in (STEP, -STEP)
    )
    for (path, slope), high, low in zip(
        jax.tree_util.tree_flatten_with_path(found)[0], jax.tree.leaves(up), jax.tree.leaves(down), strict=True
    ):
        # Parameters differ in their units, row by row.
        rows = np.asarray(slope) if "parameters" in jax.tree_util.keystr(path) else np.asarray(slope)[None]
        for row, difference in zip(rows, np.reshape((high - low) / (2.0 * STEP), rows.shape), strict=True):
            if row.size:
                apart = np.abs(row - difference).max()
                assert apart <= BY_DIFFERENCES * np.abs(row).max(), (
                    jax.tree_util.keystr(path),
                    apart / np.abs(row).max(),
                )
    still = jax.tree.map(jnp.zeros_like, change)
    ahead, back = (_products(a, second(b, still)) for a, b in ((other, one), (one, other)))
    ahead, back = (np.concatenate([np.ravel(term) for term in terms]) for terms in (ahead, back))
    assert abs(ahead.sum() - back.sum()) <= TOLERANCE * np.linalg.norm(ahead)


def _products(one: Any, other: Any) -> list[np.ndarray]:
    """Of two trees, number by number."""
    return [np.asarray(a * b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)]


def _directions(arrays: calls.Arrays, draws: np.random.Generator) -> Any:
    """Directions along one array each, or one row of the parameters, and what they are called."""
    leaves, structure = jax.tree.flatten(arrays)
    for place, (path, leaf) in enumerate(jax.tree_util.tree_flatten_with_path(arrays)[0]):
        name = jax.tree_util.keystr(path)
        along = draws.normal(size=leaf.shape)
        if "offsets" in name:  # alike in all replicas
            along = np.broadcast_to(along[..., :1], leaf.shape)
        rows = range(len(leaf)) if "parameters" in name else [None]
        for row in rows:
            chosen = along if row is None else np.where(np.arange(len(leaf))[:, None] == row, along, 0.0)
            whole = [jnp.asarray(chosen) if other == place else jnp.zeros_like(one) for other, one in enumerate(leaves)]
            yield name if row is None else f"{name}[{row}]", jax.tree.unflatten(structure, whole)
