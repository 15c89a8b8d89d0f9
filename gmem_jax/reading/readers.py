"""Baseline readers of binary words, which know more than the paper's net, and scores of any reader.

Signals and templates are [S, 256], row k holding word number k; answers are numbers of words, [S].
"""

from dataclasses import dataclass

import jax
import numpy as np

from gmem_jax.experiment import analysis
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.signals import LONGEST_WORD, Signals, bin_average, word_bits, words
from gmem_jax.files.measures import read_stress
from gmem_jax.physics.numbers import plural

FOLDS = 16  # parts into which the words are split for the linear decoder; fewer words are left out one by one
PENALTIES = np.logspace(-6, 1, 15)  # tried for the ridge, in units of the largest singular value squared


@dataclass(frozen=True)
class Stored:
    """The recalled words of one pack.

    Attributes:
        bits: length L of the words.
        background: how the background was subtracted.
        signals: p_sig of all words, [2^L, 256], in E.
        templates: J of all words, [2^L, 256].
    """

    bits: int
    background: str
    signals: np.ndarray
    templates: np.ndarray


def stored_words(recall: Recall, target: Signals | None = None) -> Stored:
    """The words of a recall, with the background SUB2-BL if it has a second readout, else SUB0.

    Args:
        recall: the recall of the words themselves, or of waveforms that were designed for them.
        target: the words, if the waveforms were designed for them.

    Raises:
        ValueError: if its signals are not all the words of one length, in order, of the default pad and width; or it
            has several reads or channels.
    """
    if len(recall.reads) * len(recall.channels) > 1:
        raise ValueError(
            f"the recall has reads {', '.join(recall.reads)} and channels {', '.join(recall.channels)}: choose one of "
            f"each, as recall.at({recall.reads[-1]!r}, {recall.channels[-1]!r})"
        )
    templates = np.asarray(recall.J if target is None else bin_average(target))
    bits = len(templates).bit_length() - 1
    expected = np.asarray(bin_average(words(bits))) if 1 <= bits <= LONGEST_WORD else np.zeros(0)
    # J of a word is of order u_b / pi; 1e-4 of this is far above round-off, and far below the distance of two words.
    if expected.shape != templates.shape or not np.allclose(templates, expected, atol=1e-4 / (np.pi * (bits + 4))):
        raise ValueError(f"the recall holds {plural(len(templates), 'signal')}, not the words of one length")
    if recall.second_readout is None:
        return Stored(bits, "sub0", np.asarray(recall.p_sig), templates)
    first, second = (read_stress(recall, read) for read in (recall.reads[0], recall.second_readout))
    return Stored(bits, "sub2-bl", np.asarray(analysis.subtract("sub2-bl", first, second)), templates)


def nearest_template(signals: jax.typing.ArrayLike, templates: jax.typing.ArrayLike) -> np.ndarray:
    """The word whose J correlates best with each signal, A.B / (|A| |B|); this reader knows nothing of the pack."""

    def unit(rows: jax.typing.ArrayLike) -> np.ndarray:
        array = np.asarray(rows)
        return np.asarray(array / np.linalg.norm(array, axis=1, keepdims=True))

    return np.asarray(np.argmax(unit(signals) @ unit(templates).T, axis=1))


def linear_decoder(signals: jax.typing.ArrayLike, *, seed: int = 0) -> np.ndarray:
    """Words read by ridge regression of each bit, which is fitted on other words of the same pack.

    The words are split at random into `FOLDS` parts (of one word each if there are no more). Each part is read by a
    decoder that has seen the other parts only. Its penalty was chosen by leaving out each of *their* words in turn.
    There is no constant term: the sign of the recall is the bit, and left-out words would shift a constant against
    themselves. With few words a decoder can be worse than the template, since it must learn from them what J looks
    like.

    Args:
        signals: p_sig of all words, [2^L, 256], in any unit.
        seed: random seed of the split.
    """
    values = np.asarray(signals, dtype=float)
    bits = len(values).bit_length() - 1
    target = 2.0 * word_bits(bits) - 1.0
    order = np.random.default_rng(seed).permutation(len(values))
    read = np.zeros(target.shape, dtype=int)
    for part in np.array_split(order, min(FOLDS, len(values))):
        others = np.setdiff1d(order, part)
        read[part] = values[part] @ _ridge(values[others], target[others]) > 0.0
    return np.asarray(read @ (1 << np.arange(bits)[::-1]))


