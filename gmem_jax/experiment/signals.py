"""Shear waveforms I(u) and their integrals J(u), on the compression variable u in [0, 1].

A set of S signals is a pytree with two methods, `shear(u)` and `integral(u)`, each [..., S] for u of shape [...].
All waveforms vanish at u = 0 and u = 1, so that the box is unsheared outside the stages that apply them.
"""

import json
import math
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.html import line
from gmem_jax.physics.numbers import is_real, plural, require_numbers, said
from gmem_jax.physics.pytree import Scalar, label, pytree, static, traced
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.stage import BINS

LONGEST_WORD = 12  # bits
PAD = 2.0  # widths of a bit left free at either end of a word
WIDTH = 1.0  # width of the bumps of a word, in widths of a bit
POINTS = 16  # points in a bin over which J is averaged


@runtime_checkable
class Signals(Protocol):
    """What a set of S waveforms provides. It is a pytree; in arrays with a leading axis [S], row s is of signal s."""

    @property
    def count(self) -> int:
        """Number of signals S."""
        ...

    def shear(self, u: jax.Array) -> jax.Array:
        """I_s(u), [..., S] for u of shape [...]."""
        ...

    def integral(self, u: jax.Array) -> jax.Array:
        """J_s(u), the integral of I_s from 0 to u, [..., S] for u of shape [...]."""
        ...


@pytree
@dataclass(frozen=True)
class SignalSets:
    """Several sets of S waveforms: replica s has waveform s of each set. `signals` makes it.

    Attributes:
        sets: the sets.
        names: their names; unless the protocol says otherwise, a set is written on the channel that has its name.
    """

    sets: tuple[Signals, ...]
    names: tuple[str, ...] = static()

    def __repr__(self) -> str:
        return line(self, lambda: (f"{self.count} signals", dict(zip(self.names, map(repr, self.sets), strict=True))))

    @property
    def count(self) -> int:
        """Number of signals S."""
        return self.sets[0].count


def sets_of(signals: Signals | SignalSets) -> dict[str, Signals]:
    """Sets of waveforms by name; a single set is called "xy", after the paper's channel."""
    if isinstance(signals, SignalSets):
        return dict(zip(signals.names, signals.sets, strict=True))
    return {"xy": signals}


@usual_rules()
def signals(**sets: Signals) -> Signals | SignalSets:
    """Join sets of waveforms for several channels or several writes: replica s has waveform s of each set.

    Args:
        sets: sets of equal length S by name: `xy=..., z=...` for two channels at once; or names that stages refer to,
            `first=..., second=...` with `gm.write(xy="first")`.

    Returns:
        The sets as `SignalSets`; the set itself, if xy is the only one.

    Raises:
        ValueError: if there is no set, one is called "kind", or they differ in length.
    """
    if "kind" in sets:
        raise ValueError('a set of waveforms cannot be called "kind"; call it by what it is for')
    counts = {name: one.count for name, one in sets.items()}
    if len(set(counts.values())) != 1:
        raise ValueError(f"sets of waveforms have one length, got {counts or 'none'}")
    return SignalSets(tuple(sets.values()), tuple(sets)) if tuple(sets) != ("xy",) else sets["xy"]


def _require_arrays(made: "Bumps | Spline") -> None:
    """Refuse fields that are not numbers; lists of numbers become arrays.

    Raises:
        ValueError: naming the field and its value.
    """
    for name, value in vars(made).items():
        if not is_real(value):
            raise ValueError(f"{name} must be numbers, got {said(value)}")
        if isinstance(value, list | tuple):
            object.__setattr__(made, name, jnp.asarray(value, float))


