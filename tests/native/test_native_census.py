"""The library's census of a configuration, against its definition in plain JAX."""

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import PERIODIC_27, PERIODIC_XY_27, SPREAD_27, TETRA_27

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.native.backend import resolve
from gmem_jax.native.census import census_anywhere, census_by_library
from gmem_jax.physics.census import Census, take_census
from gmem_jax.physics.state import Box, State, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System

pytestmark = pytest.mark.skipif(not native.available()[0], reason="the library was not built")

PACKS = {"walls": TETRA_27, "periodic": PERIODIC_27, "periodic along x and y": PERIODIC_XY_27, "sizes": SPREAD_27}
MANY = "tetra-325-a"
DEFINED, COUNTED = jax.jit(take_census), jax.jit(census_by_library)
Scene = tuple[System, State, Box]


@functools.cache
def scattered(of: str, replicas: int, shared: bool = True) -> Scene:
    """27 grains, in each replica elsewhere: some touch, some are beyond a wall; and a box for each."""
    pack = gm.load_pack(PACKS.get(of, MANY))
    system = System(pack.clump, gm.Hooke(), pack.pairs)
    state = replicate(start(system, pack.position[..., None], pack.quaternion[..., None], pack.box), replicas)
    draws = np.random.default_rng(0).normal(size=(3, pack.grains, 3, replicas))
    grains = state.grains
    turned = grains.quaternion + 0.02 * np.random.default_rng(1).normal(size=grains.quaternion.shape)
    grains = replace(
        grains,
        position=grains.position + 0.03 * draws[0],
        quaternion=turned / jnp.linalg.norm(turned, axis=1, keepdims=True),
        velocity=jnp.asarray(draws[1]),
        spin=jnp.asarray(draws[2]),
    )
    wider = jnp.linspace(-1.4, 0.9, replicas)  # the walls of the first cut spheres in halves
    lower, upper = pack.lower[:, None] - wider, pack.upper[:, None] + wider
    box = Box(lower, upper, jnp.zeros_like(lower), jnp.zeros_like(upper), pack.periodic)
    if not shared:
        own = pack.pairs.reference + 0.01 * jnp.arange(replicas)
        system = replace(system, pairs=replace(pack.pairs, reference=own))
    return system, replace(state, grains=grains, cell=box if any(pack.periodic) else None), box


def assert_same(found: Census, wanted: Census) -> None:
    """Numbers of contacts to the last, the rest to round-off of positions of some 10 R."""
    for name in Census._fields:
        one, other = (np.asarray(getattr(census, name)) for census in (found, wanted))
        exact = name.endswith("contacts") or name in ("outside", "finite")
        np.testing.assert_allclose(one, other, rtol=0, atol=0 if exact else 2e-13, err_msg=name)


@pytest.mark.parametrize("shared", [True, False], ids=["one reference", "a reference for each"])
@pytest.mark.parametrize("replicas", [1, 3, 17])
@pytest.mark.parametrize("of", PACKS)
def test_the_census_is_that_of_the_definition(of: str, replicas: int, shared: bool) -> None:
    scene = scattered(of, replicas, shared)
    wanted = DEFINED(*scene)
    assert_same(COUNTED(*scene), wanted)
    assert np.all(wanted.sphere_contacts > wanted.grain_contacts)
    assert np.all(wanted.grain_contacts > 9)
    assert of == "periodic" or (wanted.wall_contacts[0] > 9 and wanted.outside[0] == 1.0)
    assert replicas < 17 or of == "periodic" or wanted.outside[-1] == 0.0
    assert replicas < 17 or len(set(np.asarray(wanted.sphere_contacts))) > 3  # it is not one of all


