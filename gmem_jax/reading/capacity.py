"""Bounds on the bits that a pack stores: what a reader decodes at least, and what a linear memory carries at most.

A simulation is reproducible to nine digits, so a capacity needs a stated noise: here normal, independent in each of the
256 bins of p_sig, with one standard deviation. Better waveforms or readers may add bits up to the upper bound.
"""

from typing import NamedTuple

import jax
import numpy as np

from gmem_jax.design.kernel import KernelMatrix, MemoryKernel
from gmem_jax.design.waveforms import bounded
from gmem_jax.experiment.signals import word_bits
from gmem_jax.physics.numbers import require_whole
from gmem_jax.reading.readers import linear_decoder
from gmem_jax.simulation.stage import BINS

BOOTSTRAP = 400  # samples of the words for an error bar


class Decoded(NamedTuple):
    """The information that a reader decoded from words.

    Attributes:
        bits: mutual information of each bit stored and read, summed over the bits of a word, in bits.
        error: standard error of this, by bootstrap over the words; 0 if every word was read right.
    """

    bits: float
    error: float


class Alphabet(NamedTuple):
    """Waveforms chosen one by one, each with a recall as far as possible from those chosen before.

    Attributes:
        chosen: numbers of the waveforms among the candidates, from 0, in the order of choice, [S].
        distance: smallest distance between the recalls of the first 1, 2, ..., S of them, [S]: root mean square over
            the bins, in the unit of the recalls; infinite for the first.
    """

    chosen: np.ndarray
    distance: np.ndarray


def decoded_bits(signals: jax.typing.ArrayLike, noise: float, *, draws: int = 4, seed: int = 0) -> Decoded:
    """Information that a linear decoder reads from noisy recalls of words: a lower bound on the bits stored.

    The decoder is trained on other words than it reads, with other noise (`gmem_jax.reading.readers.linear_decoder`).
    The information on each bit is summed, which is at most that on the word, since the bits stored are independent.
    With S words the sum is biased upwards by 1 / (2 S ln 2) a bit, which matters only if hardly anything is read.

    Args:
        signals: p_sig of all words of L bits, in order, [2^L, 256].
        noise: standard deviation of the noise in each bin, in the unit of the signals.
        draws: number of draws of the noise.
        seed: random seed of the noise and of the splits into training and reading.

    Raises:
        ValueError: if these are not 2^L signals, or not finite, the noise is no number from 0, or there are no draws.
    """
    values = _finite(signals)
    bits = len(values).bit_length() - 1
    if values.ndim != 2 or len(values) != 2**bits or not bits:
        raise ValueError(f"all words of one length are 2, 4, 8, ... signals [2^L, 256], got {list(values.shape)}")
    if not 0.0 <= noise < np.inf:
        raise ValueError(f"noise must be a number from 0, got {noise:g}")
    draws = require_whole("draws", draws, 1)
    truth, generator = word_bits(bits), np.random.default_rng(seed)
    read = np.zeros(truth.shape)
    for draw in range(draws):
        noisy = values + generator.normal(0.0, noise, values.shape)
        read += truth[linear_decoder(noisy, seed=seed + draw)] / draws
    again = generator.multinomial(len(values), np.full(len(values), 1.0 / len(values)), BOOTSTRAP)
    found = _bitwise(truth, read, np.concatenate([np.ones_like(again[:1]), again]))
    return Decoded(float(found[0]), float(found[1:].std(ddof=1)))


def _finite(recalls: jax.typing.ArrayLike) -> np.ndarray:
    values = np.asarray(recalls, dtype=float)
    if not np.all(np.isfinite(values)):
        raise ValueError("recalls must be finite numbers: leave out those of broken runs")
    return values


