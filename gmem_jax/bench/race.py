"""Timing several programs in turn, so that other load of the machine falls on all of them alike."""

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
        replicas: replicas side by side, for LAMMPS processes side by side.
        us: best wall time of a grain-step, in microseconds.
        median: of the repeats.
        worst: of the repeats.
        compile_s: seconds spent compiling, apart.
        note: how LAMMPS was run, or what else is special.
        p_xy: of the last replica at the end, in E; NaN where it cannot be compared.
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
    """Something to be timed.

    Attributes:
        row: what it is.
        once: times it; microseconds a grain-step.
    """

    row: Row
    once: Callable[[], float]


def interleave(rivals: Sequence[Candidate], repeats: int = REPEATS) -> list[Row]:
    """Time each of them `repeats` times, all in turn; the rows with their times."""
    times: list[list[float]] = [[] for _ in rivals]
    for _ in range(repeats):
        for found, rival in zip(times, rivals, strict=True):
            found.append(rival.once())
    return [
        replace(rival.row, us=min(found), median=statistics.median(found), worst=max(found))
        for found, rival in zip(times, rivals, strict=True)
    ]
