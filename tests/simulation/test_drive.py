"""Prescribed walls: lengths, velocities and centring of the box, and the stages of the experiment."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27, Motion

import gmem_jax as gm
from gmem_jax.experiment.protocols import memory_protocol
from gmem_jax.experiment.signals import Bumps, six_signals
from gmem_jax.experiment.stages import cycle
from gmem_jax.simulation.stage import Stage, table

LOWER = jnp.asarray([[1.0], [-2.0], [0.5]])
UPPER = jnp.asarray([[9.0], [8.0], [12.5]])
LENGTHS = np.asarray(UPPER - LOWER)
SIGNALS = six_signals()
PACK = TETRA_27


def ramp(**changes) -> Motion:
    """A compression with shear, unless changed."""
    options = {"delta0": 0.05, "start": 0.0, "stop": 1.0, "duration": 40.0, "gamma0": 0.02, "signals": SIGNALS}
    return Motion(LOWER, UPPER, **{**options, **changes})


def at(motion: Motion, time: float):
    return motion.box_at(jnp.asarray(time))


def test_the_box_at_u_zero_is_the_box_given():
    box = at(ramp(), 0.0)
    np.testing.assert_allclose(box.lengths, np.broadcast_to(LENGTHS, (3, 7)), rtol=1e-15)


@pytest.mark.parametrize("delta0", [0.01, 0.05, 0.3])
def test_full_compression_takes_delta0_of_the_area_and_nothing_of_the_height(delta0):
    lengths = np.asarray(at(ramp(delta0=delta0, signals=None), 40.0).lengths)
    assert np.prod(lengths[:2]) / np.prod(LENGTHS[:2]) == pytest.approx(1.0 - delta0, rel=1e-14)
    np.testing.assert_allclose(lengths[:2] / LENGTHS[:2], np.sqrt(1.0 - delta0), rtol=1e-14)  # both axes alike
    assert lengths[2] == LENGTHS[2]


def test_u_runs_linearly_between_start_and_stop():
    motion = ramp(start=0.8, stop=0.2, signals=None, delta0=0.75)  # half the length at u = 1
    ratios = [at(motion, t).lengths[0, 0] / LENGTHS[0, 0] for t in (0.0, 10.0, 40.0)]
    np.testing.assert_allclose(ratios, 1.0 - 0.5 * np.array([0.8, 0.65, 0.2]), rtol=1e-15)


def test_half_of_gamma_goes_to_each_axis_with_opposite_signs():
    u = 0.25
    gamma = 0.02 * np.asarray(SIGNALS.shear(jnp.asarray(u)))
    sheared, plain = at(ramp(), u * 40.0), at(ramp(signals=None), u * 40.0)
    ratio = np.asarray(sheared.lengths / plain.lengths)
    np.testing.assert_allclose(ratio[0, 1:], 1.0 - 0.5 * gamma, rtol=1e-15)
    np.testing.assert_allclose(ratio[1, 1:], 1.0 + 0.5 * gamma, rtol=1e-15)
    assert np.all(ratio[2] == 1.0)
    assert abs(gamma[0]) > 0.01  # not a test of nothing: the first bump is on


def test_the_first_replica_is_never_sheared():
    for time in (5.0, 12.0, 28.0):
        np.testing.assert_array_equal(at(ramp(), time).lengths[:, 0], at(ramp(signals=None), time).lengths[:, 0])


def test_without_the_waveform_all_replicas_have_the_box_of_the_first():
    for time in (5.0, 12.0, 28.0):
        box, first = at(ramp(sheared=False), time), at(ramp(signals=None), time)
        for plane in ("lower", "upper", "lower_velocity", "upper_velocity"):
            np.testing.assert_array_equal(getattr(box, plane), np.broadcast_to(getattr(first, plane), (3, 7)))


def test_every_replica_can_have_its_own_amplitude_and_compression():
    one = Bumps(jnp.ones((2, 1)), jnp.full((2, 1), 0.3), 0.2)
    motion = ramp(
        signals=one, gamma0=jnp.asarray([5.0, 1e-3, 2e-3]), delta0=jnp.asarray([0.05, 0.05, 0.1]), duration=1.0
    )
    lengths = np.asarray(at(motion, 0.3).lengths)
    assert lengths.shape == (3, 3)
    shear = (lengths[1] / LENGTHS[1] - lengths[0] / LENGTHS[0]) / (lengths[1] / LENGTHS[1] + lengths[0] / LENGTHS[0])
    np.testing.assert_allclose(shear, [0.0, 0.5e-3, 1e-3], atol=1e-15)
    mean = 0.5 * (lengths[1] / LENGTHS[1] + lengths[0] / LENGTHS[0])
    np.testing.assert_allclose(mean, 1.0 - (1.0 - np.sqrt([0.95, 0.95, 0.9])) * 0.3, rtol=1e-14)


@pytest.mark.parametrize("time", [3.0, 9.5, 13.0, 27.0, 39.0])
def test_wall_velocities_are_the_slopes_of_the_wall_positions(time):
    h = 1e-4
    now, before, after = (at(ramp(), time + shift) for shift in (0.0, -h, h))
    # Second-order differences: h^2 / 6 times the third derivative of I, (pi / (du t))^3 gamma0 L = 1e-2, and round-off.
    for plane in ("lower", "upper"):
        difference = (getattr(after, plane) - getattr(before, plane)) / (2.0 * h)
        np.testing.assert_allclose(getattr(now, f"{plane}_velocity"), difference, atol=1e-10)
    assert np.abs(now.upper_velocity[0]).min() > 1e-4


def test_the_box_stays_centred_and_its_ends_do_not_move_in_z():
    for time in (0.0, 12.0, 33.0):
        box = at(ramp(), time)
        centre = np.broadcast_to(0.5 * (LOWER + UPPER), (3, 7))
        np.testing.assert_allclose(0.5 * (box.lower + box.upper), centre, rtol=1e-15)
        np.testing.assert_array_equal(box.lower_velocity, -box.upper_velocity)
        np.testing.assert_array_equal(box.lower[2], np.full(7, 0.5))
        np.testing.assert_array_equal(box.upper_velocity[2], np.zeros(7))


def test_decompression_retraces_compression():
    there, back = at(ramp(), 13.0), at(ramp(start=1.0, stop=0.0), 27.0)
    np.testing.assert_allclose(there.lengths, back.lengths, rtol=1e-15)
    np.testing.assert_allclose(there.upper_velocity, -back.upper_velocity, rtol=1e-12, atol=1e-15)


def test_walls_stand_still_when_u_does():
    box = at(ramp(start=1.0, stop=1.0, sheared=False), 7.0)
    assert np.all(np.asarray(box.upper_velocity) == 0.0)
    np.testing.assert_allclose(box.lengths[0] / LENGTHS[0], np.sqrt(0.95), rtol=1e-14)


def test_where_u_stands_still_the_waveform_runs_in_time():
    pulse = ramp(start=0.0, stop=0.0)
    for time in (0.0, 12.0, 28.0, 40.0):
        box = at(pulse, time)
        expected = 0.5 * 0.02 * np.concatenate([[0.0], np.asarray(SIGNALS.shear(jnp.asarray(time / 40.0)))])
        np.testing.assert_allclose(1.0 - box.lengths[0] / LENGTHS[0], expected, atol=1e-15)
        np.testing.assert_allclose(box.lengths[1] / LENGTHS[1] - 1.0, expected, atol=1e-15)


def memory(rest=0.2, hold=0.2, store=2.0, second_readout=False) -> tuple[Stage, ...]:
    return memory_protocol(rest, hold, store, second_readout=second_readout).stages


def test_the_protocol_is_continuous_in_u_and_takes_6_6_t0():
    stages = memory()
    assert sum(stage.length for stage in stages) == pytest.approx(6.6, rel=1e-14)
    assert sum(stage.length for stage in memory(second_readout=True)) == pytest.approx(9.0, rel=1e-14)
    assert all(one.stop == other.start for one, other in itertools.pairwise(stages))
    assert (stages[0].start, stages[-1].stop) == (0.0, 0.0)


def test_a_preparation_cycle_has_no_shear_and_returns_to_the_start():
    stages = cycle(rest=0.1, hold=0.3)
    assert not any(stage.drives for stage in stages)
    assert [stage.length for stage in stages] == [0.1, 1.0, 0.3, 1.0]
    assert [stage.start == stage.stop for stage in stages] == [True, False, True, False]
    assert stages[-1].stop == stages[0].start


def test_rows_are_part_of_the_table_of_their_stage():
    encode = memory()[5]
    whole, some, one = (jax.tree.leaves(rows) for rows in (table((encode,)), encode.rows(30, 7), encode.rows(33)))
    for column, part in zip(whole, some, strict=True):
        np.testing.assert_array_equal(part, column[30:37])
    assert [column[33] for column in whole] == one


def test_the_samples_of_a_run_follow_the_table():
    """A rest, a hold and a storage that differ and are no whole bins; the time of the run is that of whole bins."""
    pack, t0 = gm.load_pack(PACK), 75.0
    moments = []
    experiment = gm.Experiment(pack, SIGNALS, t0=t0, rest=0.05, hold=0.1, store=0.3)
    recall = gm.run(experiment, progress=lambda stage, time, fraction: moments.append((time, fraction)))
    bins = {"rest": 13, "compress": 256, "hold": 26, "decompress": 256, "rest-2": 13, "encode": 256, "store": 77}
    bins["readout"] = 256
    assert {name: sample.pressure.shape[0] for name, sample in recall.stages.items()} == bins
    assert moments[-1] == pytest.approx((sum(bins.values()) * t0 / 256, 1.0), rel=1e-12)
    lengths = np.asarray(pack.upper - pack.lower)
    deepest = lengths * np.array([np.sqrt(1.0 - pack.delta0)] * 2 + [1.0])
    for name, sample in recall.stages.items():
        up, replicas = (1 + np.arange(bins[name]))[:, None] / bins[name], sample.lengths.shape[-1]
        u = {"rest": 0.0 * up, "hold": 1.0 + 0.0 * up, "store": 1.0 + 0.0 * up}.get(name.split("-")[0])
        if u is None:
            u = 1.0 - up if name in ("decompress", "readout") else up
        plain = lengths + (deepest - lengths) * u
        np.testing.assert_allclose(sample.lengths[..., 0], plain, rtol=1e-13, err_msg=name)
        assert replicas == (7 if name in ("encode", "store", "readout") else 1)
        half = 0.5 * 1e-3 * np.asarray(SIGNALS.shear(jnp.asarray(u[:, 0]))) * (name == "encode")
        for replica in range(1, replicas):
            sheared = plain * np.stack(
                [1.0 - half[:, replica - 1], 1.0 + half[:, replica - 1], np.ones(len(u))], axis=1
            )
            np.testing.assert_allclose(sample.lengths[..., replica], sheared, rtol=1e-13, err_msg=name)
