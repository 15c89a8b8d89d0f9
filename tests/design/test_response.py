"""The memory kernel and designs, on made-up kernels and on a shortened run of 27 grains."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.design import by_kernel, drive, waveforms
from gmem_jax.design import kernel as response
from gmem_jax.experiment.run import prefix_of, run
from gmem_jax.experiment.signals import bin_average
from gmem_jax.show import summaries
from gmem_jax.simulation.checkpoints import NO_CHECKPOINT, Checkpoint, ResultCache
from gmem_jax.simulation.stage import BINS

PACK = TETRA_27
SHORT = {"t0": 75.0, "dt": 0.3, "rest": 0.1, "hold": 0.1, "store": 0.2}


@pytest.fixture(scope="module")
def experiment() -> gm.Experiment:
    return gm.Experiment(gm.load_pack(PACK), gm.six_signals(), **SHORT)


@pytest.fixture(scope="module")
def kernel(experiment: gm.Experiment) -> gm.MemoryKernel:
    return gm.memory_kernel(experiment, 5, 0.3)


def ideal(gain: float, n: int = 17) -> gm.MemoryKernel:
    basis = response.bumps(np.eye(n), 0.2)
    odd = gain * 0.05 * 1e-3 * np.asarray(bin_average(basis))
    return gm.MemoryKernel(np.arange(BINS) / BINS, np.asarray(basis.centres[0]), 0.2, odd, 0.0 * odd, 1e-3, 0.05)


def test_an_ideal_integral_is_at_distance_zero_and_has_its_gain() -> None:
    kernel = ideal(0.3)
    assert kernel.distance() < 1e-12
    np.testing.assert_allclose(kernel.gain(), 0.3, rtol=1e-12)
    assert kernel.asymmetry() == 0.0


def test_an_ideal_integral_predicts_every_waveform_of_its_basis() -> None:
    kernel, signals = ideal(0.3), gm.six_signals()
    expected = 0.3 * 0.05 * 1e-3 * np.asarray(bin_average(signals))
    # The six signals lie in the span of 17 bumps of width 0.2; the fine grid's sums leave some 1e-10.
    np.testing.assert_allclose(kernel.predict(signals), expected, atol=1e-8 * expected.max())


def test_singular_values_are_recalls_of_unit_waveforms() -> None:
    kernel = ideal(0.3, n=2)
    v = (np.arange(4096) + 0.5) / 4096
    shapes = np.asarray(kernel.basis.shear(jnp.asarray(v)))
    # Two bumps that do not overlap are orthogonal already.
    unit = kernel.odd / np.sqrt((shapes**2).mean(axis=0))[:, None]
    expected = np.linalg.svd(unit, compute_uv=False) / np.sqrt(BINS)
    np.testing.assert_allclose(kernel.singular_values(), expected, rtol=1e-6)
    assert kernel.capacity(0.5 * expected[1]) == 2
    assert kernel.capacity(0.5 * (expected[0] + expected[1])) == 1


def test_asymmetry_is_the_even_part_over_the_odd_one() -> None:
    kernel = ideal(0.3)
    np.testing.assert_allclose(replace(kernel, even=0.1 * kernel.odd[::-1]).asymmetry(), 0.1, rtol=1e-12)


def test_distance_is_the_sine_of_the_angle_to_the_integral() -> None:
    kernel = ideal(0.3)
    other = np.random.default_rng(1).normal(size=kernel.odd.shape)
    other -= kernel.odd * np.sum(other * kernel.odd) / np.sum(kernel.odd**2)
    other *= 0.75 * np.linalg.norm(kernel.odd) / np.linalg.norm(other)
    np.testing.assert_allclose(replace(kernel, odd=kernel.odd + other).distance(), 0.6, rtol=1e-6)


def test_resolution_of_bumps_that_do_not_overlap_is_the_width_of_each_at_half_of_its_value() -> None:
    width, points = 0.5, response.QUADRATURE_POINTS
    basis = response.bumps(np.eye(2), width)
    odd = np.asarray(bin_average(basis))
    kernel = gm.MemoryKernel(np.arange(BINS) / BINS, np.asarray(basis.centres[0]), width, odd, 0.0 * odd, 1e-3, 0.05)
    v = (np.arange(points // 5, 4 * points // 5, points // 32) + 0.5) / points
    height = np.cos(np.pi * (v % width - 0.5 * width) / width)  # of the bump at v
    expected = np.mean(2.0 * width / np.pi * np.arccos(0.5 * height))
    assert kernel.resolution(0.0) == pytest.approx(expected, abs=2.0 / points)


def test_what_is_told_of_a_kernel_is_in_pascals() -> None:
    kernel, modulus = ideal(0.3, n=5), float(gm.Material().modulus)
    values = modulus * kernel.singular_values()
    for noise, above in ((0.5 * (values[2] + values[3]), 3), (0.5 * (values[0] + values[1]), 1)):
        facts = summaries.of_kernel(kernel, {}, noise).facts
        assert facts["capacity"] == above
        np.testing.assert_allclose(facts["singular_values_pa"], values, rtol=1e-12)
        assert facts["resolution"] == kernel.resolution(noise / modulus)


def test_the_error_of_a_prediction_is_over_what_was_simulated() -> None:
    found = response.relative_error(np.array([[3.0, 4.0], [0.0, 2.0]]), jnp.asarray([[3.0, 2.0], [0.0, 4.0]]))
    np.testing.assert_allclose(found, [2.0 / np.sqrt(13.0), 0.5], rtol=1e-12)


def test_less_noise_means_finer_resolution() -> None:
    kernel = ideal(0.3)
    values = kernel.singular_values()
    assert kernel.resolution(0.0) < kernel.resolution(0.5 * values[3]) < kernel.resolution(0.9 * values[0])


def test_a_prefix_serves_several_simulations(experiment: gm.Experiment) -> None:
    whole = gm.run(experiment)
    prefix = prefix_of(experiment)
    pack = experiment.pack
    moved, turned = {"pack.position": pack.position + 1e-9}, {"pack.quaternion": pack.quaternion[:, ::-1]}
    for other in ({"friction.mu": 0.9}, {"hold_drag": 0.01}, moved, turned):
        with pytest.raises(ValueError, match="the prefix is that of another pack, law or protocol"):
            run(gm.replace(experiment, other), prefix=prefix)
    for _ in range(2):  # the same programs on the same state: the same bits
        found = run(experiment, prefix=prefix)
        np.testing.assert_array_equal(found.p_sig, whole.p_sig)
        assert float(found.fidelity) == float(whole.fidelity)
        np.testing.assert_array_equal(found.stages["compress"].pressure, whole.stages["compress"].pressure)


def test_odd_and_even_parts_add_up_to_the_recall_of_each_bump(
    experiment: gm.Experiment, kernel: gm.MemoryKernel
) -> None:
    amplitudes = np.asarray([[0.0, 1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0, 0.0]])
    signals = response.bumps(amplitudes, 0.3)
    p_sig = run(gm.replace(experiment, signals=signals)).p_sig
    np.testing.assert_allclose(kernel.predict(signals), p_sig, atol=1e-6 * np.abs(np.asarray(p_sig)).max())


@pytest.mark.slow
def test_designed_waveforms_improve_stay_within_the_bound_and_survive_a_csv(
    experiment: gm.Experiment, tmp_path: Path
) -> None:
    found = gm.design_waveforms(experiment, iterations=2, n=5, width=0.3)
    assert np.abs(np.asarray(found.signals.nodes)).max() <= 1.0 + 1e-6
    assert found.history[0] == found.before
    assert len(found.history) == 3
    assert found.history[-1] > found.before
    # What is verified are samples of the bumps, joined by cubics.
    np.testing.assert_allclose(found.fidelity, found.history[-1], atol=1e-3)
    gm.save_waveforms(tmp_path / "designed.csv", found.signals)
    again = gm.waveform(gm.load_waveforms(tmp_path / "designed.csv"))
    np.testing.assert_array_equal(again.nodes, found.signals.nodes)


def test_design_inverts_a_linear_memory(monkeypatch: pytest.MonkeyPatch, experiment: gm.Experiment) -> None:
    kernel = ideal(0.3)
    mixing = np.linalg.qr(np.random.default_rng(1).standard_normal((17, 17)))[0]
    odd = (np.eye(17) + 0.3 * mixing) @ kernel.odd  # linear, but no integral
    kernel = gm.MemoryKernel(kernel.u, kernel.centres, 0.2, odd, 0.0 * odd, 1e-3, 0.05)

    def linear(run: gm.Experiment, *_: object, **__: object) -> SimpleNamespace:
        p_sig = jnp.asarray(kernel.coefficients(run.signals) @ odd)
        return SimpleNamespace(p_sig=p_sig, **run.compare(p_sig)._asdict())

    def push(run: gm.Experiment, direction: dict, **_: object) -> SimpleNamespace:
        return SimpleNamespace(p_sig_slope=direction["signals.amplitudes"] @ odd)

    monkeypatch.setattr(waveforms, "run", linear)
    monkeypatch.setattr(waveforms, "prefix_of", lambda *_, **__: None)
    monkeypatch.setattr(waveforms, "push", push)
    found = gm.design_waveforms(experiment, iterations=3, gain=0.1, damping=(1e-6,))
    assert found.before < 0.95
    assert found.fidelity > 0.999  # the sampled waveform is a cubic through 127 nodes


def two_channels(experiment: gm.Experiment) -> gm.Experiment:
    six = gm.six_signals()
    return gm.replace(experiment, signals=gm.signals(xy=six, z=gm.Bumps(six.amplitudes[::-1], six.centres, six.width)))


def test_design_of_two_channels_takes_away_what_each_gives_back_of_the_other(
    monkeypatch: pytest.MonkeyPatch, experiment: gm.Experiment
) -> None:
    odd, across = ideal(0.3).odd, ideal(0.2).odd[::-1]  # linear memories; across one another they are no integrals
    coupling = np.array([[1.0, 0.3], [-0.4, 0.7]])  # of channel c by what was written on d
    both = two_channels(experiment)

    def mixed(rows: Any) -> jnp.ndarray:
        own, other = ([amplitudes @ kernel for amplitudes in rows] for kernel in (odd, across))
        return jnp.asarray([sum(coupling[c, d] * (own if c == d else other)[d] for d in range(2)) for c in range(2)])

    def linear(run: gm.Experiment, *_: object, **__: object) -> SimpleNamespace:
        p_sig = mixed([ideal(0.3).coefficients(one) for one in run.sets.values()])
        return SimpleNamespace(p_sig=p_sig, **run.compare(p_sig)._asdict())

    def push(run: gm.Experiment, direction: dict, **_: object) -> SimpleNamespace:
        return SimpleNamespace(p_sig_slope=mixed([direction[f"signals.{name}.amplitudes"] for name in ("xy", "z")]))

    monkeypatch.setattr(waveforms, "run", linear)
    monkeypatch.setattr(waveforms, "prefix_of", lambda *_, **__: None)
    monkeypatch.setattr(waveforms, "push", push)
    found = gm.design_waveforms(both, iterations=3, gain=0.05, damping=(1e-6,))
    assert found.target.shape == found.p_sig.shape == (2, 6, BINS)
    assert np.all(found.before < 0.85)
    assert np.all(found.fidelity > 0.995)  # the sampled waveforms are cubics through 127 nodes
    np.testing.assert_allclose(found.gain, [[0.05, 0.0], [0.0, 0.05]], atol=5e-4)
    np.testing.assert_allclose(found.history[0], np.mean(found.before), rtol=1e-12)
    assert max(np.abs(np.asarray(one.nodes)).max() for one in found.sets.values()) <= 1.0 + 1e-6


@pytest.mark.slow
def test_two_channels_are_designed_together(experiment: gm.Experiment) -> None:
    found = gm.design_waveforms(two_channels(experiment), iterations=1, n=4, width=0.4)
    assert found.fidelity.shape == (2,)
    assert found.history[1] > found.history[0]
    with pytest.raises(ValueError, match=r"gm.signals\(\*\*design.sets\)"):
        _ = found.signals
    np.testing.assert_allclose(np.mean(found.fidelity), found.history[-1], atol=1e-3)  # of samples


@pytest.mark.parametrize("gain", [0.0, math.nan, -math.inf])
@pytest.mark.parametrize("design", [gm.design_waveforms, gm.design_by_kernel])
def test_a_gain_that_no_waveform_has_is_refused_before_anything_runs(
    experiment: gm.Experiment, design: Any, gain: float
) -> None:
    def told(*_: object) -> None:
        pytest.fail("it was begun")

    with pytest.raises(ValueError, match="gain must be a finite number other than 0, got"):
        design(experiment, gain=gain, progress=told)


@pytest.mark.parametrize(
    ("changed", "asked", "words"),
    [
        (
            {"friction": gm.Hooke(mu=np.full(3, 0.5))},
            {},
            "one value of each parameter, not one for each replica as friction.mu has",
        ),
        ({}, {"n": 1}, "n must be .* 2"),
        ({}, {"damping": ()}, "damping must be finite numbers >= 0, one at least"),
        ({}, {"damping": (0.1, math.nan)}, "damping must be finite numbers"),
    ],
)
def test_a_design_that_cannot_be_is_refused_before_anything_runs(
    changed: dict[str, Any], asked: dict[str, Any], words: str, experiment: gm.Experiment
) -> None:
    def told(*_: object) -> None:
        pytest.fail("it was begun")

    with pytest.raises(ValueError, match=words):
        gm.design_waveforms(gm.replace(experiment, signals=gm.words(1), **changed), **asked, progress=told)


def test_designs_of_what_is_read_twice_are_refused(experiment: gm.Experiment) -> None:
    again = gm.Experiment(experiment.pack, experiment.signals, t0=75.0, protocol=gm.protocols.partial_readout())
    with pytest.raises(
        ValueError, match="kernels need one read, and a set of waveforms for each channel; the protocol has 2 reads"
    ):
        gm.design_waveforms(again)
    with pytest.raises(ValueError, match=r"with one channel; gm.design_waveforms designs several together"):
        gm.design_by_kernel(two_channels(experiment))


def memory_of_another_kernel(
    monkeypatch: pytest.MonkeyPatch, louder: float, otherwise: float, known_gain: float = 0.3
) -> gm.MemoryKernel:
    """Puts a memory into the place of simulations; what is taken for its kernel, and is it but for `otherwise`."""
    kernel = ideal(known_gain)
    mixing, other = (np.linalg.qr(np.random.default_rng(seed).standard_normal((17, 17)))[0] for seed in (1, 2))
    odd = (np.eye(17) + 0.3 * mixing) @ kernel.odd  # linear, but no integral
    even = 0.1 * np.roll(odd, 1, axis=0)
    known = gm.MemoryKernel(kernel.u, kernel.centres, 0.2, odd, even, 1e-3, 0.05)
    true = gm.MemoryKernel(kernel.u, kernel.centres, 0.2, odd + otherwise * other @ odd, even, 1e-3, 0.05)

    def memory(run: gm.Experiment, **_: object) -> SimpleNamespace:
        p_sig = jnp.asarray(louder * true.predict(run.signals))
        return SimpleNamespace(p_sig=p_sig, **run.compare(p_sig)._asdict())

    monkeypatch.setattr(by_kernel, "run", memory)
    monkeypatch.setattr(by_kernel, "memory_kernel", lambda *_, **__: known)
    monkeypatch.setattr(by_kernel, "prefix_of", lambda *_, **__: None)
    return known


# Memories that are what their kernel says, three times as loud, and quite another one.
@pytest.mark.parametrize(("louder", "otherwise", "reached"), [(1.0, 0.0, 0.998), (3.0, 0.0, 0.95), (1.0, 0.6, 0.97)])
def test_many_designs_share_a_kernel_learn_where_it_is_wrong_and_take_back_what_makes_them_worse(
    monkeypatch: pytest.MonkeyPatch, experiment: gm.Experiment, louder: float, otherwise: float, reached: float
) -> None:
    memory_of_another_kernel(monkeypatch, louder, otherwise)
    damping = 1e-3 if otherwise else 1e-2
    found = gm.design_by_kernel(experiment, iterations=8, n=17, width=0.2, gain=0.1, damping=damping)
    assert found.before < 0.95
    assert found.fidelity > reached  # of the last memory the kernel alone makes 0.89
    # A whole step in a memory three times as loud overshoots by twice the miss.
    assert (found.history[2] == found.history[1]) == (louder == 3.0)
    np.testing.assert_allclose(found.fidelity, found.history[-1], atol=2e-3)  # samples of bumps, joined by cubics


def test_slopes_that_are_measured_need_not_be_learned(
    monkeypatch: pytest.MonkeyPatch, experiment: gm.Experiment
) -> None:
    memory_of_another_kernel(monkeypatch, 1.0, 1.2)
    asked = {"iterations": 8, "n": 17, "width": 0.2, "gain": 0.1, "damping": 1e-3}
    told: list[float] = []
    learned = gm.design_by_kernel(experiment, **asked)
    measured = gm.design_by_kernel(experiment, measured=17, progress=lambda *at: told.append(at[-1]), **asked)
    assert measured.history[:3] == learned.history[:3]  # a third of the iterations goes by
    assert 1.0 - measured.fidelity < 0.3 * (1.0 - learned.fidelity)


def test_slopes_are_measured_where_most_is_missed() -> None:
    needs = np.array([1.0, 30.0, 0.0, 5.0, 4.0])
    # Of 20 for a need of 40 the second would take 15; the others share what it may not.
    assert by_kernel.shares(20, needs, 12).tolist() == [1, 12, 0, 4, 3]
    assert by_kernel.shares(60, needs, 12).tolist() == [12, 12, 0, 12, 12]
    assert by_kernel.shares(20, np.zeros(3), 12).tolist() == [0, 0, 0]  # nothing is missed


def test_a_kernel_that_is_there_is_not_measured_again(
    monkeypatch: pytest.MonkeyPatch, experiment: gm.Experiment
) -> None:
    known = memory_of_another_kernel(monkeypatch, 1.0, 0.6)
    asked = {"iterations": 3, "gain": 0.1, "damping": 1e-2}
    measured = gm.design_by_kernel(experiment, n=17, width=0.2, **asked)
    monkeypatch.delattr(by_kernel, "memory_kernel")
    given = gm.design_by_kernel(experiment, kernel=known, **asked)
    assert given.history == measured.history
    with pytest.raises(ValueError, match=r"the kernel was measured at gamma0 = 0\.001, but the experiment has 0\.003"):
        gm.design_by_kernel(gm.replace(experiment, gamma0=3e-3), kernel=known)


def test_a_design_goes_on_from_an_earlier_one(monkeypatch: pytest.MonkeyPatch, experiment: gm.Experiment) -> None:
    memory_of_another_kernel(monkeypatch, 1.0, 0.6)
    asked = {"n": 17, "width": 0.2, "damping": 1e-2}
    first = gm.design_by_kernel(experiment, iterations=3, gain=0.1, **asked)
    further = gm.design_by_kernel(experiment, iterations=3, start=first.signals, **asked)
    np.testing.assert_allclose(further.history[1], first.fidelity, rtol=1e-9)  # its samples are met
    assert further.fidelity > first.fidelity
    louder = gm.design_by_kernel(experiment, iterations=1, start=first.signals, gain=0.15, **asked)
    assert louder.history[1] == further.history[1]
    with pytest.raises(ValueError, match="8 waveforms to start from, for 6 signals"):
        gm.design_by_kernel(experiment, start=gm.words(3), **asked)


def test_all_recalls_of_a_design_begin_where_one_prefix_ended(experiment: gm.Experiment) -> None:
    parts: list[str] = []

    class Listing(ResultCache):
        def __call__(self, name: str, run: Callable[[Checkpoint], Any]) -> Any:
            parts.append(name)
            return run(NO_CHECKPOINT)

    found = gm.design_by_kernel(experiment, iterations=3, n=3, width=0.5, measured=1, cache=Listing())
    recalls = ["untouched", "trial-0", "slopes-1", "trial-1", "slopes-2", "trial-2", "verified"]
    assert sorted(parts) == sorted(["prefix", "kernel-basis-batch-0000", *(f"{name}-batch-0000" for name in recalls)])
    fresh = gm.run(gm.replace(experiment, signals=found.signals))
    np.testing.assert_array_equal(found.p_sig, np.asarray(fresh.p_sig))


def test_a_gain_that_is_not_asked_for_leaves_room_below_the_bound(
    monkeypatch: pytest.MonkeyPatch, experiment: gm.Experiment
) -> None:
    known = memory_of_another_kernel(monkeypatch, 1.0, 0.0)
    asked = {"iterations": 1, "n": 17, "width": 0.2, "damping": 1e-2}
    found = gm.design_by_kernel(experiment, **asked)
    own = float(experiment.compare(jnp.asarray(known.predict(experiment.signals))).gain)
    assert found.gain < 0.5 * own
    v = jnp.linspace(0.0, 1.0, 999)
    assert float(jnp.max(jnp.abs(found.signals.shear(v)))) == pytest.approx(by_kernel.FIRST_GUESS_BOUND, rel=0.05)


def test_a_drive_climbs_to_the_best_value_within_bounds(
    monkeypatch: pytest.MonkeyPatch, experiment: gm.Experiment
) -> None:
    target = np.asarray(bin_average(experiment.signals))
    off = np.random.default_rng(0).standard_normal(target.shape)

    def rugged(run: gm.Experiment) -> SimpleNamespace:
        mu = float(run.friction.mu)
        far = abs(np.log(mu / 0.6)) + 0.02 * np.sin(300.0 * mu)  # best at 0.6; its own derivative is of no use
        p_sig = jnp.asarray(target + far * off * np.linalg.norm(target) / np.linalg.norm(off))
        return SimpleNamespace(fidelity=experiment.compare(p_sig).fidelity)

    monkeypatch.setattr(drive, "run", rugged)
    wide = gm.design_drive([experiment, experiment], {"mu": (0.3, 2.0)}, iterations=8)
    assert abs(wide.values["mu"] - 0.6) < 0.1
    assert wide.fidelity > wide.before
    assert len(wide.history) == 9
    narrow = gm.design_drive([experiment], {"mu": (0.8, 2.0)}, iterations=8)
    np.testing.assert_allclose(narrow.values["mu"], 0.8, rtol=0.05)
    with pytest.raises(ValueError, match="hold the first value"):
        gm.design_drive([experiment], {"mu": (2.0, 3.0)})


def test_a_kernel_of_one_bump_is_refused(experiment: gm.Experiment) -> None:
    with pytest.raises(ValueError, match="at least 2"):
        gm.memory_kernel(experiment, 1)
