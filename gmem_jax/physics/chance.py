"""Random keys that depend on a seed alone, not on settings of JAX.

JAX's own keys depend on settings of the machine (JAX_DEFAULT_PRNG_IMPL, JAX_THREEFRY_PARTITIONABLE,
JAX_RANDOM_SEED_OFFSET). These keys name their generator: threefry-2x32, whose counters are the numbers of the elements.
`jax.random` takes them like its own, and gives the same numbers as with its own keys under JAX's default settings.
"""

import math

import jax
import jax.numpy as jnp
from jax.extend.random import define_prng_impl, threefry2x32_p


def key(seed: jax.typing.ArrayLike) -> jax.Array:
    """The random key of a seed, a whole number from 0; may be traced."""
    made: jax.Array = jax.random.wrap_key_data(_words(jnp.asarray(seed)), impl=_GENERATOR)
    return made


def _words(number: jax.Array) -> jax.Array:
    """The upper and lower 32 bits of a whole number, uint32 [2]."""
    upper = jax.lax.shift_right_logical(number, jnp.asarray(32, number.dtype))
    return jnp.stack([upper.astype(jnp.uint32), number.astype(jnp.uint32)])


def _hashed(own: jax.Array, shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    """Two words for each element of a shape, uint32."""
    count = jnp.arange(math.prod(shape), dtype=jnp.uint32).reshape(shape)
    first, second = threefry2x32_p.bind(own[0], own[1], jnp.zeros_like(count), count)
    return first, second


def _split(own: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return jnp.stack(_hashed(own, shape), axis=-1)


def _bits(own: jax.Array, width: int, shape: tuple[int, ...]) -> jax.Array:
    upper, lower = _hashed(own, shape)
    kind = jnp.dtype(f"uint{width}")
    if width == 64:
        return (upper.astype(kind) << jnp.asarray(32, kind)) | lower.astype(kind)
    return (upper ^ lower).astype(kind)


def _fold_in(own: jax.Array, data: jax.typing.ArrayLike) -> jax.Array:
    upper, lower = _words(jnp.asarray(data))
    return jnp.stack(threefry2x32_p.bind(own[0], own[1], upper, lower))


_GENERATOR = define_prng_impl(
    key_shape=(2,), seed=_words, split=_split, random_bits=_bits, fold_in=_fold_in, name="gmem-threefry2x32", tag="gmem"
)