def _bitwise(truth: np.ndarray, read: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Mutual information of each bit stored and read, summed over the L bits of a word, in bits, [B].

    Args:
        truth: bits stored, [S, L].
        read: fractions of draws in which a bit was read as 1, [S, L].
        weight: B sets of weights of the words, [B, S].
    """
    joint = np.stack([weight @ (one * other) for one in (1 - truth, truth) for other in (1.0 - read, read)])
    counted = joint.reshape(2, 2, *joint.shape[1:])  # stored, read, B, L
    stored = counted.sum(axis=1, keepdims=True)
    share = 0.5 * counted / np.where(stored > 0.0, stored, 1.0)  # 0 and 1 are stored equally often in any sample

    def entropy(part: np.ndarray) -> np.ndarray:
        return np.asarray(-(part * np.log2(np.where(part > 0.0, part, 1.0))).reshape(-1, *joint.shape[1:]).sum(axis=0))

    each = entropy(share.sum(axis=0)) + entropy(share.sum(axis=1)) - entropy(share)
    return np.asarray(each.sum(axis=-1))


def channels(kernel: MemoryKernel | KernelMatrix, noise: float, power: float = 1.0) -> np.ndarray:
    """Largest number of bits that each singular waveform of a linear memory carries; their sum is an upper bound.

    It is Shannon's capacity of parallel channels, 1/2 log2(1 + p_i 256 s_i^2 / noise^2), for singular values s_i, with
    the power p_i shared out by water-filling. The bound is generous: |I| <= 1 implies a mean of I^2 below 1, but not
    the reverse. It holds only for the odd part of the kernel, and for waveforms that are sums of its bumps.

    Args:
        kernel: a kernel of n bumps, or the matrix of kernels of several channels of strain.
        noise: standard deviation of the noise in each bin, in E.
        power: largest mean of I^2 over u, summed over channels of strain.

    Returns:
        Bits, falling, [n]; [C n] for C channels of strain.

    Raises:
        ValueError: if noise or power is not above 0.
    """
    if not (noise > 0.0 and power > 0.0):
        raise ValueError(f"noise and power must be above 0, got {noise:g} and {power:g}")
    ratio = BINS * (kernel.singular_values() / noise) ** 2
    return np.asarray(0.5 * np.log2(1.0 + water_filled(ratio, power) * ratio))


def water_filled(ratio: np.ndarray, power: float) -> np.ndarray:
    """The powers of parallel channels that give the largest total capacity (water-filling).

    Args:
        ratio: ratios of signal to noise at unit power, falling, [n].
        power: sum of the powers.

    Returns:
        The power of each channel, [n].
    """
    with np.errstate(divide="ignore"):
        bottom = 1.0 / ratio
    level = (power + np.cumsum(bottom)) / np.arange(1, len(bottom) + 1)  # of water in the first 1, 2, ... channels
    wet = np.flatnonzero(level > bottom)
    return np.asarray(np.maximum(0.0, level[wet[-1]] - bottom)) if wet.size else np.zeros(len(bottom))


def candidates(kernel: MemoryKernel, count: int, *, seed: int = 0) -> np.ndarray:
    """Random waveforms with |I| <= 1, from which `greedy_alphabet` chooses.

    Levels of -1, 0 and 1 are held over runs of bumps, long in some waveforms and short in others: of equal height, slow
    waveforms have the largest recalls and fast ones differ most.

    Args:
        kernel: the kernel whose n bumps make the waveforms.
        count: number of waveforms.
        seed: random seed.

    Returns:
        Amplitudes of the bumps, [count, n].
    """
    n, generator = kernel.centres.size, np.random.default_rng(seed)
    level = generator.choice([-1.0, 0.0, 1.0], (count, n))
    anew = generator.random((count, n)) < generator.random((count, 1))
    held = np.take_along_axis(level, np.maximum.accumulate(np.where(anew, np.arange(n), 0), axis=1), axis=1)
    return bounded(held, kernel.width)


def greedy_alphabet(recalls: jax.typing.ArrayLike, size: int) -> Alphabet:
    """Choose waveforms by their recalls: the largest first, then always the one farthest from all chosen so far.

    The smallest distance between the chosen is at least half of the largest that any choice could have.

    Args:
        recalls: p_sig of the candidates, [count, 256], in any unit.
        size: number S of waveforms to choose.

    Raises:
        ValueError: if there are fewer candidates, or a recall is not finite.
    """
    values, size = _finite(recalls), require_whole("size", size)
    if not 1 <= size <= len(values):
        raise ValueError(f"an alphabet of {len(values)} candidates has 1 to {len(values)} waveforms, got {size}")
    power = np.mean(values**2, axis=1)
    chosen, distance = [int(np.argmax(power))], [np.inf]
    nearest = np.full(len(values), np.inf)  # mean square distance to the nearest chosen one
    while len(chosen) < size:
        last = chosen[-1]
        nearest = np.minimum(nearest, power + power[last] - 2.0 * values @ values[last] / values.shape[1])
        chosen.append(int(np.argmax(nearest)))
        distance.append(float(np.sqrt(max(0.0, nearest[chosen[-1]]))))
    return Alphabet(np.asarray(chosen), np.asarray(distance))


def smallest_distance(recalls: jax.typing.ArrayLike) -> float:
    """Smallest distance between two of several recalls: root mean square over the bins, in the unit of the recalls.

    Args:
        recalls: p_sig, [S, 256], in any unit.

    Raises:
        ValueError: if there are fewer than two.
    """
    values = np.asarray(recalls, dtype=float)
    if len(values) < 2:
        raise ValueError(f"the nearest of several recalls: there must be two at least, got {len(values)}")
    pairs = (np.mean((values[row + 1 :] - values[row]) ** 2, axis=1).min() for row in range(len(values) - 1))
    return float(np.sqrt(min(pairs)))
