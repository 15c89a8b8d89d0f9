"""Spheres of unequal radii on the native backend, against the definition; their adjoint is that of plain JAX."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import PERIODIC_27, SPREAD_27, TETRA_27, assert_close, make_grains

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.grain import Clump, clump, sized, sphere
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Box, State, replicate, still_box
from gmem_jax.physics.step import System, start

pytestmark = pytest.mark.skipif(not native.available()[0], reason="the library was not built")

LAWS: dict[str, Any] = {
    "frictionless": gm.Frictionless(),
    "H": gm.Hooke(mu=0.3),
    "M1": gm.MindlinRescaled(mu=0.3),
    **{f"M2-{variant}": gm.Mindlin(mu=0.3, points=8, variant=variant) for variant in ("exact", "averaged", "paper")},
}
STEPS, REPLICAS = 40, 5
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
    """Grains that fly, spin, touch and slide in a box that shrinks, more along one axis than another."""
    grain, position, quaternion, box = SCENES[of]()
    grains = make_grains(position, quaternion)
    pairs = PairFinder(grain, np.asarray(box.lengths)[:, 0], 0.5)(grains, grain, box)
    system = System(grain, LAWS[law], pairs)
    state = replicate(start(system, grains.position, grains.quaternion, box), replicas)
    draws = 5e-3 * np.random.default_rng(0).normal(size=(2, len(position), 3, replicas))
    moving = replace(state.grains, velocity=jnp.asarray(draws[0]), spin=jnp.asarray(draws[1]))
    inwards = jnp.asarray([2e-3, 1e-3, -5e-4])[:, None] * jnp.linspace(1.0, 0.5, replicas)
    time, every = 0.3 * (1.0 + jnp.arange(STEPS))[:, None, None], jnp.ones((STEPS, 3, replicas))
    lower, upper = box.lower + time * inwards, box.upper - 2.0 * time * inwards
    return (
        system,
        replace(state, grains=moving),
        Box(lower, upper, every * inwards, -2.0 * every * inwards, box.periodic),
    )


def moved(march: Callable[..., Any], system: System, state: State, boxes: Box) -> Any:
    """All that a march gives, in two bins."""
    first, last = (jax.tree.map(lambda leaf, part=part: leaf[part], boxes) for part in (slice(25), slice(25, None)))
    state, pressure = march(system, state, first, 0.3, 0.01)
    state, more = march(system, state, last, 0.3, 0.01)
    return state.grains, state.history, pressure + more, state.cell


def both(law: str, of: str) -> tuple[Any, Any]:
    """What the library and the definition give of a scene."""
    scene = thrown(law, of)
    marches = functools.partial(moved, native.march), functools.partial(moved, dynamics.march)
    found, expected = (jax.jit(march, compiler_options=QUICKLY)(*scene) for march in marches)
    return found, expected


@pytest.mark.parametrize(
    ("law", "of"),
    [*((law, "clumps") for law in LAWS), ("H", "spheres"), ("M1", "periodic"), ("M2-averaged", "periodic")],
)
def test_values_are_those_of_the_definition_and_a_replica_has_the_same_bits_alone(law: str, of: str) -> None:
    found, expected = both(law, of)
    assert_close(found, expected, 1e-12)
    # One replica is computed contact by contact, five side by side.
    one = functools.partial(jax.tree.map, lambda leaf: leaf[..., 2:3])
    system, state, boxes = thrown(law, of)
    alone = jax.jit(functools.partial(moved, native.march))(system, one(state), one(boxes))
    for lone, among in zip(jax.tree.leaves(alone), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(lone[..., 0], among[..., 2])


@pytest.mark.parametrize("law", LAWS)
def test_tangents_are_those_of_the_definition(law: str) -> None:
    system, state, boxes = thrown(law, "clumps", 2)
    draws = np.random.default_rng(1)
    along = jax.tree.map(
        lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), (state.grains, boxes, system.clump.mass)
    )

    def of(march: Callable[..., Any], grains: Any, boxes: Box, mass: jax.Array) -> Any:
        heavy = replace(system, clump=replace(system.clump, mass=mass))
        grains, _, pressure, _ = moved(march, heavy, replace(state, grains=grains), boxes)
        return grains.position, grains.velocity, pressure

    point, slopes = (state.grains, boxes, system.clump.mass), []
    for march in (native.march, dynamics.march):
        steps = functools.partial(of, march)
        slope = jax.jit(lambda along, steps=steps: jax.jvp(steps, point, along)[1], compiler_options=QUICKLY)
        slopes.append(slope(along))
    assert_close(*slopes, 1e-9)


def test_adjoints_and_derivatives_by_sizes_are_those_of_the_definition() -> None:
    system, state, boxes = thrown("H", "clumps", 2)
    few = jax.tree.map(lambda leaf: leaf[:5], boxes)

    def of(march: Callable[..., Any], sizes: jax.Array, position: jax.Array) -> jax.Array:
        grown = replace(system, clump=replace(system.clump, sizes=sizes))
        moving = replace(state, grains=replace(state.grains, position=position))
        end, pressure = march(grown, moving, few, 0.3, 0.0)
        return jnp.sum(pressure) + jnp.sum(end.grains.velocity)

    point = system.clump.sizes, state.grains.position
    found, expected = (
        jax.jit(jax.grad(functools.partial(of, march), argnums=argnums), compiler_options=QUICKLY)(*point)
        for march in (native.march, dynamics.march)
        for argnums in ((0, 1),)
    )
    assert_close(found, expected, 1e-9)
    by_position = jax.jit(jax.grad(functools.partial(of, native.march), argnums=1), compiler_options=QUICKLY)(*point)
    assert_close(by_position, expected[1], 1e-9)  # by an adjoint call, which is the definition's


def test_packs_of_unequal_spheres_run_natively_and_in_double_precision() -> None:
    pack = gm.load_pack(SPREAD_27)
    assert gm.Experiment(pack, gm.six_signals(), t0=20.0).runs_on == "native"
    with pytest.raises(ValueError, match="precision='mixed' is not for spheres of unequal radii; use 'double'"):
        gm.Experiment(pack, gm.six_signals(), t0=20.0, precision="mixed")
    system, state, boxes = thrown("H")
    auto = jax.jit(functools.partial(moved, native.marcher("auto")))
    assert "custom_call @gmem_advance" in auto.lower(system, state, boxes).as_text()
