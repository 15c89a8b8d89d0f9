"""Vectors and unit quaternions stored along the second-to-last axis, [..., 3 or 4, B]."""

from typing import Any

import jax
import jax.numpy as jnp


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Scalar product of [..., 3, B] vectors; the axis is kept, [..., 1, B]."""
    return jnp.sum(a * b, axis=-2, keepdims=True)


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Vector product of [..., 3, B] vectors."""
    ax, ay, az = a[..., 0, :], a[..., 1, :], a[..., 2, :]
    bx, by, bz = b[..., 0, :], b[..., 1, :], b[..., 2, :]
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-2)


def matrix(quaternion: jax.Array) -> jax.Array:
    """Rotation matrices [..., 3, 3, B] (lab components of body vectors) of unit quaternions [..., 4, B]."""
    rows = matrix_rows(*(quaternion[..., k, :] for k in range(4)))
    return jnp.stack([jnp.stack(row, axis=-2) for row in rows], axis=-3)


def matrix_rows(w: Any, x: Any, y: Any, z: Any) -> list[list[Any]]:
    """The rows of the rotation matrix of a unit quaternion (w, x, y, z), in JAX or NumPy."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def turn(quaternion: jax.Array, angle: jax.Array) -> jax.Array:
    """Rotate `quaternion` [..., 4, B] by the small lab-frame rotation vector `angle` [..., 3, B].

    Uses the Cayley map (the rotation by 2 atan(|angle| / 2)), which is free of trigonometry, smooth at zero and
    right to third order in the angle of one step, one more than the integrator needs. The result is normalised.
    """
    w, v = quaternion[..., :1, :], quaternion[..., 1:, :]
    half = 0.5 * angle
    new_w = w - dot(half, v)
    new_v = v + w * half + cross(half, v)
    turned = jnp.concatenate([new_w, new_v], axis=-2)
    unit: jax.Array = turned / jnp.sqrt(jnp.sum(turned * turned, axis=-2, keepdims=True))
    return unit


_UNIT = 1e-12  # a quaternion whose length is nearer to 1 than this stays as it is


def unit(quaternion: jax.Array) -> jax.Array:
    """Quaternions [..., 4, B] of any length but zero, brought to length 1; those that have it stay, bit for bit.

    In both cases the derivative is that of the division by the length: it vanishes along the quaternion itself.
    """
    scale = 1.0 / jnp.sqrt(jnp.sum(quaternion * quaternion, axis=-2, keepdims=True))
    rest = jnp.where(jnp.abs(scale - 1.0) < _UNIT, 1.0 - scale, 0.0)
    return quaternion * (scale + jax.lax.stop_gradient(rest))


def uniform(key: jax.Array, count: int) -> jax.Array:
    """`count` unit quaternions, [count, 4], uniform over all orientations."""
    sample = jax.random.normal(key, (count, 4))
    unit: jax.Array = sample / jnp.linalg.norm(sample, axis=1, keepdims=True)
    return unit
