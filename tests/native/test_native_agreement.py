"""The native backend gives the numbers of the definition, for every law, alone or in a batch."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27, Motion, advance_by

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.pytree import pytree
from gmem_jax.physics.state import State, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System
from gmem_jax.simulation.sample import Sample

BUILT, REASON = native.available()
# Without a C++ compiler there is no native backend to compare; plain JAX is then all there is.
pytestmark = pytest.mark.skipif(not BUILT, reason=REASON)

PACK = gm.load_pack(TETRA_27)
LAWS = [
    gm.Frictionless(),
    gm.Hooke(mu=0.5),
    gm.MindlinRescaled(mu=0.5, spinning=0.3),
    gm.Mindlin(mu=0.5, points=20, spinning=0.0),
]


def compress(march: native.March, law: object, replicas: int) -> tuple[State, Sample]:
    """1,000 steps of a sheared compression by 5 %: contacts form, slide, roll and break."""
    system = System(PACK.clump, law, PACK.pairs)
    state = start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
    heights = jnp.linspace(-1.0, 1.0, max(1, replicas - 1))[:, None]
    shear = gm.Bumps(heights, jnp.full_like(heights, 0.5), 0.8) if replicas > 1 else None
    motion = Motion(PACK.lower[:, None], PACK.upper[:, None], 0.05, 0.0, 1.0, 300.0, 1e-2, shear)
    return jax.jit(lambda s: advance_by(march)(system, s, motion, 0.3, bins=10, steps=100))(replicate(state, replicas))


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
@pytest.mark.parametrize("replicas", [1, 9])
def test_native_and_plain_jax_agree_to_the_growth_of_round_off(law: object, replicas: int) -> None:
    plain, plain_sample = compress(dynamics.march, law, replicas)
    fast, fast_sample = compress(native.march, law, replicas)
    # Positions are of order 10 and carry 1e-15; contacts amplify differences some 1e4-fold in 1,000 steps at most.
    np.testing.assert_allclose(fast.grains.position, plain.grains.position, atol=1e-10)
    largest = float(jnp.abs(plain_sample.pressure).max())
    np.testing.assert_allclose(fast_sample.pressure, plain_sample.pressure, atol=1e-9 * largest)
    for one, other in zip(jax.tree.leaves(fast.history), jax.tree.leaves(plain.history), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8 * float(jnp.abs(other).max()))
    np.testing.assert_array_equal(fast.status, plain.status)


@pytest.mark.parametrize("gravity", [None, 1e-3])
def test_a_march_is_a_step_for_each_box(gravity: float | None) -> None:
    system = System(PACK.clump, gm.Hooke(), PACK.pairs, gravity=gravity)
    state = start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
    motion = Motion(PACK.lower[:, None], PACK.upper[:, None], 0.05, 0.0, 1.0, 300.0)
    boxes = jax.vmap(motion.box_at)(0.3 * jnp.arange(1.0, 101.0))
    one_step = jax.jit(lambda state, box: dynamics.step(system, state, box, 0.3, 0.0, state.status[0] >= 0))
    stepped, total = state, jnp.zeros((3, 1))
    for number in range(100):
        box = jax.tree.map(lambda leaf, number=number: leaf[number], boxes)
        stepped, walls = one_step(stepped, box)
        total = total + dynamics.wall_pressure(walls, box)
    for march in (dynamics.march, native.march):
        marched, summed = jax.jit(march)(system, state, boxes, 0.3, 0.0)
        np.testing.assert_allclose(marched.grains.position, stepped.grains.position, atol=1e-12)
        np.testing.assert_allclose(summed, total, rtol=1e-9)


@pytest.mark.parametrize("law", [gm.Hooke(), gm.Mindlin()], ids=lambda law: type(law).__name__)
def test_a_replica_is_bitwise_the_same_in_any_place_of_a_batch(law: object) -> None:
    system = System(PACK.clump, law, PACK.pairs)
    state = start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
    heights = jnp.asarray([0.3, -1.0, 1.0, 0.5, 0.1, -0.2, 0.7, 0.9, -0.4, 0.6, 0.2])

    def run(order: list[int]) -> np.ndarray:
        chosen = heights[jnp.asarray(order)][:, None]
        signals = gm.Bumps(chosen, jnp.full_like(chosen, 0.5), 0.8)
        motion = Motion(PACK.lower[:, None], PACK.upper[:, None], 0.05, 0.0, 1.0, 300.0, 1e-2, signals)
        moved = jax.jit(lambda s: advance_by(native.march)(system, s, motion, 0.3, bins=2, steps=100))
        return np.asarray(moved(replicate(state, len(order) + 1))[0].grains.position)

    everyone = run(list(range(11)))
    few = run([7, 2])
    np.testing.assert_array_equal(everyone[..., 8], few[..., 1])
    np.testing.assert_array_equal(everyone[..., 3], few[..., 2])


def test_vmap_makes_lanes() -> None:
    def end(mu: jax.Array) -> jax.Array:
        return compress(native.march, gm.Hooke(mu=mu), 1)[0].grains.position

    together = jax.vmap(end)(jnp.asarray([0.2, 0.7]))
    np.testing.assert_allclose(together[1], end(jnp.asarray(0.7)), atol=1e-10)


def test_unknown_backends_and_laws_are_refused() -> None:
    with pytest.raises(ValueError, match="auto, jax, native"):
        native.marcher("fortran")
    assert native.marcher("jax") is dynamics.march
    assert native.marcher("native") is native.march

    @pytree
    @dataclass(frozen=True)
    class Own(gm.Hooke):
        """A law the library has not seen."""

    with pytest.raises(ValueError, match="does not know the friction law Own"):
        compress(native.march, Own(), 1)


@pytest.mark.parametrize("replicas", [1, 25])
@pytest.mark.parametrize("law", [gm.Hooke(), gm.Mindlin(points=20)], ids=lambda law: type(law).__name__)
def test_any_number_of_threads_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch, law: object, replicas: int) -> None:
    pack = gm.load_pack("tetra-325-a")  # large enough for the threads to share one replica's contacts
    system = System(pack.clump, law, pack.pairs)
    state = replicate(start(system, pack.position[..., None], pack.quaternion[..., None], pack.box), replicas)
    motion = Motion(pack.lower[:, None], pack.upper[:, None], 0.05, 0.0, 1.0, 300.0)
    run = jax.jit(lambda s: advance_by(native.march)(system, s, motion, 0.3, bins=2, steps=30))

    def end(threads: int, megabytes: float) -> list[jax.Array]:
        monkeypatch.setenv("GMEM_THREADS", str(threads))
        monkeypatch.setenv("GMEM_CACHE", str(megabytes))  # decides which threads share a block
        return jax.tree.leaves(jax.block_until_ready(run(state)))

    alone = end(1, 1000)
    for threads, megabytes in ((2, 0.1), (5, 8), (5, 1000)):
        for one, other in zip(end(threads, megabytes), alone, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("instructions", ["baseline", "avx2"])
def test_every_instruction_set_agrees_to_round_off(monkeypatch: pytest.MonkeyPatch, instructions: str) -> None:
    best, _ = compress(native.march, gm.Hooke(mu=0.5), 9)
    monkeypatch.setenv("GMEM_ISA", instructions)
    other, _ = compress(native.march, gm.Hooke(mu=0.5), 9)
    np.testing.assert_allclose(other.grains.position, best.grains.position, atol=1e-10)
