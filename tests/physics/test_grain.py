"""Mass properties of grains: the specification's table, closed forms, and independence of the caller's frame."""

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import cached_tetra, orientations

from gmem_jax.physics.grain import clump, sphere, tetra
from gmem_jax.physics.rotation import matrix

BALL = 4.0 * np.pi / 3.0
BENT = np.array([[0.0, 0.0, 0.0], [1.1, 0.2, 0.0], [1.5, 1.2, 0.3], [0.4, 0.1, 1.3]])  # no symmetry at all


@pytest.mark.parametrize(
    ("overlap", "edge", "volume", "inertia", "diameter"),
    [
        (0.6, 0.8, 9.648, 0.718, 2.980),
        (0.7, 0.6, 8.157, 0.634, 2.735),
        (0.8, 0.4, 6.732, 0.553, 2.490),
        (0.9, 0.2, 5.402, 0.475, 2.245),
    ],
)
def test_tetra_matches_the_table_of_the_specification(overlap, edge, volume, inertia, diameter):
    grain = cached_tetra(overlap)
    # The table prints 3 decimals.
    assert float(grain.mass) == pytest.approx(volume, abs=1e-3)
    np.testing.assert_allclose(grain.inertia / grain.mass, inertia, atol=1e-3)
    assert float(grain.diameter) == pytest.approx(diameter, abs=1e-3)
    gaps = np.linalg.norm(grain.offsets[:, None] - grain.offsets, axis=-1)[np.triu_indices(4, 1)]
    np.testing.assert_allclose(gaps, edge, rtol=1e-12)
    assert grain.isotropic


def test_sphere_is_exact():
    grain = sphere()
    assert float(grain.mass) == pytest.approx(4.18879, abs=1e-5)
    np.testing.assert_allclose(grain.inertia, 0.4 * BALL, rtol=1e-14)
    assert (grain.spheres, float(grain.diameter), grain.isotropic) == (1, 2.0, True)


def test_sections_of_one_sphere_give_a_sphere():
    grain = clump([[3.0, -1.0, 2.0]])
    # 700 x 700 lines: about 1e-5, as the module promises.
    assert float(grain.mass) == pytest.approx(BALL, rel=1e-5)
    np.testing.assert_allclose(grain.inertia, 0.4 * BALL, rtol=2e-5)
    np.testing.assert_allclose(grain.offsets, 0.0, atol=1e-12)


def test_touching_tetra_is_four_separate_spheres():
    grain = cached_tetra(0.0)
    assert float(grain.mass) == pytest.approx(4.0 * BALL, rel=2e-5)
    # Parallel axes: each centre is sqrt(3/8) d = sqrt(3/2) away, two thirds of its square off any axis on average.
    np.testing.assert_allclose(grain.inertia, 4.0 * BALL * (0.4 + 2.0 / 3.0 * 1.5), rtol=2e-5)


@pytest.mark.parametrize("distance", [0.3, 1.0, 1.9])
def test_two_sphere_volume_is_two_balls_less_the_lens(distance):
    lens = np.pi * (4.0 + distance) * (2.0 - distance) ** 2 / 12.0  # two unit spheres
    grain = clump(np.array([[0, 0, 0], [1, 2, -2]]) * distance / 3.0)
    assert float(grain.mass) == pytest.approx(2.0 * BALL - lens, rel=1e-5)


def test_two_sphere_grain_has_an_axis_of_symmetry():
    grain = clump([[0.0, 0.0, 0.0], [0.8, 0.9, 0.3]])
    axis = np.abs(grain.offsets[1] - grain.offsets[0]) / np.linalg.norm(grain.offsets[1] - grain.offsets[0])
    np.testing.assert_allclose(axis, [1.0, 0.0, 0.0], atol=1e-4)  # smallest moment first
    assert float(grain.inertia[0]) < 0.9 * float(grain.inertia[1])
    np.testing.assert_allclose(grain.inertia[1], grain.inertia[2], rtol=2e-5)
    assert not grain.isotropic


def test_moments_do_not_depend_on_order_place_or_orientation_of_the_offsets():
    reference = clump(BENT)
    rotation = np.asarray(matrix(jnp.asarray(orientations(1)[0])[:, None]))[..., 0]
    for offsets in (BENT[[2, 0, 3, 1]], BENT + np.array([5.0, -3.0, 1.0]), BENT @ rotation.T, BENT[:, [1, 2, 0]]):
        other = clump(offsets)
        # Each is right to about 1e-5, with different lines.
        assert float(other.mass) == pytest.approx(float(reference.mass), rel=2e-5)
        np.testing.assert_allclose(other.inertia, reference.inertia, rtol=5e-5)
        assert float(other.diameter) == pytest.approx(float(reference.diameter), rel=2e-5)


def test_the_principal_frame_keeps_shape_and_handedness():
    grain = np.asarray(clump(BENT).offsets)
    np.testing.assert_allclose(
        np.linalg.norm(grain[:, None] - grain, axis=-1), np.linalg.norm(BENT[:, None] - BENT, axis=-1), atol=1e-12
    )
    volume, original = (np.linalg.det(c[1:] - c[0]) for c in (grain, BENT))
    assert volume == pytest.approx(original, rel=1e-12)  # a mirrored copy would change sign


def test_mass_properties_agree_with_random_points():
    grain = clump(BENT)
    centres = np.asarray(grain.offsets)
    half = np.abs(centres).max(axis=0) + 1.0
    points = np.random.default_rng(1).uniform(-half, half, (400_000, 3))
    inside = points[(((points[:, None] - centres) ** 2).sum(-1) < 1.0).any(1)]
    cell = np.prod(2.0 * half) / len(points)
    square = cell * inside.T @ inside
    inertia = np.trace(square) * np.eye(3) - square
    # 400,000 points: a standard error of 0.1 % of the mass; four of them allowed.
    assert cell * len(inside) == pytest.approx(float(grain.mass), rel=4e-3)
    np.testing.assert_allclose(inertia / float(grain.mass), np.diag(grain.inertia / grain.mass), atol=1e-2)
    np.testing.assert_allclose(inside.mean(axis=0), 0.0, atol=1e-2)


@pytest.mark.parametrize("overlap", [-0.1, 1.0, float("nan")])
def test_tetra_refuses_overlaps_outside_its_range(overlap):
    with pytest.raises(ValueError, match="overlap must be in"):
        tetra(overlap)


@pytest.mark.parametrize("offsets", [[0.0, 0.0, 0.0], [[0.0, 0.0]], np.zeros((0, 3)), [[0.0, 0.0, np.inf]]])
def test_clump_refuses_offsets_that_are_not_finite_points(offsets):
    with pytest.raises(ValueError, match="clump offsets"):
        clump(offsets)
