"""The stages of an experiment, and the table of bins they make up."""

import itertools
import math
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import jax
import numpy as np

from gmem_jax.experiment.signals import BINS

Shear = Literal["during", "before"]
"""When waveforms are applied: during the compression, or before it."""

Numbers = float | np.ndarray | jax.Array
"""A number, or a column of a table."""


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


@dataclass(frozen=True)
class Stage:
    """One stage of a protocol.

    Attributes:
        name: as in the paper: rest, compress, hold, decompress, encode, store, readout.
        start: u at its beginning.
        stop: u at its end.
        length: duration in units of t0.
        sheared: whether the waveform is applied: as a function of u, or, where u stands still, of time from 0 to 1.
    """

    name: str
    start: float
    stop: float
    length: float
    sheared: bool = False

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


def preparation_cycle(rest: float, hold: float) -> tuple[Stage, ...]:
    """One compress/decompress cycle without shear: rest, compress, hold, decompress."""
    return (
        Stage("rest", 0.0, 0.0, rest),
        Stage("compress", 0.0, 1.0, 1.0),
        Stage("hold", 1.0, 1.0, hold),
        Stage("decompress", 1.0, 0.0, 1.0),
    )


def memory_protocol(
    rest: float, hold: float, store: float, *, second_readout: bool, shear: str = "during"
) -> tuple[Stage, ...]:
    """The experiment of Sec. II, lengths in t0: a shear-free cycle, rest, encode, store, readout (6.6 t0 in all).

    With `second_readout`, Sec. III's: another rest, compression, hold and readout (9 t0 in all). With shear "before",
    the waveform is gone through in t0 at u = 0 before the compression ("pulse"), which is without shear then.
    """
    before = (Stage("pulse", 0.0, 0.0, 1.0, sheared=True),) if shear == "before" else ()
    first = (
        *preparation_cycle(rest, hold),
        Stage("rest-2", 0.0, 0.0, rest),
        *before,
        Stage("encode", 0.0, 1.0, 1.0, sheared=not before),
        Stage("store", 1.0, 1.0, store),
        Stage("readout", 1.0, 0.0, 1.0),
    )
    if not second_readout:
        return first
    *again, last = preparation_cycle(rest, hold)
    repeated = (replace(stage, name=f"{stage.name}-3") for stage in again)
    return (*first, *repeated, replace(last, name="readout-2"))


def compression_at(name: str, passed: np.ndarray) -> np.ndarray:
    """u where parts `passed` of a stage are over, by its name (that of `memory_protocol`, or of a preparation)."""
    kind = name.rpartition(": ")[2].partition("-")[0]
    ends = {stage.name: (stage.start, stage.stop) for stage in memory_protocol(0, 0, 0, second_readout=False)}
    start, stop = ends.get(kind, (0.0, 0.0))  # a pulse is at u = 0, like a rest
    return np.asarray(start + (stop - start) * passed)


def split(stages: tuple[Stage, ...]) -> tuple[tuple[Stage, ...], tuple[Stage, ...]]:
    """The stages before the first sheared one, common to all signals and run once; and those from it on."""
    common = tuple(itertools.takewhile(lambda stage: not stage.sheared, stages))
    return common, stages[len(common) :]
