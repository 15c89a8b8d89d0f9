"""The library's `march` where a small pack at rest shows nothing: several domains, and grains that come from afar.

The candidates of a large pack are shared out to domains, and what a contact does to a grain of another domain waits in
a place of its own (native plan.h); a pack of 27 grains is one domain. And candidates are not looked at before the
fastest grain could have brought them together.
"""

import functools
import re
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import THREE_LAWS, assert_close, random_like, scene
from transposed import assert_transposed

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.pairs import listed_candidates, sphere_centres
from gmem_jax.physics.state import Box, State, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System

BUILT, REASON = native.available()
# Without a C++ compiler there is no native backend to compare; plain JAX is then all there is.
pytestmark = pytest.mark.skipif(not BUILT, reason=REASON)

PACK = gm.load_pack("tetra-325-a")
LAWS: dict[str, Any] = {
    **THREE_LAWS,
    "narrow rings": gm.Mindlin(mu=0.3, points=60, p_max=0.02),  # some reached in one step, and overlaps beyond them
}
DT = 0.3
STEPS = 40
REPLICAS = 9  # a whole vector of the CPU and one more, whatever its width
every_law = pytest.mark.parametrize(
    "law", [pytest.param(law, marks=[pytest.mark.slow] * (law == "narrow rings")) for law in LAWS]
)


def walls(begun: int, count: int) -> Box:
    """The next `count` walls of a sheared squeeze, by up to 0.4 % in 40 steps, each replica at its own rate."""
    inwards = jnp.asarray([2e-3, 1e-3, 0.0])[:, None] * jnp.linspace(0.5, 1.0, REPLICAS)
    time = DT * (begun + 1.0 + jnp.arange(count))[:, None, None]
    every = jnp.ones((count, 3, REPLICAS))
    lower, upper = PACK.lower[:, None] + time * inwards, PACK.upper[:, None] - time * inwards
    return Box(lower, upper, every * inwards, -every * inwards)


def thrown(law: str) -> tuple[System, State]:
    """The pack with every grain on its own way, spinning: contacts stick, slide, open and close in every domain."""
    system = System(PACK.clump, LAWS[law], PACK.pairs)
    state = start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
    state = replicate(state, REPLICAS)
    draws = np.random.default_rng(0).normal(size=(2, PACK.grains, 3, REPLICAS))
    grains = replace(state.grains, velocity=jnp.asarray(5e-3 * draws[0]), spin=jnp.asarray(5e-3 * draws[1]))
    return system, replace(state, grains=grains)


def first(tree: Any, replicas: int) -> Any:
    """The first replicas of every array."""
    return jax.tree.map(lambda leaf: leaf[..., :replicas], tree)


@functools.cache
def as_defined(law: str) -> tuple[State, jax.Array]:
    """40 steps in plain JAX."""
    system, state = thrown(law)
    return jax.jit(dynamics.march)(system, state, walls(0, STEPS), DT, 0.0)


def test_the_pack_is_shared_out_to_several_domains_and_its_grains_spin_and_touch() -> None:
    # The library makes 2^round(log2(candidates / 330) / 2) of them: four from 2,640 candidates on.
    assert listed_candidates(PACK.pairs).shape[1] > 2_640
    state, _ = as_defined("H")
    one, other = listed_candidates(PACK.pairs)
    spheres = np.asarray(jax.jit(sphere_centres)(state.grains, PACK.clump))
    touching = np.linalg.norm(spheres[other] - spheres[one], axis=1) < 2.0
    assert np.all(2.0 * touching.sum(axis=0) / PACK.grains > 10.0)
    assert np.all(np.abs(np.asarray(state.grains.spin)).max(axis=(0, 1)) > 5e-3)


@every_law
@pytest.mark.parametrize("replicas", [1, REPLICAS])  # lanes of the CPU that are grains and contacts; and replicas
def test_spinning_sliding_grains_of_several_domains_move_as_defined(law: str, replicas: int) -> None:
    system, state = thrown(law)
    boxes = walls(0, STEPS)
    fast, pressure = jax.jit(native.march)(system, first(state, replicas), first(boxes, replicas), DT, 0.0)
    plain, expected = first(as_defined(law), replicas)
    # Sums in another order: 1e-16 of forces, which 40 steps of contacts magnify at most a thousandfold (seen: 1e-12).
    assert_close(fast.grains, plain.grains, 1e-11)
    assert_close(fast.history, plain.history, 1e-11)
    assert_close(pressure, expected, 1e-11)


