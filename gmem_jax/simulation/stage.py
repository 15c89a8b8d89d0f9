"""Stages of a protocol as data, and the table of their bins."""

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import jax
import numpy as np

from gmem_jax.physics.numbers import require_numbers, said
from gmem_jax.physics.pytree import static_record
from gmem_jax.simulation.channels import CHANNELS

BINS = 256  # bins of a stage of length t0, as in the paper: the resolution of every recorded quantity
LONGEST_NAME = 150  # letters; files take 200, and a protocol appends to a name that comes twice
LONGEST_STAGE = 1e9  # in t0: more bins than any machine goes through
SINE = "sine:"  # begins the name of a drive of whole sine periods

Numbers = float | np.ndarray | jax.Array
"""A number, or a column of a table."""

Role = Literal["condition", "write", "hold", "read"]
"""What a stage is for: to strain the pack without a waveform, to apply one, to wait, or to measure what it recalls."""
Along = Literal["u", "time"]
"""What a waveform is a function of: the compression u, or the time since the stage began, over its length."""


def bin_centres() -> np.ndarray:
    """u in the middle of each bin of a compression, [256]: a new array, which no trace of another precision knows."""
    centres: np.ndarray = (np.arange(BINS) + 0.5) / BINS
    return centres


class Bin(NamedTuple):
    """One bin of t0 / 256 as numbers, or a table of them with a leading axis on each.

    Attributes:
        start: u at the beginning of its stage.
        stop: u at the end of its stage.
        bins: length of its stage, in bins.
        number: its place in the stage, from 0.
        timed: whether waveforms are functions of time.
        still: whether the drag of the simulation acts.
        amplitudes: amplitude of each of `Columns.lanes`; 0 where it is not applied.
        drag: drag of the stage, in the place of the simulation's, 1 / t_c; None if no stage has a drag of its own.
        friction: 1, or 0 where the stage switches friction off; None if no stage does.
        pressure: pressure at which the walls of each axis are held, in E, 0 for walls that are not held; None if no
            stage holds walls.
    """

    start: Numbers
    stop: Numbers
    bins: Numbers
    number: Numbers
    timed: Numbers
    still: Numbers
    amplitudes: tuple[Numbers, ...] = ()
    drag: Numbers | None = None
    friction: Numbers | None = None
    pressure: tuple[Numbers, Numbers, Numbers] | None = None

    @property
    def u(self) -> Any:
        """The compression variable at the end of the bin."""
        return self.start + (self.stop - self.start) * ((self.number + 1) / self.bins)


@static_record
@dataclass(frozen=True)
class Drive:
    """A waveform on a channel.

    Attributes:
        channel: mode of strain, one of `CHANNELS`; "" for the channel that has the name of the set, or else "xy".
        waveform: the name of a set of waveforms, one for each replica; "" for the set that has the name of the channel,
            or else the first set, and without a channel for all sets that have the name of a channel. Or one waveform
            for all replicas, that of the zero signal included: its samples at k / (n + 1), k = 1..n, or "sine:n",
            n whole periods.
        amplitude: factor on the waveform, beside gamma0.

    Raises:
        ValueError: for an unknown channel, or an impossible waveform.
    """

    channel: str = ""
    waveform: str | tuple[float, ...] = ""
    amplitude: float = 1.0

    def __post_init__(self) -> None:
        if self.channel and self.channel not in CHANNELS:
            raise ValueError(f"a channel must be one of {', '.join(CHANNELS)}; got {self.channel!r}")
        if not isinstance(self.waveform, str):
            if not np.iterable(self.waveform):
                raise ValueError(f"a waveform is a name, or samples; got {said(self.waveform)}")
            require_numbers(**{f"sample {number} of a waveform": each for number, each in enumerate(self.waveform, 1)})
            object.__setattr__(self, "waveform", tuple(map(float, self.waveform)))
            if len(self.waveform) < 2 or not all(map(math.isfinite, self.waveform)):
                raise ValueError(
                    "a fixed waveform is made of 2 or more finite samples between its ends, which are zero"
                )
        elif self.waveform.startswith(SINE) and self.periods < 1:
            raise ValueError(f"a sine has whole periods, as in 'sine:4'; got {self.waveform!r}")
        if self.fixed and not self.channel:
            raise ValueError("a fixed waveform needs a channel, as in channel='xy'")
        require_numbers(**{"the amplitude of a drive": self.amplitude})
        if not math.isfinite(self.amplitude):
            raise ValueError(f"the amplitude of a drive must be a finite number, got {self.amplitude!r}")
        object.__setattr__(self, "amplitude", float(self.amplitude))

    @property
    def fixed(self) -> bool:
        """Whether it is the same for all replicas."""
        return not isinstance(self.waveform, str) or self.waveform.startswith(SINE)

    @property
    def periods(self) -> int:
        """Number of periods of a sine; 0 for other waveforms."""
        count = self.waveform.removeprefix(SINE) if isinstance(self.waveform, str) else ""
        return int(count) if count.isdecimal() else 0

    @property
    def lane(self) -> "Lane":
        """Channel and waveform, without the amplitude."""
        return Lane(self.channel, self.waveform)


