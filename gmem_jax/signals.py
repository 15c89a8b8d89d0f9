"""Shear waveforms I(u) and their integrals J(u), on the compression variable u in [0, 1].

A set of S signals is a pytree with two methods, `shear(u)` and `integral(u)`, each [..., S] for u of shape [...].
All waveforms vanish at u = 0 and u = 1, so that the box is unsheared outside the encoding ramp.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.state import Scalar

BINS = 256  # bins of u in the paper: the resolution of every recorded signal


@runtime_checkable
class Signals(Protocol):
    """A set of S waveforms: a pytree whose arrays with a leading axis of length S belong to one signal each."""

    @property
    def count(self) -> int:
        """Number of signals S."""
        ...

    def shear(self, u: jax.Array) -> jax.Array:
        """I_s(u), [..., S]."""
        ...

    def integral(self, u: jax.Array) -> jax.Array:
        """J_s(u), the integral of I_s from 0 to u, [..., S]."""
        ...


def part(signals: Signals, first: int, last: int) -> Signals:
    """Signals number `first` to `last` - 1 of a set, as a set."""

    def rows(leaf: jax.Array) -> jax.Array:
        return leaf[first:last] if jnp.ndim(leaf) > 0 and jnp.shape(leaf)[0] == signals.count else leaf

    chosen: Signals = jax.tree.map(rows, signals)
    return chosen


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bumps:
    """Sums of half-cosine bumps, I_s(u) = sum_b a_b f((u - c_b) / du), f(x) = cos(pi x) for |x| < 1/2 (Sec. II).

    Attributes:
        amplitudes: a_b, [S, b]; zero entries pad signals with fewer bumps.
        centres: c_b, [S, b].
        width: du, scalar or [S, 1].
    """

    amplitudes: jax.Array
    centres: jax.Array
    width: Scalar

    @property
    def count(self) -> int:
        """Number of signals S."""
        return int(self.amplitudes.shape[-2])

    def shear(self, u: jax.Array) -> jax.Array:
        """I_s(u), [..., S]."""
        x = (u[..., None, None] - self.centres) / self.width
        bump = jnp.where(jnp.abs(x) < 0.5, jnp.cos(jnp.pi * x), 0.0)
        return jnp.sum(self.amplitudes * bump, axis=-1)

    def integral(self, u: jax.Array) -> jax.Array:
        """J_s(u), [..., S]."""

        def primitive(v: jax.Array) -> jax.Array:
            x = jnp.clip((v[..., None, None] - self.centres) / self.width, -0.5, 0.5)
            return self.width * (1.0 + jnp.sin(jnp.pi * x)) / jnp.pi

        return jnp.sum(self.amplitudes * (primitive(u) - primitive(jnp.zeros_like(u))), axis=-1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Samples:
    """Waveforms given by samples, joined by a C1 cubic (Catmull-Rom) curve.

    Attributes:
        nodes: I_s at the n + 2 equally spaced nodes u = k / (n + 1), [S, n + 2]; first and last are zero.
    """

    nodes: jax.Array

    @property
    def count(self) -> int:
        """Number of signals S."""
        return int(self.nodes.shape[-2])

    def _pieces(self) -> tuple[jax.Array, ...]:
        """Cubic coefficients (ascending, in the local coordinate 0..1) of every interval, each [S, n + 1]."""
        slope = jnp.asarray(jnp.gradient(self.nodes, axis=-1))  # per interval
        left, right = self.nodes[..., :-1], self.nodes[..., 1:]
        m0, m1 = slope[..., :-1], slope[..., 1:]
        return left, m0, 3.0 * (right - left) - 2.0 * m0 - m1, 2.0 * (left - right) + m0 + m1

    def _locate(self, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        intervals = self.nodes.shape[-1] - 1
        scaled = jnp.clip(u, 0.0, 1.0) * intervals
        place = jnp.clip(jnp.floor(scaled).astype(jnp.int32), 0, intervals - 1)
        return place, (scaled - place)[..., None]

    def shear(self, u: jax.Array) -> jax.Array:
        """I_s(u), [..., S]."""
        place, x = self._locate(u)
        a, b, c, d = (jnp.moveaxis(p, -1, 0)[place] for p in self._pieces())
        return a + x * (b + x * (c + x * d))

    def integral(self, u: jax.Array) -> jax.Array:
        """J_s(u), [..., S]."""
        place, x = self._locate(u)
        width = 1.0 / (self.nodes.shape[-1] - 1)
        pieces = self._pieces()
        whole = pieces[0] + pieces[1] / 2.0 + pieces[2] / 3.0 + pieces[3] / 4.0
        before = jnp.moveaxis(jnp.cumsum(whole, axis=-1) - whole, -1, 0)[place]
        a, b, c, d = (jnp.moveaxis(p, -1, 0)[place] for p in pieces)
        return width * (before + x * (a + x * (b / 2.0 + x * (c / 3.0 + x * d / 4.0))))


def six_signals() -> Bumps:
    """The paper's signals 1 to 6 (Sec. II, Fig. 5): one to three bumps of width 0.2."""
    bumps: list[tuple[list[float], list[float]]] = [
        ([0.3], [1.0]),
        ([0.7], [1.0]),
        ([0.3, 0.7], [1.0, 1.0]),
        ([0.3, 0.7], [-1.0, 1.0]),
        ([0.3, 0.7], [1.0, -1.0]),
        ([0.2, 0.5, 0.8], [0.5, -1.0, 0.5]),
    ]
    centres, amplitudes = np.full((6, 3), 0.5), np.zeros((6, 3))
    for row, (places, heights) in enumerate(bumps):
        centres[row, : len(places)] = places
        amplitudes[row, : len(heights)] = heights
    return Bumps(amplitudes=jnp.asarray(amplitudes), centres=jnp.asarray(centres), width=0.2)


def waveform(samples: jax.typing.ArrayLike) -> Samples:
    """Any waveform from its samples.

    Args:
        samples: I at u = k / (n + 1), k = 1..n, for one signal [n] or several [S, n]; I is zero at u = 0 and 1.

    Raises:
        ValueError: if the shape is not [n] or [S, n] with n >= 2, or a concrete sample is not finite.
    """
    values = jnp.asarray(samples)
    if values.ndim not in (1, 2) or values.shape[-1] < 2 or values.shape[0] < 1:
        raise ValueError(f"a waveform needs at least 2 samples, as [n] or [signals, n]; got shape {values.shape}")
    if not isinstance(values, jax.core.Tracer) and not bool(jnp.all(jnp.isfinite(values))):
        raise ValueError("a waveform sample is not a finite number")
    values = jnp.atleast_2d(values)
    values = values.astype(jnp.result_type(values.dtype, float))
    return Samples(nodes=jnp.pad(values, ((0, 0), (1, 1))))


def bin_average(signals: Signals, bins: int = BINS, points: int = 16) -> jax.Array:
    """J_s averaged over each bin of u, [S, bins] (midpoint rule on `points` per bin)."""
    u = (jnp.arange(bins * points) + 0.5) / (bins * points)
    return jnp.mean(signals.integral(u).reshape(bins, points, -1), axis=1).T
