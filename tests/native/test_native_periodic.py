"""Periodic boxes on the native backend, against the definition; their adjoint, against their tangents."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import PERIODIC_27, PERIODIC_XY_27, THREE_LAWS, assert_close
from transposed import assert_transposed

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.state import Box, State, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System

pytestmark = pytest.mark.skipif(not native.available()[0], reason="the library was not built")

STEPS = 40
QUICKLY = {"xla_backend_optimization_level": 0}
Scene = tuple[System, State, Box]


def thrown(law: str, replicas: int, file: Any = PERIODIC_27) -> Scene:
    """27 grains that fly, spin and touch through the faces of a box that shrinks, more along one axis than another."""
    pack = gm.load_pack(file)
    system = System(pack.clump, THREE_LAWS[law], pack.pairs)
    state = start(system, pack.position[..., None], pack.quaternion[..., None], pack.box)
    draws = 5e-3 * np.random.default_rng(0).normal(size=(2, pack.grains, 3, replicas))
    state = replicate(state, replicas)
    grains = replace(state.grains, velocity=jnp.asarray(draws[0]), spin=jnp.asarray(draws[1]))
    inwards = jnp.asarray([2e-3, 1e-3, -5e-4])[:, None] * jnp.linspace(1.0, 0.5, replicas)
    time, every = 0.3 * (1.0 + jnp.arange(STEPS))[:, None, None], jnp.ones((STEPS, 3, replicas))
    lower, upper = pack.lower[:, None] + time * inwards, pack.upper[:, None] - 2.0 * time * inwards
    return (
        system,
        replace(state, grains=grains),
        Box(lower, upper, every * inwards, -2.0 * every * inwards, pack.periodic),
    )


def moved(march: Callable[..., Any], system: System, state: State, boxes: Box) -> Any:
    """All that a march gives, in two bins."""
    first, last = (jax.tree.map(lambda leaf, part=part: leaf[part], boxes) for part in (slice(25), slice(25, None)))
    state, pressure = march(system, state, first, 0.3, 0.01)
    state, more = march(system, state, last, 0.3, 0.01)
    return state.grains, state.history, pressure + more, state.cell


@pytest.mark.parametrize("replicas", [1, 5])
@pytest.mark.parametrize("law", THREE_LAWS)
def test_values_are_those_of_the_definition(law: str, replicas: int) -> None:
    # One replica is computed contact by contact, five side by side. Seen: 6e-13.
    scene = thrown(law, replicas)
    both = [jax.jit(functools.partial(moved, march))(*scene) for march in (native.march, dynamics.march)]
    assert_close(*both, 1e-11)
    image = np.asarray(scene[0].pairs.image)[np.any(np.asarray(jax.tree.leaves(both[0][1])[-1]) != 0.0, axis=(1, 2))]
    assert np.all(np.any(image > 0, axis=0) & np.any(image < 0, axis=0))  # contacts go through every face


@pytest.mark.parametrize("gravity", [None, 1e-3])
def test_values_between_walls_along_one_axis(gravity: float | None) -> None:
    system, *moving = thrown("H", 5, PERIODIC_XY_27)
    scene = replace(system, gravity=gravity), *moving
    assert_close(*(jax.jit(functools.partial(moved, march))(*scene) for march in (native.march, dynamics.march)), 1e-11)


@pytest.mark.parametrize(("law", "axes"), [*((law, "xyz") for law in THREE_LAWS), ("H", "xy")])
def test_the_adjoint_in_a_periodic_box_is_the_transpose_of_the_tangent(law: str, axes: str) -> None:
    system, state, boxes = thrown(law, 2, PERIODIC_27 if axes == "xyz" else PERIODIC_XY_27)
    first, last = (jax.tree.map(lambda leaf, part=part: leaf[part], boxes) for part in (slice(25), slice(25, None)))
    state, _ = jax.jit(native.march)(system, state, first, 0.3, 0.01)  # histories have begun
    bars = assert_transposed(replace(system, gravity=jnp.asarray(1e-4)), state, last)
    periodic = np.tile(np.isin(list("xyz"), list(axes)), 2)
    assert float(np.abs(bars.parameters[-7:-1])[periodic].min()) > 0.0  # by the edges of the box before the steps


@pytest.mark.parametrize("law", ["H", pytest.param("M2", marks=pytest.mark.slow)])
def test_tangents_are_those_of_the_definition(law: str) -> None:
    system, state, boxes = thrown(law, 2)
    draws = np.random.default_rng(1)
    along = jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), (state.grains, boxes, state.cell))

    def of(march: Callable[..., Any], grains: Any, boxes: Box, cell: Box) -> Any:
        grains, _, pressure, _ = moved(march, system, replace(state, grains=grains, cell=cell), boxes)
        return grains.position, grains.velocity, pressure

    point = state.grains, boxes, state.cell
    slopes = []
    for march in (native.march, dynamics.march):
        steps = functools.partial(of, march)
        slopes.append(
            jax.jit(lambda along, steps=steps: jax.jvp(steps, point, along)[1], compiler_options=QUICKLY)(along)
        )
    assert_close(*slopes, 1e-9)


def test_a_replica_has_the_same_bits_with_others_and_whatever_the_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    system, state, boxes = thrown("H", 5)
    run = jax.jit(functools.partial(moved, native.march))
    monkeypatch.setenv("GMEM_THREADS", "1")
    everyone = run(system, state, boxes)
    monkeypatch.setenv("GMEM_THREADS", "2")
    one = functools.partial(jax.tree.map, lambda leaf: leaf[..., 2:3])
    alone = run(system, one(state), one(boxes))
    for found, expected in zip(jax.tree.leaves(alone), jax.tree.leaves(everyone), strict=True):
        np.testing.assert_array_equal(found[..., 0], expected[..., 2])
