"""From wall pressures to the recalled signal, its gain and its fidelity (paper, Sec. II)."""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.numbers import said
from gmem_jax.physics.pytree import Scalar, traced
from gmem_jax.physics.rules import usual_rules

MEASURES = ("gain", "fidelity", "windowed_gain", "windowed_fidelity")
"""Measures of every recall: G and F of the set, and the same two after a running mean over the ringing period."""
Background = Literal["sub0", "sub2", "sub2-bl"]
BACKGROUNDS: tuple[Background, ...] = get_args(Background)
"""Backgrounds: readout of the zero signal; second readout of the same replica; that and a line (see `Experiment`)."""


def recalled(pressure: jax.Array) -> jax.Array:
    """p_xy = p_x - p_y of a readout in ascending u, [B, bins], from its samples [bins, 3, B] (u descending)."""
    return jnp.flip(pressure[:, 0] - pressure[:, 1], axis=0).T


def subtract(background: str, first: jax.Array, second: jax.Array | None = None) -> jax.Array:
    """p_sig of every signal, [S, bins].

    Args:
        background: one of `BACKGROUNDS`.
        first: p_xy of the readout, replica 0 the zero signal, [S + 1, bins].
        second: p_xy of the second readout, for "sub2" and "sub2-bl".

    Raises:
        ValueError: for an unknown background, or one whose second readout is missing.
    """
    if background == "sub0":
        return -(first[1:] - first[0])
    if background not in BACKGROUNDS:
        raise ValueError(f"background must be one of {', '.join(BACKGROUNDS)}; got {background!r}")
    if second is None:
        raise ValueError(f"background {background!r} needs a run with a second readout")
    signal = -(first - second)[1:]
    if background == "sub2":
        return signal
    ramp = jnp.linspace(0.0, 1.0, signal.shape[-1])
    return signal - (signal[:, :1] * (1.0 - ramp) + signal[:, -1:] * ramp)


class Match(NamedTuple):
    """How well recalled signals follow their integrals, one number each for the set.

    Attributes:
        gain: G = J.p_sig / (E delta0 gamma0 J.J).
        fidelity: F = 1 - sqrt(|p_sig - G E delta0 gamma0 J|^2 / p_sig.p_sig).
    """

    gain: jax.Array
    fidelity: jax.Array


@jax.jit
def compare(signal: jax.Array, integral: jax.Array, scale: Scalar, window: Scalar | None = None) -> Match:
    """Gain and fidelity of a set of signals (paper, Sec. II).

    Args:
        signal: p_sig, [S, bins], in E.
        integral: J, bin-averaged like p_sig, [S, bins].
        scale: delta0 gamma0; scalar or [S, 1].
        window: width in u of a running mean that both series take first; T_1 / t0 removes the ringing.
    """
    if window is not None:
        signal, integral = (running_mean(series, window * series.shape[-1]) for series in (signal, integral))
    template = scale * integral
    gain = jnp.sum(template * signal) / jnp.sum(template * template)
    miss = jnp.sum((signal - gain * template) ** 2)
    return Match(gain, 1.0 - jnp.sqrt(miss / jnp.sum(signal * signal)))


def compare_channels(signal: jax.Array, integral: jax.Array, scale: Scalar, window: Scalar | None = None) -> Match:
    """Gain and fidelity of signals that were stored on several channels at once.

    Args:
        signal: p_sig of each channel, [C, S, bins], in E.
        integral: J of the waveforms on each channel, [C, S, bins]; a channel is silent if its J are all zero.
        scale: delta0 gamma0; scalar or [S, 1].
        window: as in `compare`.

    Returns:
        The gain matrix [C, C], which minimises |p_sig_c - sum_d G_cd E delta0 gamma0 J_d|^2. Off its diagonal is the
        cross-talk: G_cd says how much of the waveform on channel d comes back on channel c. And the fidelity [C] with
        which each channel follows its own J; cross-talk counts as error. For a silent channel its column of the matrix
        and its fidelity are NaN.
    """
    if window is not None:
        signal, integral = (running_mean(series, window * series.shape[-1]) for series in (signal, integral))
    channels = signal.shape[0]
    template = (scale * integral).reshape(channels, -1)
    series = signal.reshape(channels, -1)
    products = template @ template.T
    silent = jnp.diagonal(products) == 0.0
    gain = jnp.linalg.solve(products + jnp.diag(jnp.where(silent, 1.0, 0.0)), template @ series.T).T
    own = jnp.diagonal(gain)[:, None] * template
    miss = jnp.sum((series - own) ** 2, axis=-1) / jnp.sum(series * series, axis=-1)
    return Match(jnp.where(silent, jnp.nan, gain), jnp.where(silent, jnp.nan, 1.0 - jnp.sqrt(miss)))


