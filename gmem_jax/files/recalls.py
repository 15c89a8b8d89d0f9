"""Reading and writing recalls, with their configurations."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gmem_jax.experiment.analysis import MEASURES
from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.record import values_of
from gmem_jax.files.frames import read_frames, write_frames
from gmem_jax.files.hdf5 import Content, reading, write_arrays, write_samples, writing
from gmem_jax.files.measures import EACH, of_each
from gmem_jax.files.schemas import RECALL, declared_of_recall
from gmem_jax.files.validation import (
    Array,
    is_number,
    json_of,
    numbers,
    refusing,
    require,
    require_fields,
    require_finite,
    source,
    title,
    whole,
)
from gmem_jax.files.waveforms import signals_from_dict
from gmem_jax.physics.numbers import plural
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import WARNINGS, Status
from gmem_jax.simulation.channels import CHANNELS
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.stage import bin_centres

_EVERY_BIT = int(sum(Status))


@usual_rules()
def save_recall(path: str | Path, recall: Recall) -> None:
    """Write a recall and its configuration to an HDF5 file.

    Raises:
        ValueError: if the recall has no configuration, as that of a traced experiment.
        OSError: if the path cannot be written.
    """
    require_kind("save_recall(path, recall)", recall, Recall)
    configuration = recall.configuration
    if not configuration:
        raise ValueError(
            "a recall of a traced experiment has no configuration: save recall.described(gm.describe(experiment))"
        )
    names = np.asarray([name.encode() for name in recall.names])
    if names.dtype.itemsize == 1:
        names = names.astype("S2")  # netCDF joins single letters to one text
    with writing(Path(path), RECALL.name) as file:
        file.attrs["configuration"] = json.dumps(configuration)
        file.attrs["protocol"] = json.dumps(recall.protocol.to_list())
        file.attrs["reads"], file.attrs["channels"] = json.dumps(recall.reads), json.dumps(recall.channels)
        values = {**vars(recall), **of_each(recall), "signal": names}
        write_arrays(file, _declared(recall.reads, recall.channels, np.ndim(recall.dt)), values)
        write_samples(file.create_group("stages"), recall.stages, recall.protocol.begins, configuration.get("observed"))
        if recall.frames is not None:
            write_frames(file, recall.frames)


def _declared(reads: Sequence[str], channels: Sequence[str], dt_dimensions: int) -> dict[str, Array]:
    return declared_of_recall(len(reads), len(channels), own_steps=dt_dimensions > 0)


@usual_rules()
def load_recall(path: str | Path) -> Recall:
    """Read a recall and its configuration.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is damaged, is no complete recall, or its numbers do not fit each other.
    """
    path = Path(path)
    with refusing(path, "recall"):
        with reading(path, RECALL.name) as content:
            configuration = json_of(content.text("configuration"), "configuration")
            _check_configuration(configuration)
            recall = _recall_of(content)
        _check(recall)
        return recall.described(configuration)


def _recall_of(content: Content) -> Recall:
    dt = content.datasets.get("dt")
    protocol = Protocol.from_list(json.loads(content.text("protocol")))
    reads, channels = (json.loads(content.text(name)) for name in ("reads", "channels"))
    for name, own, known in (("reads", reads, protocol.reads), ("channels", channels, tuple(CHANNELS))):
        sound = isinstance(own, list) and own and len(set(map(str, own))) == len(own)
        require(sound and all(one in known for one in own), f"its {name} are none that its protocol has")
    found = content.arrays(_declared(reads, channels, 0 if dt is None else len(dt.shape)))
    for name in ("signal", *EACH):  # names are in the configuration too; the others follow from the recall
        found.pop(name)
    return Recall(
        **found,  # type: ignore[arg-type]
        stages=content.samples("stages"),
        protocol=protocol,
        reads=tuple(reads),
        channels=tuple(channels),
        frames=read_frames(content),
    )


def _check_configuration(configuration: dict[str, Any]) -> None:
    """Check the fields of a configuration that tables and figures use."""
    kinds = {"pack": source, "friction": title, "background": title, "grains": whole, "steps": whole}
    amounts = dict.fromkeys(("mu", "delta0", "gamma0", "t0", "hold_drag", "dt"), numbers)
    experiment = configuration.get("experiment", {})
    require(isinstance(experiment, dict), "its configuration has an impossible 'experiment'")
    require_fields(values_of(configuration), "configuration", **kinds, **amounts, seconds=is_number)
    require_fields(configuration.get("grain"), "configuration's grain", shape=title, mass=is_number, diameter=is_number)
    signals, form = configuration.get("signals", []), experiment.get("signals", {})
    require(isinstance(signals, list) and isinstance(form, dict), "its configuration has impossible 'signals'")
    require(isinstance(configuration.get("warnings", []), list), "its configuration has impossible 'warnings'")
    observed = configuration.get("observed", {})
    require(isinstance(observed, dict), "its configuration has impossible 'observed'")
    for told in observed.values():
        require_fields(told, "configuration's 'observed'", units=title, words=title)
        require(len(told) == 2, "its configuration has more in 'observed' than units and words")
    if "target" in configuration:
        require_fields(configuration["target"], "target", kind=title)
        signals_from_dict(configuration["target"])


def _check(recall: Recall) -> None:
    signals, replicas = recall.J.shape[-2], len(recall.status)
    status = np.asarray(recall.status)
    require(
        signals > 0 and replicas == signals + 1,
        f"it has {plural(signals, 'signal')} and {plural(replicas, 'replica')}, must have one replica more",
    )
    require((status >= 0) & (status & ~_EVERY_BIT == 0), "its status has bits that gm.Status does not have")
    require(np.abs(np.asarray(recall.u) - bin_centres()) < 1e-12, "its u are not the centres of bins")
    require_finite({name: getattr(recall, name) for name in ("J", "window", "dt")})
    require(
        (recall.window > 0.0) & np.all(np.asarray(recall.dt) > 0.0), "its time step or ringing period is not positive"
    )
    if not np.any(status & ~int(WARNINGS)):
        measured = {name: getattr(recall, name) for name in ("p_sig", "window", "residual_speed")}
        require_finite(measured)
        unread = bool(np.any(status & int(Status.ROUNDED | Status.UNLOADED)))
        for one in recall.each():  # measures are NaN where nothing was written or came back
            if np.any(one.J) and not unread:
                require_finite({name: getattr(one, name) for name in MEASURES})
    reads = recall.protocol.reads
    require(len(reads) > 0, "its protocol reads nothing")
    for name in reads:
        require(name in recall.stages, f"incomplete file, the stage {name!r} is missing")
    lengths = {stage.name: stage.bins for stage in recall.protocol}
    for name, stage in recall.stages.items():
        require(title(name), "the name of a stage is not a line of text")
        _check_stage(name, stage, replicas, bins=lengths[name] if name in reads else 0)


def _check_stage(name: str, stage: Sample, replicas: int, *, bins: int) -> None:
    """Refuse a stage of wrong shape. `bins` is the number of bins of a stage that reads; 0 allows any number."""
    found, wide = np.shape(stage.pressure)[0], np.shape(stage.pressure)[-1]
    require(
        found > 0 and wide in (1, replicas), f"stage {name!r} has {plural(wide, 'replica')}, must have 1 or {replicas}"
    )
    if bins:
        require((found, wide) == (bins, replicas), f"stage {name!r} must have {bins} bins of {replicas} replicas")
