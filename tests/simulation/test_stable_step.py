"""The largest stable step: what a kicked pack does in steps a little shorter and a little longer."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.experiment import stepping
from gmem_jax.simulation.stable_step import CLOSE, GROWTH, LONGEST_STEP, SHORTEST_STEP, largest_without

EXPERIMENT = gm.Experiment(gm.load_pack(TETRA_27), gm.words(1), gm.Hooke(stiffness=0.5), delta0=1e-4)


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


STEPS = 20  # what grows does so by some 20 % in a step, and must stay small


def test_a_kick_dies_out_in_stable_steps_and_grows_beyond_them() -> None:
    stable = gm.stable_step(EXPERIMENT)
    assert 0.8 < stable < 1.2  # 2 under the default law, and there it ends
    assert growth(0.98 * stable) < 0.0
    assert growth(1.03 * stable) > GROWTH


def test_the_step_is_not_looked_for_in_single_precision() -> None:
    with jax.enable_x64(False), pytest.raises(ValueError, match="float64 is needed"):
        gm.stable_step(EXPERIMENT)


def test_whether_a_step_is_stable_is_known_without_the_longest_one(monkeypatch: pytest.MonkeyPatch) -> None:
    stable = gm.stable_step(EXPERIMENT)
    monkeypatch.setattr(stepping, "_known", {})
    monkeypatch.setattr(stepping, "_borne", {})
    monkeypatch.setattr(stepping, "largest_stable_step", None)
    assert stepping.is_stable(EXPERIMENT, 0.98 * stable)
    assert not stepping.is_stable(EXPERIMENT, CLOSE**2 * stable)
    monkeypatch.setattr(stepping, "growth", None)  # asked once
    assert stepping.is_stable(EXPERIMENT, 0.9 * stable)


def test_the_step_is_the_longest_without_growth() -> None:
    assert 0.7 / CLOSE < largest_without(lambda dt: dt - 0.7) < 0.7 + GROWTH


@pytest.mark.parametrize("frequency", [1.02, 2.0, 7.0])
def test_the_step_of_one_undamped_mode_is_found_in_four_questions(frequency: float) -> None:
    asked = []

    def growth(dt: float) -> float:
        asked.append(dt)
        return float(np.arccosh(max(1.0, 0.5 * (frequency * dt) ** 2 - 1.0)))  # z + 1 / z = 2 - (w dt)^2

    assert 2.0 / CLOSE < frequency * largest_without(growth) <= 2.0
    assert len(asked) <= 4


@pytest.mark.parametrize(("found", "expected"), [(-1.0, LONGEST_STEP), (1.0, 0.0), (np.nan, 0.0)])
def test_steps_that_are_all_stable_or_not_have_no_root(found: float, expected: float) -> None:
    assert largest_without(lambda _: found) == expected
    assert largest_without(lambda dt: found if dt > SHORTEST_STEP else -1.0) >= SHORTEST_STEP
