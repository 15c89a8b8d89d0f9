"""Spheres of unequal radii on the native backend, against the definition; their adjoint, against their tangents."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import EVERY_LAW, PERIODIC_27, SPREAD_27, TETRA_27, assert_close, make_grains, scene
from transposed import assert_transposed

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.grain import Clump, clump, sized, sphere
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Box, State, replicate, still_box
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System

pytestmark = pytest.mark.skipif(not native.available()[0], reason="the library was not built")

STEPS, REPLICAS = 20, 5  # of a bin
QUICKLY = {"xla_backend_optimization_level": 0}
Scene = tuple[System, State, Box]


def bent() -> Clump:
    """The tetrahedron with spheres of three radii, in the principal frame that it has then."""
    return clump(gm.load_pack(TETRA_27).clump.offsets, "bent", radii=[1.0, 1.05, 0.9, 1.0])


def clumps(file: Any = TETRA_27) -> tuple[Clump, np.ndarray, np.ndarray, Box]:
    """Grains of a pack, each with a size of its own and spheres that differ; and where they are, in which box."""
    pack = gm.load_pack(file)
    sizes = np.random.default_rng(0).uniform(0.93, 1.04, pack.grains)
    return sized(bent(), sizes), np.asarray(pack.position), np.asarray(pack.quaternion), pack.box


def bidisperse() -> tuple[Clump, np.ndarray, np.ndarray, Box]:
    """Spheres of two sizes by turns on a lattice, between walls that all of the larger ones on a face touch."""
    lattice = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    grain = sized(sphere(), np.where(lattice.sum(axis=1) % 2, 0.8, 1.3))
    box = still_box(jnp.full((3, 1), -1.25), jnp.full((3, 1), 3 * 2.04 + 1.25))
    return grain, 2.04 * lattice, np.tile([1.0, 0.0, 0.0, 0.0], (len(lattice), 1)), box


SCENES: dict[str, Callable[[], tuple[Clump, np.ndarray, np.ndarray, Box]]] = {
    "clumps": clumps,
    "spheres": bidisperse,
    "periodic": functools.partial(clumps, PERIODIC_27),
}


@functools.cache
def thrown(law: str, of: str = "clumps", replicas: int = REPLICAS) -> Scene:
    """Grains that fly, spin, touch and slide in a box that shrinks, more along one axis than another, in two bins."""
    grain, position, quaternion, box = SCENES[of]()
    grains = make_grains(position, quaternion)
    finder = PairFinder(grain, np.asarray(box.lengths)[:, 0], 0.5, search=native.search())
    system = System(grain, EVERY_LAW[law], finder(grains, grain, box))
    begin = jax.jit(start, compiler_options=QUICKLY)
    state = replicate(begin(system, grains.position, grains.quaternion, box), replicas)
    draws = 5e-3 * np.random.default_rng(0).normal(size=(2, len(position), 3, replicas))
    moving = replace(state.grains, velocity=jnp.asarray(draws[0]), spin=jnp.asarray(draws[1]))
    inwards = jnp.asarray([2e-3, 1e-3, -5e-4])[:, None] * jnp.linspace(1.0, 0.5, replicas)
    time = 0.3 * (1.0 + jnp.arange(2 * STEPS)).reshape(2, STEPS, 1, 1)
    lower, upper, every = box.lower + time * inwards, box.upper - 2.0 * time * inwards, jnp.ones_like(time)
    boxes = Box(lower, upper, every * inwards, -2.0 * every * inwards, box.periodic)
    return system, replace(state, grains=moving), boxes


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICKLY)
def bin_by(march: native.March, system: System, state: State, boxes: Box) -> tuple[State, jax.Array]:
    return march(system, state, boxes, 0.3, 0.01)


def nth(boxes: Box, bin: int) -> Box:
    return jax.tree.map(lambda leaf: leaf[bin], boxes)


def moved(march: native.March, system: System, state: State, boxes: Box) -> Any:
    """All that a march gives, in two bins."""
    state, pressure = bin_by(march, system, state, nth(boxes, 0))
    state, more = bin_by(march, system, state, nth(boxes, 1))
    return state.grains, state.history, pressure + more, state.cell


def slow(*names: str) -> list[Any]:
    """The laws, these among the slow tests."""
    return [pytest.param(law, marks=[pytest.mark.slow] * (law in names)) for law in EVERY_LAW]


@pytest.mark.parametrize("law", slow("M2-exact"))
def test_values_of_unequal_spheres_are_those_of_the_definition(law: str) -> None:
    given = thrown(law)
    assert_close(moved(native.march, *given), moved(dynamics.march, *given), 1e-12)


@pytest.mark.parametrize(("law", "of"), [("H", "spheres"), ("M1", "periodic")])
def test_values_of_bidisperse_spheres_and_in_periodic_boxes_are_those_of_the_definition(law: str, of: str) -> None:
    given = thrown(law, of)
    found = moved(native.march, *given)
    assert_close(found, moved(dynamics.march, *given), 1e-12)
    touching = np.any(np.asarray(jax.tree.leaves(found[1])[0]) != 0.0, axis=(1, 2))
    first, second = (np.asarray(given[0].pairs.radii)[side] for side in (given[0].pairs.first, given[0].pairs.second))
    assert np.any(touching & (first > second))
    assert np.any(touching & (first < second))
    assert of == "spheres" or np.any(np.asarray(given[0].pairs.image)[touching] != 0)


@pytest.mark.parametrize("law", EVERY_LAW)
def test_a_replica_of_unequal_spheres_has_the_same_bits_alone(law: str) -> None:
    # One replica is computed contact by contact, five side by side.
    system, state, boxes = thrown(law)
    one = functools.partial(jax.tree.map, lambda leaf: leaf[..., 2:3])
    everyone, alone = moved(native.march, system, state, boxes), moved(native.march, system, one(state), one(boxes))
    for lone, among in zip(jax.tree.leaves(alone), jax.tree.leaves(everyone), strict=True):
        np.testing.assert_array_equal(lone[..., 0], among[..., 2])


@pytest.mark.parametrize("law", slow("frictionless", "M2-exact", "M2-paper"))
def test_tangents_of_unequal_spheres_are_those_of_the_definition(law: str) -> None:
    system, state, boxes = thrown(law)
    state, _ = bin_by(native.march, system, state, nth(boxes, 0))  # histories have begun
    draws = np.random.default_rng(1)
    point = state.grains, nth(boxes, 1), system.clump.mass, system.clump.inertia
    along = jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), point)

    def of(march: native.March, grains: Any, boxes: Box, mass: jax.Array, inertia: jax.Array) -> Any:
        heavy = replace(system, clump=replace(system.clump, mass=mass, inertia=inertia))
        return march(heavy, replace(state, grains=grains), boxes, 0.3, 0.01)

    def slope(march: native.March) -> Any:
        change = jax.jit(lambda along: jax.jvp(functools.partial(of, march), point, along)[1], compiler_options=QUICKLY)
        end, pressure = change(along)
        return end.grains, end.history, pressure

    assert_close(slope(native.march), slope(dynamics.march), 1e-9)


@pytest.mark.parametrize(
    ("law", "of"),
    [*((law, "clumps") for law in EVERY_LAW), ("H", "spheres"), ("H", "periodic"), ("M2-paper", "periodic")],
)
def test_the_adjoint_of_unequal_spheres_is_the_transpose_of_their_tangent(law: str, of: str) -> None:
    system, state, boxes = thrown(law, of, 2)
    state, _ = bin_by(native.march, system, state, nth(boxes, 0))  # histories have begun
    assert_transposed(system, state, nth(boxes, 1))


def test_derivatives_by_sizes_are_those_of_the_definition() -> None:
    system, state, boxes = thrown("H", "clumps", 2)
    few = jax.tree.map(lambda leaf: leaf[:5], nth(boxes, 0))

    def of(march: native.March, sizes: jax.Array) -> jax.Array:
        grown = replace(system, clump=replace(system.clump, sizes=sizes))
        end, pressure = march(grown, state, few, 0.3, 0.0)
        return jnp.sum(pressure) + jnp.sum(end.grains.velocity)

    slopes = (
        jax.jit(jax.grad(functools.partial(of, march)), compiler_options=QUICKLY)(system.clump.sizes)
        for march in (native.march, dynamics.march)
    )
    assert_close(*slopes, 1e-9)


@pytest.mark.parametrize("replicas", [1, REPLICAS])
def test_large_spheres_that_come_from_afar_meet_when_they_should(replicas: int) -> None:
    large = sized(sphere(), [1.6, 2.2])
    system, state, box = scene(
        large, [[0, 0, 0], [6.0, 0.3, 0.2]], None, [[0.05, 0, 0], [-0.05, 0, 0]], replicas=replicas
    )
    boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (400, 3, replicas)), box)
    fast, plain = (bin_by(march, system, state, boxes)[0] for march in (native.march, dynamics.march))
    assert np.abs(plain.grains.spin).max() > 1e-3  # they met
    assert_close(fast.grains, plain.grains, 1e-11)  # as there: test_native_march.py


def test_a_list_is_remembered_with_the_sizes_of_its_grains() -> None:
    system, state, boxes = thrown("H")
    other = replace(system, clump=replace(system.clump, sizes=0.999 * system.clump.sizes))
    first, second, again = (moved(native.march, grains, state, boxes) for grains in (system, other, system))
    np.testing.assert_array_equal(first[0].position, again[0].position)
    assert float(jnp.max(jnp.abs(first[0].position - second[0].position))) > 1e-6


def test_packs_of_unequal_spheres_run_natively_and_in_double_precision() -> None:
    pack = gm.load_pack(SPREAD_27)
    assert gm.Experiment(pack, gm.six_signals(), t0=20.0).runs_on == "native"
    with pytest.raises(ValueError, match="precision='mixed' is not for spheres of unequal radii; use 'double'"):
        gm.Experiment(pack, gm.six_signals(), t0=20.0, precision="mixed")
    lowered = bin_by.lower(native.marcher("auto"), *thrown("H")[:2], nth(thrown("H")[2], 0))
    assert "custom_call @gmem_advance" in lowered.as_text()