@pytree
@dataclass(frozen=True)
class Bumps:
    """Sums of half-cosine bumps, I_s(u) = sum_b a_b f((u - c_b) / du), f(x) = cos(pi x) for |x| < 1/2 (Sec. II).

    Attributes:
        amplitudes: a_b, [S, b]; zero entries pad signals with fewer bumps.
        centres: c_b, [S, b]; or [1, b], the same for all signals.
        width: du, the full width of a bump in u; scalar or [S, 1].
        form: JSON of the call that made them, as by `six_signals` or `words`; else "". A label: a set with changed
            numbers may still carry it.

    Raises:
        ValueError: for values that are no numbers, or not of these shapes.
    """

    amplitudes: jax.Array
    centres: jax.Array
    width: Scalar
    form: str = label("", given=False)

    def __post_init__(self) -> None:
        _require_arrays(self)
        shapes = [jnp.shape(leaf) for leaf in (self.amplitudes, self.centres, self.width)]
        given, places, width = (shape[-2:] for shape in shapes)
        if len(given) != 2 or places not in (given, (1, given[1])) or width not in ((), (given[0], 1)):
            wanted = "amplitudes must be [S, b], centres [S, b] or [1, b], width a number or [S, 1]"
            raise ValueError(f"{wanted}; got {said(shapes)}")
        if not traced(self.width) and not np.all(np.asarray(self.width) > 0.0):
            raise ValueError(f"the width of bumps must be positive, got {said(self.width)}")

    def __repr__(self) -> str:
        return line(
            self, lambda: (plural(self.count, "signal"), {"bumps": self.centres.shape[-1], "width": self.width})
        )

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


@pytree
@dataclass(frozen=True)
class Spline:
    """Waveforms through samples, joined by a C1 cubic (Catmull-Rom) curve.

    Attributes:
        nodes: I_s at the n + 2 nodes u = k / (n + 1), k = 0..n + 1, [S, n + 2]; the first and the last are zero.

    Raises:
        ValueError: for values that are no numbers, or not of this shape.
    """

    nodes: jax.Array

    def __post_init__(self) -> None:
        _require_arrays(self)
        shape = jnp.shape(self.nodes)
        if len(shape) < 2 or shape[-1] < 3:
            raise ValueError(f"nodes must be [S, n + 2], n samples and two zeros; got {said(shape)}")

    def __repr__(self) -> str:
        return line(self, lambda: (plural(self.count, "signal"), {"nodes": self.nodes.shape[-1]}))

    @property
    def count(self) -> int:
        """Number of signals S."""
        return int(self.nodes.shape[-2])

    def _pieces(self) -> tuple[jax.Array, ...]:
        """Cubic coefficients of every interval, in ascending order and in a coordinate from 0 to 1, each [S, n + 1]."""
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


@pytree
@dataclass(frozen=True)
class ChosenSignals:
    """Waveforms chosen from some sets. Number 0 is the zero signal; numbers from 1 count through the sets in order.

    Attributes:
        sets: the sets.
        numbers: numbers of the chosen waveforms, int [S].
    """

    sets: tuple[Signals, ...]
    numbers: jax.Array

    @property
    def count(self) -> int:
        """Number of signals S."""
        return int(self.numbers.shape[0])

    def shear(self, u: jax.Array) -> jax.Array:
        """I_s(u), [..., S]."""
        return self._chosen([one.shear(u) for one in self.sets], u)

    def integral(self, u: jax.Array) -> jax.Array:
        """J_s(u), [..., S]."""
        return self._chosen([one.integral(u) for one in self.sets], u)

    def _chosen(self, values: list[jax.Array], u: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.zeros((*u.shape, 1)), *values], axis=-1)[..., self.numbers]


Chosen = TypeVar("Chosen", bound=Signals | SignalSets)


def part(signals: Chosen, first: int, last: int) -> Chosen:
    """Signals `first` to `last` - 1 of a set, or of each of several sets, counted from 0.

    Only sets of our own classes are cut: of others it is not known which arrays have a row for each signal.
    """
    one: Any = signals
    if isinstance(one, SignalSets):
        one = SignalSets(tuple(part(each, first, last) for each in one.sets), one.names)
    elif type(one) in (Bumps, Spline):
        count = one.count
        one = jax.tree.map(lambda leaf: leaf[first:last] if jnp.shape(leaf)[:1] == (count,) else leaf, one)
    else:
        one = ChosenSignals((one,), jnp.arange(first + 1, last + 1))
    chosen: Chosen = one
    return chosen


@usual_rules()
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
    return _made_as(Bumps(jnp.asarray(amplitudes), jnp.asarray(centres), 0.2), kind="six")


def _made_as(made: Bumps, **form: Any) -> Bumps:
    object.__setattr__(made, "form", json.dumps(form))
    return made


