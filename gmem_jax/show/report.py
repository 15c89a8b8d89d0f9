"""One page of everything that some files hold, which needs nothing else to be read: `gmem report`."""

import html
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.table import Table

from gmem_jax.design.stored import load_kernel
from gmem_jax.errors import FileFormatError
from gmem_jax.experiment import analysis
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.signals import Signals, bin_average, waveform
from gmem_jax.files.checked import is_number, refusing
from gmem_jax.files.configuration import names_of, pack_fingerprint, signals_from
from gmem_jax.files.frames import load_frames
from gmem_jax.files.hdf5 import schema_of
from gmem_jax.files.measures import relative_scale
from gmem_jax.files.packs import load_pack, load_stages, pack_called
from gmem_jax.files.recalls import load_recall
from gmem_jax.files.results import load_result
from gmem_jax.files.schemas import GRADIENT, KERNEL, PACK, READING, RECALL, TUNED
from gmem_jax.files.waveforms import load_design, load_target, load_waveforms
from gmem_jax.physics.material import Material
from gmem_jax.physics.state import Status, explain
from gmem_jax.reading.readers import confusion
from gmem_jax.show import plots, tables, view
from gmem_jax.show.kinds import NOISE, kernel_facts
from gmem_jax.show.scene import at_rest
from gmem_jax.simulation.frames import Frames
from gmem_jax.simulation.protocol import BINS
from gmem_jax.simulation.sample import Sample
from gmem_jax.sweeps.curves import axes_of, is_sample, lines_of
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.table import doubts
from gmem_jax.sweeps.table import rows as points_of

LARGEST_CONFUSION = 256  # words
_CELL = 300  # characters of a value in a configuration
_NUMBER = re.compile(r"[-+]?\d[\d.,e±\s+-]*|nan|")


def _but_for_its_pack(configuration: dict[str, Any]) -> str:
    """All that makes the experiment of a recall, and size and shape of the grains, so that packs can be compared."""
    own = {**configuration["experiment"], "pack": [configuration["grains"], configuration["grain"]["shape"]]}
    return json.dumps(own, sort_keys=True)


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], caption: str = "") -> str:
    """A table as HTML; columns of numbers stand to the right."""
    cells = [[html.escape("" if cell is None else str(cell)) for cell in row] for row in rows]
    right = [all(_NUMBER.fullmatch(cell) for cell in column) for column in zip(*cells, strict=True)]

    def line(row: Sequence[str], tag: str) -> str:
        kinds = (' class="number"' if number else "" for number in right)
        each = (f"<{tag}{kind}>{cell}</{tag}>" for cell, kind in zip(row, kinds, strict=True))
        return f"<tr>{''.join(each)}</tr>"

    top = [line([html.escape(name) for name in head], "th")] if any(head) else []
    body = "\n".join([*top, *(line(row, "td") for row in cells)])
    return f'<div class="scroll"><table>{body}</table></div>' + (_note(caption) if caption else "")


def of_rich(drawn: Table) -> str:
    """A table of the terminal as HTML."""
    head = [str(column.header) for column in drawn.columns] if drawn.show_header else [""] * len(drawn.columns)
    rows = list(zip(*(map(str, column.cells) for column in drawn.columns), strict=True))
    title = f"<h3>{html.escape(str(drawn.title))}</h3>" if drawn.title else ""
    return title + table(head, rows, str(drawn.caption or ""))


