"""Timing several programs in turn, so that other load of the machine affects all of them alike."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

REPEATS = 5


@dataclass(frozen=True)
class Row:
    """One measurement.

    Attributes:
        engine: "native", "jax" or "lammps".
        law: "H", "M1" or "M2".
        grains: number of grains.
        replicas: number of replicas side by side; for LAMMPS, of processes.
        us: best wall time of a grain-step over the repeats, in microseconds.
        median: median over the repeats.
        worst: longest time over the repeats.
        compile_s: seconds of compilation, which are not part of the times.
        note: how LAMMPS was run, or another remark.
        p_xy: p_xy of the last replica at the end, in E; NaN if it cannot be compared.
    """

    engine: str
    law: str
    grains: int
    replicas: int
    us: float = float("nan")
    median: float = float("nan")
    worst: float = float("nan")
    compile_s: float = 0.0
    note: str = ""
    p_xy: float = float("nan")


class Candidate(NamedTuple):
    """A program to be timed.

    Attributes:
        row: its description.
        once: times the program; gives microseconds per grain-step.
    """

    row: Row
    once: Callable[[], float]


def interleave(rivals: Sequence[Candidate], repeats: int = REPEATS) -> list[Row]:
    """Time each program `repeats` times, all in turn; gives the rows with their times."""
    times: list[list[float]] = [[] for _ in rivals]
    for _ in range(repeats):
        for found, rival in zip(times, rivals, strict=True):
            found.append(rival.once())
    return [
        replace(rival.row, us=min(found), median=statistics.median(found), worst=max(found))
        for found, rival in zip(times, rivals, strict=True)
    ]