def word_bits(bits: int) -> np.ndarray:
    """The bits of every word, most significant first, [2^bits, bits] of 0 and 1; row k holds the number k.

    Raises:
        ValueError: if `bits` is not a whole number from 1 to 12.
    """
    if isinstance(bits, bool) or not isinstance(bits, int | np.integer) or not 1 <= bits <= LONGEST_WORD:
        raise ValueError(f"a word has 1 to {LONGEST_WORD} bits, got {bits!r}")
    places = np.arange(bits - 1, -1, -1)
    return np.arange(2**bits)[:, None] >> places & 1


@usual_rules()
def words(bits: int, pad: float = PAD, width: float = WIDTH) -> Bumps:
    """All binary words of a length (App. A): J has a plateau of height +u_b / pi for a 1 and -u_b / pi for a 0.

    A bit is u_b = 1 / (bits + 2 pad) wide; `pad` such widths are left free at both ends. A bump of I joins plateaus
    that differ. Signal s, from 1 to 2^bits, is the word of the number s - 1, most significant bit at small u. As in the
    paper, bumps between bits have an amplitude of 1, and those at the ends of the word 1/2.

    Args:
        bits: length L of the words.
        pad: free widths of a bit at either end.
        width: width of the bumps, in widths of a bit; the height of the plateaus is proportional to it.

    Raises:
        ValueError: if `bits` is not a whole number from 1 to 12, or bumps of this width do not fit into [0, 1].
    """
    value = word_bits(bits)
    require_numbers(pad=pad, width=width)
    if not 0.0 < width <= 2.0 * pad < math.inf:
        raise ValueError(f"the bumps of a word must be in (0, 2 pad] = (0, {2.0 * pad:g}] bits wide, got {width:g}")
    bit = bit_width(bits, pad)
    level = np.pad(value - 0.5, ((0, 0), (1, 1)))  # a word begins and ends half-way between its two plateaus
    amplitudes = np.diff(level, axis=1)
    centres = np.tile((pad + np.arange(bits + 1)) * bit, (len(value), 1))
    made = Bumps(jnp.asarray(amplitudes), jnp.asarray(centres), width * bit)
    return _made_as(made, kind="words", bits=int(bits), pad=float(pad), width=float(width))


def bit_width(bits: int, pad: float = PAD) -> float:
    """u_b, the width of a bit in u."""
    return 1.0 / (bits + 2.0 * pad)


@usual_rules()
def waveform(samples: jax.typing.ArrayLike) -> Spline:
    """Waveforms from equally spaced samples; `waveform_from` takes samples at any times.

    Args:
        samples: I at u = k / (n + 1), k = 1..n, of one signal [n] or several [S, n]; I is zero at u = 0 and 1.

    Raises:
        ValueError: if the shape is not [n] or [S, n] with n >= 2, or a concrete sample is not a finite real number.
    """
    known = samples if traced(samples) else np.asarray(samples)
    if jnp.iscomplexobj(known) or (isinstance(known, np.ndarray) and known.dtype.kind not in "fiub"):
        raise ValueError(f"a waveform is made of real samples, got {said(samples)}")
    if jnp.ndim(known) not in (1, 2) or jnp.shape(known)[-1] < 2 or jnp.shape(known)[0] < 1:
        raise ValueError(f"a waveform needs at least 2 samples, as [n] or [signals, n]; got shape {jnp.shape(known)}")
    if isinstance(known, np.ndarray) and not np.all(np.isfinite(known)):
        raise ValueError("a waveform sample is not a finite number")
    values = jnp.asarray(known)
    values = jnp.atleast_2d(values)
    values = values.astype(jnp.result_type(values.dtype, float))
    return Spline(nodes=jnp.pad(values, ((0, 0), (1, 1))))


@usual_rules()
@jax.jit  # fuses the mean: without it 4,096 words would fill the memory
def bin_average(signals: Signals) -> jax.Array:
    """J_s averaged over each bin of u, [S, 256], by the midpoint rule with `POINTS` points in a bin."""
    u = (jnp.arange(BINS * POINTS) + 0.5) / (BINS * POINTS)
    return jnp.mean(signals.integral(u).reshape(BINS, POINTS, -1), axis=1).T
