"""What any file that a command writes holds: facts, lines for a person, and the pictures that can be drawn of it."""

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.design.stored import load_kernel
from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.analysis import MEASURES
from gmem_jax.experiment.signals import waveform
from gmem_jax.files.checked import is_number, refusing
from gmem_jax.files.hdf5 import schema_of
from gmem_jax.files.packs import load_pack, load_stages, pack_called
from gmem_jax.files.recalls import load_recall
from gmem_jax.files.results import load_result
from gmem_jax.files.schemas import GRADIENT, KERNEL, PACK, READING, RECALL
from gmem_jax.files.waveforms import load_design, load_target, load_waveforms
from gmem_jax.physics.material import Material
from gmem_jax.show import figures, pictures, tables
from gmem_jax.show.recalls import PICTURES, recall_drawing
from gmem_jax.show.stages import QUANTITIES, stages_drawing
from gmem_jax.sweeps import table
from gmem_jax.sweeps.store import Store

Draw = Callable[[Path], None]
NOISE = 1.0  # Pa RMS, that values of a kernel are compared with; as `gmem kernel` does


class Shown(NamedTuple):
    """What a file holds.

    Attributes:
        facts: as one JSON object.
        lines: tables and lines for a person.
        pictures: what writes them, by name; the first says most.
        csv: makes the recalled signals, or a row for each, for a recall.
    """

    facts: dict[str, Any]
    lines: list[Any]
    pictures: dict[str, Draw]
    csv: Callable[[], str] | None = None


def shown(file: Path, against: str = "time", signals: Sequence[int] = (), *, each: bool = False) -> Shown:
    """What a file, a pack or the folder of a sweep holds.

    Args:
        file: its path, or the name of a pack.
        against: "time" or "u": what pictures of stages are drawn over.
        signals: numbers of those that pictures of a recall show; default all.
        each: whether a recall tells of each signal by itself, however many there are.

    Raises:
        ValueError: if signals are chosen of what is no recall.
        FileNotFoundError: if it is not there.
        FileFormatError: if it is of no kind that commands write, or damaged.
    """
    found = _held(file, against, signals, each)
    if signals and found.csv is None:
        raise ValueError(f"{file}: holds no recall whose signals could be chosen")
    return found


def _held(file: Path, against: str, signals: Sequence[int], each: bool) -> Shown:
    if pack_called(str(file)):
        return _pack(file, against)
    suffix = file.suffix.lower()
    if suffix == ".json":
        return _result(file)
    if suffix == ".msgpack":
        return _net(file)
    if suffix in (".csv", ".npy"):
        return _waveforms(file)
    kind = schema_of(file)
    if kind == KERNEL.name:
        return _kernel(file)
    if kind == PACK.name:
        return _pack(file, against)
    if kind == RECALL.name:
        return _recall(file, against, signals, each)
    known = ", ".join(schema.name for schema in (RECALL, PACK, KERNEL))
    raise FileFormatError(f"{file}: schema is {kind[:40]!r}, expected one of {known}")


def _recall(file: Path, against: str, signals: Sequence[int], each: bool) -> Shown:
    stored = load_recall(file)
    recall, configuration = stored
    row = tables.summary(recall, configuration)

    def draw(what: str, path: Path) -> None:
        recall_drawing(recall, what, configuration, against=against, signals=signals).save(path)

    drawn: dict[str, Draw] = {what: functools.partial(draw, what) for what in PICTURES}
    facts = {**row, "configuration": configuration}
    lines = tables.recall_lines(row, configuration, each=each)
    return Shown(facts, lines, drawn, functools.partial(stored.to_csv, each=each))