def test_calls_after_calls_move_grains_in_their_own_memory_and_leave_what_they_were_given() -> None:
    system, state = thrown("H")

    def three(state: State) -> State:
        box = walls(0, 2)
        moved: State = jax.lax.fori_loop(0, 3, lambda _, now: native.march(system, now, box, DT, 0.0)[0], state)
        return moved

    compiled = jax.jit(three).lower(state).compile()
    # One copy of each of the six fields, before the first call: the caller may need what was given again.
    assert len(re.findall(rf"f64\[{PACK.grains},[34],{REPLICAS}\]\S* copy\(", compiled.as_text() or "")) == 6
    given = [np.array(leaf) for leaf in jax.tree.leaves(state)]
    ends = [jax.tree.leaves(compiled(state)) for _ in range(2)]
    for once, again in zip(*ends, strict=True):
        np.testing.assert_array_equal(once, again)
    for before, now in zip(given, jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(before, now)


def end(march: Any, system: System, state: State, theta: dict[str, Any]) -> Any:
    """Everything that a few more steps give, as a function of everything they depend on."""
    law = replace(system.friction, **theta["law"])
    clump = replace(system.clump, mass=theta["mass"], inertia=theta["inertia"])
    state = replace(state, grains=theta["grains"], history=theta["history"])
    system = replace(system, friction=law, clump=clump)
    after, pressure = march(system, state, theta["boxes"], theta["dt"], theta["drag"])
    return after.grains, after.history, pressure


# One history of each kind, and new runs of several rings; what crosses is the same for all.
@pytest.mark.parametrize("law", ["H", *(pytest.param(law, marks=pytest.mark.slow) for law in ("M2", "narrow rings"))])
def test_derivatives_cross_the_domains_as_defined(law: str) -> None:
    system, _ = thrown(law)
    state = first(as_defined(law)[0], 2)
    theta = {
        "grains": state.grains,
        "history": state.history,
        "law": {name: jnp.asarray(getattr(system.friction, name)) for name in ("mu", "stiffness", "damping_time")},
        "mass": system.clump.mass,
        "inertia": system.clump.inertia,
        "boxes": first(walls(STEPS, 10), 2),
        "dt": jnp.asarray(DT),
        "drag": jnp.asarray(0.01),
    }

    def forwards(march: Any, direction: Any) -> Any:
        of = functools.partial(end, march, system, state)
        return jax.jit(lambda direction: jax.jvp(of, (theta,), (direction,))[1])(direction)

    direction = random_like(theta, 0)
    # Without derivatives by what is zero and stays so: histories of contacts apart, Mindlin's unreached layers.
    direction["history"] = jax.tree.map(
        lambda slope, leaf: jnp.where(leaf != 0.0, slope, 0.0), direction["history"], state.history
    )
    # Exact derivatives of one program over 10 steps: round-off, magnified where the normal part of a carried force
    # nearly cancels (see test_native_derivatives.py).
    assert_close(forwards(native.march, direction), forwards(dynamics.march, direction), 1e-9)
    assert_transposed(system, state, theta["boxes"], DT)


MEETINGS = {  # of two upright rods: distance, velocity of the first along x (the second's is opposite), spin of both
    "flying": (5.0, 0.05, 0.0),
    "turning": (3.2, 0.0, 0.05),
    "both": (5.0, 0.02, 0.03),
}


@pytest.mark.parametrize("replicas", [1, 5])
@pytest.mark.parametrize("meeting", MEETINGS)
def test_grains_that_come_from_afar_meet_when_they_should(meeting: str, replicas: int) -> None:
    apart, speed, spin = MEETINGS[meeting]
    rod = gm.clump([[-1.5, 0.0, 0.0], [0.0, 0.0, 0.0], [1.5, 0.0, 0.0]])
    upright = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]
    motion = [[speed, 0, 0], [-speed, 0, 0]], [[0, 0, spin], [0, 0, spin]]
    system, state, box = scene(rod, [[0, 0, 0], [apart, 0.3, 0.2]], [upright, upright], *motion, replicas=replicas)
    count = 400
    boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, 3, replicas)), box)
    fast, plain = (jax.jit(march)(system, state, boxes, 0.1, 0.0)[0] for march in (native.march, dynamics.march))
    assert np.abs(plain.grains.velocity - state.grains.velocity).max() > 1e-3  # they met
    assert_close(fast.grains, plain.grains, 1e-11)  # a few contacts magnify round-off little
