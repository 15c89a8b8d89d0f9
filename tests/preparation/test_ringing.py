"""The ringing period: the peak of a spectrum that is known, and the mode of two spheres that can be written down."""

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SPHERE, column, scene

import gmem_jax as gm
from gmem_jax.physics.material import Material
from gmem_jax.physics.state import still_box
from gmem_jax.preparation.ringing import ringing_period, spectrum_peak

SPACING = 1.2
TIME = SPACING * np.arange(400)  # 480 t_c


def wave(period: float, phase: float = 0.3) -> np.ndarray:
    return np.sin(2.0 * np.pi * TIME / period + phase)


@pytest.mark.parametrize("period", [7.3, 13.71, 21.9, 37.4])
def test_the_peak_of_one_oscillation_is_its_period(period: float) -> None:
    # The padded spectrum has a point every period / (16 * 480) of the period, 0.1 to 0.5 %; the parabola through the
    # peak leaves a hundredth of that.
    assert spectrum_peak(wave(period), SPACING) == pytest.approx(period, rel=1e-4)


def test_the_period_is_in_the_unit_of_the_spacing() -> None:
    assert spectrum_peak(wave(20.0), 3.0 * SPACING) == pytest.approx(60.0, rel=1e-4)


def test_the_strongest_of_two_oscillations_is_taken() -> None:
    for strong, weak in ((25.0, 11.0), (11.0, 25.0)):
        assert spectrum_peak(wave(strong) + 0.5 * wave(weak), SPACING) == pytest.approx(strong, rel=1e-3)


def test_a_decaying_oscillation_has_the_period_of_the_oscillation() -> None:
    # The line is as wide as the decay is fast, 1 / 100, and lies at the frequency of the damped oscillation.
    assert spectrum_peak(np.exp(-TIME / 100.0) * wave(19.0), SPACING) == pytest.approx(19.0, rel=1e-2)


def test_drift_is_not_taken_for_ringing() -> None:
    # A slope, and a single period in the whole record, both much larger than what rings.
    drift = 50.0 * TIME / TIME[-1] + 20.0 * wave(480.0)
    assert spectrum_peak(drift + wave(19.0), SPACING) == pytest.approx(19.0, rel=1e-2)


def test_what_is_faster_than_any_wave_in_the_box_is_not_taken_for_its_ringing() -> None:
    both = wave(19.0) + 3.0 * wave(7.0)
    assert spectrum_peak(both, SPACING) == pytest.approx(7.0, rel=1e-3)
    assert spectrum_peak(both, SPACING, shortest=10.0) == pytest.approx(19.0, rel=1e-3)


def test_where_no_wall_feels_anything_there_is_no_ringing() -> None:
    box = still_box(column([-5.0, -5.0, -5.0]), column([5.0, 5.0, 5.0]))
    system, state, _ = scene(SPHERE, [[0.0, 0.0, 0.0]], box=box)
    with pytest.raises(gm.RunFailedError, match="the x and y walls feel no oscillation"):
        ringing_period(system, state.grains.position, state.grains.quaternion, box, jnp.asarray(0.3))


def test_two_spheres_between_two_walls_ring_at_the_rate_of_their_springs() -> None:
    """A kick along x moves them against each other, each on a wall and on the other.

    At overlaps p with each other and p / 2 with the walls forces balance, k_w being 2^1.5 k_n. A sphere that moves by
    dx feels 1.5 k_w sqrt(p / 2) dx = 3 k_n sqrt(p) dx of the wall, and as much of the other, which meets it halfway.
    """
    material = Material(normal_damping=0.0)
    overlap = 0.1
    half = 1.0 - 0.5 * overlap
    box = still_box(column([-2.0 * half, -5.0, -5.0]), column([2.0 * half, 5.0, 5.0]))
    system, state, _ = scene(SPHERE, [[-half, 0.0, 0.0], [half, 0.0, 0.0]], material=material, box=box)
    assert np.abs(state.grains.acceleration).max() < 1e-15
    rate = np.sqrt(6.0 * material.normal_stiffness * np.sqrt(overlap) / float(SPHERE.mass))
    found = ringing_period(system, state.grains.position, state.grains.quaternion, box, jnp.asarray(0.3))
    # Velocity Verlet rings (rate dt)^2 / 24 = 0.1 % too fast.
    assert found == pytest.approx(2.0 * np.pi / rate, rel=3e-3)
