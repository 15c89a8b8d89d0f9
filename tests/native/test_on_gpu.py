"""What only a CUDA GPU can show: that the kernels, launched by XLA, give what the CPU's library gives."""

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import EVERY_LAW, assert_close
from test_gpu import PACK

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.native import march
from gmem_jax.physics.state import Box, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System

try:
    GPU = jax.devices("cuda")[0]
except RuntimeError:
    GPU = None
pytestmark = [
    pytest.mark.skipif(GPU is None or not native.available()[0], reason="JAX sees no CUDA GPU here"),
]
STEPS = 40
Scene = tuple[System, Any, Box]


def thrown(law: str, replicas: int, isotropic: bool = True, wall_mu: float | None = None) -> Scene:
    """A pack in a box that closes, each grain with a velocity and a spin of its own in every replica."""
    clump = replace(PACK.clump, isotropic=isotropic)
    if not isotropic:
        clump = replace(clump, inertia=clump.inertia * jnp.asarray([0.8, 1.0, 1.3]))
    system = System(clump, EVERY_LAW[law], PACK.pairs, wall_mu=wall_mu)
    state = start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
    draws = 5e-3 * np.random.default_rng(0).normal(size=(2, PACK.grains, 3, 1)) * np.linspace(1.0, 0.5, replicas)
    state = replicate(state, replicas)
    grains = replace(state.grains, velocity=jnp.asarray(draws[0]), spin=jnp.asarray(draws[1]))
    inwards = jnp.asarray([2e-3, 1e-3, 0.0])[:, None] * jnp.linspace(1.0, 0.5, replicas)
    time, every = 0.3 * (1.0 + jnp.arange(STEPS))[:, None, None], jnp.ones((STEPS, 3, replicas))
    lower, upper = PACK.lower[:, None] + time * inwards, PACK.upper[:, None] - time * inwards
    return system, replace(state, grains=grains), Box(lower, upper, every * inwards, -every * inwards)


@jax.jit
def moved(system: System, state: Any, boxes: Box) -> Any:
    """Grains, history and pressures after all steps."""
    found, pressure = march(system, state, boxes, 0.3, 0.01)
    return found.grains, found.history, found.wall_history, pressure


@jax.jit
def slopes(system: System, state: Any, boxes: Box, along: jax.Array) -> Any:
    """The derivative of `moved` by the walls."""
    return jax.jvp(lambda upper: moved(system, state, replace(boxes, upper=upper)), (boxes.upper,), (along,))[1]


@jax.jit
def gradient(system: System, state: Any, boxes: Box, weights: Any) -> Any:
    """The derivative of a weighted sum of `moved` by where walls and grains are, and by the grains' velocities."""

    def total(upper: jax.Array, lower: jax.Array, position: jax.Array, velocity: jax.Array) -> jax.Array:
        grains = replace(state.grains, position=position, velocity=velocity)
        found = moved(system, replace(state, grains=grains), replace(boxes, upper=upper, lower=lower))
        products = jax.tree.map(lambda weight, leaf: jnp.sum(weight * leaf), weights, found)
        return jax.tree.reduce(jnp.add, products)

    by = boxes.upper, boxes.lower, state.grains.position, state.grains.velocity
    return jax.grad(total, argnums=(0, 1, 2, 3))(*by)


def weighted(law: str, replicas: int, isotropic: bool = True) -> tuple[Any, ...]:
    """`thrown`, and random weights of all that it gives."""
    parts = thrown(law, replicas, isotropic)
    draws = np.random.default_rng(2)
    shapes = jax.eval_shape(moved, *parts)
    return (*parts, jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), shapes))


def on_both(function: Any, make: Any) -> tuple[Any, Any]:
    """What a function of arguments that are made on the CPU gives on the GPU, and on the CPU."""
    with jax.default_device(jax.devices("cpu")[0]):
        arguments = make()
        expected = function(*arguments)
    return function(*jax.device_put(arguments, GPU)), expected


@pytest.mark.parametrize("law", EVERY_LAW)
def test_values_and_tangents_are_those_of_the_cpu(law: str) -> None:
    # Sums are taken in another order. Seen: 1e-13, and 1e-11 for M2-paper; tangents 5e-11, and 2e-10.
    assert_close(*on_both(moved, lambda: thrown(law, 5)), 1e-10)
    along = jnp.asarray(np.random.default_rng(1).normal(size=(STEPS, 3, 5)))
    assert_close(*on_both(slopes, lambda: (*thrown(law, 5), along)), 1e-9)


@pytest.mark.parametrize(("law", "isotropic"), [("frictionless", True), ("H", True), ("M1", True), ("H", False)])
def test_gradients_are_those_of_the_cpu(law: str, isotropic: bool) -> None:
    with jax.default_device(GPU):
        assert "@gmem_adjoint" in gradient.lower(*weighted(law, 2, isotropic)).as_text()  # not plain JAX
    assert_close(*on_both(gradient, lambda: weighted(law, 5, isotropic)), 1e-9)


def test_the_gradient_of_a_replica_has_the_same_bits_alone_and_among_many() -> None:
    system, state, boxes, weights = weighted("M1", 512)
    many = gradient(system, state, boxes, weights)
    first = functools.partial(jax.tree.map, lambda leaf: leaf[..., :1])
    alone = gradient(system, *map(first, (state, boxes, weights)))
    for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(one[..., 0], other[..., 0])


def test_grains_with_unequal_moments_of_inertia() -> None:
    assert_close(*on_both(moved, lambda: thrown("H", 3, isotropic=False)), 1e-10)


@pytest.mark.parametrize("law", ["H", "M1", "M2-averaged"])
def test_between_walls_with_friction(law: str) -> None:
    assert_close(*on_both(moved, lambda: thrown(law, 5, wall_mu=0.2)), 1e-10)
    along = jnp.asarray(np.random.default_rng(1).normal(size=(STEPS, 3, 5)))
    assert_close(*on_both(slopes, lambda: (*thrown(law, 5, wall_mu=0.2), along)), 1e-9)


@pytest.mark.parametrize("law", ["H", "M2-averaged"])
def test_a_replica_has_the_same_bits_alone_and_among_many(law: str) -> None:
    # Alone, several threads share the contacts of a grain; of 512 replicas (166,400 grains) each has one.
    many = moved(*thrown(law, 512))
    system, state, boxes = thrown(law, 512)
    first = functools.partial(jax.tree.map, lambda leaf: leaf[..., :1])
    alone = moved(system, first(state), first(boxes))
    for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(one[..., 0], other[..., 0])


def test_a_list_that_leads_nowhere_gives_no_numbers() -> None:
    system, state, boxes = thrown("H", 3)
    for field, place, wrong in (("incidence", (5, 0), 10**8), ("second", (3,), 10**6), ("incidence", (5, 0), -7)):
        pairs = replace(PACK.pairs, **{field: getattr(PACK.pairs, field).at[place].set(wrong)})
        grains, *_ = moved(replace(system, pairs=pairs), state, boxes)
        assert np.all(np.isnan(np.asarray(grains.position)))


def test_a_whole_recall_is_that_of_the_cpu() -> None:
    recalls = []
    for device in (GPU, jax.devices("cpu")[0]):
        with jax.default_device(device):
            recalls.append(gm.run(gm.Experiment(PACK, gm.six_signals(), gm.Hooke(), t0=60.0)))
    found, expected = recalls
    assert_close(found.p_sig, expected.p_sig, 1e-7)  # round-off grows with every contact that opens or slides
