"""The numbers of a recall for programs, and the published ones."""

import csv
from importlib import resources
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment import analysis
from gmem_jax.experiment.analysis import spread
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.record import values_of
from gmem_jax.experiment.signals import bin_average
from gmem_jax.files.configuration import recorded_material
from gmem_jax.files.measures import of_each, read_stress, relative_scale
from gmem_jax.files.waveforms import signals_from_dict
from gmem_jax.physics.state import Status, combined_status, explain

LARGE_FOR_SPHERES = 3000  # grains: see `note_on_size`


def published(file: str = "six_signals.csv", **conditions: str | float) -> list[dict[str, Any]]:
    """Rows of a published table (numbers converted) in which every named column has the given value.

    The tables are of arXiv:2603.14595 and its authors' public table of the data, `gmem-data`.
    """
    text = (resources.files("gmem_jax") / "reference" / file).read_text(encoding="utf-8")
    rows = [{key: _number(cell) for key, cell in row.items()} for row in csv.DictReader(text.splitlines())]
    return [row for row in rows if all(row[key] == value for key, value in conditions.items())]


def _number(cell: str) -> str | float:
    try:
        return float(cell)
    except ValueError:
        return cell


def summary(recall: Recall) -> dict[str, Any]:
    """The numbers of one recall, for JSON output and `recall_table`.

    With several reads or channels the measures are lists, as in the recall. "each" then has the numbers of every read
    and channel, with "gains", its row of the gain matrix by the channel that was written on.
    """
    parts = [*recall.each()]
    rows = [_summary(one) for one in parts]
    if len(rows) == 1:
        return rows[0]
    common = {name: value for name, value in rows[0].items() if name not in _OF_READ}
    gains = np.asarray(recall.gain).reshape(len(rows), -1)
    each = [
        {
            "read": one.reads[0],
            "channel": one.channels[0],
            **{name: row[name] for name in _OF_READ if name in row},
            "gains": dict(zip(recall.channels, own.tolist(), strict=True)),
        }
        for one, row, own in zip(parts, rows, gains, strict=True)
    ]
    measures = {name: np.asarray(getattr(recall, name)).tolist() for name in analysis.MEASURES}
    return {**common, "reads": list(recall.reads), "channels": list(recall.channels), **measures, "each": each}


_OF_READ = (
    *analysis.MEASURES,
    "inertial_number",
    "filling",
    "coordination",
    "contacts_per_grain",
    "pressure_pa",
    "largest_signal_pa",
    "signals",
    "backgrounds",
    "second_readout",
    "target_gain",
    "target_fidelity",
)
"""Fields that a `summary` has for each read and channel."""


def status_words(status: int) -> list[str]:
    """The names of the set bits of a status, in lower case."""
    return [str(bit.name).lower().replace("_", " ") for bit in Status if status & bit]


def _summary(recall: Recall) -> dict[str, Any]:
    """The numbers of one read and channel."""
    configuration = recall.configuration
    readout = recall.stages[recall.reads[0]]
    pressure = np.asarray(readout.pressure)
    unit = recorded_material(configuration).modulus
    status = combined_status(recall.status)
    return {
        "pack": configuration["pack"],
        "grains": configuration["grains"],
        "gain": float(recall.gain),
        "fidelity": float(recall.fidelity),
        "windowed_gain": float(recall.windowed_gain),
        "windowed_fidelity": float(recall.windowed_fidelity),
        "ringing_period": float(recall.window),
        "residual_speed": float(np.max(np.asarray(recall.residual_speed))),
        "inertial_number": float(np.max(np.asarray(readout.inertial_number))),
        "filling": [float(np.asarray(readout.filling)[k, 0]) for k in (-1, 0)],
        "coordination": [float(np.asarray(readout.coordination)[k, 0]) for k in (-1, 0)],
        "contacts_per_grain": [_known(np.asarray(readout.contacts_per_grain)[k, 0]) for k in (-1, 0)],
        "pressure_pa": [float(pressure[k, :2, 0].mean() * unit) for k in (-1, 0)],
        "largest_signal_pa": float(np.max(np.abs(np.asarray(recall.p_sig))) * unit),
        "dt": float(np.max(np.asarray(recall.dt))),
        "status": status,
        "status_names": ", ".join(status_words(status)) or "ok",
        "status_text": explain(status),
        "note": note_on_size(configuration),
        "signals": _signals(recall),
        **second_readout(recall, configuration),
        **of_target(recall, configuration),
    }


def note_on_size(configuration: dict[str, Any]) -> str:
    """A note on packs of few spheres, which remember little although the run is sound; "" for other packs."""
    grains = configuration["grains"]
    if configuration.get("grain", {}).get("shape") != "sphere" or grains >= LARGE_FOR_SPHERES:
        return ""
    return (
        f"{grains} spheres hold little: G = 0.04 ± 0.03 and F = 0.3 ± 0.2 were measured at N = 325 (SD of two packs), "
        "0.103 ± 0.001 and 0.86 ± 0.04 at 3,267; take a larger pack, or tetra grains"
    )


def _signals(recall: Recall) -> list[dict[str, Any]]:
    """The measures of each signal by itself."""
    measures = of_each(recall)
    rows = zip(recall.names, *(values.tolist() for values in measures.values()), strict=True)
    return [
        dict(zip(("signal", *(name.removeprefix("signal_") for name in measures)), row, strict=True)) for row in rows
    ]


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def of_target(recall: Recall, configuration: dict[str, Any]) -> dict[str, Any]:
    """Gain and fidelity with respect to the J of the design's target; {} if the waveforms were not designed."""
    if "target" not in configuration:
        return {}
    wanted = bin_average(signals_from_dict(configuration["target"]))
    match = analysis.compare(jnp.asarray(recall.p_sig), wanted, relative_scale(configuration))
    return {"target_gain": float(match.gain), "target_fidelity": float(match.fidelity)}


def second_readout(recall: Recall, configuration: dict[str, Any]) -> dict[str, Any]:
    """Gain and fidelity with every background, and the memory that the second readout still finds; {} without one.

    "second_readout" has mean and standard error, over the S signals, of its correlation with J and of its gain. Words
    are sums of few bits, so that their errors are not independent: the spread over packs is the better measure.
    """
    if recall.second_readout is None:
        return {}
    first, second = (read_stress(recall, name) for name in recall.protocol.reads)
    scale = relative_scale(configuration)
    rows: dict[str, dict[str, float]] = {name: {} for name in analysis.BACKGROUNDS}
    smooth = recall.windows(values_of(configuration)["t0"])[0]
    for prefix, window in (("", None), ("windowed_", smooth)):
        for name, match in analysis.backgrounds(first, second, recall.J, scale, window).items():
            rows[name] |= {f"{prefix}gain": float(match.gain), f"{prefix}fidelity": float(match.fidelity)}
    correlation, left = (spread(values) for values in analysis.remembered_after(second, recall.J, scale))
    rest = {"correlation": correlation[0], "correlation_se": correlation[2], "gain": left[0], "gain_se": left[2]}
    return {"backgrounds": rows, "second_readout": rest}