def _ridge(values: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Weights [256, bits] of ridge regression with the penalty of least mean square error on left-out rows."""
    left, size, right = np.linalg.svd(values, full_matrices=False)
    along = left.T @ target
    inverse = size / (size**2 + PENALTIES[:, None] * size[0] ** 2)  # [penalties, rank]
    leverage = np.einsum("nr,pr->pn", left**2, inverse * size)
    fitted = np.einsum("nr,pr,rb->pnb", left, inverse * size, along)
    errors = np.mean(((target - fitted) / (1.0 - leverage)[..., None]) ** 2, axis=(1, 2))
    return np.asarray(right.T @ (inverse[np.argmin(errors)][:, None] * along))


def confusion(read: jax.typing.ArrayLike, count: int) -> np.ndarray:
    """How often word k (row) was read as word j (column), [count, count], from one or several readings [..., count]."""
    answers = np.asarray(read).reshape(-1, count)
    table = np.zeros((count, count), dtype=int)
    np.add.at(table, (np.tile(np.arange(count), len(answers)), answers.ravel()), 1)
    return table


def bit_errors(read: jax.typing.ArrayLike) -> np.ndarray:
    """Error rate of each bit, most significant first, [L], from one or several readings [..., 2^L]."""
    answers = np.asarray(read)
    bits = word_bits(answers.shape[-1].bit_length() - 1)
    return np.asarray(np.mean(bits[answers] != bits, axis=tuple(range(answers.ndim))))


def information(table: np.ndarray) -> dict[str, float]:
    """Mutual information in bits between words stored (equally likely) and words read, in three ways.

    "plug_in" is the plug-in estimate. With one reading of each word it is only the entropy of the answers: a reader
    that is always wrong and always different scores L bits. It is biased upwards, by about (S - 1)^2 / (2 n ln 2) for
    n readings as long as that is small, and so is rather an upper bound. Several nets that read one recall add
    readings, but no new noise of the pack. One recall of each word supports only smaller estimates. "bitwise" sums the
    information of each bit by itself, for which the S words are S samples (bias 1 / (2 S ln 2) for each bit). It is
    below that of the whole words, because the bits stored are independent. "fano" is the least that any channel with
    this rate of errors carries (Fano's inequality).

    Args:
        table: a `confusion` table, [S, S].
    """
    count = len(table)
    bits = word_bits(count.bit_length() - 1)
    each = [_mutual(np.array([[_count(table, b, i, j) for j in (0, 1)] for i in (0, 1)])) for b in bits.T]
    wrong = 1.0 - float(np.trace(table)) / float(table.sum())
    doubt = _entropy(np.array([wrong, 1.0 - wrong])) + (wrong * np.log2(count - 1) if wrong > 0.0 else 0.0)
    fano = max(0.0, float(np.log2(count) - doubt))
    return {"plug_in": _mutual(table), "bitwise": float(sum(each)), "fano": fano}


def _count(table: np.ndarray, bit: np.ndarray, stored: int, read: int) -> int:
    """How often a bit that was `stored` was `read`."""
    return int(table[np.ix_(bit == stored, bit == read)].sum())


def _entropy(share: np.ndarray) -> float:
    positive = share[share > 0.0]
    return float(-np.sum(positive * np.log2(positive)))


def _mutual(table: np.ndarray) -> float:
    """Plug-in mutual information of a table of counts, in bits."""
    share = table / table.sum()
    return _entropy(share.sum(axis=0)) + _entropy(share.sum(axis=1)) - _entropy(share.ravel())
