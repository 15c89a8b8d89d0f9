"""Running a figure of the paper, from its sweep to its picture and its table."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from gmem_jax.bench.measure import rival
from gmem_jax.errors import RunFailedError
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.files.atomic import atomic
from gmem_jax.files.cache import list_packs
from gmem_jax.files.packs import load_pack
from gmem_jax.native.backend import backend_name
from gmem_jax.physics.contact.laws import entry_of, law_named
from gmem_jax.physics.state import combined_status
from gmem_jax.reading.lessons import TrainingConfig
from gmem_jax.reading.readers import stored_words
from gmem_jax.reading.report import reading_report
from gmem_jax.reading.training import train_net
from gmem_jax.reproduce import choices, claims, draw
from gmem_jax.reproduce.choices import Effect
from gmem_jax.reproduce.claims import Verdict
from gmem_jax.reproduce.compare import (
    Compared,
    ComputedPoint,
    Conditions,
    compare_points,
    compared,
    comparison_rows,
    points_of,
    write_csv,
)
from gmem_jax.reproduce.cost import spec_for, spec_for_all
from gmem_jax.reproduce.dataset import COLLECTED, write_dataset
from gmem_jax.reproduce.figures import (
    FIGURES,
    GALLERY,
    SHOWN_WORD,
    PaperFigure,
    Scale,
    Values,
    packs,
    scale_of,
)
from gmem_jax.reproduce.single_contact import convergence_figure, laws_figure
from gmem_jax.reproduce.two_grains import two_grains_figure
from gmem_jax.show.numbers import summary
from gmem_jax.show.recalls import recall_figure
from gmem_jax.show.render import packs_figure
from gmem_jax.show.render_matplotlib import to_matplotlib
from gmem_jax.simulation.compiled import require_x64
from gmem_jax.simulation.progress import Progress, silent
from gmem_jax.sweeps.executors import Executor, Processes
from gmem_jax.sweeps.spec import PREPARE, Spec
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.sweep import SECONDS_PER_GRAIN_STEP, SIDE_BY_SIDE, SweepRunner, Tell
from gmem_jax.sweeps.table import doubts, rows

RUNS = "runs"  # the folder of the sweep that all figures share
MOST_SHOWN = 8  # words of a length in Fig. 13


_Row = TypeVar("_Row")  # a measure beside the published one, or an effect of a choice


class Schematic(NamedTuple):
    """A figure of the paper that needs no experiments.

    Attributes:
        title: title of the figure.
        draw: writes the figure to a file, as SVG beside it, and its numbers, if any, as CSV; gives results to print.
        has_numbers: whether it has numbers.
    """

    title: str
    draw: Callable[[Path], object]
    has_numbers: bool = False


SCHEMATICS = {
    "fig05": Schematic("the waveforms and some words, with their integrals", draw.waveforms),
    "fig07": Schematic("two grains, and how their contact keeps a shear", two_grains_figure, has_numbers=True),
    "fig10": Schematic("one contact under every law, beside closed forms", laws_figure, has_numbers=True),
    "fig15": Schematic("M2 with more and more points", convergence_figure, has_numbers=True),
}


class Outcome(NamedTuple, Generic[_Row]):
    """What a figure, or the choices that the paper leaves open, resulted in.

    Attributes:
        name: name of the figure, or "choices".
        rows: the measures of a figure beside the published ones, or the effects of every value of every choice.
        files: the files written.
        failed: reasons of points that failed, by key.
    """

    name: str
    rows: list[_Row]
    files: list[Path]
    failed: dict[str, str]


class Claims(NamedTuple):
    """The tests of all claims on one pack.

    Attributes:
        pack: name of the pack.
        grains: its number of grains N.
        t0: duration of one compression, in t_c.
        verdicts: a verdict on each claim.
        path: the file written.
    """

    pack: str
    grains: int
    t0: float
    verdicts: list[Verdict]
    path: Path

    def rows(self) -> list[dict[str, Any]]:
        """The verdicts as JSON, each with its conditions."""
        conditions = {"pack": self.pack, "grains": self.grains, "t0": self.t0}
        return [{**verdict._asdict(), **conditions} for verdict in self.verdicts]


@dataclass(frozen=True)
class Reproduction:
    """Makes figures and tests claims of the paper. Finished runs in its folder are not run again.

    Attributes:
        folder: folder for figures and tables, and for the runs, which all figures share; made if it does not exist.
        scale: a name of `SCALES`, or one with changes: see `scale_of`.
        executor: runs the points; default processes of this machine.
        progress: called with the progress of the runs.
        say: called with lines of text on what is planned, what happened, and why recalls are doubtful.
        statuses: gets the status of every recall.

    Raises:
        ValueError: by its methods, if there is no such scale, or JAX runs in 32 bits.
        RunFailedError: by its methods, if workers die again and again.
        OSError: by its methods, if something cannot be written, or no worker can be started.
    """

    folder: Path
    scale: str = "laptop"
    executor: Executor | None = None
    progress: Progress = silent
    say: Tell = print
    statuses: list[int] = field(default_factory=list, compare=False)

    def figure(self, name: str) -> Outcome[Compared]:
        """Run the missing points of a figure of `FIGURES`, and write its picture (PNG, SVG) and its table (CSV).

        Raises:
            ValueError: if there is no such figure.
        """
        require_x64()
        if name not in FIGURES:
            raise ValueError(f"no figure {name!r}; there are {', '.join(FIGURES)}")
        size, figure = scale_of(self.scale), FIGURES[name]
        if name == "fig14":
            (self.folder / "nets").mkdir(parents=True, exist_ok=True)
        store = self._run(spec_for(name, self.scale)).store
        points, failed = points_of(store), _failed(store)
        if not points:
            return Outcome(name, [], [], failed)
        measured = compare_points(points, size.t0)
        if name == "fig14":
            measured += self._read_words(store, points, size)
        target = self._target(name)
        write_csv(target.with_suffix(".csv"), comparison_rows(measured))
        title = f"{figure.title}\n{draw.said_of(measured, f'{size.t0:,.0f}')}"
        _draw(figure, name, target, measured, points, store, title)
        return Outcome(name, measured, _written(target), failed)

    def picture(self, name: str) -> list[Path]:
        """Draw a figure that needs no experiments: one of `SCHEMATICS`, or the packs of `GALLERY`.

        Only `GALLERY` depends on the scale. Gives the files written.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        if name != GALLERY:
            target = self.folder / f"{name}.png"
            self.say(f"{name}: {SCHEMATICS[name].draw(target) or 'drawn'}")
            return _written(target)[: None if SCHEMATICS[name].has_numbers else -1]
        runner = self._runner(spec_for(GALLERY, self.scale))
        shown, target = runner.packs(self.executor or Processes(), self.progress), self._target(name)
        packs_figure(target, shown, "Packs at rest, by size and by shape")
        return [target]

    def sensitivity(self) -> Outcome[Effect]:
        """Run every choice that the paper leaves open with other values, on the same packs, and write choices-SCALE."""
        size = scale_of(self.scale, choices.SIZES)
        named = packs(size, size.grains, size.few)
        store = self._run(spec_for("choices", self.scale)).store
        done = store.done()
        points = [row for row in store.card()["points"] if row["key"] in done]
        runs = [(row["values"], summary(store.load(row["key"]))) for row in points]
        found, target = choices.effects(named, runs, size.t0), self._target("choices")
        if not found:
            return Outcome("choices", [], [], _failed(store))
        write_csv(target.with_suffix(".csv"), choices.effect_rows(found))
        choices.draw(target, found, choices.choices_title(size, found[0].gain.packs))
        return Outcome("choices", found, _written(target), _failed(store))

    def dataset(self) -> tuple[list[Path], dict[str, str]]:
        """Run the missing points of the figures `COLLECTED`, and write their recalls as one archive, dataset-SCALE.zip.

        Returns:
            The files written, and the reasons of points that failed, by key.
        """
        require_x64()
        store = self._run(spec_for_all(COLLECTED, self.scale)).store
        points, target, failed = points_of(store), self._target("dataset", ".zip"), _failed(store)
        if points:
            write_dataset(target, store, points, self.scale, scale_of(self.scale).t0, len(failed))
        return [target] if points else [], failed

    def claims(self) -> Claims:
        """Run the points that the claims of the paper need, test the claims on one pack, and write claims-SCALE.json.

        The claim on rearrangement is tested on as many packs, tetra grains and spheres, as a point of the scale has.

        Raises:
            RunFailedError: if a point failed, so that a claim cannot be tested.
        """
        spec = spec_for("claims", self.scale)
        runner = self._run(spec)
        store = runner.store
        if failed := _failed(store):
            raise RunFailedError(next(iter(failed.values())))
        points, many = store.card()["points"], scale_of(self.scale).packs
        made = [runner.pack_of({**spec.shared, **row["values"]}) for row in (points[0], *points[1 - 2 * many :])]
        tetra, spheres = made[:many], made[many:]
        runs = [(row["values"], store.load(row["key"])) for row in points[: 1 - 2 * many]]
        t0, target = spec.shared["t0"], self._target("claims", ".json")
        found = Claims(tetra[0].name, tetra[0].grains, t0, claims.verdicts(tetra, spheres, t0, runs), target)
        with atomic(target) as path:
            path.write_text(json.dumps(found.rows(), indent=1) + "\n", encoding="utf-8")
        return found

    def _runner(self, spec: Spec, cost: float = SECONDS_PER_GRAIN_STEP) -> SweepRunner:
        self.folder.mkdir(parents=True, exist_ok=True)
        return SweepRunner(spec, self.folder / RUNS, self.say, cost=cost)

    def _run(self, spec: Spec) -> SweepRunner:
        """Run the missing points of a sweep; gives its runner."""
        runner = self._runner(spec, quick_cost(spec.extra))
        runner.run(self.executor or Processes(), self.progress)
        table = rows(runner.store)
        self.statuses.extend(row["status"] for row in table if row["state"] == "done")
        for line in doubts(table):
            self.say(f"warning: {line}")
        return runner

    def _target(self, name: str, suffix: str = ".png") -> Path:
        """The file of a figure; its name has the scale with its changes."""
        return self.folder / f"{name}-{self.scale.replace(',', '-')}{suffix}"

    def _read_words(self, store: Store, points: Sequence[ComputedPoint], size: Scale) -> list[Compared]:
        """Accuracies with which recalled words are read, by nets that were trained on inputs only and by the baselines.

        Nets are kept in the folder; those that ran out of time are trained on at each call.
        """
        found: dict[tuple[Conditions, str], list[float]] = {}
        status: dict[Conditions, int] = {}
        for length in sorted({point.conditions.bits for point in points}):
            nets = []
            for seed in range(size.nets):
                file = self.folder / "nets" / f"words-{length}-{seed}.msgpack"
                net = train_net(TrainingConfig(length), seed, budget=size.budget, checkpoint=file)
                nets.append(net)
                state = "trained" if net.finished else "out of time"
                known = f"{net.step} steps, held-out accuracy {net.validation:.4f}"
                self.say(f"net {seed} for {length} bits: {state}, {known}")
            for point in points:
                if point.conditions.bits == length:
                    bits = point.numbers["status"]
                    status[point.conditions] = combined_status([status.get(point.conditions, 0), bits])
                    read = reading_report(stored_words(store.load(point.key)), nets)["readers"]
                    for reader, row in read.items():
                        found.setdefault((point.conditions, f"accuracy {reader}"), []).append(row["accuracy"])
        return [compared(at, measure, values, status[at]) for (at, measure), values in found.items()]


