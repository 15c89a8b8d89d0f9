"""The results of a sweep as a table: a row for each point, and means over what is only a sample, like packs."""

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gmem_jax.experiment.analysis import MEASURES, spread
from gmem_jax.files.atomic import atomic
from gmem_jax.files.checked import optional
from gmem_jax.files.labelled import described, plain_cell
from gmem_jax.physics.state import explain, together
from gmem_jax.sweeps.store import Store

FORMATS = (".csv", ".parquet", ".h5", ".nc")


def rows(store: Store) -> list[dict[str, Any]]:
    """A row for each point of a sweep, in its order: what varies, the measures, status.

    Points that are not computed yet have the state "open", those that failed "failed" and their reason.

    Raises:
        FileFormatError: if there is no sweep, or a result is damaged.
    """
    card, failed = store.card(), store.failed()
    found = []
    for point in card["points"]:
        key = point["key"]
        row: dict[str, Any] = {name: _cell(point["values"].get(name)) for name in card["names"]}
        if store.at(key).is_file():
            recall, configuration = store.load(key)
            status = together(recall.status)
            row |= {"state": "done", **{name: float(getattr(recall, name)) for name in MEASURES}}
            row |= {"status": status, "why": explain(status) if status else "", "seconds": configuration["seconds"]}
        else:
            row |= {"state": "failed" if key in failed else "open", **dict.fromkeys(MEASURES)}
            row |= {"status": None, "why": failed.get(key, ""), "seconds": None}
        found.append({**row, "key": key})
    return found


def _cell(value: Any) -> Any:
    return value if isinstance(value, str | int | float | bool | None) else json.dumps(value)


def means(table: Sequence[dict[str, Any]], names: Sequence[str], over: Sequence[str]) -> list[dict[str, Any]]:
    """Rows that differ only in the names `over` as one: mean, standard deviation and number of each measure."""
    left = [name for name in names if name not in over]
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in table:
        groups.setdefault(tuple(row[name] for name in left), []).append(row)
    found = []
    for values, members in groups.items():
        done = [row for row in members if row["state"] == "done"]
        row = dict(zip(left, values, strict=True)) | {"points": len(members), "done": len(done)}
        for measure in MEASURES:
            mean, deviation, error = spread([one[measure] for one in done]) if done else (None, None, None)
            row |= {measure: mean, f"{measure}_sd": deviation, f"{measure}_se": error}
        found.append(row)
    return found


def export(store: Store, path: Path) -> None:
    """Write the table: .csv (see `plain_cell`); .parquet; .h5 or .nc, which xarray reads, with every recalled signal.

    Raises:
        ValueError: for another suffix, or if a library is missing.
        OSError: if it cannot be written.
    """
    suffix = path.suffix.lower()
    table = rows(store)
    if not table:
        raise ValueError(f"{store.folder}: has no points yet")
    if suffix == ".csv":
        with atomic(path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerows([map(plain_cell, row) for row in (table[0], *(row.values() for row in table))])
    elif suffix == ".parquet":
        pyarrow, parquet = optional("pyarrow", "export"), optional("pyarrow.parquet", "export")
        with atomic(path) as temporary:
            parquet.write_table(pyarrow.Table.from_pylist(table), temporary)
    elif suffix in (".h5", ".nc"):
        with atomic(path) as temporary:
            _dataset(store, table).to_netcdf(temporary, engine="h5netcdf")
    else:
        raise ValueError(f"{path}: must end in one of {', '.join(FORMATS)}")


def _dataset(store: Store, table: Sequence[dict[str, Any]]) -> Any:
    """The table as an xarray.Dataset over points; signals where all points have as many."""
    xarray = optional("xarray", "export")
    optional("h5netcdf", "export")
    card = store.card()
    columns = {name: ("point", _column([row[name] for row in table])) for name in table[0]}
    data = xarray.Dataset(columns, attrs={"schema": "gmem-sweep-table/1", "shared": json.dumps(card["shared"])})
    recalls = {row["key"]: store.load(row["key"])[0] for row in table if row["state"] == "done"}
    shapes = {np.shape(recall.p_sig) for recall in recalls.values()}
    if len(shapes) == 1:
        (shape,) = shapes
        blank = np.full(shape, np.nan)
        for name in ("p_sig", "J", "shear"):
            stacked = [
                np.asarray(getattr(recalls[row["key"]], name)) if row["key"] in recalls else blank for row in table
            ]
            data[name] = (("point", "signal", "u"), np.stack(stacked), described(name))
        data = data.assign_coords(u=("u", np.asarray(next(iter(recalls.values())).u), described("u")))
    return data


def _column(values: list[Any]) -> np.ndarray:
    if all(isinstance(value, int | float | None) and not isinstance(value, bool) for value in values):
        return np.asarray([np.nan if value is None else value for value in values], float)
    return np.asarray(["" if value is None else str(value) for value in values])
