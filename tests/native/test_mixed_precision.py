"""Contacts in single precision, all else in double: close to double precision, the same bits in any company."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SPHERE, TETRA_27, Motion, advance_by, scene

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.experiment.record import key_of_run, to_dict
from gmem_jax.files.configuration import from_dict, named_experiment
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.state import State, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System

BUILT, REASON = native.available()
pytestmark = pytest.mark.skipif(not BUILT, reason=REASON)

PACK = gm.load_pack(TETRA_27)
LAWS = [gm.Frictionless(), gm.Hooke(mu=0.5), gm.MindlinRescaled(mu=0.5)]
REPLICAS = 21  # a wide block and a narrow one, whatever the CPU's vectors
every_law = pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)


def compress(law: FrictionLaw, replicas: int, precision: str, first: int = 0) -> tuple[State, jax.Array]:
    """300 steps of a sheared compression by 5 %, each of 21 replicas with a waveform of its own; some of them."""
    system = System(PACK.clump, law, PACK.pairs)
    state = start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
    heights = jnp.linspace(-1.0, 1.0, REPLICAS)[first : first + replicas]
    heights = (heights[1:] if replicas > 1 else heights)[:, None]
    shear = gm.Bumps(heights, jnp.full_like(heights, 0.5), 0.8) if replicas > 1 else None
    motion = Motion(PACK.lower[:, None], PACK.upper[:, None], 0.05, 0.0, 1.0, 90.0, 1e-2, shear)
    march = native.marcher("native", precision)
    run = jax.jit(lambda s: advance_by(march)(system, s, motion, 0.3, bins=3, steps=100))
    state, sample = run(replicate(state, replicas))
    return state, sample.pressure


@every_law
def test_mixed_precision_is_close_to_double_and_not_the_same(law: FrictionLaw) -> None:
    (mixed, pressure), (double, expected) = (compress(law, REPLICAS, name) for name in ("mixed", "double"))
    # Forces are rounded to 6e-8 of themselves 300 times and more; contacts amplify that some hundredfold.
    np.testing.assert_allclose(mixed.grains.position, double.grains.position, atol=1e-5)
    np.testing.assert_allclose(pressure, expected, atol=2e-5 * float(jnp.abs(expected).max()))
    assert not np.array_equal(mixed.grains.position, double.grains.position)
    for leaf in jax.tree.leaves(mixed.history):
        np.testing.assert_array_equal(np.asarray(leaf, np.float32), leaf)  # what is remembered is in single precision
        assert np.any(leaf)
    np.testing.assert_array_equal(mixed.status, double.status)


@every_law
def test_bits_depend_neither_on_company_nor_on_threads(law: FrictionLaw, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GMEM_THREADS", "3")
    many, _ = compress(law, REPLICAS, "mixed")
    monkeypatch.setenv("GMEM_THREADS", "1")
    few, _ = compress(law, 5, "mixed")
    for one, other in zip(jax.tree.leaves(few), jax.tree.leaves(many), strict=True):
        np.testing.assert_array_equal(one[..., 1:], other[..., 1:5])


def test_a_lone_replica_is_in_double_precision() -> None:
    (mixed, _), (double, _) = (compress(gm.Hooke(), 1, name) for name in ("mixed", "double"))
    jax.tree.map(np.testing.assert_array_equal, mixed, double)


@pytest.mark.parametrize("instructions", ["baseline", "avx2"])
def test_every_instruction_set_agrees_to_round_off(monkeypatch: pytest.MonkeyPatch, instructions: str) -> None:
    best, _ = compress(gm.Hooke(mu=0.5), 9, "mixed")
    monkeypatch.setenv("GMEM_ISA", instructions)
    other, _ = compress(gm.Hooke(mu=0.5), 9, "mixed")
    tolerance = 0.0 if instructions == native.available()[1] or instructions == "avx2" else 1e-5
    np.testing.assert_allclose(other.grains.position, best.grains.position, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("overlap", [1e-3, 1e-6])
def test_gaps_are_differences_in_double_precision(overlap: float) -> None:
    """Far from the origin, where single precision knows positions to 4e-6 R."""
    at = np.array([41.3, 47.1, 52.7])
    across = np.array([2.0, 1.0, -2.0]) / 3.0
    places = [at.tolist(), (at + (2.0 - overlap) * across).tolist()]
    still = [[0.0, 0.0, 0.0]] * 2
    system, state, box = scene(SPHERE, places, [[1.0, 0.0, 0.0, 0.0]] * 2, still, still, replicas=2)
    boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (1, 3, 2)), box)
    mixed, double = (
        jax.jit(native.marcher("native", name))(system, state, boxes, 1e-3, 0.0)[0].grains.acceleration
        for name in ("mixed", "double")
    )
    assert float(jnp.abs(double).max()) > 0.0
    np.testing.assert_allclose(mixed, double, rtol=1e-5, atol=1e-6 * float(jnp.abs(double).max()))


def test_what_cannot_be_had_in_mixed_precision_is_refused_in_a_line() -> None:
    signals = gm.six_signals()
    with pytest.raises(ValueError, match=r"precision must be one of double, mixed; got 'half'"):
        gm.Experiment(PACK, signals, precision="half")
    with pytest.raises(ValueError, match=r"precision='mixed' is a mode of the native backend; here plain JAX"):
        gm.Experiment(PACK, signals, backend="jax", precision="mixed")
    with pytest.raises(ValueError, match="precision='mixed' is not for the Mindlin law"):
        gm.Experiment(PACK, signals, gm.Mindlin(), precision="mixed")
    experiment = gm.Experiment(PACK, signals, precision="mixed")
    with pytest.raises(NotImplementedError, match=r"no derivatives in mixed precision; use precision='double'"):
        jax.grad(lambda gamma0: gm.fidelity(gm.replace(experiment, gamma0=gamma0)))(1e-3)


def test_results_say_their_precision_and_are_kept_apart() -> None:
    double = named_experiment(PACK, {})
    mixed = named_experiment(PACK, {"precision": "mixed"})
    assert (double.precision, mixed.precision) == ("double", "mixed")
    assert key_of_run(mixed) != key_of_run(double)
    assert from_dict(to_dict(mixed), PACK).precision == "mixed"


def test_a_recall_in_mixed_precision_is_that_in_double() -> None:
    experiment = gm.Experiment(PACK, gm.six_signals(), steps=2, t0=150.0)
    double, mixed = (gm.run(replace(experiment, precision=name)) for name in ("double", "mixed"))
    largest = float(jnp.abs(double.p_sig).max())
    # The background is subtracted from pressures a hundred times as large as the signal.
    np.testing.assert_allclose(mixed.p_sig, double.p_sig, rtol=0.0, atol=1e-2 * largest)
    assert not np.array_equal(mixed.p_sig, double.p_sig)
