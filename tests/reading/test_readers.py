"""Baseline readers and scores, on made-up recalls whose answers are known."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from gmem_jax.experiment.protocols import memory_protocol
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.signals import bin_average, six_signals, word_bits, words
from gmem_jax.reading import readers
from gmem_jax.simulation.sample import MEASURED, Sample

J = {bits: np.asarray(bin_average(words(bits))) for bits in (1, 3, 5)}


def noisy(bits: int, noise: float, seed: int = 0) -> np.ndarray:
    """Words as a pack might recall them: a gain, a smooth distortion, noise in units of <|J|>."""
    draws = np.random.default_rng(seed).normal(size=J[bits].shape)
    return 2e-7 * J[bits] * np.linspace(0.8, 1.2, 256) + noise * 2e-7 * np.abs(J[bits]).mean() * draws


@pytest.mark.parametrize("bits", [1, 3, 5])
def test_both_baselines_read_mildly_noisy_words(bits: int) -> None:
    truth = np.arange(2**bits)
    assert np.array_equal(readers.nearest_template(noisy(bits, 0.5), J[bits]), truth)
    assert np.array_equal(readers.linear_decoder(noisy(bits, 0.5)), truth)


def test_the_nearest_template_is_the_likeliest_word_and_not_the_row_number() -> None:
    order = np.random.default_rng(1).permutation(32)
    assert np.array_equal(readers.nearest_template(noisy(5, 0.5)[order], J[5]), order)


def test_the_nearest_template_is_found_whatever_its_size() -> None:
    sizes = np.geomspace(0.01, 100.0, 8)[:, None]
    truth = np.arange(8)
    assert np.array_equal(readers.nearest_template(noisy(3, 0.5), sizes * J[3]), truth)
    assert np.array_equal(readers.nearest_template(sizes * noisy(3, 0.5), J[3]), truth)


def test_the_linear_decoder_learns_what_the_pack_does_to_the_words() -> None:
    """A pack that mirrors u: templates are lost, a decoder fitted on other words is not."""
    mirrored = noisy(5, 0.2)[:, ::-1]
    assert np.mean(readers.nearest_template(mirrored, J[5]) == np.arange(32)) < 0.5
    assert np.mean(readers.linear_decoder(mirrored) == np.arange(32)) > 0.9


def test_the_linear_decoder_never_sees_the_word_it_reads() -> None:
    """Signals that are pure noise, as many as can be learnt by heart: other words teach nothing about this one."""
    rates = [
        readers.bit_errors(readers.linear_decoder(np.random.default_rng(seed).normal(size=(32, 256))))
        for seed in range(8)
    ]
    # 8 * 32 * 5 bits, half of them wrong by chance: SD 0.014, and 0.3 would be a leak.
    assert 0.44 < np.mean(rates) < 0.56


def test_a_left_out_word_has_no_influence_on_the_decoder_that_reads_it() -> None:
    """Its decoder comes from the others alone: turn its sign, and the answer turns to the complement."""
    signals = noisy(3, 0.1)  # one word left out at a time
    turned = signals.copy()
    turned[5] *= -1.0
    assert readers.linear_decoder(signals)[5] == 5
    assert readers.linear_decoder(turned)[5] == 7 - 5


def test_the_ridge_penalty_is_the_best_on_rows_really_left_out() -> None:
    draws = np.random.default_rng(3)
    values = draws.normal(size=(12, 5))
    target = np.sign(values @ draws.normal(size=(5, 2)) + draws.normal(size=(12, 2)))
    penalties = readers.PENALTIES * np.linalg.norm(values, 2) ** 2

    def solved(rows: np.ndarray, penalty: float) -> np.ndarray:
        return np.linalg.solve(values[rows].T @ values[rows] + penalty * np.eye(5), values[rows].T @ target[rows])

    def error(penalty: float) -> float:
        gaps = [target[k] - values[k] @ solved(np.delete(np.arange(12), k), penalty) for k in range(12)]
        return float(np.mean(np.square(gaps)))

    best = penalties[np.argmin([error(penalty) for penalty in penalties])]
    assert penalties[0] < best < penalties[-1]
    np.testing.assert_allclose(readers._ridge(values, target), solved(np.arange(12), best), rtol=1e-10)


def test_confusion_counts_rows_of_stored_and_columns_of_read_words() -> None:
    table = readers.confusion([[0, 1, 2, 2], [0, 1, 2, 3]], 4)
    np.testing.assert_array_equal(table, [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 1, 1]])


def test_bit_errors_count_from_the_most_significant_bit() -> None:
    truth = np.arange(8)
    assert readers.bit_errors(truth).tolist() == [0.0, 0.0, 0.0]
    assert readers.bit_errors(truth ^ 0b100).tolist() == [1.0, 0.0, 0.0]
    assert readers.bit_errors(np.stack([truth, truth ^ 0b001])).tolist() == [0.0, 0.0, 0.5]


def test_perfect_reading_carries_all_bits_by_every_estimate() -> None:
    found = readers.information(readers.confusion(np.arange(32), 32))
    assert found == pytest.approx({"plug_in": 5.0, "bitwise": 5.0, "fano": 5.0}, abs=1e-12)


def test_a_constant_answer_carries_nothing() -> None:
    found = readers.information(readers.confusion(np.zeros(8, dtype=int), 8))
    assert found == pytest.approx({"plug_in": 0.0, "bitwise": 0.0, "fano": 0.0}, abs=1e-12)


def test_one_lost_bit_costs_one_bit() -> None:
    both = readers.confusion([np.arange(8) & 0b110, np.arange(8) | 0b001], 8)  # the last bit is a coin
    found = readers.information(both)
    assert found["plug_in"] == pytest.approx(2.0, abs=1e-12)
    assert found["bitwise"] == pytest.approx(2.0, abs=1e-12)
    # Fano: half of the words wrong, log2(8) - 1 - log2(7) / 2.
    assert found["fano"] == pytest.approx(2.0 - 0.5 * np.log2(7.0), abs=1e-12)


def test_the_plug_in_estimate_of_single_readings_is_blind_to_wrong_answers() -> None:
    """What its docstring warns of."""
    wrong = readers.confusion(np.roll(np.arange(8), 3), 8)
    assert readers.information(wrong)["plug_in"] == pytest.approx(3.0)
    assert readers.information(wrong)["fano"] < 0.2


def recall(bits: int, second: bool) -> Recall:
    """A recall of words whose readout is -J, and whose second one a straight line."""
    signals = jnp.asarray(J[bits])
    first = jnp.concatenate([jnp.zeros((1, 256)), -signals])

    def sample(p_xy: jnp.ndarray) -> Sample:
        pressure = jnp.zeros((256, 3, len(p_xy))).at[:, 0].set(jnp.flip(p_xy.T, axis=0))
        empty = jnp.zeros((256, len(p_xy)))
        return Sample(**{name: empty for name in MEASURED} | {"pressure": pressure})

    stages = {"readout": sample(first)}
    if second:
        stages["readout-2"] = sample(jnp.broadcast_to(jnp.linspace(1.0, 2.0, 256), first.shape))
    rest = {name: jnp.zeros(()) for name in Recall.__dataclass_fields__}
    protocol = memory_protocol(0.2, 0.2, 2.0, second_readout=second)
    return Recall(
        **rest
        | {
            "J": signals,
            "p_sig": signals,
            "stages": stages,
            "protocol": protocol,
            "reads": ("readout",),
            "channels": ("xy",),
            "record": "{}",
        }
    )


def test_words_are_read_by_sub2_bl_where_there_is_a_second_readout() -> None:
    for second, background in ((True, "sub2-bl"), (False, "sub0")):
        stored = readers.stored_words(recall(3, second))
        assert (stored.bits, stored.background) == (3, background)
        np.testing.assert_allclose(stored.signals, J[3], atol=1e-14)


def test_signals_that_are_not_words_are_refused() -> None:
    one = recall(3, False)
    six = replace(one, J=bin_average(six_signals()))
    shuffled = replace(one, J=one.J[::-1])
    for wrong in (six, shuffled, replace(one, J=one.J[:7])):
        with pytest.raises(ValueError, match="not the words of one length"):
            readers.stored_words(wrong)


def test_numbers_of_words_and_their_bits_agree() -> None:
    np.testing.assert_array_equal(word_bits(5) @ [16, 8, 4, 2, 1], np.arange(32))
