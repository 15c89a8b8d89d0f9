"""Bounds on the bits of a pack and alphabets, on made-up memories whose answers are known."""

import numpy as np
import pytest

import gmem_jax as gm
from gmem_jax.design.kernel import bumps
from gmem_jax.experiment.signals import bin_average, words
from gmem_jax.reading import capacity
from gmem_jax.reading.readers import bit_errors, confusion, information
from gmem_jax.simulation.stage import BINS

J = np.asarray(bin_average(words(5)))


def memory(sizes: list[float]) -> gm.MemoryKernel:
    """A linear memory whose singular values (RMS of p_sig for a waveform of unit RMS) are known: bumps side by side."""
    n = len(sizes)
    basis = bumps(np.eye(n), 1.0 / n)
    loud = np.sqrt(0.5 / n)  # RMS of one bump: half of its mean square over 1 / n of [0, 1]
    odd = np.zeros((n, BINS))
    odd[np.arange(n), np.arange(n)] = loud * np.sqrt(BINS) * np.asarray(sizes)
    return gm.MemoryKernel(np.arange(BINS) / BINS, np.asarray(basis.centres[0]), 1.0 / n, odd, 0.0 * odd, 1e-3, 0.05)


def test_equal_channels_share_the_power() -> None:
    """n channels of one gain: n / 2 log2(1 + P / n SNR)."""
    bits = capacity.channels(memory([2.0] * 4), 0.5, power=3.0)
    np.testing.assert_allclose(bits, 0.5 * np.log2(1.0 + 3.0 / 4.0 * BINS * (2.0 / 0.5) ** 2), rtol=1e-6)


def test_water_fills_the_deepest_channels_and_leaves_the_rest_dry() -> None:
    # Bottoms at 1/4, 1 and 5: a power of 2 stands at (2 + 1/4 + 1) / 2 = 1.625 in the first two.
    np.testing.assert_allclose(capacity.water_filled(np.array([4.0, 1.0, 0.2]), 2.0), [1.375, 0.625, 0.0])
    np.testing.assert_allclose(capacity.water_filled(np.array([4.0, 1.0, 0.0]), 0.5), [0.5, 0.0, 0.0])


def test_no_other_sharing_carries_more() -> None:
    ratio = np.array([50.0, 8.0, 3.0, 0.4])
    best = np.log2(1.0 + capacity.water_filled(ratio, 1.0) * ratio).sum()
    others = np.random.default_rng(0).dirichlet(np.ones(4), 1000)
    assert best >= np.log2(1.0 + others * ratio).sum(axis=1).max()


def test_a_noise_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="must be above 0"):
        capacity.channels(memory([1.0, 1.0]), 0.0)
    for noise in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="noise must be a number from 0"):
            capacity.decoded_bits(J, noise)


def test_a_pack_that_keeps_nothing_carries_nothing() -> None:
    np.testing.assert_array_equal(capacity.channels(memory([0.0, 0.0]), 1.0), [0.0, 0.0])
    np.testing.assert_array_equal(capacity.channels(memory([1.0, 1.0]), np.inf), [0.0, 0.0])


def test_without_noise_every_bit_is_read_and_none_under_much() -> None:
    assert capacity.decoded_bits(J, 0.0, draws=1) == (5.0, 0.0)
    lost = capacity.decoded_bits(J, 100.0 * np.abs(J).max(), draws=8)
    # The bias of 32 words is 5 / (2 32 ln 2) = 0.11 bits for one draw, less for several; the true value is 0.
    assert lost.bits < 0.2
    middle = capacity.decoded_bits(J, 2.0 * np.abs(J).max())
    assert lost.bits + 0.5 < middle.bits < 4.9
    assert 0.01 < middle.error < 1.0


def test_the_sum_over_bits_is_that_of_the_confusion_table(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = np.random.default_rng(1).permutation(32) // 4  # wrong in a way that leaves something known
    monkeypatch.setattr(capacity, "linear_decoder", lambda *_, **__: answers)
    expected = information(confusion(answers, 32))["bitwise"]
    assert bit_errors(answers).mean() > 0.1
    np.testing.assert_allclose(capacity.decoded_bits(J, 0.0).bits, expected, atol=1e-12)


def test_what_is_not_all_words_of_a_length_is_refused() -> None:
    with pytest.raises(ValueError, match=r"got \[31, "):
        capacity.decoded_bits(J[1:], 0.0)
    with pytest.raises(ValueError, match=r"got \[256\]"):
        capacity.decoded_bits(J[0], 0.0)
    with pytest.raises(ValueError, match="draws must be a whole number from 1"):
        capacity.decoded_bits(J, 0.0, draws=0)
    with pytest.raises(ValueError, match="two at least, got 1"):
        capacity.smallest_distance(J[:1])


def test_points_on_a_line_are_chosen_from_its_ends_inwards() -> None:
    line = np.array([0.0, 0.1, 1.0, 2.0, 2.9, 4.0])[:, None] - 0.5
    alphabet = capacity.greedy_alphabet(line, 5)
    np.testing.assert_array_equal(alphabet.chosen, [5, 0, 3, 2, 4])
    np.testing.assert_allclose(alphabet.distance, [np.inf, 4.0, 2.0, 1.0, 0.9])


def test_eight_points_on_a_circle_are_as_far_apart_as_can_be() -> None:
    angle = 2.0 * np.pi * np.arange(64) / 64
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    alphabet = capacity.greedy_alphabet(circle, 8)
    # Neighbours of a regular octagon, root mean square over two coordinates.
    np.testing.assert_allclose(alphabet.distance[-1], 2.0 * np.sin(np.pi / 8) / np.sqrt(2.0))
    np.testing.assert_allclose(capacity.smallest_distance(circle[alphabet.chosen]), alphabet.distance[-1])
    with pytest.raises(ValueError, match="1 to 64 waveforms, got 65"):
        capacity.greedy_alphabet(circle, 65)


def test_candidates_keep_their_bound_and_differ_in_how_fast_they_are() -> None:
    n, width = 9, 0.2
    kernel = gm.MemoryKernel(np.zeros(BINS), np.zeros(n), width, np.zeros((n, BINS)), np.zeros((n, BINS)), 1e-3, 0.05)
    amplitudes = capacity.candidates(kernel, 200)
    values = np.asarray(bumps(amplitudes, width).shear(np.linspace(0.0, 1.0, 20001)))  # has the kinks, at 0.1 k
    assert 0.99 < np.abs(values).max() <= 1.0 + 1e-5  # between the points of v that were looked at
    changes = np.count_nonzero(np.diff(amplitudes), axis=1)
    assert changes.min() == 0
    assert changes.max() > 5
