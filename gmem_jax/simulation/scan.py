"""Scans whose reverse mode needs little memory: states are kept at two levels, and the others are computed again."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

SHORT = 32  # carries that one level may keep


def inner_length(length: int) -> int:
    """A length of blocks near the square root of `length`; if possible a divisor, so that the body is compiled once."""
    root = math.isqrt(max(1, length))
    return next((part for part in range(root, root // 2, -1) if length % part == 0), root)


def scan(body: Callable[[Any, Any], tuple[Any, Any]], carry: Any, xs: Any) -> tuple[Any, Any]:
    """`jax.lax.scan` over xs, leaves [n, ...], in blocks of blocks: reverse mode keeps about 2 sqrt(n) carries, not n.

    The price is one more evaluation of the body, which scans of up to `SHORT` steps are spared. Forward evaluation and
    forward mode are those of one scan. The steps beyond the last whole block are a block by themselves.

    Args:
        body: as for `jax.lax.scan`.
        carry: as for `jax.lax.scan`.
        xs: as for `jax.lax.scan`.
    """
    one = jax.checkpoint(body)
    length = jax.tree.leaves(xs)[0].shape[0]
    inner = inner_length(length) if length > SHORT else 1
    if inner == 1:
        return lax.scan(one, carry, xs)

    def block(carry: Any, some: Any) -> tuple[Any, Any]:
        return lax.scan(one, carry, some)

    whole = length - length % inner
    blocks = jax.tree.map(lambda leaf: leaf[:whole].reshape(-1, inner, *leaf.shape[1:]), xs)
    carry, ys = lax.scan(jax.checkpoint(block), carry, blocks)
    ys = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), ys)
    if whole == length:
        return carry, ys
    carry, last = jax.checkpoint(block)(carry, jax.tree.map(lambda leaf: leaf[whole:], xs))
    return carry, jax.tree.map(lambda one, other: jnp.concatenate([one, other]), ys, last)
