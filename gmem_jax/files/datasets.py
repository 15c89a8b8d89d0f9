"""Recalls as xarray datasets (with the extra `export`), and as CSV."""

import csv
import io
import json
from typing import Any

import numpy as np

from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.record import values_of
from gmem_jax.files.hdf5 import OBSERVED, observed_array
from gmem_jax.files.measures import of_each
from gmem_jax.files.schemas import RECALL, STAGE, declared_of_recall
from gmem_jax.files.validation import optional
from gmem_jax.simulation.sample import ends_of_bins


def to_xarray(recall: Recall) -> Any:
    """A recall as an `xarray.Dataset` with named axes, units and descriptions.

    The samples of all stages are joined along the axis `time`; those of stages that were run once for all replicas are
    repeated for each replica.

    Args:
        recall: the recall.

    Raises:
        ValueError: if xarray is not installed.
    """
    require_kind("to_xarray", recall, Recall)
    xarray, configuration = optional("xarray", "export"), recall.configuration
    stages, replicas = recall.stages, len(recall.status)
    bins = {name: len(sample.filling) for name, sample in stages.items()}
    joined: dict[str, Any] = {
        "time": np.concatenate([*ends_of_bins(stages, recall.protocol.begins).values()]),
        "u_of_time": np.concatenate([np.asarray(sample.u)[:, 0] for sample in stages.values()]),
        "stage": np.repeat(list(bins), list(bins.values())),
    }
    data = {}
    for name, array in STAGE.items():
        if name in ("time", "u"):
            at = "u_of_time" if name == "u" else name
            joined[at] = ("time", joined[at], array.attributes)
            continue
        own = (np.asarray(getattr(sample, name)) for sample in stages.values())
        wide = [np.broadcast_to(values, (*values.shape[:-1], replicas)) for values in own]
        data[name] = (array.shape, np.concatenate(wide), array.attributes)
    for name in next(iter(stages.values())).observed or {}:
        own = (np.asarray((sample.observed or {})[name]) for sample in stages.values())
        wide = [np.broadcast_to(values, (*values.shape[:-1], replicas)) for values in own]
        array = observed_array(OBSERVED + name, wide[0].ndim, **configuration.get("observed", {}).get(name, {}))
        about = {"units": array.units, "description": array.words}
        data[OBSERVED + name] = (array.shape, np.concatenate(wide), about)
    derived = of_each(recall)
    declared = declared_of_recall(len(recall.reads), len(recall.channels), own_steps=np.ndim(recall.dt) > 0)
    for name, array in declared.items():
        if name not in ("u", "signal"):
            values = derived[name] if name in derived else np.asarray(getattr(recall, name))
            data[name] = (array.shape, values, array.attributes)
    several = {"read": list(recall.reads), "channel": list(recall.channels), "written": list(recall.channels)}
    several = {
        name: names for name, names in several.items() if any(name in array.shape for array in declared.values())
    }
    coordinates = {
        **several,
        "signal": ("signal", recall.names, RECALL.arrays["signal"].attributes),
        "u": ("u", np.asarray(recall.u), RECALL.arrays["u"].attributes),
        "replica": np.arange(replicas),
        "axis": ["x", "y", "z"],
        **joined,
        "stage": ("time", joined["stage"]),
    }
    told = ("pack", "grains", "friction", "background", "mu", "gamma0", "delta0", "t0")
    known = values_of(configuration)
    facts = {name: known[name] for name in told if name in known}
    about = {"schema": RECALL.name, "units": "R = E = rho = 1", **facts, "configuration": json.dumps(configuration)}
    return xarray.Dataset(data, coordinates, about)


def plain_cell(value: Any) -> Any:
    """The value of a CSV cell. A text that spreadsheets would take for a formula gets an apostrophe in front."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@")) else value


def to_csv(recall: Recall, *, each: bool = False) -> str:
    """A recall as the text of a CSV table.

    Args:
        recall: the recall.
        each: whether to give a row for each signal with its G and F. Otherwise there is a row for each of 256 bins: u
            (the time in the read, from 0 to 1, if u stands still in every read), and p_sig of every signal in E.
    """
    require_kind("to_csv", recall, Recall)
    several = len(recall.reads) * len(recall.channels) > 1
    rows: list[list[Any]]
    if each:
        measures = of_each(recall)
        rows = [[*(["read", "channel"] * several), "signal", *(name.removeprefix("signal_") for name in measures)]]
        values = np.stack([*measures.values()], axis=-1).reshape(-1, len(recall.names), len(measures)).tolist()
        for one, own in zip(recall.each(), values, strict=True):
            where = [one.reads[0], one.channels[0]] * several
            rows += [[*where, name, *row] for name, row in zip(recall.names, own, strict=True)]
    else:
        rows = [["time (parts of the read)" if recall.of_time else "u"]]
        for one in recall.each():
            of = f", {one.reads[0]}, {one.channels[0]}" if several else ""
            rows[0] += [f"p_sig of {name}{of} (E)" for name in recall.names]
        signals = np.asarray(recall.p_sig).reshape(-1, len(np.asarray(recall.u)))
        rows += np.column_stack([recall.u, signals.T]).tolist()
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
