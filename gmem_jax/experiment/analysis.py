"""From wall pressures to the recalled signal, its gain and its fidelity (paper, Sec. II; spec, section 7)."""

import jax
import jax.numpy as jnp

from gmem_jax.physics.state import Scalar

BACKGROUNDS = ("sub0", "sub2", "sub2-bl")
"""Ways to remove the background: the zero signal's run; the same run's second readout; that without its line."""


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


def gain(signal: jax.Array, integral: jax.Array, delta0: Scalar, gamma0: Scalar) -> jax.Array:
    """G = J.p_sig / (E delta0 gamma0 J.J), one for the set.

    Args:
        signal: p_sig, [S, bins], in E.
        integral: J, bin-averaged like p_sig, [S, bins].
        delta0: areal compression.
        gamma0: shear amplitude; scalar or [S, 1].
    """
    template = delta0 * gamma0 * integral
    return jnp.sum(template * signal) / jnp.sum(template * template)


def fidelity(signal: jax.Array, integral: jax.Array, delta0: Scalar, gamma0: Scalar) -> jax.Array:
    """F = 1 - sqrt(|p_sig - G E delta0 gamma0 J|^2 / p_sig.p_sig); arguments as in `gain`."""
    template = gain(signal, integral, delta0, gamma0) * delta0 * gamma0 * integral
    return 1.0 - jnp.sqrt(jnp.sum((signal - template) ** 2) / jnp.sum(signal * signal))


def backgrounds(
    first: jax.Array, second: jax.Array, integral: jax.Array, delta0: Scalar, gamma0: Scalar
) -> dict[str, tuple[jax.Array, jax.Array]]:
    """Gain and fidelity of the set by each of `BACKGROUNDS`, from a run with a second readout.

    Args:
        first: p_xy of the readout, replica 0 the zero signal, [S + 1, bins], in E.
        second: p_xy of the second readout, alike.
        integral: J, [S, bins].
        delta0: areal compression.
        gamma0: shear amplitude; scalar or [S, 1].
    """
    signals = {name: subtract(name, first, second) for name in BACKGROUNDS}
    return {
        name: (gain(signal, integral, delta0, gamma0), fidelity(signal, integral, delta0, gamma0))
        for name, signal in signals.items()
    }


def correlation(signal: jax.Array, integral: jax.Array) -> jax.Array:
    """Correlation A.B / (|A| |B|) of each signal with its J, [S]; the inner product is that of gain and fidelity.

    Args:
        signal: [S, bins].
        integral: J, [S, bins].
    """
    power = jnp.sum(signal * signal, axis=-1) * jnp.sum(integral * integral, axis=-1)
    return jnp.sum(signal * integral, axis=-1) / jnp.sqrt(power)


def remembered_after(
    second: jax.Array, integral: jax.Array, delta0: Scalar, gamma0: Scalar
) -> tuple[jax.Array, jax.Array]:
    """What the second readout still holds of each signal: its correlation with J, and its gain, both [S].

    The zero signal's second readout is subtracted, as in SUB0. Both are near zero where the first readout erased the
    memory. The correlation alone can be large for a residue of no size: the gain says how large, beside the first's.

    Args:
        second: p_xy of the second readout, replica 0 the zero signal, [S + 1, bins], in E.
        integral: J, [S, bins].
        delta0: areal compression.
        gamma0: shear amplitude; scalar or [S, 1].
    """
    residue = subtract("sub0", second)
    template = delta0 * gamma0 * integral
    return correlation(residue, integral), jnp.sum(template * residue, axis=-1) / jnp.sum(template * template, axis=-1)


def running_mean(series: jax.Array, width: Scalar) -> jax.Array:
    """Mean over a window of `width` bins (need not be whole) along the last axis, [..., bins].

    The integral of the piecewise-constant series over the window, divided by the part of the window inside [0, 1].
    """
    bins = series.shape[-1]
    edges = jnp.concatenate([jnp.zeros_like(series[..., :1]), jnp.cumsum(series, axis=-1)], axis=-1)

    def cumulative(at: jax.Array) -> jax.Array:
        whole = jnp.clip(jnp.floor(at).astype(jnp.int32), 0, bins - 1)
        return edges[..., whole] + (at - whole) * series[..., whole]

    centre = jnp.arange(bins) + 0.5
    low = jnp.clip(centre - 0.5 * width, 0.0, bins)
    high = jnp.clip(centre + 0.5 * width, 0.0, bins)
    return (cumulative(high) - cumulative(low)) / (high - low)
