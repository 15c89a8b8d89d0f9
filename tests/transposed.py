"""What reverse mode is to forward mode, without a derivative of plain JAX, which compiles for tens of seconds."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.native import primitives
from gmem_jax.native.march import PlainDefinition, arrays_of, call_of, fixed_of
from gmem_jax.physics.state import Box, State
from gmem_jax.physics.system import System

# Round-off of a sum of a thousand numbers; more where steps magnify it, as 3e-12 in a periodic box with law M2.
TOLERANCE = 1e-10


def assert_transposed(system: System, state: State, boxes: Box, dt: float = 0.3, drag: float = 0.01) -> Any:
    """The library's adjoint is the transpose of its tangent: w . (J d) = (J^T w) . d, for every argument of a call.

    J is the derivative of the steps, w weights of all that they give, d a direction along one argument, or along one
    row of the parameters.

    Returns:
        J^T w, `primitives.Arrays`.
    """
    boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*leaf.shape[:-1], state.replicas)), boxes)
    numbers = jnp.asarray(dt), jnp.asarray(drag)
    arrays = arrays_of(system, state.grains, state.history, boxes, numbers, state.cell, state.wall_history)
    call, fixed = call_of(system, boxes.periodic), fixed_of(system)
    definition = PlainDefinition.of(system, state.history, True, boxes.periodic, state.wall_history)

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
    return bars


def _products(one: Any, other: Any) -> list[np.ndarray]:
    """Of two trees, number by number."""
    return [np.asarray(a * b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)]


def _directions(arrays: primitives.Arrays, draws: np.random.Generator) -> Any:
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
