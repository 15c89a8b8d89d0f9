"""The elastic solid: stiffnesses, the unit of time, and refusal of unphysical values."""

import pytest

from gmem_jax.physics.material import Material


def test_stiffnesses_are_those_of_the_specification():
    material = Material()
    # The specification prints 5 digits.
    assert material.normal_stiffness == pytest.approx(0.62035, abs=5e-6)
    assert material.wall_stiffness == pytest.approx(1.7546, abs=5e-5)
    assert material.mindlin_stiffness == pytest.approx(0.62857, abs=5e-6)


def test_a_wall_is_two_to_the_three_halves_stiffer_than_a_sphere():
    material = Material(poisson=0.3)
    assert material.wall_stiffness / material.normal_stiffness == pytest.approx(2.0**1.5, rel=1e-14)


def test_mindlin_to_hertz_ratio_follows_poissons_ratio():
    for poisson in (0.0, 0.25, 0.5):
        material = Material(poisson=poisson)
        expected = 3.0 * (1.0 - poisson) / (2.0 - poisson)
        assert material.mindlin_stiffness / material.normal_stiffness == pytest.approx(expected, rel=1e-14)


def test_the_time_unit_is_the_papers():
    assert Material().time_unit == pytest.approx(5.477e-6, rel=1e-4)  # printed to 4 digits


def test_conversions_to_si_scale_with_modulus_and_time_unit():
    material = Material(radius=1e-3, modulus=4e6, density=1000.0)
    assert material.pascal(2e-3) == pytest.approx(8e3, rel=1e-14)
    assert material.seconds(10.0) == pytest.approx(10.0 * 1e-3 * (1000.0 / 4e6) ** 0.5, rel=1e-14)


@pytest.mark.parametrize("name", ["radius", "modulus", "density"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_size_modulus_and_density_must_be_positive(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be in \(0, inf\), got "):
        Material(**{name: value})


@pytest.mark.parametrize("value", [-1.0, 0.51, float("nan")])
def test_poissons_ratio_must_be_physical(value):
    with pytest.raises(ValueError, match=r"^poisson must be in \(-1, 0.5\], got "):
        Material(poisson=value)


@pytest.mark.parametrize("value", [-0.1, float("nan")])
def test_damping_times_must_not_be_negative_or_nan(value):
    with pytest.raises(ValueError, match=r"^normal_damping must be in \[0, inf\), got "):
        Material(normal_damping=value)
