"""A protocol as data: stages one after the other, and the table of bins that they make up."""

import itertools
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple, get_args

import jax
import numpy as np

BINS = 256  # bins of a stage of length t0, as in the paper: the resolution of every recorded quantity

Numbers = float | np.ndarray | jax.Array
"""A number, or a column of a table."""

Role = Literal["condition", "write", "hold", "read"]
"""What a stage is for: to strain the pack without a waveform, to apply one, to wait, or to measure what it recalls."""


class Bin(NamedTuple):
    """One bin of t0 / 256 as numbers, or a table of them with a leading axis on each.

    Attributes:
        start: u at the beginning of its stage.
        stop: u at the end of its stage.
        bins: length of its stage.
        number: its place in the stage, from 0.
        sheared: whether the waveform is applied.
    """

    start: Numbers
    stop: Numbers
    bins: Numbers
    number: Numbers
    sheared: Numbers

    @property
    def u(self) -> Any:
        """The compression variable at the end of the bin."""
        return self.start + (self.stop - self.start) * ((self.number + 1) / self.bins)


@dataclass(frozen=True)
class Stage:
    """One stage of a protocol.

    Attributes:
        name: for people; nothing follows from it.
        start: u at its beginning.
        stop: u at its end.
        length: duration in units of t0.
        role: what it is for.
        sheared: whether the waveform is applied: as a function of u, or, where u stands still, of time from 0 to 1.

    Raises:
        ValueError: for an unknown role, or a length that is negative or infinite.
    """

    name: str
    start: float
    stop: float
    length: float
    role: Role = "condition"
    sheared: bool = False

    def __post_init__(self) -> None:
        if self.role not in get_args(Role):
            raise ValueError(f"the role of stage {self.name!r} must be one of {', '.join(get_args(Role))}")
        if not 0.0 <= self.length < math.inf:
            raise ValueError(f"the length of stage {self.name!r} must be in [0, inf), got {self.length}")

    @property
    def bins(self) -> int:
        """Length in bins of t0 / 256; a hold is rounded up to whole bins."""
        return max(1, math.ceil(self.length * BINS - 1e-9))

    def bin(self, number: Numbers) -> Bin:
        """The bin of a number, or the bins of several."""
        return Bin(self.start, self.stop, self.bins, number, self.sheared)

    def rows(self, first: int, count: int) -> Bin:
        """`count` bins from number `first` on, as columns [count]."""
        return Bin(*(np.broadcast_to(column, count) for column in self.bin(first + np.arange(count))))


def table(stages: tuple[Stage, ...]) -> Bin:
    """All bins of some stages, one after the other; [rows] each."""
    columns = zip(*(stage.rows(0, stage.bins) for stage in stages), strict=True)
    return Bin(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True)
class Protocol:
    """Stages one after the other.

    Raises:
        ValueError: if there is none, two have one name, or the walls would jump from one to the next.
    """

    stages: tuple[Stage, ...]

    def __post_init__(self) -> None:
        if not self.stages:
            raise ValueError("a protocol has at least one stage")
        name, times = Counter(stage.name for stage in self.stages).most_common(1)[0]
        if times > 1:
            raise ValueError(f"the stages of a protocol have different names; {name!r} is there {times} times")
        for one, other in itertools.pairwise(self.stages):
            if one.stop != other.start:
                raise ValueError(
                    f"the walls would jump: stage {one.name!r} ends at u = {one.stop:g}, and {other.name!r} begins at "
                    f"u = {other.start:g}"
                )

    def __iter__(self) -> Iterator[Stage]:
        return iter(self.stages)

    def __len__(self) -> int:
        return len(self.stages)

    @property
    def bins(self) -> int:
        """Bins of all stages."""
        return sum(stage.bins for stage in self.stages)

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the stages that read."""
        return tuple(stage.name for stage in self.stages if stage.role == "read")

    @property
    def before_read(self) -> str:
        """Name of the stage before the first that reads: how quiet the pack is at its end limits the reading."""
        return self.stages[max(0, self._place("read") - 1)].name

    @property
    def first_memory(self) -> tuple[str, ...]:
        """Names of the stages from the first that writes to the first that reads."""
        return tuple(stage.name for stage in self.stages[self._place("write") : self._place("read") + 1])

    def _place(self, role: Role) -> int:
        for place, stage in enumerate(self.stages):
            if stage.role == role:
                return place
        raise ValueError(f"the protocol has no stage whose role is {role!r}")

    @property
    def phases(self) -> tuple[tuple[Stage, ...], tuple[Stage, ...]]:
        """The stages before the first sheared one, common to all waveforms and run once; and those from it on."""
        common = tuple(itertools.takewhile(lambda stage: not stage.sheared, self.stages))
        return common, self.stages[len(common) :]

    def to_list(self) -> list[dict[str, Any]]:
        """The stages as JSON has them."""
        return [asdict(stage) for stage in self.stages]

    @classmethod
    def from_list(cls, stages: list[dict[str, Any]]) -> "Protocol":
        """The protocol of `to_list`.

        Raises:
            ValueError: if a stage has other fields, or they make no protocol.
        """
        try:
            return cls(tuple(Stage(**stage) for stage in stages))
        except TypeError as error:
            raise ValueError(f"not the stages of a protocol: {error}") from None
