"""Sizes of grains: distributions, what a recipe makes of them, and a prepared pack."""

from dataclasses import asdict, replace

import numpy as np
import pytest

import gmem_jax as gm
from gmem_jax.physics.grain import LARGEST_RATIO
from gmem_jax.preparation.grading import LARGEST_SPREAD
from gmem_jax.preparation.preparation import _gas
from gmem_jax.preparation.recipe import bins_outside, graded, grain_steps, sites_of


@pytest.mark.parametrize(("spread", "grains"), [(0.1, 27), (0.1, 3000), (0.3, 3000)])
def test_sizes_are_lognormal_with_the_spread_that_was_asked_for(spread: float, grains: int) -> None:
    sizes = gm.lognormal(grains, spread, seed=3)
    assert sizes.mean() == pytest.approx(1.0, rel=1e-14)
    assert sizes.std() == pytest.approx(spread, rel=0.06 if grains > 100 else 0.1)
    width = np.sqrt(np.log1p(spread**2))
    logs = np.log(sizes)
    assert np.ptp(logs) <= 6.0 * width
    assert np.ptp(logs) > (5.9 if grains > 100 else 4.0) * width
    assert np.median(logs) == pytest.approx(-0.5 * width**2, abs=0.02 * width)
    np.testing.assert_allclose(np.quantile(logs, [0.1587, 0.8413]) - np.median(logs), [-width, width], rtol=0.1)


def test_spheres_of_the_widest_spread_can_be_listed_together() -> None:
    sizes = gm.lognormal(100_000, LARGEST_SPREAD)
    assert 7.0 < sizes.max() / sizes.min() < LARGEST_RATIO
    assert gm.sized(gm.sphere(), sizes).widest == 2.0 * sizes.max()


def test_a_seed_orders_sizes_and_changes_none() -> None:
    one, again, other = (gm.lognormal(100, 0.2, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.any(one != other)
    np.testing.assert_array_equal(np.sort(one), np.sort(other))
    assert abs(np.corrcoef(np.arange(100), one)[0, 1]) < 0.35
    np.testing.assert_array_equal(gm.lognormal(5, 0.0), np.ones(5))


def test_a_mixture_has_its_shares() -> None:
    sizes = gm.mixture(10, [1.0, 1.4, 0.7], [0.5, 0.3, 0.2])
    assert {size: int(np.sum(sizes == size)) for size in (1.0, 1.4, 0.7)} == {1.0: 5, 1.4: 3, 0.7: 2}
    assert np.sum(gm.mixture(27, [1.0, 1.4]) == 1.4) in (13, 14)
    assert np.any(np.diff(gm.mixture(40, [1.0, 1.4])[:20]) != 0.0)


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda: gm.lognormal(10, -0.1), r"size_spread must be in \[0, 0.35\], got -0.1"),
        (lambda: gm.lognormal(10, float("nan")), r"size_spread must be in \[0, 0.35\], got nan"),
        (lambda: gm.lognormal(0, 0.1), "grains must be a whole number from 1"),
        (lambda: gm.mixture(10, [1.0, 0.0]), "sizes must be positive numbers"),
        (lambda: gm.mixture(10, [1.0, np.inf]), "sizes must be positive numbers"),
        (lambda: gm.mixture(10, [1.0, 1.4], [0.5]), "shares must be one for each of 2 sizes and sum to 1"),
        (lambda: gm.mixture(10, [1.0, 1.4], [0.5, 0.6]), "shares must be one for each of 2 sizes and sum to 1"),
        (lambda: gm.mixture(10, [1.0, 1.4], [0.99, 0.01]), "of 10 grains none would have size 1.4"),
        (lambda: gm.Recipe(size_spread=0.6), r"size_spread must be in \[0, 0.35\]"),
        (lambda: gm.Recipe(size_spread=0.1, sizes="1,1.4"), "sizes and size_spread exclude each other"),
        (lambda: gm.Recipe(shares="0.5,0.5"), "shares are the fractions of grains of each size"),
        (lambda: gm.Recipe(sizes="1;1.4"), "sizes must be numbers with commas between them"),
        (lambda: gm.Recipe(sizes="1,-1.4"), "sizes must be positive numbers"),
        (lambda: gm.Recipe(sizes="1,1.4", shares="0.5"), "shares must be one for each of 2 sizes"),
    ],
)
def test_impossible_sizes_are_refused_in_a_line(make, why: str) -> None:
    with pytest.raises(ValueError, match=why) as error:
        make()
    assert "\n" not in str(error.value)


def test_a_recipe_says_its_sizes_in_words_and_the_same_recipe_comes_of_them() -> None:
    recipe = gm.Recipe(grains=20, sizes=(1, 1.4), shares=[0.25, 0.75])
    assert (recipe.sizes, recipe.shares) == ("1,1.4", "0.25,0.75")
    assert gm.Recipe(**asdict(recipe)) == recipe
    assert np.sum(graded(recipe, gm.sphere()).sizes == 1.4) == 15
    assert graded(gm.Recipe(grains=20), gm.sphere()).equal
    np.testing.assert_array_equal(graded(gm.Recipe(size_spread=0.2), gm.tetra()).sizes, gm.lognormal(325, 0.2, seed=1))


def test_a_grain_with_sizes_of_its_own_must_fit_the_recipe() -> None:
    grain = gm.sized(gm.sphere(), np.linspace(0.9, 1.1, 15))
    assert graded(gm.Recipe(grains=15), grain) == grain
    for recipe in (gm.Recipe(grains=16), gm.Recipe(grains=15, size_spread=0.1)):
        with pytest.raises(ValueError, match="the grain has 15 sizes of its own"):
            graded(recipe, grain)
    with pytest.raises(ValueError, match="cannot be listed together"):
        graded(gm.Recipe(sizes="0.2,3"), gm.sphere())


@pytest.mark.parametrize("grain", [gm.sphere(), gm.tetra()], ids=["sphere", "tetra"])
def test_grains_of_the_gas_turn_freely_whatever_their_sizes(grain: gm.Clump) -> None:
    recipe = gm.Recipe(grains=100, sizes="0.8,1.3")
    made = graded(recipe, grain)
    position, _, _, _, lengths = _gas(recipe, made)
    apart = np.linalg.norm(position[:, None] - position, axis=-1)[np.triu_indices(100, 1)]
    assert apart.min() > 1.3 * float(grain.diameter)
    assert np.all(np.minimum(position, lengths - position) > 0.65 * float(grain.diameter))
    assert float(made.volume(100)) / np.prod(lengths) <= 0.3


def test_what_a_preparation_costs_goes_with_the_volume_of_its_grains() -> None:
    small, large = (graded(gm.Recipe(grains=100, sizes=size), gm.sphere()) for size in ("0.8", "1.6"))
    recipe = gm.Recipe(grains=100)
    np.testing.assert_allclose(sites_of(recipe, large)[1], 2.0 * sites_of(recipe, small)[1], rtol=1e-12)
    assert bins_outside(recipe, large) > bins_outside(recipe, small)
    assert grain_steps(recipe, large) > grain_steps(recipe, small)
    assert replace(recipe, size_spread=0.0) == recipe
