"""Waveforms from samples at any times: where they go in u, what is changed on request, what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

import gmem_jax as gm

U = np.linspace(0.0, 1.0, 101)
WAVE = np.sin(np.pi * U) * np.sin(2.0 * np.pi * U)
NOISE = np.random.default_rng(0).normal(size=1001)
FINE = jnp.linspace(0.0, 1.0, 1001)


def test_samples_at_equal_times_are_the_nodes_as_they_are() -> None:
    said: list[str] = []
    signals = gm.waveform_from(20.0 + 3.0 * U, WAVE, told=said.append)
    np.testing.assert_allclose(signals.nodes[0], WAVE, atol=1e-15)
    assert said == []


def test_samples_at_uneven_times_keep_their_places() -> None:
    t = np.sort(np.append(np.random.default_rng(0).uniform(size=400), [0.0, 1.0])) ** 2
    signals = gm.waveform_from(t, np.sin(np.pi * t) ** 2)
    np.testing.assert_allclose(signals.shear(FINE)[:, 0], np.sin(np.pi * FINE) ** 2, atol=0.01)


def test_the_waveform_is_zero_in_a_span_beyond_its_samples() -> None:
    signals = gm.waveform_from([2.0, 3.0, 4.0], [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], span=(0.0, 8.0))
    values = np.asarray(signals.shear(FINE))
    assert FINE[np.argmax(values[:, 0])] == pytest.approx(3.0 / 8.0, abs=1e-2)
    assert np.all(values[(FINE < 0.24) | (FINE > 0.51)] == 0.0)


def test_smoothing_takes_noise_away_and_leaves_the_wave_and_its_ends() -> None:
    wave = np.sin(np.pi * FINE) ** 2
    said: list[str] = []
    signals = gm.waveform_from(FINE, wave + 0.05 * NOISE * wave, smooth=0.1, told=said.append)
    assert np.abs(signals.shear(FINE)[:, 0] - wave).max() < 0.03
    assert said[0].startswith("smoothed over 0.1 in u (which took away 0.0")
    straight = gm.waveform_from(U, np.minimum(U, 1.0 - U), smooth=0.1)  # the mean of a line is the line
    np.testing.assert_allclose(straight.nodes[0, :110], np.arange(110) / 256.0, atol=1e-12)


def test_a_taper_changes_nothing_but_the_ends() -> None:
    said: list[str] = []
    signals = gm.waveform_from(U, np.full_like(U, 0.7), taper=0.2, told=said.append)
    np.testing.assert_allclose(signals.nodes[0, 20:81], 0.7, atol=1e-12)
    np.testing.assert_allclose(signals.nodes[0, [10, 90]], 0.35, atol=1e-12)
    assert signals.nodes[0, 0] == signals.nodes[0, -1] == 0.0
    assert said == ["brought to zero within 0.2 in u of its ends (which were at 0.7 at most)"]


def test_a_scale_is_common_to_all_signals() -> None:
    said: list[str] = []
    signals = gm.waveform_from(U, [5.0 * WAVE, -2.0 * WAVE], scale=True, told=said.append)
    assert np.abs(signals.nodes[0]).max() == 1.0
    np.testing.assert_allclose(signals.nodes[1], -0.4 * signals.nodes[0], atol=1e-15)
    assert said == [f"divided by {5.0 * np.abs(WAVE).max():.4g}"]


REFUSED = {
    "is zero at both ends: bring it there, with taper = 0.1 (gmem recall --taper 0.1)": (U, WAVE + 0.3, {}),
    "more than the 20% that a pack can hold: smooth it, with smooth = 0.05": (
        FINE,
        0.3 * NOISE * (abs(FINE - 0.5) < 0.4),
        {},
    ),
    "changes by 200% of its largest value within 1/256": (  # and is the same again a bin later
        np.linspace(0.0, 1.0, 4097),
        np.cos(np.pi * np.arange(4097)),
        {"taper": 0.1},
    ),
    "signal 2 changes by": (U, [WAVE, np.where(np.abs(U - 0.5) < 0.2, 1.0, 0.0)], {}),
    "times must rise; sample 2": (U[::-1], WAVE, {}),
    "a time or a sample is not a finite number": (U, np.where(U == 0.5, np.nan, WAVE), {}),
    "samples [n] or [signals, n] at times [n]": (U[:-1], WAVE, {}),
    "smooth must be in [0, 0.5]": (U, WAVE, {"smooth": 0.6}),
    "taper must be in [0, 0.5]": (U, WAVE, {"taper": -0.1}),
    "span must be two times": (U, WAVE, {"span": (1.0, 1.0)}),
    "times from 0 to 1 lie outside 0.5 to 1": (U, WAVE, {"span": (0.5, 1.0)}),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_no_pack_can_hold_is_refused_with_what_would_help(words: str) -> None:
    t, x, options = REFUSED[words]
    with pytest.raises(ValueError) as refused:  # noqa: PT011
        gm.waveform_from(t, x, **options)
    assert words in str(refused.value)


def test_the_steepest_waveforms_of_the_package_are_not_too_steep() -> None:
    words = np.asarray(gm.words(12).shear(jnp.asarray(U)))[:, [0, 1365, 2730, 4095]].T
    gm.waveform_from(U, words)
