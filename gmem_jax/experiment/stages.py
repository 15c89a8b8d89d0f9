"""Builders of the stages of a protocol. Lengths are in t0.

    gm.Protocol(gm.cycle(), gm.rest(), gm.write(), gm.hold(2.0), gm.read())

Builders leave open where u is: each stage begins where the one before ends.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.signals import Signals
from gmem_jax.simulation.stage import BINS, OWN, SINE, Along, Drive, Role, Stage

Waveform = str | Signals | Sequence[float] | np.ndarray
"""What a stage writes: the name of a set, "sine:n", one waveform, or its samples at k / (n + 1)."""


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
    """One compress/decompress cycle without shear: rest, compress to u = `to`, hold, decompress to u = 0.

    Compressions and decompressions last as long as at the rate of one t0 from u = 0 to 1.
    """
    return (
        Stage("rest", 0.0, 0.0, rest, "hold"),
        Stage("compress", 0.0, to, to),
        Stage("hold", to, to, hold, "hold"),
        Stage("decompress", to, 0.0, to),
    )


def rest(length: float = 0.2, **more: Any) -> Stage:
    """Walls stand still where they are; `more` are fields of `Stage`."""
    return Stage("rest", length=length, role="hold", **more)


def hold(length: float = 2.0, *, name: str = "hold", **more: Any) -> Stage:
    """Walls stand still where they are: storage. `more` are fields of `Stage`, as pressure=(None, None, 2e-3)."""
    return Stage(name, length=length, role="hold", **more)


def compress(to: float, length: float | None = None, *, name: str = "compress", **more: Any) -> Stage:
    """u goes to `to`, in `length` (default 1), without a waveform; `more` are fields of `Stage`."""
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
    """Waveforms are applied while u goes to `to`; or in time where it stands, with `to` None.

    Args:
        waveform: on channel xy.
        to: u at the end.
        length: of the stage.
        amplitude: what waveforms are multiplied with.
        along: "u" or "time".
        name: of the stage.
        channels: waveforms by channel, as xy="first", z=[0.5, 1.0, 0.5]; without any each set of the experiment is
            written on the channel that it is called like.

    Raises:
        ValueError: for what makes no waveform or no stage.
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
    """Stresses are read while u goes to `to`; or, with `to` None, while waveforms (`channels`) shear the pack.

    Args:
        name: of the stage.
        to: u at the end.
        length: of the stage.
        amplitude: what waveforms are multiplied with.
        of: the stage that the recall is compared with; default the last that wrote on each channel.
        mark: whether observers compare with its beginning.
        channels: waveforms by channel that are applied meanwhile.
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
    """A waveform is applied again and again, in time where u stands, `times` times.

    Args:
        times: how often.
        waveform: on channel xy; default the sets of the experiment.
        amplitude: what it is multiplied with.
        length: of each time.
        role: of the stages.
        channels: waveforms by channel.
    """
    given = dict(channels) if waveform is None else {"xy": waveform, **channels}
    return (Stage("train", length=length, role=role, drives=_drives(given, amplitude), along="time"),) * times


def shake(
    amplitude: float, periods: int, *, length: float = 1.0, channel: str = "xy", name: str = "shake", **more: Any
) -> Stage:
    """Walls swing by a sine of whole periods where u stands; the amplitude is a multiple of gamma0.

    Args:
        amplitude: of the sine.
        periods: how many of them.
        length: of the stage.
        channel: the mode of strain.
        name: of the stage.
        more: fields of `Stage`.
    """
    drives = (Drive(channel, f"{SINE}{periods}", amplitude),)
    return Stage(name, length=length, drives=drives, along="time", **more)
