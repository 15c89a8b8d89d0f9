"""Quaternions: exact properties of the Cayley turn, and its order against the exact rotation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import column, orientations

from gmem_jax.physics.rotation import cross, dot, matrix, turn, uniform

AXIS = np.array([0.6, -0.48, 0.64])
TURN, MATRIX = jax.jit(turn), jax.jit(matrix)


def exact(angle: float) -> np.ndarray:
    """Rodrigues' rotation about AXIS."""
    k = np.cross(AXIS, np.eye(3)).T
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k


def test_turn_keeps_the_unit_norm_for_any_angle():
    quaternion = jnp.asarray(orientations(50))[:, :, None]
    for size in (1e-8, 0.1, 3.0, 100.0):
        angle = size * np.random.default_rng(1).normal(size=(50, 3, 1))
        np.testing.assert_allclose(np.sum(np.asarray(TURN(quaternion, angle)) ** 2, axis=1), 1.0, rtol=4e-15)


def test_a_zero_turn_changes_nothing():
    quaternion = jnp.asarray(orientations(5))[:, :, None]
    np.testing.assert_allclose(TURN(quaternion, jnp.zeros((5, 3, 1))), quaternion, rtol=4e-16, atol=1e-16)


def test_one_turn_is_the_rotation_by_twice_the_arctangent_in_the_lab_frame():
    before = jnp.asarray(orientations(1)[0])[:, None]
    after = TURN(before, column(0.7 * AXIS))
    expected = exact(2.0 * np.arctan(0.35)) @ np.asarray(MATRIX(before))[..., 0]
    np.testing.assert_allclose(MATRIX(after)[..., 0], expected, atol=4e-15)


def test_turn_is_right_to_third_order_in_the_angle_of_a_step():
    angles = np.array([0.4, 0.2, 0.1, 0.05])
    start = column([1.0, 0.0, 0.0, 0.0])
    errors = [np.linalg.norm(MATRIX(TURN(start, column(a * AXIS)))[..., 0] - exact(a), 2) for a in angles]
    order = np.polyfit(np.log(angles), np.log(errors), 1)[0]
    # The Cayley map's error is exactly cubic (angle^3 / 12).
    assert order == pytest.approx(3.0, abs=0.05)
    assert errors[-1] == pytest.approx(0.05**3 / 12.0, rel=0.1)


def test_many_small_turns_reach_the_exact_orientation_at_second_order():
    def error(steps: int) -> float:
        angle = column(2.0 / steps * AXIS)
        end = jax.lax.fori_loop(0, steps, lambda _, q: turn(q, angle), column([1.0, 0.0, 0.0, 0.0]))
        return float(np.abs(MATRIX(end)[..., 0] - exact(2.0)).max())

    assert np.log2(error(50) / error(100)) == pytest.approx(2.0, abs=0.02)


def test_matrices_are_proper_rotations():
    rotations = np.asarray(MATRIX(jnp.asarray(orientations(100, 2))[:, :, None]))[..., 0]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (100, 1, 1)), atol=4e-15)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, rtol=4e-15)


def test_products_are_those_of_numpy_along_the_component_axis():
    a, b = np.random.default_rng(0).normal(size=(2, 7, 3, 4))
    np.testing.assert_allclose(cross(jnp.asarray(a), jnp.asarray(b)), np.cross(a, b, axis=1), rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(dot(jnp.asarray(a), jnp.asarray(b))[:, 0], (a * b).sum(1), rtol=1e-12, atol=1e-14)


def test_uniform_orientations_have_no_preferred_direction():
    rotations = np.asarray(MATRIX(uniform(jax.random.PRNGKey(3), 20_000)[:, :, None]))[..., 0]
    # Each component has standard deviation sqrt(1/3): five standard errors are 0.02.
    np.testing.assert_allclose(rotations.mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose((rotations**2).mean(axis=0), 1.0 / 3.0, atol=0.02)
