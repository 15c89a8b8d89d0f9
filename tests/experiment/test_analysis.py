"""Gain, fidelity and background subtraction on made-up signals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmem_jax.experiment import analysis
from gmem_jax.experiment.signals import bin_average, six_signals

SCALE = 0.05 * 1e-3  # delta0 gamma0
J = bin_average(six_signals())
RUNNING_MEAN = jax.jit(analysis.running_mean)


def test_a_scaled_integral_is_a_perfect_memory() -> None:
    signal = 0.3 * SCALE * J
    np.testing.assert_allclose(analysis.compare(signal, J, SCALE).gain, 0.3, rtol=1e-14)
    np.testing.assert_allclose(analysis.compare(signal, J, SCALE).fidelity, 1.0, atol=1e-7)  # sqrt of round-off


def test_fidelity_is_one_minus_the_sine_of_the_angle_to_the_template() -> None:
    template = J / jnp.sqrt(jnp.sum(J * J))
    other = jnp.roll(template, 40, axis=1)
    other = other - template * jnp.sum(other * template)
    other = other / jnp.sqrt(jnp.sum(other * other))
    for angle in (0.1, 0.7, 1.4):
        signal = np.cos(angle) * template + np.sin(angle) * other
        np.testing.assert_allclose(analysis.compare(signal, J, SCALE).fidelity, 1.0 - np.sin(angle), rtol=1e-12)


def test_one_gain_serves_the_whole_set() -> None:
    signal = SCALE * J * jnp.asarray([0.2, 0.2, 0.2, 0.2, 0.2, 0.8])[:, None]
    assert 0.2 < float(analysis.compare(signal, J, SCALE).gain) < 0.8
    assert float(analysis.compare(signal, J, SCALE).fidelity) < 0.9


def test_a_scale_of_its_own_for_each_signal_is_that_signals_part_of_the_template() -> None:
    scale = SCALE * jnp.asarray([1.0, 2.0, 0.5, 3.0, 1.5, 0.1])[:, None]
    found = analysis.compare(0.3 * scale * J, J, scale)
    np.testing.assert_allclose(found.gain, 0.3, rtol=1e-14)
    np.testing.assert_allclose(found.fidelity, 1.0, atol=1e-7)  # sqrt of round-off
    assert float(analysis.compare(0.3 * scale * J, J, SCALE).fidelity) < 0.9


def test_a_readout_is_turned_to_ascending_u() -> None:
    pressure = jnp.arange(4.0)[:, None, None] * jnp.asarray([2.0, 1.0, 0.0])[None, :, None]
    np.testing.assert_array_equal(analysis.recalled(pressure), [[3.0, 2.0, 1.0, 0.0]])


def test_backgrounds_subtract_what_they_say() -> None:
    first = jnp.asarray([[1.0, 2.0, 4.0], [0.0, 5.0, 7.0]])
    second = jnp.asarray([[1.0, 1.0, 1.0], [1.0, 1.0, 2.0]])
    np.testing.assert_array_equal(analysis.subtract("sub0", first), [[1.0, -3.0, -3.0]])
    np.testing.assert_array_equal(analysis.subtract("sub2", first, second), [[1.0, -4.0, -5.0]])
    np.testing.assert_array_equal(analysis.subtract("sub2-bl", first, second), [[0.0, -2.0, 0.0]])


def test_a_background_without_its_second_readout_is_refused() -> None:
    with pytest.raises(ValueError, match="second readout"):
        analysis.subtract("sub2", jnp.zeros((2, 4)))
    with pytest.raises(ValueError, match="sub0, sub2, sub2-bl"):
        analysis.subtract("nothing", jnp.zeros((2, 4)))


def test_a_running_mean_over_one_period_removes_it_and_keeps_a_line() -> None:
    bins, period = 256, 10.4
    x = jnp.arange(bins) + 0.5
    line, wave = 3.0 + 0.1 * x, jnp.sin(2.0 * jnp.pi * x / period)
    smooth = analysis.running_mean(line + wave, period)
    inner = slice(8, -8)  # nearer to the ends the window is one-sided
    # Piecewise-constant sampling of the wave leaves about (pi / period)^2 / 6 of it.
    np.testing.assert_allclose(smooth[inner], line[inner], atol=0.02)


def test_a_running_mean_of_one_bin_changes_nothing() -> None:
    series = jnp.asarray([[1.0, 5.0, 2.0, 8.0]])
    np.testing.assert_allclose(analysis.running_mean(series, 1.0), series, rtol=1e-15)
    for width in (0.0, -2.0, jnp.asarray([1.0, float("nan")])):
        with pytest.raises(ValueError, match="needs a width above 0"):
            analysis.running_mean(series, width)


@pytest.mark.parametrize("width", [0.5, 1.0, 2.5, 4.3, 6.9, 40.0])
def test_a_running_mean_is_the_mean_over_the_part_of_its_window_that_is_inside(width: float) -> None:
    bins, fine = 7, 20  # windows of these widths begin and end between the fine steps
    series = np.random.default_rng(0).normal(size=(2, bins))
    steps = np.repeat(series, fine, axis=1)
    place = (np.arange(bins * fine) + 0.5) / fine
    expected = [steps[:, np.abs(place - centre) < 0.5 * width].mean(axis=1) for centre in np.arange(bins) + 0.5]
    np.testing.assert_allclose(RUNNING_MEAN(jnp.asarray(series), width), np.transpose(expected), rtol=1e-12)


def test_a_running_mean_keeps_a_constant_to_the_ends() -> None:
    np.testing.assert_allclose(analysis.running_mean(jnp.full((1, 9), 0.7), 3.7), np.full((1, 9), 0.7), rtol=1e-14)


def test_every_background_is_reported_with_its_own_gain_and_fidelity() -> None:
    signal = 0.3 * SCALE * J
    ramp = jnp.linspace(0.0, 1.0, 256)
    drift = 1e-6 * (0.4 + ramp)  # between the two readouts: SUB2 suffers from it, a line is all that SUB2-BL removes
    first = jnp.concatenate([jnp.zeros((1, 256)), -signal]) + jnp.sin(ramp)
    rows = analysis.backgrounds(first, jnp.broadcast_to(jnp.sin(ramp) + drift, first.shape), J, SCALE)
    assert list(rows) == ["sub0", "sub2", "sub2-bl"]
    np.testing.assert_allclose(
        rows["sub0"].fidelity, 1.0, atol=1e-6
    )  # round-off of the background, of order 1, over 1e-6
    np.testing.assert_allclose(rows["sub0"].gain, 0.3, rtol=1e-9)
    assert float(rows["sub2"].fidelity) < 0.9
    # The line through the end bins also takes what J has left there, 2 du / pi of signals 1 to 3 and 6.
    alone = analysis.subtract("sub2-bl", -jnp.concatenate([jnp.zeros((1, 256)), signal]), jnp.zeros((7, 256)))
    np.testing.assert_allclose(rows["sub2-bl"].fidelity, analysis.compare(alone, J, SCALE).fidelity, rtol=1e-6)


def test_averaging_over_a_window_removes_what_rings_in_it_from_every_background() -> None:
    integral, period = J[3:], 8.5  # both are zero at the ends, so that the line of SUB2-BL takes nothing of them
    signal = 0.3 * SCALE * integral
    ringing = 0.2 * jnp.max(signal) * jnp.sin(2.0 * jnp.pi * jnp.arange(256) / period)
    first = -jnp.concatenate([jnp.zeros((1, 256)), signal + ringing])
    second = jnp.zeros_like(first)
    raw = analysis.backgrounds(first, second, integral, SCALE)
    smooth = analysis.backgrounds(first, second, integral, SCALE, period / 256.0)
    for name in analysis.BACKGROUNDS:
        assert float(raw[name].fidelity) < 0.8 < 0.97 < float(smooth[name].fidelity)
        p_sig, wanted = (RUNNING_MEAN(series, period) for series in (analysis.subtract(name, first, second), integral))
        np.testing.assert_allclose(smooth[name], analysis.compare(p_sig, wanted, SCALE), rtol=1e-9)


def test_correlation_is_the_cosine_between_signal_and_integral() -> None:
    np.testing.assert_allclose(analysis.correlation(-3.0 * J, J), -np.ones(6), rtol=1e-14)
    angle = 0.3
    one = jnp.ones((1, 4)) / 2.0
    other = jnp.asarray([[1.0, -1.0, 1.0, -1.0]])  # orthogonal to it
    np.testing.assert_allclose(
        analysis.correlation(jnp.cos(angle) * one + jnp.sin(angle) * other / 2.0, one), [np.cos(angle)], rtol=1e-14
    )


def test_what_is_left_after_the_first_readout_has_its_sign_and_its_size() -> None:
    zero = jnp.sin(jnp.linspace(0.0, 3.0, 256))[None]
    second = jnp.concatenate([zero, zero - 0.02 * SCALE * J])
    correlation, left = analysis.remembered_after(second, J, SCALE)
    np.testing.assert_allclose(left, 0.02 * np.ones(6), rtol=1e-7)  # round-off of a background of order 1 over 1e-7
    np.testing.assert_allclose(correlation, np.ones(6), rtol=1e-12)


def test_an_unrelated_second_readout_is_uncorrelated_with_the_integral() -> None:
    noise = jnp.asarray(np.random.default_rng(0).normal(size=(7, 256)))
    correlation, _ = analysis.remembered_after(noise, J, SCALE)
    assert np.abs(correlation).max() < 4.0 / 16.0  # the correlation of white noise has an SD of 1 / sqrt(256)
