"""Curves of a measure of a sweep against one name, with means and standard errors over others."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gmem_jax.experiment.analysis import spread
from gmem_jax.files.validation import is_number
from gmem_jax.sweeps.table import result_of

Rows = Sequence[Mapping[str, Any]]


class Axes(NamedTuple):
    """The roles of the names of a sweep in a picture.

    Attributes:
        x: the name along the horizontal axis.
        by: names with a line for each combination of their values.
        over: names over which means and standard errors are taken.
    """

    x: str
    by: tuple[str, ...]
    over: tuple[str, ...]


class Line(NamedTuple):
    """A line of a picture.

    Attributes:
        values: the values, by name, that its points have in common.
        x: the places of its points, in order.
        each: the measures at each place.
    """

    values: dict[str, Any]
    x: list[Any]
    each: list[list[float]]

    @property
    def mean(self) -> np.ndarray:
        """Mean of the measures at each x."""
        return np.asarray([spread(values)[0] for values in self.each])

    @property
    def error(self) -> np.ndarray:
        """Standard error of the mean at each x; NaN where there is one measure."""
        return np.asarray([spread(values)[2] for values in self.each])

    @property
    def most(self) -> int:
        """The largest number of measures at an x."""
        return max(map(len, self.each))


def is_sample(name: str) -> bool:
    """Whether a name only numbers random samples, as "pack" and seeds do."""
    return name == "pack" or name.rpartition(".")[2] == "seed"


def axes_of(rows: Rows, names: Sequence[str], x: str = "", by: Sequence[str] = (), over: Sequence[str] = ()) -> Axes:
    """The role of every name, of which some may be chosen. Only samples are averaged over unless `over` says otherwise.

    Args:
        rows: rows of the points that are done.
        names: names that the sweep varies.
        x: default the first name with numbers that is not a sample, else the first that is not, else the first sample.
        by: default all other names that vary and do not follow from x.
        over: default the samples (`is_sample`).

    Raises:
        ValueError: for a chosen name that does not vary or has two roles; or if `by` is chosen and another name that
            varies has no role.
    """
    chosen = [*([x] if x else []), *by, *over]
    varying = [name for name in names if len({row[name] for row in rows}) > 1]
    for name in chosen:
        if name not in names:
            raise ValueError(f"{name}: does not vary here; {', '.join(names)} do")
        if chosen.count(name) > 1:
            raise ValueError(f"{name}: is named twice in --x, --by and --over; name it in one of them")
    free = [name for name in varying if name not in chosen]
    if not x:
        numbers = [name for name in free if all(is_number(row[name]) for row in rows)]
        known = [name for some in (numbers, free) for name in some if not is_sample(name)]
        x = next(iter([*known, *free, *[name for name in names if name not in chosen], *names]))
        free = [name for name in free if name != x]
    if not over:
        over = [name for name in free if is_sample(name)]
    left = [name for name in free if name not in over and not _follows(rows, name, x)]
    if by and left:
        raise ValueError(f"{left[0]}: varies too; name it in --by for a line each, or in --over for a mean")
    return Axes(x, tuple(by) or tuple(left), tuple(over))


def _follows(rows: Rows, name: str, x: str) -> bool:
    """Whether each value of x goes with one value of another name, as in a [[zip]]."""
    return len({(row[x], row[name]) for row in rows}) == len({row[x] for row in rows})


def lines_of(rows: Rows, axes: Axes, measure: str) -> list[Line]:
    """The lines of a picture, each in the order of x; points without an x are left out."""
    there = [row for row in rows if row[axes.x] is not None]
    numbers = all(is_number(row[axes.x]) for row in there)
    found: dict[tuple[Any, ...], dict[Any, dict[Any, float]]] = {}
    for row in sorted(there, key=lambda row: row[axes.x] if numbers else str(row[axes.x])):
        line = found.setdefault(tuple(row[name] for name in axes.by), {})
        line.setdefault(row[axes.x], {})[result_of(row)] = float(row[measure])
    lines = [
        Line(dict(zip(axes.by, own, strict=True)), list(at), [list(each.values()) for each in at.values()])
        for own, at in found.items()
    ]
    order = {value: place for place, value in enumerate(tuple(row[name] for name in axes.by) for row in there)}
    return sorted(lines, key=lambda line: order[tuple(line.values.values())])