def quick_cost(points: Sequence[Values]) -> float:
    """Mean seconds per grain-step on this machine with `SIDE_BY_SIDE` replicas, over some points.

    It is measured for a second for each law, on the shipped pack that is nearest in size.
    """
    work: dict[tuple[str, str], float] = {}
    for values in points:
        law = entry_of(law_named(str(values.get("friction", "H"))))
        assert law is not None
        grains = int(values.get(f"{PREPARE}grains", 0)) or load_pack(values["pack"]).grains
        near = min(list_packs(), key=lambda name: abs(math.log(int(name.split("-")[1]) / grains)))
        work[law.paper, near] = work.get((law.paper, near), 0.0) + grains
    backend = backend_name("auto", Experiment.friction)
    timed = {(law, near): rival(load_pack(near), backend, law, SIDE_BY_SIDE, seconds=1.0).once() for law, near in work}
    return 1e-6 * sum(timed[case] * weight for case, weight in work.items()) / sum(work.values())


def _written(target: Path) -> list[Path]:
    """The files of a figure: its picture twice, and its table."""
    return [target.with_suffix(suffix) for suffix in (".png", ".svg", ".csv")]


def _failed(store: Store) -> dict[str, str]:
    """The reasons of all failed points of the latest sweep, by key; rows of equal values are one point."""
    failed = store.failed()
    return {row["key"]: failed[row["key"]] for row in store.card()["points"] if failed.get(row["key"])}


