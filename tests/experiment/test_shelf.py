"""The shelf of protocols: each in the limit where its result is known; gradients through five of them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.experiment import protocols
from gmem_jax.show.figure import TIME_OF_READ
from gmem_jax.show.recalls import recall_figure
from gmem_jax.simulation.protocol import Protocol

PACK = gm.load_pack(TETRA_27)
ONE = gm.Bumps(jnp.asarray([[1.0]]), jnp.asarray([[0.5]]), 0.6)
OTHER = gm.Bumps(jnp.asarray([[-1.0]]), jnp.asarray([[0.4]]), 0.6)
SILENT = gm.Bumps(jnp.asarray([[0.0]]), jnp.asarray([[0.5]]), 0.6)
QUICK: dict[str, Any] = {"t0": 20.0, "gamma0": 0.01}

BY_NAME: dict[str, Callable[..., Protocol]] = {
    name: getattr(protocols, name)
    for name in (
        *("paper", "paper_twice_read", "write_read_write_read", "partial_readout", "two_channels"),
        *("two_channels_in_turn", "amplitude_training", "several_amplitudes", "erasure_by_shear"),
        *("erasure_by_vibration", "long_storage", "read_by_shear"),
    )
}
SETS: dict[str, Any] = {
    "write_read_write_read": gm.signals(first=ONE, second=OTHER),
    "two_channels": gm.signals(xy=ONE, z=OTHER),
    "two_channels_in_turn": gm.signals(xy=ONE, z=OTHER),
}


def experiment(protocol: Protocol, signals: Any = ONE, **changes: Any) -> gm.Experiment:
    return gm.Experiment(PACK, signals, protocol=protocol, **{**QUICK, **changes})


def run(*arguments: Any, **changes: Any) -> gm.Recall:
    return gm.run(experiment(*arguments, **changes), progress=False)


@pytest.mark.parametrize("name", BY_NAME)
def test_a_protocol_needs_no_arguments_and_is_its_own_list(name: str) -> None:
    one = experiment(BY_NAME[name](), SETS.get(name, ONE))
    assert one.protocol.reads
    assert Protocol.from_list(one.protocol.to_list()) == one.protocol


def test_the_papers_two_are_those_of_an_experiment_without_a_protocol() -> None:
    assert experiment(protocols.paper()).is_paper
    assert experiment(protocols.paper_twice_read(), background="sub2").is_paper
    assert protocols.long_storage(2.0) == protocols.paper()


@pytest.mark.slow  # whose programs are optimised: to the last bit these two agree only then
def test_a_second_write_after_a_silent_first_is_the_papers() -> None:
    protocol = protocols.write_read_write_read(0.1, cycles=0).with_value("store.length", 0.2)
    twice = run(protocol, gm.signals(first=SILENT, second=ONE))
    once = run(protocols.paper(0.1))
    assert not np.any(twice.p_sig[0])
    np.testing.assert_array_equal(twice.p_sig[1], once.p_sig)
    assert float(twice.gain[1]) == pytest.approx(float(once.gain), rel=1e-12)


def test_a_partial_readout_begins_as_the_papers() -> None:
    part, whole = run(protocols.partial_readout(0.5, 0.1)), run(protocols.paper(0.1))
    np.testing.assert_allclose(part.p_sig[0, :, 128:], whole.p_sig[:, 128:], atol=1e-9 * np.abs(whole.p_sig).max())
    assert not np.any(part.p_sig[0, :, :128])
    assert np.all(part.p_sig[1] != 0.0)


def test_a_second_channel_that_is_silent_leaves_the_papers_recall() -> None:
    both, alone = run(protocols.two_channels(store=0.1), gm.signals(xy=ONE, z=SILENT)), run(protocols.paper(0.1))
    np.testing.assert_allclose(both.p_sig[0], alone.p_sig, atol=1e-12 * np.abs(alone.p_sig).max())


@pytest.mark.parametrize("order", [("xy", "z"), ("z", "xy")])
def test_a_silent_channel_is_a_wait_before_or_after_the_other(order: tuple[str, str]) -> None:
    turns = protocols.two_channels_in_turn(*order, store=0.1)
    waits = Protocol(replace(s, drives=(), role="hold", drag=0.0) if s.name == "write-z" else s for s in turns)
    found = run(turns, gm.signals(xy=ONE, z=SILENT))
    np.testing.assert_array_equal(found.p_sig[0], run(waits).p_sig)
    assert np.all(found.p_sig[0] != 0.0)


TRAININGS: dict[str, Callable[[float], Protocol]] = {
    "one": lambda amplitude: protocols.amplitude_training(amplitude, 2, (0.5, 1.0), 0.1),
    "several": lambda amplitude: protocols.several_amplitudes((amplitude, 0.5 * amplitude), 1, (0.5, 1.0), 0.1),
}


@pytest.mark.parametrize("name", TRAININGS)
def test_training_of_no_amplitude_leaves_the_readout_of_an_untrained_pack(name: str) -> None:
    assert not np.any(run(TRAININGS[name](0.0)).p_sig)
    assert np.all(run(TRAININGS[name](1.0)).p_sig != 0.0)


def test_training_goes_through_its_amplitudes_in_their_order() -> None:
    protocol = protocols.several_amplitudes((1.0, 0.5), 2, (0.25, 2.0))
    driven = [(stage.role, stage.drives[0].amplitude) for stage in protocol if stage.drives]
    assert driven == [*[("write", 1.0), ("write", 0.5)] * 2, ("read", 0.25), ("read", 2.0)]
    assert [stage.name for stage in protocol if stage.mark] == ["read-0.25"]


@pytest.mark.parametrize("name", ["erasure_by_shear", "erasure_by_vibration"])
def test_erasure_of_no_amplitude_changes_nothing(name: str) -> None:
    none, some = (BY_NAME[name](amplitude, length=0.1, store=0.1) for amplitude in (0.0, 10.0))
    waits = Protocol(gm.hold(0.1, name="erase", drag=0.0) if stage.name == "erase" else stage for stage in none)
    left = run(waits).p_sig
    np.testing.assert_array_equal(run(none).p_sig, left)
    assert np.abs(np.asarray(run(some).p_sig - left)).max() > 0.01 * np.abs(left).max()


def test_reading_by_a_shear_of_no_amplitude_is_waiting() -> None:
    reads = protocols.read_by_shear(0.0, times=1, length=0.1, store=0.1)
    waits = Protocol(replace(stage, drives=(), drag=0.0) if stage.role == "read" else stage for stage in reads)
    np.testing.assert_array_equal(run(reads).p_sig, run(waits).p_sig)


def test_a_shear_to_one_side_stays_there_and_returns() -> None:
    recall = run(protocols.read_by_shear(2.0, one_sided=True, times=2, length=0.1, store=0.1))
    assert recall.of_time
    assert gm.to_csv(recall).startswith("time (parts of the read),")
    assert {recall_figure(recall, what).panels[0].x for what in ("signals", "all")} == {TIME_OF_READ}
    for read in recall.reads:
        lengths = np.asarray(recall.stages[read].lengths)
        ratio = lengths[:, 1] / lengths[:, 0]
        ratio = ratio / ratio[-1] - 1.0
        assert np.all(ratio > -1e-12)
        assert ratio.max() == pytest.approx(2.0 * 0.01, rel=0.03)


SHORT = {
    "write_read_write_read": lambda: protocols.write_read_write_read(0.1, cycles=0),
    "partial_readout": lambda: protocols.partial_readout(0.5, 0.1),
    "two_channels_in_turn": lambda: protocols.two_channels_in_turn(store=0.1),
    "amplitude_training": lambda: protocols.amplitude_training(1.0, 1, (1.0,), 0.25),
    "erasure_by_shear": lambda: protocols.erasure_by_shear(3.0, 0.25, 0.1),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "backend"), [*((name, "native") for name in SHORT), ("amplitude_training", "jax")])
def test_gradients_through_the_shelf_are_central_differences(name: str, backend: str) -> None:
    one = experiment(SHORT[name](), SETS.get(name, ONE), backend=backend)

    def loss(_: gm.Experiment, p_sig: jax.Array) -> jax.Array:
        return 1e6 * jnp.sum(p_sig * p_sig)

    found = gm.value_and_grad(one, ["gamma0", "friction.mu"], loss=loss, progress=False)
    for path, slope in found.slope.items():
        middle, step, values = float(one.gamma0 if path == "gamma0" else one.friction.mu), 1e-6, []
        for sign in (1.0, -1.0):
            other = gm.replace(one, {path: middle * (1.0 + sign * step)})
            values.append(float(loss(other, gm.run(other, progress=False).p_sig)))
        assert float(slope) == pytest.approx((values[0] - values[1]) / (2.0 * step * middle), rel=1e-5), path
