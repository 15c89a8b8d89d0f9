"""Results with names on their axes: xarray (an extra of the package), and CSV."""

import csv
import io
import json
from typing import Any

import numpy as np

from gmem_jax.experiment.recall import Recall
from gmem_jax.files.measures import of_each
from gmem_jax.files.schemas import RECALL, STAGE
from gmem_jax.files.validation import optional
from gmem_jax.simulation.protocol import BINS


def described(name: str) -> dict[str, str]:
    """Units and description of an array of a recall."""
    array = RECALL.arrays[name]
    return {"units": array.units, "description": array.words}


def recall_dataset(recall: Recall) -> Any:
    """A recall as an xarray.Dataset: its arrays, and the samples of all stages one after the other along `time`.

    Args:
        recall: the recall; stages that were run once for all replicas are repeated for each.

    Raises:
        ValueError: if xarray is not installed.
    """
    xarray, configuration = optional("xarray", "export"), recall.configuration
    stages, replicas = recall.stages, len(recall.status)
    bins = {name: len(sample.filling) for name, sample in stages.items()}
    joined: dict[str, Any] = {
        "time": np.arange(1, sum(bins.values()) + 1) / BINS,
        "u_of_time": np.concatenate([np.asarray(sample.u)[:, 0] for sample in stages.values()]),
        "stage": np.repeat(list(bins), list(bins.values())),
    }
    data = {}
    for name, array in STAGE.items():
        about = {"units": array.units, "description": array.words}
        if name in ("time", "u"):
            at = "u_of_time" if name == "u" else name
            joined[at] = ("time", joined[at], about)
            continue
        own = (np.asarray(getattr(sample, name)) for sample in stages.values())
        wide = [np.broadcast_to(values, (*values.shape[:-1], replicas)) for values in own]
        data[name] = (array.shape, np.concatenate(wide), about)
    derived = of_each(recall)
    for name, array in RECALL.arrays.items():
        if name not in ("u", "signal"):
            values = derived[name] if name in derived else np.asarray(getattr(recall, name))
            data[name] = (array.shape if values.ndim == len(array.shape) else ("replica",), values, described(name))
    coordinates = {
        "signal": ("signal", recall.names, described("signal")),
        "u": ("u", np.asarray(recall.u), described("u")),
        "replica": np.arange(replicas),
        "axis": ["x", "y", "z"],
        **joined,
        "stage": ("time", joined["stage"]),
    }
    told = ("pack", "grains", "friction", "background", "mu", "gamma0", "delta0", "t0")
    facts = {name: configuration[name] for name in told if name in configuration}
    about = {"schema": RECALL.name, "units": "R = E = rho = 1", **facts, "configuration": json.dumps(configuration)}
    return xarray.Dataset(data, coordinates, about)


def plain_cell(value: Any) -> Any:
    """The value of a cell of CSV; before a text that spreadsheets would take for a formula an apostrophe is put."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@")) else value


def recall_csv(recall: Recall) -> str:
    """The recalled signals as CSV: u, and p_sig of every signal in E."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["u", *(f"p_sig of {name} (E)" for name in recall.names)])
    writer.writerows(np.column_stack([recall.u, np.asarray(recall.p_sig).T]).tolist())
    return text.getvalue()


def each_csv(recall: Recall) -> str:
    """What is said of each signal by itself (`of_each`) as CSV, a row for each."""
    text, measures = io.StringIO(), of_each(recall)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["signal", *(name.removeprefix("signal_") for name in measures)])
    writer.writerows(
        [name, *row] for name, row in zip(recall.names, np.column_stack([*measures.values()]).tolist(), strict=True)
    )
    return text.getvalue()