def _configuration(values: Mapping[str, Any]) -> str:
    """Every parameter, folded away; long lists are cut."""

    def flat(part: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
        for name, value in part.items():
            if isinstance(value, dict) and value:
                yield from flat(value, f"{above}{name}.")
            else:
                text = value if isinstance(value, str) else json.dumps(value)
                yield above + name, text if len(text) <= _CELL else f"{text[:_CELL]} ..."

    rows = list(flat(values))
    if not rows:
        return ""
    return f"<details><summary>configuration, {len(rows)} values</summary>{table(['', ''], rows)}</details>"


def _note(words: str) -> str:
    return f'<p class="note">{html.escape(words)}</p>'


def _state(status: int) -> str:
    kind = "" if not status else " fatal" if Status(status).fatal else " doubtful"
    return f'<p><span class="status{kind}">{html.escape(explain(status))}</span></p>'


class Report:
    """A page in the making: sections of files, one after the other.

    Attributes:
        sections: title and HTML of each.
    """

    def __init__(self) -> None:
        self.sections: list[tuple[str, str]] = []
        self._recalls: list[tuple[dict[str, Any], dict[str, Any]]] = []
        self._seen: set[str] = set()  # packs that are shown at rest
        self._figures = self._views = 0

    def add(self, source: str) -> None:
        """Add what a file, the folder of a sweep or a shipped pack holds.

        Raises:
            FileNotFoundError: if there is none.
            FileFormatError: if it is damaged, or of a kind that no report shows.
        """
        path = Path(source)
        if path.is_dir():
            self._sweep(path)
        elif path.suffix.lower() == ".json":
            self._result(path)
        elif path.suffix.lower() in (".csv", ".npy"):
            self._waveforms(path)
        elif pack_called(source):
            self._pack(source)
        else:
            kinds = {PACK.name: self._pack, RECALL.name: self._recall, KERNEL.name: self._kernel}
            schema = schema_of(path)
            if schema not in kinds:
                raise FileFormatError(f"{source}: schema is {schema[:40]!r}, expected one of {', '.join(kinds)}")
            kinds[schema](source)

    def page(self, title: str) -> str:
        """The whole page."""
        parts = [*self._overview(), *self.sections]
        links = "".join(f'<a href="#part-{number}">{html.escape(name)}</a>' for number, (name, _) in enumerate(parts))
        made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        top = f"<header><h1>{html.escape(title)}</h1>{_note(f'gmem report, {made}')}<nav>{links}</nav></header>"
        body = "\n".join(
            f'<section id="part-{number}"><h2>{html.escape(name)}</h2>\n{content}</section>'
            for number, (name, content) in enumerate(parts)
        )
        library = f"<script>{plots.script()}</script>\n" if self._figures else ""
        return view.page(title, f"{library}{top}\n{body}", three=self._views > 0)

    def _overview(self) -> list[tuple[str, str]]:
        """Recalls of one experiment on several packs beside each other, with means and standard deviations."""
        if len(self._recalls) < 2:
            return []
        own = [configuration.get("experiment", {}) for _, configuration in self._recalls]
        packs = {each.get("pack", {}).get("sha256") for each in own}
        rows, configuration = [row for row, _ in self._recalls], self._recalls[-1][1]
        if len(packs) < len(own) or len({_but_for_its_pack(each) for _, each in self._recalls}) > 1:
            return []
        return [("Packs", of_rich(tables.recall_table(rows, configuration)))]

    def _figure(self, drawn: tuple[Any, int]) -> str:
        self._figures += 1
        return plots.written(drawn[0], f"figure-{self._figures}", drawn[1])

    def _view(self, frames: Frames, material: Material) -> str:
        self._views += 1
        return view.figure(f"view-{self._views}", frames, material)

    def _pack(self, source: str) -> None:
        pack = load_pack(source)
        made = load_frames(pack_called(source) or Path(source))
        self._seen.add(pack_fingerprint(pack))
        parts = [of_rich(tables.pack_table(pack)), self._view(at_rest(pack), Material())]
        if stages := load_stages(source):
            parts += self._stages(stages, [], pack.info.get("recipe", {}).get("t0"), "Its preparation")
        if made is not None:
            parts.append(self._view(made, Material()))
        parts.append(_configuration(pack.info))
        self.sections.append((f"Pack {pack.name}", "\n".join(parts)))

    def _recall(self, source: str) -> None:
        stored = load_recall(Path(source))
        recall, configuration = stored
        row = tables.summary(recall, configuration)
        self._recalls.append((row, configuration))
        names, t0 = stored.names, configuration["t0"]
        scale = np.asarray(relative_scale(configuration))
        wanted = configuration.get("target")
        target = None if wanted is None else np.asarray(bin_average(signals_from(wanted)))
        about = "G: gain; F: fidelity, 1 if what is recalled is the integral of what was stored; "
        about += "errors: standard errors over the signals stored in this pack (jackknife)"
        parts = [
            _note(tables.conditions(configuration)),
            _state(row["status"]),
            table(["", "G", "F"], _measures(recall, scale, t0), about),
        ]
        beside = tables.recall_table([row], configuration)
        if beside.row_count > 1:  # a published point
            parts.append(of_rich(beside))
        if len(names) > 1:
            few, own = len(names) <= tables.FEW, of_rich(tables.signals_table(row))
            parts.append(own if few else f"<details><summary>each of {len(names)} signals</summary>{own}</details>")
        if "backgrounds" in row:
            parts += [of_rich(tables.backgrounds_table(row)), _note(tables.second_readout_lines(row))]
        if target is not None:
            parts.append(_note(tables.target_line(row)))
        shown = f" (the first {plots.MOST} of {len(names)})" if len(names) > plots.MOST else ""
        parts += [f"<h3>Recalled signals{shown}</h3>", self._figure(plots.recalls(recall, scale, names, target, t0))]
        parts += self._stages(recall.stages, names, t0)
        parts += ["<h3>Grains</h3>", self._grains(recall, names, configuration), _configuration(configuration)]
        self.sections.append(
            (f"Recall {Path(source).name}, pack {tables.cell(configuration['pack'])}", "\n".join(parts))
        )

    def _grains(self, recall: Recall, names: Sequence[str], configuration: dict[str, Any]) -> str:
        """The frames of a recall, or its pack at rest if it is there."""
        written = configuration.get("experiment", {})
        material = Material(**written.get("material", {}))
        if (frames := recall.frames) is not None:
            whose = f"the run of {names[frames.signal - 1]}" if frames.signal else "the run without shear"
            told = f"{frames.count} moments of {whose}; displacements are since the first."
            return _note(told) + self._view(frames, material)
        without = "No frames in this file: gmem recall --frames 10 keeps some."
        of_pack = written.get("pack", {})
        if of_pack.get("sha256") in self._seen:
            return _note(f"{without} Its pack at rest is shown above.")
        try:
            pack = load_pack(of_pack["source"])
        except (OSError, ValueError, KeyError):
            return _note(without)
        if pack_fingerprint(pack) != of_pack["sha256"]:
            return _note(without)
        self._seen.add(of_pack["sha256"])
        return _note(f"{without} This is its pack at rest, before the run.") + self._view(at_rest(pack), material)

    def _stages(
        self, stages: Mapping[str, Sample], names: Sequence[str], t0: Any, title: str = "Along the run"
    ) -> list[str]:
        told = f"Stages, white and grey in turn: {', '.join(stages)}."
        drawn = plots.series(stages, names, t0 if is_number(t0) else None)
        return [f"<h3>{title}</h3>", self._figure(drawn), _note(told)]

    def _kernel(self, source: str) -> None:
        kernel, configuration = load_kernel(Path(source))
        facts = kernel_facts(kernel, NOISE)
        words = {
            "gain": "gain of the nearest ideal kernel",
            "distance": "distance from it",
            "asymmetry": "asymmetry |even| / |odd|",
            "resolution": f"resolution in v at {NOISE:g} Pa of noise",
        }
        rows = [(words[name], f"{facts[name]:.3f}") for name in words]
        rows.append((f"singular values above {NOISE:g} Pa", f"{facts['capacity']} of {len(kernel.centres)}"))
        drawn = self._figure(plots.kernel(kernel, NOISE / float(Material().modulus)))
        bumps = {**configuration, "signals": (), "experiment": {}}  # no signals were stored
        about = f"{tables.heading(bumps)}, {len(kernel.centres)} bumps of width {kernel.width:g}"
        parts = [_note(about), table(["", ""], rows), drawn, _configuration(configuration)]
        self.sections.append((f"Kernel {Path(source).name}", "\n".join(parts)))

    def _result(self, path: Path) -> None:
        schema, found = load_result(path)
        with refusing(path, schema.title):
            draw = {READING.name: self._reading, GRADIENT.name: self._gradient, TUNED.name: self._tuned}[schema.name]
            parts = draw(found)
        title = f"{schema.title.partition(' (')[0]} {path.name}"
        self.sections.append((title, "\n".join([*parts, _configuration(found.get("configuration", {}))])))

    def _reading(self, found: dict[str, Any]) -> list[str]:
        parts = [
            _note(f"of {found['recall']}, pack {tables.cell(found['pack'])}"),
            *map(of_rich, tables.reading_tables(found)),
        ]
        if found["words"] <= LARGEST_CONFUSION:
            names = [f"{word:0{found['bits']}b}" for word in range(found["words"])]
            counts = {name: confusion(row["read"], found["words"]) for name, row in found["readers"].items()}
            parts.append(self._figure(plots.confusion(counts, names)))
        return parts

    def _gradient(self, found: dict[str, Any]) -> list[str]:
        slopes, configuration = found["gradient"], found.get("configuration", {})
        rows = [("F", f"{found['fidelity']:.4f}")]
        stiffness = "per E R" if configuration.get("friction") == "hooke" else "per E R^0.5"
        units = {"stiffness": f" ({stiffness})"}
        rows += [
            (f"dF/d{name}{units.get(name, '')}", f"{slopes[name]:.5g}") for name in slopes if is_number(slopes[name])
        ]
        lines = zip(found["places"], slopes["waveform"], strict=True)
        curves = {f"signal {n}": (np.asarray(place), np.asarray(slope)) for n, (place, slope) in enumerate(lines, 1)}
        drawn = plots.curves(curves, plots.U, "dF / d amplitude", mode="lines+markers")
        about = tables.heading(configuration) if configuration else tables.cell(found["pack"])
        return [_note(about), table(["", ""], rows), self._figure(drawn)]

    def _tuned(self, found: dict[str, Any]) -> list[str]:
        names = list(found["values"])
        rows = [
            [number, *(f"{one[name]:.4g}" for name in names), f"{one['fidelity']:.4f}"]
            for number, one in enumerate(found["history"])
        ]
        packs = ", ".join(tables.cell(pack) for pack in found["packs"])
        history = self._history(packs, [one["fidelity"] for one in found["history"]])
        about = f"mean over {packs}; stiffness in E R (k_M in E R^0.5)"
        return [_note(about), table(["iteration", *names, "mean F"], rows), history]

    def _history(self, name: str, fidelities: Sequence[float]) -> str:
        line = (np.arange(len(fidelities)), 1.0 - np.asarray(fidelities))
        figure, height = plots.curves({name: line}, "iteration", "1 - F", mode="lines+markers", log=True)
        figure.update_xaxes(dtick=1 + len(fidelities) // 20)
        return self._figure((figure, height))

    def _waveforms(self, path: Path) -> None:
        commented = path.suffix.lower() == ".csv"
        target, design = (load_target(path), load_design(path)) if commented else (None, {})
        parts = [self._waves(waveform(load_waveforms(path)))]
        if target is not None:
            told = "Designed so that their recall follows the integrals of these:"
            parts += [_note(told), self._waves(target)]
        if design:
            words = {"before": "F before", "fidelity": "F", "gain": "G"}
            rows = [(words[name], f"{design[name]:.4f}") for name in words]
            pack = tables.cell(design["pack"])
            parts += [table(["", ""], rows, f"of the recall on {pack} with respect to the target")]
            parts.append(self._history(pack, design["history"]))
        self.sections.append((f"Waveforms {path.name}", "\n".join(parts)))

    def _waves(self, signals: Signals) -> str:
        u = np.linspace(0.0, 1.0, 2 * BINS + 1)
        values = np.asarray(signals.shear(jnp.asarray(u))).T
        lines = {name: (u, value) for name, value, _ in zip(names_of(signals), values, range(plots.MOST), strict=False)}
        return self._figure(plots.curves(lines, plots.U, "I(u)"))

    def _sweep(self, folder: Path) -> None:
        store = Store(folder, make=False)
        card, rows = store.card(), points_of(store)
        names = card["names"]
        cells = [
            [
                *(tables.cell(row[name]) for name in names),
                *("" if row[name] is None else f"{row[name]:.3f}" for name in analysis.MEASURES),
                (doubts(row) or "ok") if row["state"] == "done" else row["why"] or row["state"],
            ]
            for row in rows
        ]
        parts = [table([*names, "G", "F", "G over T1", "F over T1", "status"], cells)]
        done = [row for row in rows if row["state"] == "done"]
        parts += [self._figure(drawn) for name in names if (drawn := _against(name, done, names))]
        parts.append(_configuration(card["shared"]))
        self.sections.append((f"Sweep {folder.name}", "\n".join(parts)))


def _against(x: str, done: Sequence[Mapping[str, Any]], names: Sequence[str]) -> tuple[Any, int] | None:
    """F and G of a sweep against a number that varies and is no sample; None if it is none."""
    rows = [row for row in done if isinstance(row[x], int | float)]
    if is_sample(x) or len({row[x] for row in rows}) < 2:
        return None
    axes, lines, errors = axes_of(rows, names, x), {}, {}
    for letter, measure in (("F", "fidelity"), ("G", "gain")):
        for line in lines_of(rows, axes, measure):
            name = " ".join(
                [letter, ", ".join(f"{name} = {tables.cell(value)}" for name, value in line.values.items())]
            )
            lines[name], errors[name] = (np.array(line.x), line.mean), line.error
    y = f"F, G (mean ± SE over {', '.join(axes.over)})" if axes.over else "F, G"
    return plots.curves(lines, x, y, mode="lines+markers", errors=errors)


def _measures(recall: Recall, scale: np.ndarray, t0: float | list[float]) -> list[list[str]]:
    """G and F with their standard errors over signals, as they are and averaged over the ringing period."""
    p_sig, integral = jnp.asarray(recall.p_sig), jnp.asarray(recall.J)
    window = float(recall.window) * BINS / float(np.max(t0))
    rows = []
    for name, (gain, fidelity), smooth in (
        ("as recalled", (recall.gain, recall.fidelity), lambda curve: curve),
        (
            f"averaged over T1 = {float(recall.window):.0f} t_c",
            (recall.windowed_gain, recall.windowed_fidelity),
            lambda curve: analysis.running_mean(curve, window),
        ),
    ):
        errors = analysis.errors_over_signals(np.asarray(smooth(p_sig)), np.asarray(smooth(integral)), scale)
        pairs = zip((gain, fidelity), errors, strict=True)
        rows.append([name, *(f"{float(value):.3f} ± {error:.3f}" for value, error in pairs)])
    return rows
