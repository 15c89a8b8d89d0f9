"""Gravity: free fall, a sphere on a floor, and the weight of a pack."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import PERIODIC_27, SPHERE, TETRA_27, scene, standing

import gmem_jax as gm
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.state import Box, replicate

MARCH = jax.jit(dynamics.march)
G = 1e-4


def falling(place: list[float], gravity: object = G, **more: object) -> tuple:
    system, state, box = scene(SPHERE, [place], **more)
    system = replace(system, gravity=gravity)
    return system, dynamics.accelerate(system, state, box), box


def test_a_free_grain_falls_as_galilei_says():
    heights = jnp.asarray([G, 3.0 * G, 0.0])
    system, state, box = falling([0.0, 0.0, 0.0], velocity=[[1e-3, 0.0, 2e-3]])
    system = replace(system, gravity=heights)
    state = dynamics.accelerate(system, replicate(state, 3), box)
    after, _ = MARCH(system, state, standing(box, 100), 0.5, 0.0)
    t = 50.0
    fallen = np.asarray(after.grains.position)[0]  # Verlet's steps are exact where forces are steady
    np.testing.assert_allclose(fallen[0], 1e-3 * t, rtol=1e-12)
    np.testing.assert_allclose(fallen[2], 2e-3 * t - 0.5 * np.asarray(heights) * t**2, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(after.grains.velocity)[0, 2], 2e-3 - np.asarray(heights) * t, rtol=1e-12)


def test_drag_and_gravity_reach_the_speed_at_which_they_are_equal():
    system, state, box = falling([0.0, 0.0, 0.0])
    drag = 0.05
    after, _ = MARCH(system, state, standing(box, 1000), 0.5, drag)
    np.testing.assert_allclose(np.asarray(after.grains.velocity)[0, 2, 0], -G / drag, rtol=1e-9)


def test_a_sphere_comes_to_rest_as_deep_in_the_floor_as_hertz_says():
    box = Box(*(jnp.full((3, 1), x) for x in (-3.0, 3.0, 0.0, 0.0)))
    system, state, _ = falling([0.0, 0.0, -2.0], box=box)
    after, _ = MARCH(system, state, standing(box, 40_000), 0.5, 0.02)
    deep = 1.0 - (float(after.grains.position[0, 2, 0]) + 3.0)
    weight = float(system.clump.mass) * G
    np.testing.assert_allclose(deep, (weight / float(system.material.wall_stiffness)) ** (2.0 / 3.0), rtol=1e-6)


def test_the_floor_of_a_pack_bears_its_weight_more_than_the_lid():
    pack = gm.load_pack(TETRA_27)
    system = dynamics.System(pack.clump, gm.Hooke(), pack.pairs, gravity=G)
    state = dynamics.start(system, pack.position[..., None], pack.quaternion[..., None], pack.box)
    state, _ = MARCH(system, state, standing(pack.box, 6000), 0.5, 0.05)
    _, walls = dynamics.step(system, state, pack.box, jnp.asarray(0.5), 0.0, state.status[0] >= 0)
    weight = 27 * float(pack.clump.mass) * G
    assert float(jnp.abs(state.grains.velocity).max()) < 1e-9
    np.testing.assert_allclose(float(walls[0, 2, 0] - walls[1, 2, 0]), weight, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(walls[0, :2, 0] - walls[1, :2, 0]), 0.0, atol=1e-6 * weight)


def test_gravity_is_a_number_of_an_experiment():
    pack = gm.load_pack(TETRA_27)
    signal = gm.Bumps(jnp.asarray([[1.0]]), jnp.asarray([[0.5]]), 0.3)
    short = {"t0": 60.0, "rest": 0.1, "hold": 0.02, "store": 0.02}
    heavy = gm.Experiment(pack, signal, gravity=1e-4, **short)
    weightless = gm.recall(gm.replace(heavy, gravity=0.0)).p_sig
    recalled = gm.recall(heavy).p_sig
    assert not np.allclose(recalled, weightless, rtol=1e-3)
    definition = gm.recall(replace(heavy, backend="jax")).p_sig
    np.testing.assert_allclose(recalled, definition, atol=1e-9 * float(heavy.scale))


def test_impossible_gravity_is_refused():
    pack = gm.load_pack(TETRA_27)
    with pytest.raises(ValueError, match="gravity must be in"):
        gm.Experiment(pack, gm.six_signals(), gravity=-1.0)
    with pytest.raises(ValueError, match="no floor"):
        gm.Experiment(gm.load_pack(PERIODIC_27), gm.six_signals(), gravity=1e-5)