def test_nothing_touches_where_all_are_apart() -> None:
    system, state, box = scattered("walls", 5)
    apart = replace(state, grains=replace(state.grains, position=3.0 * state.grains.position))
    found = COUNTED(system, apart, box)
    assert_same(found, DEFINED(system, apart, box))
    assert not np.any(found.sphere_contacts + found.grain_contacts)
    assert np.all(found.outside == 1.0)
    empty = replace(system, pairs=replace(system.pairs, valid=jnp.zeros_like(system.pairs.valid)))
    np.testing.assert_array_equal(COUNTED(empty, state, box).largest_overlap, -1.0)


@pytest.mark.parametrize("replicas", [2, 9])
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("field", ["position", "velocity", "acceleration", "spin_rate"])
def test_a_number_that_is_not_finite_is_seen_in_its_replica(field: str, value: float, replicas: int) -> None:
    system, state, box = scattered("walls", replicas)
    broken = getattr(state.grains, field).at[5, 1, 1].set(value)
    found = COUNTED(system, replace(state, grains=replace(state.grains, **{field: broken})), box)
    sound, others = COUNTED(system, state, box), np.arange(replicas) != 1
    for name in Census._fields:
        np.testing.assert_array_equal(getattr(found, name)[others], getattr(sound, name)[others], err_msg=name)
    assert found.finite[1] == float(field == "velocity")  # which is of no next step: accelerations show it then
    assert np.isfinite(found.largest_speed[1]) == (field in ("acceleration", "spin_rate"))


@pytest.mark.parametrize("threads", ["1", "2", "5"])
@pytest.mark.parametrize("instructions", ["avx512", "avx2", "baseline"])
def test_threads_change_no_bit_and_instruction_sets_round_off(
    monkeypatch: pytest.MonkeyPatch, instructions: str, threads: str
) -> None:
    scene = scattered("many", 9)  # whose candidates are shared out to threads
    with monkeypatch.context() as patch:
        patch.setenv("GMEM_ISA", instructions)
        wanted = COUNTED(*scene)
        patch.setenv("GMEM_THREADS", threads)
        jax.tree.map(np.testing.assert_array_equal, COUNTED(*scene), wanted)
    assert_same(wanted, DEFINED(*scene))


def test_vmap_counts_each_by_itself() -> None:
    system, state, box = scattered("walls", 3)
    states = [replace(state, grains=replace(state.grains, position=state.grains.position + 0.1 * n)) for n in range(4)]
    together: Any = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    found = jax.jit(jax.vmap(census_by_library, in_axes=(None, 0, None)))(system, together, box)
    for n, one in enumerate(states):
        assert_same(jax.tree.map(lambda leaf, n=n: leaf[n], found), COUNTED(system, one, box))


def test_nothing_of_a_census_has_a_derivative() -> None:
    system, state, box = scattered("walls", 2)

    def total(census: Any, position: jax.Array) -> jax.Array:
        moved = replace(state, grains=replace(state.grains, position=position))
        return sum(map(jnp.sum, census(system, moved, box)))

    for census in (take_census, census_by_library):
        slope = jax.jit(jax.grad(functools.partial(total, census)))(state.grains.position)
        assert not np.any(slope)


def test_a_candidate_of_other_spheres_is_refused() -> None:
    system, state, box = scattered("walls", 2)
    for name, number in (("first", 108), ("second", -1), ("grain_pair", 1 << 20)):
        wrong = replace(system.pairs, **{name: getattr(system.pairs, name).at[3].set(number)})
        with pytest.raises((ValueError, jax.errors.JaxRuntimeError), match="a candidate is not of spheres of the pack"):
            jax.block_until_ready(COUNTED(replace(system, pairs=wrong), state, box))


def test_each_backend_has_its_census() -> None:
    law = gm.Hooke()
    assert resolve("jax", "double", law).census is take_census
    assert resolve("native", "double", law).census is census_by_library
    assert resolve("auto", "double", law).census is census_anywhere
    system, state, box = scattered("walls", 2)
    short = replace(state, grains=jax.tree.map(lambda leaf: leaf.astype(jnp.float32), state.grains))
    assert census_anywhere(system, short, box).finite.dtype == jnp.float32  # by the definition
