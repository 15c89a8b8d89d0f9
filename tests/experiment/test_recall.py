"""What is made of the samples of a run: gain and fidelity, raw and over a window, and the bits that doubt them."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SPHERE, TETRA_27, scene

import gmem_jax as gm
from gmem_jax.experiment.recall import Recall, finish
from gmem_jax.files.measures import of_each
from gmem_jax.physics.state import Status
from gmem_jax.simulation.sample import MEASURED, Sample, end_bin

PACK = gm.load_pack(TETRA_27)
FINISH = jax.jit(finish)


LOAD = 1e-5  # on every wall, some times as much as what is recalled


@cache
def experiment() -> gm.Experiment:
    """Two signals at 15 periods of ringing to a compression."""
    bumps = gm.Bumps(jnp.asarray([[1.0, -0.5], [0.3, 1.0]]), jnp.asarray([[0.3, 0.7]] * 2), 0.2)
    return gm.Experiment(PACK, bumps, t0=15.0 * float(PACK.ringing_period), dt=0.3)


def finished(speed: object = 0.0, ripple: float = 0.0, status: object = 0, one: gm.Experiment | None = None) -> Recall:
    """The recall of a perfect memory whose gain is 0.3, with a ripple of the ringing period beside it.

    Args:
        speed: largest grain speed when the readout began, over the walls' speed, [3].
        ripple: its amplitude, in that of the recall.
        status: bits of the run, [3].
        one: the experiment, if not that of `experiment`.
    """
    one = one or experiment()
    signal = 0.3 * one.scale * one.integral()
    wave = jnp.sin(2.0 * jnp.pi * 15.0 * (jnp.arange(256) + 0.5) / 256.0)
    rows = jnp.concatenate([jnp.zeros((1, 256)), -signal - ripple * jnp.abs(signal).max() * wave])
    pressure = jnp.full((256, 3, 3), LOAD).at[:, 0].add(jnp.flip(rows, axis=1).T)  # u falls during the readout

    # A wall goes from half the box's length at u = 0 to sqrt(1 - delta0) of that at u = 1, in t0.
    of_walls = 0.5 * float((PACK.upper - PACK.lower)[0]) * (1.0 - np.sqrt(1.0 - float(PACK.delta0))) / one.t0
    speeds = jnp.zeros((4, 3)).at[-1].set(of_walls * jnp.asarray(speed)).at[0].set(1.0)  # only the end counts

    def sample(**given: jax.Array) -> Sample:
        bins = len(next(iter(given.values())))
        loaded = {"pressure": jnp.full((bins, 3, 3), LOAD)}
        return Sample(**{name: jnp.zeros((bins, 3)) for name in MEASURED} | loaded | given)

    stages = {"store": sample(largest_speed=speeds), "readout": sample(pressure=pressure)}
    return FINISH(one, stages, jnp.broadcast_to(jnp.asarray(status, jnp.int32), 3))


def test_a_perfect_memory_has_its_gain_and_a_fidelity_of_one() -> None:
    found = finished()
    np.testing.assert_allclose(found.gain, 0.3, rtol=1e-12)
    np.testing.assert_allclose(found.fidelity, 1.0, atol=1e-7)  # the square root of round-off
    np.testing.assert_array_equal(found.status, 0)


def test_each_replica_may_have_a_shear_of_its_own() -> None:
    one = gm.replace(experiment(), gamma0=jnp.asarray([9e-3, 1e-3, 3e-3]))
    found = finished(one=one)
    np.testing.assert_allclose(found.gain, 0.3, rtol=1e-12)
    np.testing.assert_allclose(found.fidelity, 1.0, atol=1e-7)
    each = of_each(found.described(gm.describe(one)))
    np.testing.assert_allclose(each["signal_gain"], 0.3, rtol=1e-12)


def test_the_window_is_the_ringing_period_in_bins_and_takes_ringing_out() -> None:
    found = finished(ripple=0.5)
    assert float(found.window) == float(PACK.ringing_period)
    assert float(found.fidelity) < 0.6
    fine = 30  # steps to a bin: a period of 256 / 15 bins is 512 of them
    place = (np.arange(256 * fine) + 0.5) / fine
    near = np.abs(place - (np.arange(256)[:, None] + 0.5)) < 0.5 * 256.0 / 15.0
    smooth, target = (
        np.repeat(series, fine, axis=1) @ near.T / near.sum(axis=1)
        for series in (np.asarray(found.p_sig), experiment().scale * np.asarray(found.J))
    )
    gain = np.sum(smooth * target) / np.sum(target**2)
    fidelity = 1.0 - np.sqrt(np.sum((smooth - gain * target) ** 2) / np.sum(smooth**2))
    assert fidelity > 0.9  # what is left is near both ends of u, where the window is cut
    np.testing.assert_allclose(found.windowed_gain, gain, rtol=1e-9)
    np.testing.assert_allclose(found.windowed_fidelity, fidelity, rtol=1e-9)


def test_a_replica_is_not_at_rest_from_one_per_cent_of_the_walls_speed_on() -> None:
    found = finished(speed=[0.0, 0.0099, 0.0101])
    np.testing.assert_allclose(found.residual_speed, [0.0, 0.0099, 0.0101], rtol=1e-12)
    assert [int(bits) for bits in found.status] == [0, 0, Status.NOT_AT_REST]
    np.testing.assert_allclose(found.gain, 0.3, rtol=1e-12)  # only noisy


@pytest.mark.parametrize("bit", [bit for bit in Status if bit.fatal])
def test_a_fatal_bit_of_any_replica_leaves_no_numbers(bit: Status) -> None:
    found = finished(status=[0, 0, int(bit)], speed=[0.5, 0.0, 0.0])
    assert [int(bits) for bits in found.status] == [Status.NOT_AT_REST, 0, bit]
    for value in (found.gain, found.fidelity, found.windowed_gain, found.windowed_fidelity):
        assert np.isnan(float(value))


@pytest.mark.parametrize(("p_max", "flagged"), [(0.1001, False), (0.0999, True)])
def test_an_overlap_beyond_the_range_of_the_law_is_flagged_by_replica(p_max: float, flagged: bool) -> None:
    law = gm.Mindlin(p_max=jnp.asarray([0.2, p_max]), points=8)
    system, state, box = scene(SPHERE, [[0.0, 0.0, 0.0], [1.9, 0.0, 0.0]], friction=law, replicas=2)
    after, sample = jax.jit(end_bin)(system, state, box, jnp.zeros((3, 2)), 0.0)
    np.testing.assert_allclose(sample.largest_overlap, 0.1, rtol=1e-12)
    assert [int(bits) for bits in after.status] == [0, Status.OVERLAP_RANGE if flagged else 0]


def test_laws_without_a_range_are_never_flagged() -> None:
    system, state, box = scene(SPHERE, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    after, _ = jax.jit(end_bin)(system, state, box, jnp.zeros((3, 1)), 0.0)
    assert int(after.status[0]) == 0