class Lane(NamedTuple):
    """A waveform on a channel, whatever its amplitude: a column of a table of bins. See `Drive`."""

    channel: str
    waveform: str | tuple[float, ...]

    @property
    def drive(self) -> Drive:
        """The drive of amplitude 1."""
        return Drive(*self)


OWN = (Drive(),)
"""Each set of waveforms on the channel of its name."""


class Columns(NamedTuple):
    """The columns that a table of bins of some stages needs: programs are compiled for them.

    Attributes:
        lanes: waveforms by channel.
        drag: whether any stage has a drag of its own.
        friction: whether any stage switches friction off.
        pressure: whether any stage holds walls at a pressure.
    """

    lanes: tuple[Lane, ...] = ()
    drag: bool = False
    friction: bool = False
    pressure: bool = False


@static_record
@dataclass(frozen=True)
class Stage:
    """One stage of a protocol. u goes linearly from `start` to `stop`.

    Attributes:
        name: key of its samples in `Recall.stages`, and the name by which `of` and sweeps refer to it.
        start: u at its beginning; None for the u at which the stage before ends.
        stop: u at its end; None for the u at which it begins.
        length: duration, in t0.
        role: "condition" strains the pack without a waveform of its own, "write" applies waveforms, "hold" waits, and
            "read" measures the recall.
        drives: the waveforms that are applied.
        along: what the waveforms are a function of, "u" or "time"; default u, or time if u stands still.
        drag: viscous drag, in 1 / t_c; default the experiment's `hold_drag` if all walls stand still, else none.
        friction: whether contacts have friction.
        pressure: pressures in E at which a servo holds the walls of x, y and z; None in the place of one for walls that
            follow u. Later stages strain the box from where the servo left it.
        of: in a stage that reads, the name of the stage whose waveforms the recall is compared with; default the last
            that wrote on each channel.
        mark: whether observers compare with the beginning of this stage (`gmem_jax.simulation.observables`).
        recorded: whether its samples are kept in the recall.

    Raises:
        ValueError: for an impossible stage.
    """

    name: str
    start: float | None = None
    stop: float | None = None
    length: float = 1.0
    role: Role = "condition"
    drives: tuple[Drive, ...] = ()
    along: Along | None = None
    drag: float | None = None
    friction: bool = True
    pressure: tuple[float | None, float | None, float | None] | None = None
    of: str | None = None
    mark: bool = False
    recorded: bool = True

    def __post_init__(self) -> None:
        def refuse(problem: str) -> None:
            raise ValueError(f"stage {self.name!r}: {problem}")

        object.__setattr__(self, "drives", tuple(self.drives))
        name = self.name if isinstance(self.name, str) else ""
        if not name.isprintable() or not 0 < len(name) <= LONGEST_NAME or "/" in name or name == ".":
            wanted = f"1 to {LONGEST_NAME} printable letters without '/', not '.'"
            raise ValueError(f"a stage has a name of {wanted}; got {said(self.name)}")
        if self.role not in get_args(Role):
            refuse(f"its role must be one of {', '.join(get_args(Role))}; got {self.role!r}")
        if self.along not in (None, *get_args(Along)):
            refuse(f"along must be one of {', '.join(get_args(Along))}; got {self.along!r}")
        pressure: tuple[Any, ...] = tuple(self.pressure) if np.iterable(self.pressure) else (self.pressure,)
        try:
            require_numbers(start=self.start, stop=self.stop, length=self.length, drag=self.drag)
            require_numbers(**dict(zip(("pressure along x", "along y", "along z"), pressure, strict=False)))
        except ValueError as error:
            refuse(f"its {error}")
        for name in ("start", "stop"):
            u = getattr(self, name)
            if u is not None and not 0.0 <= u <= 1.0:
                refuse(f"u must be in [0, 1], and its {name} is {u}")
        if self.length is None or not 0.0 <= self.length < math.inf:
            refuse(f"its length must be in [0, inf), got {self.length}")
        if self.length > LONGEST_STAGE:
            refuse(f"its length may be up to {LONGEST_STAGE:g} t0, got {self.length:g}")
        if self.drag is not None and not 0.0 <= self.drag < math.inf:
            refuse(f"its drag must be in [0, inf), got {self.drag}")
        if self.role == "write" and not self.drives:
            refuse("it writes no waveform; give it drives, or another role")
        written = [drive.channel for drive in self.own if drive.channel]
        if self.role == "write" and len(written) > len(set(written)):
            refuse(
                "it writes two sets of waveforms on one channel, and a recall is compared with one; add them up in one"
            )
        if self.of is not None and self.role != "read":
            refuse("only a stage that reads is compared with another")
        if self.role == "read" and not self.recorded:
            refuse("its role is read, so it must be recorded; leave out recorded=False")
        if self.pressure is not None:
            if len(pressure) != 3 or not all(p is None or 0.0 < p < math.inf for p in pressure):
                refuse(f"its pressure is three numbers above 0 or none, for x, y and z; got {self.pressure}")
            object.__setattr__(self, "pressure", pressure)

    @property
    def bins(self) -> int:
        """Length in bins of t0 / 256, rounded up to a whole number, at least 1."""
        return max(1, math.ceil(self.length * BINS - 1e-9))

    @property
    def ends(self) -> tuple[float, float]:
        """u at its beginning and at its end, once the stage is part of a protocol."""
        return self.start or 0.0, self.stop or 0.0

    @property
    def moves(self) -> bool:
        """Whether u changes."""
        return self.start != self.stop

    @property
    def timed(self) -> bool:
        """Whether waveforms are functions of time."""
        return self.along == "time" or not self.moves

    @property
    def own(self) -> tuple[Drive, ...]:
        """The drives of which each replica has its own waveform."""
        return tuple(drive for drive in self.drives if not drive.fixed)

    def rows(self, first: Any, count: int | None = None, columns: Columns | None = None) -> Bin:
        """One bin of the stage, or `count` bins as a table whose columns are [count].

        Args:
            first: number of the first bin, from 0.
            count: number of bins; None for one bin, whose entries are numbers.
            columns: columns of the table; default those that this stage needs.
        """
        columns = columns_of((self,)) if columns is None else columns
        held = None if self.pressure is None else tuple(p or 0.0 for p in self.pressure)
        amplitudes = Counter[Lane]()
        for drive in self.drives:
            amplitudes[drive.lane] += drive.amplitude  # type: ignore[assignment]
        row = Bin(
            *self.ends,
            self.bins,
            first if count is None else first + np.arange(count),
            self.timed,
            not (self.moves or self.drives) and self.drag is None,
            tuple(float(amplitudes[lane]) for lane in columns.lanes),
            (self.drag or 0.0) if columns.drag else None,
            float(self.friction) if columns.friction else None,
            (held or (0.0, 0.0, 0.0)) if columns.pressure else None,  # type: ignore[arg-type]
        )
        if count is None:
            return row
        table_: Bin = jax.tree.map(lambda column: np.broadcast_to(column, count), row)
        return table_


def columns_of(stages: Iterable[Stage]) -> Columns:
    """The columns that some stages need."""
    stages = tuple(stages)
    lanes = dict.fromkeys(drive.lane for stage in stages for drive in stage.drives)
    return Columns(
        tuple(lanes),
        any(stage.drag is not None for stage in stages),
        not all(stage.friction for stage in stages),
        any(stage.pressure is not None for stage in stages),
    )


def table(stages: Iterable[Stage], columns: Columns | None = None) -> Bin:
    """All bins of some stages, one after the other; [rows] each."""
    stages = tuple(stages)
    columns = columns_of(stages) if columns is None else columns
    parts = [stage.rows(0, stage.bins, columns) for stage in stages]
    joined: Bin = jax.tree.map(lambda *column: np.concatenate(column), *parts)
    return joined
