"""How many bits a pack holds: what a reader gets from it at least, and what a linear memory could carry at most.

A simulation repeats itself to nine digits, so that a capacity is one at a stated noise: normal, independent in each of
the 256 bins of p_sig, of one standard deviation. Between the two bounds lies what better waveforms or readers may add.
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
    """Information that a reader got from words.

    Attributes:
        bits: sum over the bits of a word of what is known of each by itself.
        error: standard error, by bootstrap over the words. It is 0 where every word was read right.
    """

    bits: float
    error: float


class Alphabet(NamedTuple):
    """Waveforms chosen one by one, each as far from all before as can be.

    Attributes:
        chosen: their numbers among the candidates, in the order of choice, [S].
        distance: between the two nearest recalls of the first 1, 2, ... S chosen, [S]: root mean square over bins,
            in the unit of the recalls; infinite for the first.
    """

    chosen: np.ndarray
    distance: np.ndarray


def decoded_bits(signals: jax.typing.ArrayLike, noise: float, *, draws: int = 4, seed: int = 0) -> Decoded:
    """Information that the linear decoder reads from noisy recalls of words it has not seen: a lower bound.

    The decoder learns from other words, with noise of their own (`readers.linear_decoder`). What the answers say of
    each bit is added up: no more than they say of the word, since the bits stored are independent. S words bias the
    sum upwards by 1 / (2 S ln 2) a bit, which matters only where hardly anything is read.

    Args:
        signals: p_sig of all words of L bits, in order, [2^L, 256].
        noise: standard deviation in each bin, in the unit of the signals.
        draws: of the noise.
        seed: of the noise and of the decoder's splits.

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
    """Information in bits, summed over bits, [B], for B weights of the words [B, S].

    Args:
        truth: bits stored, [S, L].
        read: shares of draws in which a bit was read as 1, [S, L].
        weight: how often each word counts, [B, S].
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
    """Bits that each singular waveform of a linear memory can carry at most, [n], falling: an upper bound in all.

    Shannon's capacity of parallel channels, 1/2 log2(1 + p_i 256 s_i^2 / noise^2), with the power shared out by
    water-filling. |I| <= 1 implies a mean of I^2 below 1, not the other way round: the bound is generous. It holds
    for the odd part of the kernel and for waveforms made up of its basis, and for nothing else.

    Args:
        kernel: of n basis waveforms; or of n for each of several channels of strain.
        noise: standard deviation in each bin, in E.
        power: largest mean of I^2 over u, of all channels of strain together.

    Raises:
        ValueError: if noise or power is not above 0.
    """
    if not (noise > 0.0 and power > 0.0):
        raise ValueError(f"noise and power must be above 0, got {noise:g} and {power:g}")
    ratio = BINS * (kernel.singular_values() / noise) ** 2
    return np.asarray(0.5 * np.log2(1.0 + water_filled(ratio, power) * ratio))


def water_filled(ratio: np.ndarray, power: float) -> np.ndarray:
    """The power of each channel that carries most in all, [n], for falling ratios of signal to noise at unit power."""
    with np.errstate(divide="ignore"):
        bottom = 1.0 / ratio
    level = (power + np.cumsum(bottom)) / np.arange(1, len(bottom) + 1)  # of the water, if so many channels are wet
    wet = np.flatnonzero(level > bottom)
    return np.asarray(np.maximum(0.0, level[wet[-1]] - bottom)) if wet.size else np.zeros(len(bottom))


def candidates(kernel: MemoryKernel, count: int, *, seed: int = 0) -> np.ndarray:
    """Amplitudes of random waveforms with |I| <= 1 on the kernel's bumps, [count, n], for an alphabet.

    Levels of -1, 0 and 1 are held over runs of bumps, long in some waveforms and short in others: of the same height,
    slow waveforms are recalled best and fast ones differ most.
    """
    n, generator = kernel.centres.size, np.random.default_rng(seed)
    level = generator.choice([-1.0, 0.0, 1.0], (count, n))
    anew = generator.random((count, n)) < generator.random((count, 1))
    held = np.take_along_axis(level, np.maximum.accumulate(np.where(anew, np.arange(n), 0), axis=1), axis=1)
    return bounded(held, kernel.width)


def greedy_alphabet(recalls: jax.typing.ArrayLike, size: int) -> Alphabet:
    """Choose waveforms by their recalls: the largest first, then always the farthest from all chosen so far.

    The smallest distance is at least half of the best that `size` of these candidates could have.

    Args:
        recalls: p_sig of the candidates, [count, 256], in any unit.
        size: S, how many to choose.

    Raises:
        ValueError: if there are not as many candidates, or not all are finite.
    """
    values, size = _finite(recalls), require_whole("size", size)
    if not 1 <= size <= len(values):
        raise ValueError(f"an alphabet of {len(values)} candidates has 1 to {len(values)} waveforms, got {size}")
    power = np.mean(values**2, axis=1)
    chosen, distance = [int(np.argmax(power))], [np.inf]
    nearest = np.full(len(values), np.inf)  # mean square to the nearest that is chosen
    while len(chosen) < size:
        last = chosen[-1]
        nearest = np.minimum(nearest, power + power[last] - 2.0 * values @ values[last] / values.shape[1])
        chosen.append(int(np.argmax(nearest)))
        distance.append(float(np.sqrt(max(0.0, nearest[chosen[-1]]))))
    return Alphabet(np.asarray(chosen), np.asarray(distance))


def smallest_distance(recalls: jax.typing.ArrayLike) -> float:
    """Distance of the two nearest recalls [S, 256], as in `Alphabet`.

    Raises:
        ValueError: if there are not two.
    """
    values = np.asarray(recalls, dtype=float)
    if len(values) < 2:
        raise ValueError(f"the nearest of several recalls: there must be two at least, got {len(values)}")
    pairs = (np.mean((values[row + 1 :] - values[row]) ** 2, axis=1).min() for row in range(len(values) - 1))
    return float(np.sqrt(min(pairs)))
