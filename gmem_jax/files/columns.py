"""Reading tables of numbers in text, as spreadsheets and instruments write them."""

import csv
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gmem_jax.errors import FileFormatError

_SEPARATORS = {";": "semicolons", "\t": "tabs"}
_AXIS = re.compile(r"(u|t|time)(\s*[(\[].*[)\]])?|(t|time)\s*[/_]\s*[^\W\d]+", re.IGNORECASE)
_NAMELESS = re.compile(r"(unnamed.*)?", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_PAIRS = re.compile(r"\s*-?[01],\d+(,-?[01],\d+)*\s*")  # a row of numbers of size 1 whose decimal commas separate cells
_OWN = re.compile(r"signal_\d+")  # column names of `save_waveforms`
_AS_AXIS = "call it u or time if it is the axis, else leave it out"


class SampleTable(NamedTuple):
    """The samples in a table.

    Attributes:
        values: the columns other than the axis, [S, n].
        axis: values of the axis, [n]; None if there is no such column.
        name: name of the axis.
        said: remarks on the format of the table, for a person.
    """

    values: np.ndarray
    axis: np.ndarray | None = None
    name: str = ""
    said: tuple[str, ...] = ()


def read_columns(path: Path) -> SampleTable:
    """The columns of a CSV: separated by commas, semicolons or tabs, with or without a line of names.

    Raises:
        FileFormatError: for decimal commas, names that do not fit the columns, and a column of times or row numbers
            that is not named as the axis.
        ValueError: if it is not a table of numbers.
    """
    lines = [line for line in path.read_text("utf-8-sig").splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        return SampleTable(np.zeros((0, 0)))
    separator = next((one for one in _SEPARATORS if one in lines[0]), ",")
    first = [cell.strip() for cell in next(csv.reader(lines[:1], delimiter=separator))]
    numbers = [_is_number(cell) for cell in first]
    if any(numbers) and not all(numbers):
        raise FileFormatError(f"{path}: its first line mixes numbers and words ({lines[0].strip()[:40]!r})")
    names = [] if all(numbers) else first
    rows = lines[1:] if names else lines
    if not rows:
        return SampleTable(np.zeros((0, 0)))
    values = _numbers(path, rows, separator)
    said = () if separator == "," else (f"separated by {_SEPARATORS[separator]}",)
    _require_names(path, names, values, rows)
    axes = [place for place, name in enumerate(names) if _AXIS.fullmatch(name)]
    if len(axes) > 1 or len(axes) == len(values):
        raise FileFormatError(f"{path}: columns {', '.join(names)}: need one axis (u or time) and one signal or more")
    _require_no_axis(path, names, values, axes)
    if not axes:
        return SampleTable(values, said=said)
    return SampleTable(np.delete(values, axes, axis=0), values[axes[0]], names[axes[0]], said)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _numbers(path: Path, rows: list[str], separator: str) -> np.ndarray:
    """The numbers of a table, [columns, rows]."""
    try:
        return np.loadtxt(rows, delimiter=separator, ndmin=2, quotechar='"').T
    except ValueError:
        for cell in (cell.strip() for row in csv.reader(rows, delimiter=separator) for cell in row):
            if _DECIMAL_COMMA.fullmatch(cell):
                raise FileFormatError(f"{path}: decimal commas ({cell!r}); write numbers with points") from None
            if len(cell.split()) > 1 and all(map(_is_number, cell.split())):
                raise FileFormatError(f"{path}: numbers separated by blanks ({cell[:40]!r}); use commas") from None
        raise


def _require_names(path: Path, names: list[str], values: np.ndarray, rows: list[str]) -> None:
    """Refuse names that do not fit the columns, and numbers that decimal commas cut into two columns."""
    count = len(values)
    halves = len(names) * 2 == count if names else all(map(_PAIRS.fullmatch, rows)) and np.any(values[1::2] > 1.0)
    if halves and "," in rows[0]:
        raise FileFormatError(f"{path}: decimal commas ({rows[0].strip()[:40]!r}); write numbers with points")
    if names and len(names) != count:
        raise FileFormatError(f"{path}: {len(names)} names over {count} columns; name each, or none")
    if nameless := [place + 1 for place, name in enumerate(names) if _NAMELESS.fullmatch(name)]:
        raise FileFormatError(f"{path}: column {nameless[0]} has no name, as row numbers have none; {_AS_AXIS}")


def _require_no_axis(path: Path, names: list[str], values: np.ndarray, axes: list[int]) -> None:
    """Refuse a column that rises by equal steps beside others: it has times, places or row numbers, not a waveform.

    Steps count as equal if no number is further than half a step from a straight line, since times are often rounded.
    """
    if len(values) < 2 or values.shape[1] < 3:
        return
    for place, column in enumerate(values):
        if place in axes:
            continue
        name = names[place] if names else ""
        step = (column[-1] - column[0]) / (len(column) - 1)
        line = np.linspace(column[0], column[-1], len(column))
        rises = step > 0.0 and np.all(np.diff(column) >= 0.0) and np.all(np.abs(column - line) <= 0.5 * step)
        if rises and not _OWN.fullmatch(name):
            called = f"column {place + 1}" + (f" ({name!r})" if name else "")
            raise FileFormatError(f"{path}: {called} rises by equal steps, as times and row numbers do; {_AS_AXIS}")
