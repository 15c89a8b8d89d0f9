"""Builders of the stages of a protocol; all lengths are in t0.

    gm.Protocol(gm.cycle(), gm.rest(), gm.write(), gm.hold(2.0), gm.read())

A stage begins at the u at which the one before ends.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.signals import Signals
from gmem_jax.simulation.stage import BINS, OWN, SINE, Along, Drive, Role, Stage

Waveform = str | Signals | Sequence[float] | np.ndarray
"""A waveform of a stage: the name of a set, "sine:n", a `Signals` of one waveform, or samples at k / (n + 1)."""


def _drives(channels: dict[str, Waveform], amplitude: float) -> tuple[Drive, ...]:
    if not channels:
        return (replace(OWN[0], amplitude=amplitude),)
    return tuple(Drive(name, _samples(waveform), amplitude) for name, waveform in channels.items())


def _samples(waveform: Waveform) -> Any:
    """A name, or the samples of one waveform."""
    if isinstance(waveform, str):
        return waveform
    if not isinstance(waveform, Signals):
        return tuple(np.asarray(waveform, float).ravel().tolist())
    if waveform.count != 1:
        raise ValueError(
            f"a stage writes one waveform for all replicas, got {waveform.count}; give sets to gm.signals(name=...), "
            'and their names here, as gm.write(xy="name")'
        )
    return tuple(np.asarray(waveform.shear(jnp.arange(1, BINS) / BINS))[:, 0].tolist())


def cycle(rest: float = 0.2, hold: float = 0.2, *, to: float = 1.0) -> tuple[Stage, ...]:
    """One cycle without shear: rest at u = 0, compress to u = `to`, hold, decompress to u = 0.

    Compression and decompression last `to` t0 each, at the usual rate of one t0 from u = 0 to 1.

    Args:
        rest: length of the rest, in t0.
        hold: length of the hold, in t0.
        to: u at the end of the compression.
    """
    return (
        Stage("rest", 0.0, 0.0, rest, "hold"),
        Stage("compress", 0.0, to, to),
        Stage("hold", to, to, hold, "hold"),
        Stage("decompress", to, 0.0, to),
    )


def rest(length: float = 0.2, **more: Any) -> Stage:
    """The walls stand still for a short time, so that grains come to rest.

    Args:
        length: length of the stage, in t0.
        more: further fields of `Stage`.
    """
    return Stage("rest", length=length, role="hold", **more)


def hold(length: float = 2.0, *, name: str = "hold", **more: Any) -> Stage:
    """The walls stand still: storage.

    Args:
        length: length of the stage, in t0.
        name: name of the stage.
        more: further fields of `Stage`, as pressure=(None, None, 2e-3).
    """
    return Stage(name, length=length, role="hold", **more)


def compress(to: float, length: float | None = None, *, name: str = "compress", **more: Any) -> Stage:
    """Compress or decompress to another u, without a waveform.

    Args:
        to: u at the end.
        length: length of the stage, in t0; default 1.
        name: name of the stage.
        more: further fields of `Stage`.
    """
    return Stage(name, stop=to, length=1.0 if length is None else length, **more)


def write(
    waveform: Waveform | None = None,
    *,
    to: float | None = 1.0,
    length: float = 1.0,
    amplitude: float = 1.0,
    along: Along | None = None,
    name: str = "write",
    **channels: Any,
) -> Stage:
    """Apply waveforms while u goes to `to`, or while it stands still.

    A waveform is the name of a set of `gm.signals`, "sine:n" (n whole periods), samples at k / (n + 1), k = 1..n, or a
    `Signals` of one waveform. A set has one waveform for each replica; all others are applied to every replica, that of
    the zero signal included.

    Args:
        waveform: the waveform on channel xy.
        to: u at the end; None if u stands still.
        length: length of the stage, in t0.
        amplitude: factor on the waveforms, beside gamma0.
        along: what waveforms are a function of, "u" or "time"; default u, or time if u stands still.
        name: name of the stage.
        channels: waveforms by channel, as xy="first", z=[0.5, 1.0, 0.5]. If no waveform is given at all, each set of
            the experiment is written on the channel that has its name.

    Raises:
        ValueError: for an impossible waveform or stage.
    """
    given = dict(channels) if waveform is None else {"xy": waveform, **channels}
    return Stage(name, stop=to, length=length, role="write", drives=_drives(given, amplitude), along=along)


def read(
    name: str = "read",
    *,
    to: float | None = 0.0,
    length: float = 1.0,
    amplitude: float = 1.0,
    of: str | None = None,
    mark: bool = False,
    **channels: Any,
) -> Stage:
    """Read the stresses while u goes to `to`, or while it stands still and waveforms shear the pack.

    Args:
        name: name of the stage.
        to: u at the end; None if u stands still.
        length: length of the stage, in t0.
        amplitude: factor on the waveforms in `channels`, beside gamma0.
        of: name of the stage whose waveforms the recall is compared with; default the last that wrote on each channel.
        mark: whether observers compare with the beginning of this stage.
        channels: waveforms by channel that are applied during the read, as in `write`; default none.
    """
    drives = _drives(channels, amplitude) if channels else ()
    return Stage(name, stop=to, length=length, role="read", drives=drives, of=of, mark=mark)


def train(
    times: int,
    waveform: Waveform | None = None,
    *,
    amplitude: float = 1.0,
    length: float = 1.0,
    role: Role = "write",
    **channels: Any,
) -> tuple[Stage, ...]:
    """Apply a waveform `times` times while u stands still, as a function of time.

    Args:
        times: number of stages, of which each applies the waveform once.
        waveform: the waveform on channel xy, as in `write`; default the sets of the experiment.
        amplitude: factor on the waveform, beside gamma0.
        length: length of each stage, in t0.
        role: role of each stage; see `Stage`.
        channels: waveforms by channel, as in `write`.
    """
    given = dict(channels) if waveform is None else {"xy": waveform, **channels}
    return (Stage("train", length=length, role=role, drives=_drives(given, amplitude), along="time"),) * times


def shake(
    amplitude: float, periods: int, *, length: float = 1.0, channel: str = "xy", name: str = "shake", **more: Any
) -> Stage:
    """Shear the pack by a sine of whole periods while u stands still, the same in all replicas.

    Args:
        amplitude: amplitude of the sine, in gamma0.
        periods: number of periods.
        length: length of the stage, in t0.
        channel: mode of strain, one of `CHANNELS`.
        name: name of the stage.
        more: further fields of `Stage`.
    """
    drives = (Drive(channel, f"{SINE}{periods}", amplitude),)
    return Stage(name, length=length, drives=drives, along="time", **more)
