"""Waveforms from samples at given times: times become u; on demand they are smoothed, tapered and scaled."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.signals import Spline, waveform
from gmem_jax.physics.numbers import is_real, require_numbers, said
from gmem_jax.simulation.stage import BINS

STEEPEST = 0.2  # largest change of a waveform within a bin, over its largest value. It is 0.196 for words of 12 bits,
# the steepest ones. Noise that makes it 0.23 changes J by 1 % and the recall by 29 %; see docs/howto/waveform.md
OPEN = 0.01  # largest value of a waveform at its ends, over its largest value (the ends are then set to zero)
WIDEST = 0.5  # largest width in u of smoothing and tapering
_TAPER = "bring it there, with taper = 0.1 (gmem recall --taper 0.1)"
_FINE = 8  # points per bin at which a waveform is evaluated to find its steepest change

Told = Callable[[str], None]


def untold(_: str) -> None:
    """Tell nobody."""


def waveform_from(
    t: jax.typing.ArrayLike,
    x: jax.typing.ArrayLike,
    *,
    span: tuple[float, float] | None = None,
    smooth: float = 0.0,
    taper: float = 0.0,
    scale: bool = False,
    told: Told = untold,
) -> Spline:
    """Waveforms from samples at given times, which are mapped to u from 0 to 1.

    Equally spaced samples are used as they are. Others, and those that are smoothed, are interpolated linearly to equal
    steps of at most 1/256. Smoothing, tapering and scaling are done only if asked for, in this order. A waveform that
    a pack cannot follow is refused.

    Args:
        t: times or places, rising, [n], in any unit.
        x: samples at t, of one signal [n] or several [S, n], without unit; the usual size is 1.
        span: the two times that become u = 0 and u = 1; default the first and the last of t. Where the samples do not
            reach them, the waveform is zero there.
        smooth: width in u of the running average, whose weight is a squared cosine; 0 for none.
        taper: width in u at both ends within which the waveform is brought to zero by a squared sine; 0 for none.
        scale: whether to divide all signals by the largest absolute value of all.
        told: called with one line of text on what was changed, if anything was, such as `print`.

    Raises:
        ValueError: if the shapes do not fit, a number is not finite, times do not rise or lie outside the span, a width
            is not in [0, 0.5]; if a waveform does not begin and end at zero, or is steeper than a pack can follow. The
            message says what would help.
    """
    for name, given in (("t", t), ("x", x)):
        if not is_real(given):
            raise ValueError(f"{name} must be real numbers, got {said(given)}")
    require_numbers(smooth=smooth, taper=taper)
    places, values = np.asarray(t, float), np.atleast_2d(np.asarray(x, float))
    if places.ndim != 1 or values.ndim != 2 or values.shape[1:] != places.shape or places.size < 2:
        raise ValueError(
            f"a waveform needs samples [n] or [signals, n] at times [n], n >= 2; got {np.shape(x)} at {np.shape(t)}"
        )
    if not (np.all(np.isfinite(places)) and np.all(np.isfinite(values))):
        raise ValueError("a time or a sample is not a finite number")
    if not np.all(np.diff(places) > 0.0):
        raise ValueError(f"times must rise; sample {np.argmin(np.diff(places) > 0.0) + 2} is not after the one before")
    for name, width in (("smooth", smooth), ("taper", taper)):
        if not 0.0 <= width <= WIDEST:
            raise ValueError(f"{name} must be in [0, {WIDEST}], a width in u, got {width}")
    u = _placed(places, (places[0], places[-1]) if span is None else span)
    missing = [int(u[0] > 0.0), int(u[-1] < 1.0)]
    u, values = np.pad(u, missing, constant_values=(0.0, 1.0)), np.pad(values, ((0, 0), missing))
    done = []
    nodes = _smoothed(u, values, smooth) if smooth else _even(u, values)
    if smooth:
        taken = values - np.stack([np.interp(u, np.linspace(0.0, 1.0, BINS + 1), row) for row in nodes])
        done.append(f"smoothed over {smooth:g} in u (which took away {np.sqrt(np.mean(taken**2)):.2g} rms)")
    ends = float(np.max(np.abs(nodes[:, [0, -1]])))
    if taper:
        inwards = np.minimum(np.linspace(0.0, 1.0, nodes.shape[1]), np.linspace(1.0, 0.0, nodes.shape[1]))
        nodes = nodes * np.sin(0.5 * np.pi * np.minimum(1.0, inwards / taper)) ** 2
        done.append(f"brought to zero within {taper:g} in u of its ends (which were at {ends:.3g} at most)")
    if scale and (largest := float(np.max(np.abs(nodes)))) > 0.0:
        nodes = nodes / largest
        done.append(f"divided by {largest:.4g}")
    require_closed(nodes)
    if ends > 1e-9 and not taper:
        done.append(f"set to zero at its ends (which were at {ends:.2g} at most)")
    require_gentle(nodes)
    if done:
        told("; ".join(done))
    return waveform(nodes[:, 1:-1])


def _placed(places: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    """Times as u."""
    if not is_real(span) or np.shape(span) != (2,) or not span[0] < span[1] or not np.all(np.isfinite(span)):
        raise ValueError(f"span must be two times, the later one last, got {said(span)}")
    first, last = map(float, span)
    u: np.ndarray = (places - first) / (last - first)
    if u[0] < 0.0 or u[-1] > 1.0:
        raise ValueError(f"times from {places[0]:g} to {places[-1]:g} lie outside {first:g} to {last:g}")
    return u


def _even(u: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Samples at equal steps of u; unchanged if u are equal steps already, to a hundredth of a step."""
    count = u.size - 1
    if np.all(np.abs(u * count - np.arange(count + 1)) < 0.01):
        return values
    even = np.linspace(0.0, 1.0, max(count, BINS) + 1)
    return np.stack([np.interp(even, u, row) for row in values])