def _pack(file: Path, against: str) -> Shown:
    pack = load_pack(file)
    facts = {"pack": pack.name, "grains": pack.grains, "ringing_period": float(pack.ringing_period), **pack.info}
    stages, t0 = load_stages(file), pack.info.get("recipe", {}).get("t0")

    def draw(what: str, path: Path) -> None:
        known = t0 if is_number(t0) else None
        stages_drawing(stages, what, f"{pack.name}: preparation", against=against, t0=known).save(path)

    drawn: dict[str, Draw] = {"grains": lambda path: pictures.grains_drawing(pack).save(path)}
    drawn |= {what: functools.partial(draw, what) for what in QUANTITIES if stages}
    return Shown(facts, [tables.pack_table(pack)], drawn)


def _plain(label: str) -> str:
    """The label of an axis without the marks of formulas."""
    return label.replace("$", "").replace("\\", "")


KERNEL_WORDS = {
    "gain": "G of the perfect integral that comes nearest",
    "distance": "from that integral: 0 none, 1 nothing of it",
    "asymmetry": "of the recalls of a waveform and its negative: 0 for a linear memory",
    "resolution": "width in v of a point of the waveform that is read back",
}
"""What is printed of a kernel, in words; more in docs/glossary.md."""

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
    "windowed_fidelity": "F after the same",
    **{name: f"{_plain(quantity.label)}, over the stages" for name, quantity in QUANTITIES.items()},
}
"""What every picture shows, in words."""


def kernel_lines(facts: Mapping[str, Any], noise: float, n: int) -> list[str]:
    """`kernel_facts` for a person."""
    lines = [f"{key}: {facts[key]:.3f}  ({words})" for key, words in KERNEL_WORDS.items()]
    return [*lines, f"values above {noise:g} Pa: {facts['capacity']} of {n}  (independent ones, told from this noise)"]


def kernel_facts(kernel: MemoryKernel, noise: float) -> dict[str, Any]:
    """What a kernel says of a memory; `noise` in Pa RMS."""
    modulus = float(Material().modulus)
    return {
        "gain": kernel.gain(),
        "distance": kernel.distance(),
        "asymmetry": kernel.asymmetry(),
        "capacity": kernel.capacity(noise / modulus),
        "resolution": kernel.resolution(noise / modulus),
        "singular_values_pa": (kernel.singular_values() * modulus).tolist(),
    }


def _kernel(file: Path) -> Shown:
    kernel, configuration = load_kernel(file)
    pack = tables.cell(configuration.get("pack", file.stem))
    about = {"pack": pack, "n": len(kernel.centres), "width": kernel.width, "gamma0": kernel.gamma0}
    facts = kernel_facts(kernel, NOISE)
    lines = [f"memory kernel of {pack}: {about['n']} bumps of width {kernel.width:g}, gamma0 = {kernel.gamma0:g}"]
    lines += kernel_lines(facts, NOISE, len(kernel.centres))
    floor = NOISE / float(Material().modulus)
    drawn: dict[str, Draw] = {
        "kernel": lambda path: figures.kernel_figure(path, kernel, floor, pack),
        "recalls": lambda path: pictures.bumps_drawing(kernel, pack).save(path),
    }
    whole = {**about, "noise_pa": NOISE, **facts, "configuration": configuration}
    return Shown(whole, ["\n".join(lines)], drawn)


def _result(file: Path) -> Shown:
    schema, found = load_result(file)
    facts = {name: value for name, value in found.items() if name != "about"}
    with refusing(file, schema.title):
        if schema is READING:
            return _reading(facts)
        return _gradient(facts) if schema is GRADIENT else _tuned(facts)


def _reading(facts: dict[str, Any]) -> Shown:
    lines = tables.reading_tables(facts)
    title = f"{tables.cell(facts['pack'])}, {facts['bits']} bits"
    net = facts["readers"]["net"]
    reads = np.asarray(net["read"]).reshape(-1, facts["words"])
    right = f"{title}: accuracy {net['accuracy']:.3f} ({len(reads)} nets)"
    confusion = np.stack([np.sum(reads == word, axis=0) for word in range(facts["words"])], axis=1)
    drawn: dict[str, Draw] = {
        "confusion": lambda path: figures.confusion_figure(path, confusion, right),
        "bits": lambda path: pictures.bits_drawing(facts["readers"], title).save(path),
    }
    return Shown(facts, lines, drawn)


