"""The largest stable step: what a kicked pack does in steps a little shorter and a little longer."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.simulation.stable_step import GROWTH, LONGEST_STEP, SHORTEST_STEP, largest_without

EXPERIMENT = gm.Experiment(gm.load_pack(TETRA_27), gm.words(1))


def growth(dt: float) -> float:
    """Of accelerations after a kick, in a step, between walls at rest."""
    simulation, state = EXPERIMENT.simulation(sheared=False), EXPERIMENT.begin()
    kick = 1e-12 * jax.random.normal(jax.random.key(1), state.grains.velocity.shape)
    state = replace(state, grains=replace(state.grains, velocity=kick))
    walls = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (STEPS, *leaf.shape)), EXPERIMENT.pack.box)
    sizes = []
    for _ in range(3):
        rest = state.grains.acceleration
        state, _ = simulation.resolved.march(simulation.system, state, walls, dt, 0.0)
        sizes.append(float(jnp.linalg.norm(state.grains.acceleration - rest)))
    return float(np.log(sizes[2] / sizes[1]) / STEPS)


STEPS = 1500


def test_a_kick_dies_out_in_stable_steps_and_grows_beyond_them() -> None:
    stable = gm.stable_step(EXPERIMENT)
    assert 0.7 < stable < 0.9
    assert growth(0.96 * stable) < 0.0
    assert growth(1.04 * stable) > GROWTH


def test_the_root_is_that_of_growth_which_is_a_fourth_power_less_a_first() -> None:
    np.testing.assert_allclose(largest_without(lambda dt: 0.1 * (dt**4 - 0.7**3 * dt)), 0.7, rtol=1e-3)


@pytest.mark.parametrize(("found", "expected"), [(-1.0, LONGEST_STEP), (1.0, 0.0), (np.nan, 0.0)])
def test_steps_that_are_all_stable_or_not_have_no_root(found: float, expected: float) -> None:
    assert largest_without(lambda _: found) == expected
    assert largest_without(lambda dt: found if dt > SHORTEST_STEP else -1.0) >= SHORTEST_STEP
