"""Summaries of all kinds of files, for commands, `gmem show` and reports: facts, lines, figures."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.design.stored import load_kernel
from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.analysis import MEASURES
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.record import pack_fingerprint, values_of
from gmem_jax.experiment.signals import bin_average, waveform
from gmem_jax.files.configuration import recorded_material
from gmem_jax.files.datasets import to_csv
from gmem_jax.files.exporters import frames_of_pack
from gmem_jax.files.frames import load_frames
from gmem_jax.files.hdf5 import schema_of
from gmem_jax.files.measures import relative_scale
from gmem_jax.files.packs import load_pack, load_stages, pack_called
from gmem_jax.files.recalls import load_recall
from gmem_jax.files.results import load_result
from gmem_jax.files.schemas import GRADIENT, KERNEL, PACK, READING, RECALL, TUNED, other_kind
from gmem_jax.files.validation import is_number, refusing
from gmem_jax.files.waveforms import load_design, load_target, load_waveforms, signals_from_dict
from gmem_jax.physics.material import Material
from gmem_jax.physics.numbers import plural
from gmem_jax.reading.readers import confusion
from gmem_jax.show import figures, sweeps, tables
from gmem_jax.show.figure import Figure
from gmem_jax.show.numbers import summary
from gmem_jax.show.recalls import MOST_OF_PAGE, OF_SIGNALS, PICTURES, place_of, recall_figure, signals_figure
from gmem_jax.show.stages import QUANTITIES, observed_quantities, series_figures, stages_figure
from gmem_jax.show.tables import Fact, cell
from gmem_jax.simulation.frames import Frames
from gmem_jax.simulation.sample import Sample
from gmem_jax.sweeps import table
from gmem_jax.sweeps.store import Store

KERNEL_NOISE = 1.0  # Pa RMS, noise with which singular values of a kernel are compared; the default of `gmem kernel`
LARGEST_CONFUSION = 256  # words, in the largest confusion matrix of a page
_ASYMMETRY = "of the recalls of a waveform and its negative: 0 for a linear memory"
_RESOLUTION = "width in v of a point of the waveform that is read back"
Draw = Callable[[], Figure]


class GrainView(NamedTuple):
    """A 3D view of a page.

    Attributes:
        frames: gives the frames.
        material: material of the grains, for forces in mN.
        pack: fingerprint of the pack, if it is shown at rest, which a page does once; "" for frames of a run.
    """

    frames: Callable[[], Frames]
    material: Material
    pack: str = ""


class Part(NamedTuple):
    """A part of a page.

    Attributes:
        content: a text, a table, a figure, several figures that differ only in x, or a 3D view.
        heading: heading above it.
        folded: whether it is folded, and opens by a click on the heading.
    """

    content: str | Table | Figure | Mapping[str, Figure] | GrainView
    heading: str = ""
    folded: bool = False


@dataclass(frozen=True)
class Summary:
    """The content of a file, for a person and for programs.

    Attributes:
        title: kind and name of the file.
        facts: the content as one JSON object.
        lines: tables and lines for a person.
        figures: functions that make the figures, by name; the first figure says most.
        parts: gives further parts of a page, in order.
        configuration: every parameter, for a page.
        csv: for a recall, gives the recalled signals as CSV, or a row for each signal (`each=True`).
    """

    title: str
    facts: dict[str, Any]
    lines: list[str | Table]
    figures: dict[str, Draw]
    parts: Callable[[], Iterator[Part]] = field(default=lambda: iter(()))
    configuration: Mapping[str, Any] = field(default_factory=dict)
    csv: Callable[..., str] | None = None


def summary_of(
    source: str | Path, against: str = "time", signals: Sequence[int] = (), *, each: bool = False, **chosen: Any
) -> Summary:
    """The content of a file, of a pack, or of the folder of a sweep.

    Args:
        source: a path, or the name of a pack.
        against: horizontal axis of pictures of stages, "time" or "u".
        signals: numbers of the signals in pictures of a recall; default all.
        each: whether the lines of a recall have every signal, however many there are.
        **chosen: x, by and over of the picture of a sweep (`gmem_jax.sweeps.curves.axes_of`).

    Raises:
        ValueError: if signals are chosen and the file is not a recall.
        FileNotFoundError: if there is no such file.
        FileFormatError: if it is damaged, or of a kind that no command writes.
    """
    found = _summary_of(Path(source), against, signals, each, chosen)
    if signals and found.csv is None:
        raise ValueError(f"{source}: holds no recall whose signals could be chosen")
    return found


def _summary_of(file: Path, against: str, signals: Sequence[int], each: bool, chosen: dict[str, Any]) -> Summary:
    if file.is_dir():
        return of_sweep(Store(file, make=False), **chosen)
    if pack_called(str(file)):
        return _stored_pack(file, against)
    suffix = file.suffix.lower()
    if suffix == ".json":
        schema, found = load_result(file)
        with refusing(file, schema.title):
            kind = {READING.name: of_reading, GRADIENT.name: of_gradient, TUNED.name: of_tuned}[schema.name]
            return kind({name: value for name, value in found.items() if name != "about"}, file.name)
    if suffix == ".msgpack":
        return _net(file)
    if suffix in (".csv", ".npy"):
        return _waveforms(file)
    schema_name = schema_of(file)
    if schema_name == KERNEL.name:
        return of_kernel(*load_kernel(file), name=file.name)
    if schema_name == PACK.name:
        return _stored_pack(file, against)
    if schema_name == RECALL.name:
        return of_recall(load_recall(file), file.name, against=against, signals=signals, each=each)
    raise FileFormatError(f"{file}: {other_kind(schema_name, RECALL.name, PACK.name, KERNEL.name)}")


def of_recall(
    recall: Recall, name: str = "", *, against: str = "time", signals: Sequence[int] = (), each: bool = False
) -> Summary:
    """The summary of a recall; see `summary_of`."""
    configuration, row = recall.configuration, summary(recall)
    choice: dict[str, Any] = {"against": against, "signals": signals}
    pictures = (*PICTURES, *observed_quantities(recall.stages, configuration.get("observed", {})))
    drawn: dict[str, Draw] = {what: partial(recall_figure, recall, what, **choice) for what in pictures}
    if row.get("each"):
        drawn |= {
            f"{what}/{one.reads[0]}/{one.channels[0]}": partial(recall_figure, one, what, **choice)
            for one in recall.each()
            for what in OF_SIGNALS
        }
    lines = tables.recall_lines(row, configuration, each=each)
    return Summary(
        f"Recall {name}, pack {cell(configuration['pack'])}",
        {**row, "configuration": configuration},
        lines,
        drawn,
        partial(_parts_of_recall, recall, row),
        configuration,
        partial(to_csv, recall),
    )


def _parts_of_recall(recall: Recall, row: dict[str, Any]) -> Iterator[Part]:
    configuration = recall.configuration
    names, t0 = recall.names, values_of(configuration)["t0"]
    yield Part(tables.errors_table(recall))
    if tables.signals_told(row) > tables.FEW:
        yield Part(tables.signals_table(row), f"each of {plural(len(names), 'signal')}", folded=True)
    scale, wanted = np.asarray(relative_scale(configuration)), configuration.get("target")
    target = None if wanted is None else np.asarray(bin_average(signals_from_dict(wanted)))
    shown = f" (the first {MOST_OF_PAGE} of {len(names)})" if len(names) > MOST_OF_PAGE else ""
    for one in recall.each():
        figure = signals_figure(one, names, "", scale, t0, target=target, page=True)
        yield Part(figure, f"Recalled signals{place_of(recall, one)}{shown}")
    material = recorded_material(configuration)
    yield from _series("Along the run", recall.stages, names, t0, recall.protocol.begins, material)
    yield from _grains(recall, names, material)


def _series(heading: str, stages: Mapping[str, Sample], *more: Any) -> Iterator[Part]:
    """Figures of all stages; `more` are the other arguments of `series_figures`."""
    yield Part(series_figures(stages, *more), heading)
    yield Part(f"Stages, white and grey in turn: {', '.join(stages)}.")


def _grains(recall: Recall, names: Sequence[str], material: Material) -> Iterator[Part]:
    """The frames of a recall; or its pack at rest, if its file is there."""
    if (frames := recall.frames) is not None:
        whose = f"the run of {names[frames.signal - 1]}" if frames.signal else "the run without shear"
        yield Part(f"{frames.count} moments of {whose}; displacements are since the first.", "Grains")
        yield Part(GrainView(lambda: frames, material))
        return
    yield Part("No frames in this file: gmem recall --frames 10 keeps some.", "Grains")
    of_pack = recall.configuration.get("experiment", {}).get("pack", {})

    def rest() -> Frames:
        pack = load_pack(of_pack["source"])
        if pack_fingerprint(pack) != of_pack["sha256"]:
            raise ValueError("another pack has this name now")
        return frames_of_pack(pack, material)

    yield Part(GrainView(rest, material, str(of_pack.get("sha256"))))


def of_pack(
    pack: Pack, stages: Mapping[str, Sample] | None = None, frames: Frames | None = None, against: str = "time"
) -> Summary:
    """The summary of a pack, with the stages and frames of its preparation, if they were kept."""
    kept, t0 = dict(stages or {}), pack.info.get("recipe", {}).get("t0")
    material = recorded_material(pack.info)
    drawn: dict[str, Draw] = {"grains": partial(figures.grains_figure, pack)}
    title = f"{pack.name}: preparation"
    if kept:
        own: dict[str, Any] = {"against": against, "t0": t0, "material": material}
        drawn |= {what: partial(stages_figure, kept, quantity, title, **own) for what, quantity in QUANTITIES.items()}

    def parts() -> Iterator[Part]:
        yield Part(GrainView(lambda: frames_of_pack(pack, material), material, pack_fingerprint(pack)))
        if kept:
            yield from _series("Its preparation", kept, [], t0, None, material)
        if frames is not None:
            yield Part(GrainView(lambda: frames, material))

    facts = {"pack": pack.name, "grains": pack.grains, "ringing_period": float(pack.ringing_period), **pack.info}
    return Summary(f"Pack {pack.name}", facts, [tables.pack_table(pack)], drawn, parts, pack.info)


def _stored_pack(file: Path, against: str) -> Summary:
    return of_pack(load_pack(file), load_stages(file), load_frames(pack_called(str(file)) or file), against)


def of_kernel(
    kernel: MemoryKernel, configuration: Mapping[str, Any], noise: float = KERNEL_NOISE, name: str = ""
) -> Summary:
    """The summary of a memory kernel; `noise` is in Pa RMS."""
    modulus, count = float(recorded_material(configuration).modulus), len(kernel.centres)
    pack = cell(configuration.get("pack", name))
    capacity = kernel.capacity(noise / modulus)
    told = [
        Fact("gain", kernel.gain(), words="G of the perfect integral that comes nearest"),
        Fact("distance", kernel.distance(), words="from that integral: 0 none, 1 nothing of it"),
        Fact("asymmetry", kernel.asymmetry(), words=_ASYMMETRY),
        Fact("resolution", kernel.resolution(noise / modulus), words=_RESOLUTION),
        Fact(f"values above {noise:g} Pa", f"{capacity} of {count}", words="independent ones, told from this noise"),
    ]
    facts = {
        "pack": pack,
        "n": count,
        "width": kernel.width,
        "gamma0": kernel.gamma0,
        "noise_pa": noise,
        **{fact.name: fact.value for fact in told[:-1]},
        "capacity": capacity,
        "singular_values_pa": (kernel.singular_values() * modulus).tolist(),
        "configuration": configuration,
    }
    title = f"memory kernel of {pack}: {count} bumps of width {kernel.width:g}, gamma0 = {kernel.gamma0:g}"
    drawn: dict[str, Draw] = {
        "kernel": partial(figures.kernel_figure, kernel, noise, pack, modulus),
        "recalls": partial(figures.bumps_figure, kernel, pack, modulus),
    }

    def parts() -> Iterator[Part]:
        written = {**configuration.get("experiment", {}), "signals": {}}  # no signals were stored
        bumps = {**configuration, "signals": (), "experiment": written}
        yield Part(tables.heading(bumps))
        yield Part(drawn["kernel"]())

    return Summary(f"Kernel {name}", facts, ["\n".join([title, *map(str, told)])], drawn, parts, configuration)


def of_reading(facts: dict[str, Any], name: str = "") -> Summary:
    """The summary of a classification, from its result."""
    words, readers = facts["words"], facts["readers"]
    title, net = f"{cell(facts['pack'])}, {plural(facts['bits'], 'bit')}", readers["net"]
    nets = len(np.asarray(net["read"]).reshape(-1, words))
    right = f"{title}: accuracy {net['accuracy']:.3f} ({plural(nets, 'net')})"
    drawn: dict[str, Draw] = {
        "confusion": lambda: figures.confusion_figure({right: confusion(net["read"], words)}),
        "bits": partial(figures.bits_figure, readers, title),
    }

    def parts() -> Iterator[Part]:
        yield Part(f"of {facts['recall']}, pack {cell(facts['pack'])}")
        if words <= LARGEST_CONFUSION:
            yield Part(figures.confusion_figure({key: confusion(row["read"], words) for key, row in readers.items()}))

    found = facts.get("configuration", {})
    return Summary(f"Classification {name}", facts, [*tables.reading_tables(facts)], drawn, parts, found)


def of_gradient(facts: dict[str, Any], name: str = "") -> Summary:
    """The summary of the derivatives of a fidelity, from their result."""
    slopes, configuration = facts["gradient"], facts.get("configuration", {})
    title = f"{cell(facts['pack'])}: F = {facts['fidelity']:.4f}"
    law = configuration.get("friction")
    units = {"stiffness": " per E R" if law == "hooke" else " per E R^0.5"} if law else {}
    lines = [title]
    lines += [f"dF/d{key} = {value:.5g}{units.get(key, '')}" for key, value in slopes.items() if is_number(value)]
    rows = enumerate(slopes["waveform"], 1)
    lines += [f"dF/da of signal {number}: " + " ".join(f"{value:.4g}" for value in row) for number, row in rows]
    drawn: dict[str, Draw] = {"waveforms": partial(figures.gradient_figure, facts["places"], slopes["waveform"], title)}

    def parts() -> Iterator[Part]:
        if configuration:
            yield Part(tables.heading(configuration))
        yield Part(drawn["waveforms"]())

    return Summary(f"Gradient {name}", facts, ["\n".join(lines)], drawn, parts, configuration)


def of_tuned(facts: dict[str, Any], name: str = "") -> Summary:
    """The summary of a tuned drive, from its result."""
    packs, history = ", ".join(map(cell, facts["packs"])), facts["history"]
    values = ", ".join(f"{key} = {value:.4g}" for key, value in facts["values"].items())
    line = f"{packs}: mean F {facts['before']:.4f} -> {facts['fidelity']:.4f} with {values}"
    fidelities = [float(one["fidelity"]) for one in history]
    drawn: dict[str, Draw] = {
        "history": partial(figures.history_figure, {packs: fidelities}),
        "values": partial(figures.values_figure, history, packs),
    }

    def parts() -> Iterator[Part]:
        yield Part(tables.history_table(facts["values"], history))
        yield Part(drawn["history"]())

    return Summary(f"Tuned drive {name}", facts, [line], drawn, parts, facts.get("configuration", {}))


def _net(file: Path) -> Summary:
    from gmem_jax.reading import training  # loads flax

    found = training.load(file)
    lessons = found.net.lessons
    names = ("seed", "step", "loss", "validation", "examples", "finished", "seconds")
    facts: dict[str, Any] = {"bits": lessons.bits, "hidden": list(lessons.hidden)}
    facts |= {name: getattr(found, name) for name in names}
    state = "trained" if found.finished else "not finished"
    line = (
        f"net for words of {plural(lessons.bits, 'bit')}, seed {found.seed}: {state}, {found.step} steps, "
        f"held-out accuracy {found.validation:.4f}, loss {found.loss:.3g} nats"
    )
    weights = np.asarray(found.net.parameters["Dense_0"]["kernel"])
    drawn: dict[str, Draw] = {"weights": partial(figures.weights_figure, weights, line.split(":")[0])}
    return Summary(f"Net {file.name}", facts, [line], drawn, lambda: _all(drawn))


def _waveforms(file: Path) -> Summary:
    commented = file.suffix.lower() == ".csv"
    target, design = (load_target(file), load_design(file)) if commented else (None, {})
    samples = load_waveforms(file)
    facts: dict[str, Any] = {"signals": len(samples), "samples": samples.shape[1], **design}
    lines = [
        f"{plural(len(samples), 'waveform')} of {samples.shape[1]} samples"
        + (", designed" if target is not None else "")
    ]
    drawn: dict[str, Draw] = {"waveforms": partial(figures.waves_figure, waveform(samples), target, file.name)}
    if design:
        pack = cell(design["pack"])
        way = f"F {design['before']:.4f} -> {design['fidelity']:.4f}, gain {design['gain']:.3f}"
        lines.append(f"{pack}: {way} of the recall with respect to the target")
        drawn["history"] = partial(figures.history_figure, {pack: design["history"]})
    return Summary(f"Waveforms {file.name}", facts, ["\n".join(lines)], drawn, lambda: _all(drawn))


def _all(drawn: Mapping[str, Draw]) -> Iterator[Part]:
    return (Part(draw()) for draw in drawn.values())


def of_sweep(store: Store, **chosen: Any) -> Summary:
    """The summary of a sweep; `chosen` are x, by and over of `gmem_jax.sweeps.curves.axes_of`.

    Raises:
        FileFormatError: if there is no sweep, or a result is damaged.
    """
    card, rows = store.card(), table.rows(store)
    names, name = table.names_in(rows, card["names"]), store.folder.name
    drawn: dict[str, Draw] = {
        measure: partial(sweeps.sweep_figure, rows, names, measure, name, **chosen) for measure in sorted(MEASURES)
    }

    def parts() -> Iterator[Part]:
        return (Part(figure) for x in names if (figure := sweeps.against(x, rows, names)) is not None)

    lines: list[str | Table] = [sweeps.points_table(rows, names)]
    return Summary(f"Sweep {name}", sweeps.sweep_facts(store, rows), lines, drawn, parts, card["shared"])


def _plain(label: str) -> str:
    """The label of an axis without the marks of formulas."""
    return label.replace("$", "").replace("\\,", " ").replace("\\", "")


PLOTS = {
    "signals": "recalled signals beside the integral J",
    "waveforms": "what was stored: waveforms I, or slopes by them",
    "all": "an image of all signals, a row each",
    "grains": "the grains in their box",
    "kernel": "M(u, v) and its singular values",
    "recalls": "recalls of the kernel's bumps",
    "confusion": "words stored against words read",
    "bits": "error rate of each bit, by reader",
    "history": "F by iteration",
    "values": "parameters by iteration",
    "weights": "a net's weights by u",
    "gain": "G of the points",
    "fidelity": "F of the points",
    "windowed_gain": "G after a running mean over the ringing period",
    "windowed_fidelity": "F after a running mean over the ringing period",
    **{name: f"{_plain(quantity.label)}, over the stages" for name, quantity in QUANTITIES.items()},
}
"""Descriptions of all pictures, by name."""