def _smoothed(u: np.ndarray, values: np.ndarray, width: float) -> np.ndarray:
    """Weighted means over a width in u around k / 256.

    Beyond its ends a curve is continued by its point reflection about them, so that the values at the ends stay.
    """
    known = np.concatenate([-u[:0:-1], u, 2.0 - u[-2::-1]])
    ends = 2.0 * values[:, :1] - values[:, :0:-1], 2.0 * values[:, -1:] - values[:, -2::-1]
    wide = np.concatenate([ends[0], values, ends[1]], axis=1)
    around = width * np.linspace(-0.5, 0.5, 33 + 2 * int(width * u.size))  # two points per sample, and 33 more
    weight = np.cos(np.pi * around / width) ** 2
    places = np.linspace(0.0, 1.0, BINS + 1)
    means = [[np.interp(at + around, known, row) @ weight for at in places] for row in wide]
    return np.array(means, float) / float(weight.sum())


def require_closed(nodes: np.ndarray) -> None:
    """Refuse waveforms that are not zero at their ends; their nodes [S, n] include both ends.

    Raises:
        ValueError: saying where, and what would help.
    """
    for number, row in enumerate(nodes):
        begins, ends = row[0], row[-1]
        if max(abs(begins), abs(ends)) > OPEN * np.max(np.abs(row)):
            raise ValueError(
                f"signal {number + 1} begins at {begins:.3g} and ends at {ends:.3g}; a waveform is zero at both ends: "
                + _TAPER
            )


def require_gentle(nodes: np.ndarray) -> None:
    """Refuse waveforms that change within a bin by more than a pack can follow; their nodes [S, n] include both ends.

    Raises:
        ValueError: saying where, and what would help.
    """
    count = nodes.shape[1] - 1
    at = np.linspace(0.0, 1.0, BINS * _FINE * max(1, -(-count // (BINS * _FINE))) + 1)  # no coarser than nodes
    values = np.asarray(waveform(nodes[:, 1:-1]).shear(jnp.asarray(at))).T
    apart = (len(at) - 1) // BINS
    change = np.ptp(np.lib.stride_tricks.sliding_window_view(values, apart + 1, axis=1), axis=-1)
    for number, row in enumerate(values):
        largest = float(np.max(np.abs(row)))
        place = int(np.argmax(change[number]))
        if change[number, place] > STEEPEST * largest:
            raise ValueError(
                f"signal {number + 1} changes by {change[number, place] / largest:.0%} of its largest value within "
                f"1/256 in u at u = {at[place]:.3f}, more than the {STEEPEST:.0%} that a pack can hold: "
                + _help(at[place], nodes[number], largest)
            )


def _help(place: float, nodes: np.ndarray, largest: float) -> str:
    """Advice on how to make a steep waveform gentle."""
    at_end = min(place, 1.0 - place) < 2.0 / (len(nodes) - 1) + 1.0 / BINS
    if at_end and max(abs(nodes[1]), abs(nodes[-2])) > STEEPEST * largest:
        return f"it is zero at both ends; {_TAPER}"
    return "smooth it, with smooth = 0.05 (gmem recall --smooth 0.05)"
