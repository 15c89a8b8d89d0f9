"""How objects are displayed: a line in a terminal, a short table in a notebook."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from gmem_jax.physics.pytree import traced

MOST_ROWS = 20  # rows of a long table


def brief(value: Any) -> str:
    """A value as a short text: a number, the range of several numbers, or words."""
    if traced(value):
        return "traced"
    if isinstance(value, str | bool | None):
        return str(value)
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "fiu" or numbers.size == 0:
        return str(value)
    low, high = numbers.min(), numbers.max()
    return f"{low:.4g}" if numbers.ndim == 0 or low == high else f"{low:.4g} to {high:.4g}"


Facts = tuple[str, Mapping[str, Any]]
"""A title, and the values to be shown by name."""


def line(made: Any, found: Callable[[], Facts]) -> str:
    """The facts of an object in one line; only its class if its leaves are not numbers (`jax.tree.map` makes such)."""
    try:
        title, rows = found()
        return f"<{title}: {', '.join(f'{name} = {brief(value)}' for name, value in rows.items())}>"
    except (AttributeError, TypeError, ValueError):
        return f"<{type(made).__name__}>"


def facts(title: str, rows: Mapping[str, Any]) -> str:
    """A table of names and values."""
    return _table(title, [[name, brief(value)] for name, value in rows.items()])


def listing(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table with a line for each of the first 20 rows."""
    more = [[f"... {len(rows) - MOST_ROWS} more"]] if len(rows) > MOST_ROWS else []
    shown = [[brief(value) for value in row] for row in rows[:MOST_ROWS]]
    return _table(title, [*shown, *more], columns)


def _table(title: str, rows: Sequence[Sequence[str]], columns: Sequence[str] = ()) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in columns)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><caption>{escape(title)}</caption>{f'<tr>{head}</tr>' if head else ''}{body}</table>"
