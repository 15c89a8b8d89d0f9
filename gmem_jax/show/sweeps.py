"""Tables and figures of sweeps."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from gmem_jax.files.validation import is_number
from gmem_jax.physics.numbers import plural
from gmem_jax.physics.state import SENTENCES, Status, combined_status
from gmem_jax.show.figure import Curve, Figure, Panel, ramp
from gmem_jax.show.numbers import status_words
from gmem_jax.show.tables import cell, decimal
from gmem_jax.sweeps.curves import Line, axes_of, is_sample, lines_of
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.table import names_in, points_in

ABOUT = "F(T1): F after a running mean over the ringing period"
FEW_LINES = 6  # most lines whose legend fits inside the axes
_LABELS = {
    "gain": "gain G",
    "fidelity": "fidelity F",
    "windowed_gain": "G after a mean over T1",
    "windowed_fidelity": "F after a mean over T1",
}


def sweep_facts(store: Store, table: list[dict[str, Any]]) -> dict[str, Any]:
    """Numbers of points by state, status and seconds of a sweep, and the rows of its table."""
    points = points_in(table)
    states = {state: sum(row["state"] == state for row in points) for state in ("done", "failed", "open")}
    done = [row for row in points if row["state"] == "done"]
    status = combined_status([row["status"] for row in done])
    seconds = sum(row["seconds"] for row in done)
    return {"folder": str(store.folder), **states, "status": status, "seconds": seconds, "points": table}


def points_table(table: list[dict[str, Any]], names: list[str]) -> Table:
    """A table of the points of a sweep: the names that vary, G, F and status, from `gmem_jax.sweeps.table.rows`."""
    drawn, names = Table(caption_justify="left"), names_in(table, names)
    for name in (*names, "G", "F", "F(T1)", "status"):
        drawn.add_column(name, no_wrap=name != "status")
    for row in table:
        state = _state(row) if row["state"] == "done" else row["state"]
        numbers = [row[name] for name in ("gain", "fidelity", "windowed_fidelity")]
        measured = ("" if number is None else decimal(number) for number in numbers)
        drawn.add_row(*(cell(row[name]) for name in names), *measured, state)
    drawn.caption = "\n".join([ABOUT, *_reasons(table)])
    return drawn


def _state(row: dict[str, Any]) -> str:
    """The status of a point, or of several, as a short text."""
    return ", ".join([*status_words(row["status"] or 0), *(["warned"] if row["warnings"] else [])]) or "ok"


def _reasons(table: list[dict[str, Any]]) -> list[str]:
    """Explanations of the words of `_state` that occur in a table."""
    bits = {bit for row in table for bit in Status if (row["status"] or 0) & bit}
    told = dict.fromkeys(f"warned: {row['warnings']}" for row in table if row["warnings"])
    return [*(f"{word}: {SENTENCES[bit]}" for bit in sorted(bits) for word in status_words(bit)), *told]


def means_table(table: list[dict[str, Any]], names: list[str]) -> Table:
    """A table of means over points, from `gmem_jax.sweeps.table.means`."""
    drawn = Table(caption_justify="left")
    for name in (*names, "n", "G", "F", "F(T1)", "status"):
        drawn.add_column(
            name, no_wrap=name not in (*names, "status"), min_width=14 if name in ("G", "F", "F(T1)") else None
        )
    for row in table:
        shown = [_with_error(row, name) for name in ("gain", "fidelity", "windowed_fidelity")]
        drawn.add_row(
            *(cell(row[name]) for name in names), str(row["done"]), *shown, _state(row) if row["done"] else ""
        )
    drawn.caption = "\n".join(["mean and standard error", ABOUT, *_reasons(table)])
    return drawn


def _with_error(row: dict[str, Any], measure: str) -> str:
    if row[measure] is None:
        return ""
    return decimal(row[measure], row[f"{measure}_se"])


def sweep_figure(
    rows: Sequence[Mapping[str, Any]], names: Sequence[str], measure: str, title: str, **chosen: Any
) -> Figure:
    """A measure of the points of a sweep. Several points at one place are dots, with their mean and standard error.

    Args:
        rows: rows of the points (`gmem_jax.sweeps.table.rows`).
        names: the names that vary.
        measure: one of `MEASURES`.
        title: title above the picture.
        **chosen: `x`, `by` and `over` of `axes_of`.

    Raises:
        ValueError: if no point is done, or the choice is impossible (see `axes_of`).
    """
    done = [row for row in rows if row["state"] == "done"]
    if not done:
        raise ValueError(f"{title}: no point is done, so there is nothing to draw")
    axes = axes_of(done, names, **chosen)
    lines = lines_of(done, axes, measure)
    places = {value for line in lines for value in line.x}
    ticks = [] if all(map(is_number, places)) else sorted(places, key=str)
    colours = [f"C{number}" for number in range(len(lines))] if len(lines) <= 10 else ramp(len(lines))
    marks: list[Curve] = []
    for line, colour in zip(lines, colours, strict=True):
        at = np.array([ticks.index(value) if ticks else value for value in line.x])
        errors = line.error if line.most > 1 else None
        marks.append(Curve(at, line.mean, _label(line), colour, "o" if ticks else "o-", errors=errors))
        if line.most > 1:
            dots = np.array([(x, y) for x, values in zip(at, line.each, strict=True) for y in values])
            marks.append(Curve(dots[:, 0], dots[:, 1], "", colour, "."))
    counts = [len(values) for line in lines for values in line.each]
    samples = f"n = {min(counts)}" + (f" to {max(counts)}" if max(counts) > min(counts) else "")
    several = f"mean ± SE over {', '.join(axes.over) or 'points'}, {samples}" if max(counts) > 1 else ""
    few = len(lines) <= FEW_LINES
    panel = Panel(tuple(marks), "", axes.x, _LABELS[measure], x_names=[cell(value)[:24] for value in ticks])
    over = (f"{title}: {len(points_in(done))} of {plural(len(points_in(rows)), 'point')}", several)
    return Figure((panel,), size=(6.4 if few else 8.6, 4.0), title=over, legend="panel" if few else "right")


def _label(line: Line) -> str:
    return ", ".join(f"{name} = {cell(value)}" for name, value in line.values.items())


def against(x: str, rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Figure | None:
    """F and G of a sweep against x; None if x is a sample, or has fewer than two numbers among the points done."""
    done = [row for row in rows if row["state"] == "done" and isinstance(row[x], int | float)]
    if is_sample(x) or len({row[x] for row in done}) < 2:
        return None
    axes = axes_of(done, names, x)
    marks: list[Curve] = []
    for letter, measure in (("F", "fidelity"), ("G", "gain")):
        for line in lines_of(done, axes, measure):
            colour = f"C{len(marks) % 7}"
            marks.append(
                Curve(np.array(line.x), line.mean, f"{letter} {_label(line)}", colour, "o-", errors=line.error)
            )
    label = f"F, G (mean ± SE over {', '.join(axes.over)})" if axes.over else "F, G"
    return Figure((Panel(tuple(marks), "", x, label),), legend="panel")