def _draw(
    figure: PaperFigure,
    name: str,
    target: Path,
    rows: Sequence[Compared],
    points: Sequence[ComputedPoint],
    store: Store,
    title: str,
) -> None:
    if figure.across:
        draw.draw_comparison(target, rows, figure.across, title)
        return
    recall = store.load(points[0].key)
    if name == "fig04":
        draw.through_time(target, recall, 5, title)
    elif name == "fig06":
        drawn = to_matplotlib(recall_figure(recall, "signals"))
        for suffix in (".png", ".svg"):
            drawn.save(target.with_suffix(suffix))
    else:
        kept = [store.load(point.key) for point in points]
        draw.words_figure(
            target,
            kept,
            [_shown(point.conditions.bits) for point in points],
            title,
        )


def _shown(bits: int) -> list[int]:
    """Numbers of the words that are drawn: all eight of three bits, some of longer ones, and the paper's one of ten."""
    count = 1 << bits
    chosen = sorted({round((k + 0.5) * count / MOST_SHOWN - 0.5) for k in range(MOST_SHOWN)})
    return [SHOWN_WORD - 1] if bits == 10 else chosen


def outcome_summary(outcome: Outcome[Compared]) -> dict[str, Any]:
    """An outcome as JSON."""
    lines = [
        {
            **row.conditions.__dict__,
            "measure": row.measure,
            "mean": row.ours.mean,
            "sd": row.ours.sd,
            "packs": row.ours.packs,
            "published": row.theirs.mean if row.theirs else None,
            "published_grains": row.grains or None,
            "combined_errors_apart": row.errors_apart,
            "status": row.status,
        }
        for row in outcome.rows
    ]
    return {
        "figure": outcome.name,
        "rows": lines,
        "files": list(map(str, outcome.files)),
        "failed": sorted(outcome.failed.values()),
    }