@jax.jit
def each(signal: jax.Array, integral: jax.Array, scale: Scalar, window: Scalar | None = None) -> Match:
    """Gain and fidelity of each signal by itself, [S]: each has a gain of its own. NaN where p_sig or J is zero.

    Args:
        signal: p_sig, [S, bins], in E.
        integral: J, [S, bins].
        scale: delta0 gamma0; scalar or [S, 1].
        window: as in `compare`.
    """

    def alone(p_sig: jax.Array, own: jax.Array, scale: jax.Array) -> Match:
        match: Match = compare(p_sig[None], own[None], scale, window)
        return match

    return jax.vmap(alone)(signal, integral, jnp.broadcast_to(scale, (len(signal), 1)))


def errors_over_signals(signal: np.ndarray, integral: np.ndarray, scale: np.ndarray | float) -> tuple[float, float]:
    """Standard errors of gain and fidelity from their spread over the S signals of a set (jackknife); NaN if S = 1.

    They say how much gain and fidelity depend on the choice of signals in this pack, and nothing of other packs. Words
    are sums of few bits, so that their errors are not independent.

    Args:
        signal: p_sig, [S, bins], in E.
        integral: J, [S, bins].
        scale: delta0 gamma0; scalar or [S, 1].
    """
    count, template = len(signal), scale * integral
    if count < 2:
        return math.nan, math.nan
    overlap, power, own = (
        np.sum(product) - np.sum(product, axis=1)
        for product in (template * signal, template * template, signal * signal)
    )
    without = np.stack([overlap / power, 1.0 - np.sqrt(np.maximum(0.0, 1.0 - overlap**2 / (power * own)))])
    gain, fidelity = np.sqrt((count - 1) * np.var(without, axis=1))
    return float(gain), float(fidelity)


def backgrounds(
    first: jax.Array, second: jax.Array, integral: jax.Array, scale: Scalar, window: Scalar | None = None
) -> dict[str, Match]:
    """Gain and fidelity of the set with each of `BACKGROUNDS`, from a run with a second readout.

    Args:
        first: p_xy of the readout, replica 0 the zero signal, [S + 1, bins], in E.
        second: p_xy of the second readout, of the same shape.
        integral: J, [S, bins].
        scale: delta0 gamma0; scalar or [S, 1].
        window: as in `compare`.
    """
    return {name: compare(subtract(name, first, second), integral, scale, window) for name in BACKGROUNDS}


@jax.jit
def correlation(signal: jax.Array, integral: jax.Array) -> jax.Array:
    """Correlation A.B / (|A| |B|) of each signal with its J, [S]; the inner product is that of gain and fidelity.

    Args:
        signal: [S, bins].
        integral: J, [S, bins].
    """
    power = jnp.sum(signal * signal, axis=-1) * jnp.sum(integral * integral, axis=-1)
    return jnp.sum(signal * integral, axis=-1) / jnp.sqrt(power)


def remembered_after(second: jax.Array, integral: jax.Array, scale: Scalar) -> tuple[jax.Array, jax.Array]:
    """The memory of each signal that the second readout still finds: correlation with J, and gain, both [S].

    The zero signal's second readout is subtracted, as in "sub0". The gain is near zero where the first readout erased
    the memory. The correlation can be large even then, since it does not depend on the size of the residue.

    Args:
        second: p_xy of the second readout, replica 0 the zero signal, [S + 1, bins], in E.
        integral: J, [S, bins].
        scale: delta0 gamma0; scalar or [S, 1].
    """
    residue = subtract("sub0", second)
    template = scale * integral
    return correlation(residue, integral), jnp.sum(template * residue, axis=-1) / jnp.sum(template * template, axis=-1)


@usual_rules()
def running_mean(series: jax.Array, width: Scalar) -> jax.Array:
    """Running mean along the last axis, in the shape of the series.

    It is the mean of the piecewise-constant series over the part of the window that lies inside the series.

    Args:
        series: values in each bin, [..., bins].
        width: width of the window in bins; need not be whole.

    Raises:
        ValueError: if the width is not above 0.
    """
    if not traced(width) and not np.all(np.asarray(width) > 0.0):
        raise ValueError(f"width: a mean over bins needs a width above 0, got {said(width)}")
    mean: jax.Array = _running_mean(series, width)
    return mean


@jax.jit
def _running_mean(series: jax.Array, width: Scalar) -> jax.Array:
    bins = series.shape[-1]
    edges = jnp.concatenate([jnp.zeros_like(series[..., :1]), jnp.cumsum(series, axis=-1)], axis=-1)

    def cumulative(at: jax.Array) -> jax.Array:
        whole = jnp.clip(jnp.floor(at).astype(jnp.int32), 0, bins - 1)
        return edges[..., whole] + (at - whole) * series[..., whole]

    centre = jnp.arange(bins) + 0.5
    low = jnp.clip(centre - 0.5 * width, 0.0, bins)
    high = jnp.clip(centre + 0.5 * width, 0.0, bins)
    return (cumulative(high) - cumulative(low)) / (high - low)


def spread(values: Sequence[float] | jax.Array) -> tuple[float, float, float]:
    """Mean, sample standard deviation and standard error (NaN for fewer than two values)."""
    array = np.asarray(values, dtype=float)
    deviation = float(array.std(ddof=1)) if array.size > 1 else math.nan
    return float(array.mean()), deviation, deviation / math.sqrt(array.size)