def _gradient(facts: dict[str, Any]) -> Shown:
    slopes, title = facts["gradient"], f"{tables.cell(facts['pack'])}: F = {facts['fidelity']:.4f}"
    lines = [title, *(f"dF/d{name} = {slopes[name]:.5g}" for name in slopes if is_number(slopes[name]))]
    for number, row in enumerate(slopes["waveform"]):
        lines.append(f"dF/da of signal {number + 1}: " + " ".join(f"{value:.4g}" for value in row))
    rows = zip(facts["places"], slopes["waveform"], strict=True)
    pairs = [(np.asarray(place, float), np.asarray(slope, float)) for place, slope in rows]
    return Shown(facts, ["\n".join(lines)], {"waveforms": lambda path: figures.gradient_figure(path, pairs, title)})


def _tuned(facts: dict[str, Any]) -> Shown:
    packs, history = " ".join(map(tables.cell, facts["packs"])), facts["history"]
    values = ", ".join(f"{name} = {value:.4g}" for name, value in facts["values"].items())
    line = f"{packs}: mean F {facts['before']:.4f} -> {facts['fidelity']:.4f} with {values}"
    fidelities = [float(one["fidelity"]) for one in history]
    drawn: dict[str, Draw] = {
        "history": lambda path: figures.history_figure(path, {packs: fidelities}),
        "values": lambda path: pictures.values_drawing(history, packs).save(path),
    }
    return Shown(facts, [line], drawn)


def _net(file: Path) -> Shown:
    from gmem_jax.reading import training  # loads flax

    found = training.load(file)
    lessons = found.net.lessons
    names = ("seed", "step", "loss", "validation", "examples", "finished", "seconds")
    facts: dict[str, Any] = {"bits": lessons.bits, "hidden": list(lessons.hidden)}
    facts |= {name: getattr(found, name) for name in names}
    state = "trained" if found.finished else "not finished"
    line = (
        f"net for words of {lessons.bits} bits, seed {found.seed}: {state}, {found.step} steps, "
        f"held-out accuracy {found.validation:.4f}, loss {found.loss:.3g} nats"
    )
    weights = np.asarray(found.net.parameters["Dense_0"]["kernel"])
    return Shown(
        facts, [line], {"weights": lambda path: pictures.weights_drawing(weights, line.split(":")[0]).save(path)}
    )


def _waveforms(file: Path) -> Shown:
    samples = load_waveforms(file)
    target = load_target(file) if file.suffix.lower() == ".csv" else None
    design = load_design(file) if file.suffix.lower() == ".csv" else {}
    facts: dict[str, Any] = {"signals": len(samples), "samples": samples.shape[1], **design}
    lines = [f"{len(samples)} waveforms of {samples.shape[1]} samples" + (", designed" if target is not None else "")]
    drawn: dict[str, Draw] = {
        "waveforms": lambda path: pictures.waves_drawing(waveform(samples), target, file.name).save(path)
    }
    if design:
        lines.append(
            f"{design['pack']}: F {design['before']:.4f} -> {design['fidelity']:.4f}, gain {design['gain']:.3f}"
        )
        drawn["history"] = lambda path: figures.history_figure(path, {tables.cell(design["pack"]): design["history"]})
    return Shown(facts, ["\n".join(lines)], drawn)


def sweep_pictures(store: Store, **chosen: Any) -> dict[str, Draw]:
    """Each measure of the points of a sweep; `chosen` are x, by and over of `gmem_jax.sweeps.curves.axes_of`.

    Raises:
        FileFormatError: if there is no sweep, or a result is damaged.
    """

    def draw(measure: str, path: Path) -> None:
        names, title = store.card()["names"], store.folder.name
        pictures.sweep_drawing(table.rows(store), names, measure, title, **chosen).save(path)

    return {measure: functools.partial(draw, measure) for measure in sorted(MEASURES)}
