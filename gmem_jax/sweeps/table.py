"""The results of a sweep as a table, with means over names that are samples, such as packs."""

import csv
import functools
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gmem_jax.experiment.analysis import MEASURES, spread
from gmem_jax.files.atomic import atomic
from gmem_jax.files.datasets import plain_cell
from gmem_jax.files.measures import EACH, of_each
from gmem_jax.files.schemas import RECALL
from gmem_jax.files.validation import optional
from gmem_jax.physics.numbers import plural
from gmem_jax.physics.state import combined_status, explain
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.work import WARNED

TABLE_SCHEMA = "gmem-sweep-table/0.1"
READ_AND_CHANNEL = ("read", "channel")
_Row = TypeVar("_Row", bound=Mapping[str, Any])
TABLE_FORMATS = (".csv", ".parquet", ".h5", ".nc")


def rows(store: Store) -> list[dict[str, Any]]:
    """A row for each point of a sweep, in order: the names that vary, the measures, and the status.

    The state of a point is "done", "failed" with a reason, or "open" if it is not computed yet. If a point has several
    reads or channels, it has a row for each, and all rows of the table have the names "read" and "channel".

    Raises:
        FileFormatError: if there is no sweep, or a result is damaged.
    """
    card, failed = store.card(), store.failed()
    found: list[tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = []  # names that vary; read and channel; others
    for point in card["points"]:
        key = point["key"]
        row: dict[str, Any] = {name: _cell(point["values"].get(name)) for name in card["names"]}
        if store.at(key).is_file():
            recall = store.load(key)
            configuration = recall.configuration
            status = combined_status(recall.status)
            told = {"status": status, "why": explain(status) if status else ""}
            warned = "; ".join(map(str, configuration.get(WARNED, ())))
            told |= {"warnings": warned, "seconds": configuration["seconds"], "key": key}
            for one in recall.each():
                measures = {"state": "done", **{name: float(getattr(one, name)) for name in MEASURES}}
                found.append((row, {"read": one.reads[0], "channel": one.channels[0]}, {**measures, **told}))
        else:
            measures = {"state": "failed" if key in failed else "open", **dict.fromkeys(MEASURES)}
            told = {"status": None, "why": failed.get(key, ""), "warnings": "", "seconds": None, "key": key}
            found.append((row, dict.fromkeys(READ_AND_CHANNEL), {**measures, **told}))
    several = len(found) > len(card["points"])
    return [{**row, **(part if several else {}), **rest} for row, part, rest in found]


def names_in(table: Sequence[Mapping[str, Any]], names: Sequence[str]) -> list[str]:
    """The names that distinguish the rows of a sweep: those that vary, and read and channel if there are several."""
    return [*names, *(part for part in READ_AND_CHANNEL if part not in names and any(part in row for row in table))]


def points_in(table: Sequence[_Row]) -> list[_Row]:
    """The first row of each point."""
    found: list[_Row] = []
    seen: set[Any] = set()
    for row in table:
        part = tuple(row.get(name) for name in READ_AND_CHANNEL)
        if not found or row.get("key") != found[-1].get("key") or part in seen:  # a point may occur twice
            found.append(row)
            seen = set()
        seen.add(part)
    return found


def result_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """The identity of a row's result: means count each result once, though several points may have it."""
    return row["key"], *(row.get(name) for name in READ_AND_CHANNEL)


def warnings_of(row: Mapping[str, Any]) -> str:
    """Why the result of a row is doubtful: its status and the warnings of its run; "" if it is not."""
    return "; ".join(filter(None, (row["why"], row["warnings"]))) if row["state"] == "done" else ""


def doubts(table: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each reason why results are doubtful, with their number; points with one key count once."""
    points = {row["key"]: row for row in points_in(table)}
    counts = Counter(reason for row in points.values() if (reason := warnings_of(row)))
    return [f"{count} of {plural(len(points), 'point')}: {reason}" for reason, count in counts.items()]


def _cell(value: Any) -> Any:
    return value if isinstance(value, str | int | float | bool | None) else json.dumps(value)


def means(table: Sequence[dict[str, Any]], names: Sequence[str], over: Sequence[str]) -> list[dict[str, Any]]:
    """One row for all rows that differ only in the names `over`: mean, SD and SE of each measure, and their number."""
    left = [name for name in names if name not in over]
    groups: dict[tuple[Any, ...], dict[Any, dict[str, Any]]] = {}
    for row in table:
        groups.setdefault(tuple(row[name] for name in left), {})[result_of(row)] = row
    found = []
    for values, members in groups.items():
        done = [row for row in members.values() if row["state"] == "done"]
        row = dict(zip(left, values, strict=True)) | {"points": len(members), "done": len(done)}
        for measure in MEASURES:
            mean, deviation, error = spread([one[measure] for one in done]) if done else (None, None, None)
            row |= {measure: mean, f"{measure}_sd": deviation, f"{measure}_se": error}
        row["status"] = combined_status([one["status"] for one in done]) if done else None
        row["warnings"] = "; ".join(dict.fromkeys(one["warnings"] for one in done if one["warnings"]))
        found.append(row)
    return found


def export_table(store: Store, path: Path) -> str:
    """Write the table as .csv (see `plain_cell`) or .parquet; or, with all recalled signals, as .h5 or .nc for xarray.

    Returns:
        A remark on the file for the user; "" if there is none.

    Raises:
        ValueError: for another suffix, a sweep without points, or if a library is missing.
        OSError: if it cannot be written.
    """
    suffix = path.suffix.lower()
    table = rows(store)
    if not table:
        raise ValueError(f"{store.folder}: has no points yet")
    if suffix == ".csv":
        with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerows([map(plain_cell, row) for row in (table[0], *(row.values() for row in table))])
    elif suffix == ".parquet":
        pyarrow, parquet = optional("pyarrow", "export"), optional("pyarrow.parquet", "export")
        with atomic(path) as temporary:
            parquet.write_table(pyarrow.Table.from_pylist(table), temporary)
    elif suffix in (".h5", ".nc"):
        data = _dataset(store, table)
        with atomic(path) as temporary:
            data.to_netcdf(temporary, engine="h5netcdf")
        counts = sorted({int(count) for count in data.get("signal_count", ()) if count})
        if len(counts) > 1:
            return f"points have {counts[0]} to {counts[-1]} signals, see `signal_count`; what lies beyond them is NaN"
    else:
        raise ValueError(f"{path}: must end in one of {', '.join(TABLE_FORMATS)}")
    return ""


def _dataset(store: Store, table: Sequence[dict[str, Any]]) -> Any:
    """The table as an xarray.Dataset over points, with the signals of each; NaN where a point has fewer than others."""
    xarray = optional("xarray", "export")
    optional("h5netcdf", "export")
    card = store.card()
    columns = {name: ("point", _column([row[name] for row in table])) for name in table[0]}
    about = {"schema": TABLE_SCHEMA, "shared": json.dumps(card["shared"])}
    data = xarray.Dataset(columns, attrs=about)
    whole = functools.lru_cache(1)(store.load)
    loaded = {
        place: whole(row["key"]).at(*(row.get(name) or 0 for name in READ_AND_CHANNEL))
        for place, row in enumerate(table)
        if row["state"] == "done"
    }
    if not loaded:
        return data
    counts = np.zeros(len(table), int)
    for place, recall in loaded.items():
        counts[place] = recall.J.shape[-2]
    u = np.asarray(next(iter(loaded.values())).u)
    blank = (len(table), counts.max())
    names = np.full(blank, "", object)
    values = {name: np.full((*blank, len(u)), np.nan) for name in ("p_sig", "J", "shear")}
    values |= {name: np.full(blank, np.nan) for name in EACH}
    for place, recall in loaded.items():
        own = {**vars(recall), **of_each(recall)}
        names[place, : counts[place]] = recall.names
        for name, array in values.items():
            array[place, : counts[place]] = own[name]
    for name, array in values.items():
        data[name] = (("point", "signal", "u")[: array.ndim], array, RECALL.arrays[name].attributes)
    told = {"units": "1", "description": "signals of the point; what lies beyond them is NaN"}
    data["signal_count"] = ("point", counts, told)
    data["signal_name"] = (("point", "signal"), names.astype(str), {"description": "names of its signals"})
    return data.assign_coords(u=("u", u, RECALL.arrays["u"].attributes))


def _column(values: list[Any]) -> np.ndarray:
    if all(isinstance(value, int | float | None) and not isinstance(value, bool) for value in values):
        return np.asarray([np.nan if value is None else value for value in values], float)
    return np.asarray(["" if value is None else str(value) for value in values])
