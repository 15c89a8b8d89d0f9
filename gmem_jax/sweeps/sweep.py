"""Running a sweep from its points to its results: `gm.sweep`, and the sweeps of the command line."""

import contextlib
import functools
import itertools
import json
import numbers
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import psutil

from gmem_jax.errors import FileFormatError, RunFailedError
from gmem_jax.experiment.arguments import require_kind, require_several
from gmem_jax.experiment.changes import replace as with_values
from gmem_jax.experiment.cost import replica_bins
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.html import listing
from gmem_jax.experiment.identity import identity
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.recall import Recall
from gmem_jax.files.configuration import named_experiment, with_protocol
from gmem_jax.files.packs import load_pack
from gmem_jax.files.protocols import named_protocol
from gmem_jax.files.sizes import STEP_SECONDS, in_time, recall_bytes
from gmem_jax.files.validation import require_kinds
from gmem_jax.files.waveforms import named_signals, waveforms_of
from gmem_jax.physics.numbers import plural
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import combined_status, explain
from gmem_jax.simulation.progress import Progress, ProgressChoice, callback, shows_progress, within, work_of_bin
from gmem_jax.sweeps.executors import Executor
from gmem_jax.sweeps.making import AS_THEY_ARE, pack_job, require_prepared
from gmem_jax.sweeps.plan import ABREAST, Point, digest, groups, plan, point
from gmem_jax.sweeps.spec import PREPARE, Spec
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.work import parts_of_job, run_group

FREE_CORES = "of two free cores once compiled (native, law H)"
SECONDS_PER_GRAIN_STEP = STEP_SECONDS["native"][1]  # with SIDE_BY_SIDE replicas; see docs/scaling.md
SIDE_BY_SIDE = 8  # replicas of a block
CHECKED = 50  # values of a name that are tried before a sweep begins
ANY_PACK = "tetra-325-a"
Tell = Callable[[str], None]


class Result(NamedTuple):
    """The values of a point of a sweep, and its recall."""

    values: dict[str, Any]
    recall: Recall


class Results(list[Result]):
    """The points of a sweep, in order; a notebook shows them as a table."""

    def _repr_html_(self) -> str:
        names = list(self[0].values) if self else []
        several = ["read", "channel"] * any(len([*one.recall.each()]) > 1 for one in self)
        columns = [_labels([one.values[name] for one in self]) for name in names]
        rows = [
            [
                *(column[place] for column in columns),
                *((part.reads[0], part.channels[0]) if several else ()),
                part.gain,
                part.fidelity,
                explain(combined_status(part.status)),
            ]
            for place, one in enumerate(self)
            for part in one.recall.each()
        ]
        return listing(f"Sweep of {plural(len(self), 'point')}", [*names, *several, "G", "F", "status"], rows)


@usual_rules()
@shows_progress
def sweep(
    experiment: Experiment,
    vary: Mapping[str, Sequence[Any]],
    folder: Path | str | None = None,
    *,
    progress: ProgressChoice = None,
) -> Results:
    """Run an experiment with every combination of some values, in this process, side by side where possible.

    Args:
        experiment: the experiment; all that is not varied is the same in all points.
        vary: lists of values by dotted name, like {"friction.mu": [0.0, 0.5], "pack": packs}. Packs may be given by
            name or file.
        folder: folder that keeps the results: points that are there already are not computed again, and its table shows
            the points of the latest call. Default none.
        progress: see `run`.

    Returns:
        A list of points, each with its `values` by name and its `recall`, in the order of `itertools.product`: the last
        name changes fastest.

    Raises:
        ValueError: for a name that is no field, or an impossible value.
        RunFailedError: if a simulation broke down.
        FileFormatError: if another call is computing the same points in this folder, or it holds something else.
    """
    require_kind("sweep", experiment, Experiment)
    tell = callback(progress)
    for name, several in vary.items():
        require_several(several, name)
    vary = {name: list(several) for name, several in vary.items()}
    packs = functools.cache(load_pack)  # points on one pack object can run side by side
    points, labels = [], []
    for row in itertools.product(*(zip(several, _labels(several), strict=True) for several in vary.values())):
        values = {name: value for name, (value, _) in zip(vary, row, strict=True)}
        labels.append({name: label for name, (_, label) in zip(vary, row, strict=True)})
        own = {**values, "pack": packs(values["pack"])} if isinstance(values.get("pack"), str) else values
        points.append(point(values, with_values(experiment, own)))
    store = None if folder is None else Store(Path(folder))
    if store:
        named = [replace(one, values=label) for one, label in zip(points, labels, strict=True)]
        store.write_manifest(named, {}, list(vary))
    found = {one.key: store.load(one.key) for one in points if store and store.at(one.key).is_file()}
    missing = list({one.key: one for one in points if one.key not in found}.values())
    jobs = list(groups(missing, ABREAST, psutil.virtual_memory().available))
    total, done = sum(one.experiment.replicas for one in missing) or 1, 0
    for group in jobs:
        share = sum(one.experiment.replicas for one in group)
        on = within(tell, done / total, (done + share) / total)
        keys, experiments = [one.key for one in group], [one.experiment for one in group]
        job = {"name": digest(keys)}
        with store.lock(job) if store else contextlib.nullcontext():
            cache = parts_of_job(store, job) if store else None
            found |= run_group(keys, experiments, store=store, cache=cache, progress=on)
        done += share
    return Results(Result(one.values, found[one.key]) for one in points)


def _labels(values: Sequence[Any]) -> list[Any]:
    """Values for a table; different objects of one name, as packs or laws of one kind, are numbered."""
    labels = [_label(value) for value in values]
    objects = {id(value): value for value, label in zip(values, labels, strict=True) if isinstance(label, str)}
    own = {key: identity(value) for key, value in objects.items()}
    numbers: dict[str, dict[str, int]] = {}
    for key, value in objects.items():
        known = numbers.setdefault(_label(value), {})
        known.setdefault(own[key], len(known) + 1)
    return [
        f"{label} ({numbers[label][own[id(value)]]})" if len(numbers.get(label, ())) > 1 else label
        for value, label in zip(values, labels, strict=True)
    ]


def _label(value: Any) -> Any:
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, Pack):
        return value.name
    scalar = isinstance(value, np.ndarray | jax.Array) and value.ndim == 0
    return float(value) if scalar or isinstance(value, numbers.Real) else type(value).__name__


def seconds_of(jobs: Sequence[Mapping[str, Any]], cost: float = SECONDS_PER_GRAIN_STEP) -> float:
    """Seconds that jobs take, from work and replicas; `cost` is that of a grain-step at `SIDE_BY_SIDE` replicas."""
    blocks: float = sum(job["work"] * work_of_bin(job["replicas"]) / job["replicas"] for job in jobs)
    return cost * blocks * SIDE_BY_SIDE / work_of_bin(SIDE_BY_SIDE)


class SweepRunner:
    """The sweep of a file, run by workers on a store.

    Args:
        spec: the content of the file.
        folder: folder of the store.
        say: called with lines of text on what is planned and what happened.
        cost: seconds per grain-step with `SIDE_BY_SIDE` replicas, for the announced times.

    Raises:
        FileFormatError: if packs_as_they_are in [run] is neither true nor false.
    """

    def __init__(self, spec: Spec, folder: Path, say: Tell, *, cost: float = SECONDS_PER_GRAIN_STEP) -> None:
        self.spec, self.folder, self.say, self.cost = spec, folder, say, cost
        self._packs = functools.cache(load_pack)
        self._signals = functools.cache(functools.partial(named_signals, told=say))
        self._protocols = functools.cache(lambda written: named_protocol(json.loads(written)))
        self.impossible: list[tuple[dict[str, Any], str]] = []
        self.as_they_are = spec.run.get(AS_THEY_ARE, False)
        if not isinstance(self.as_they_are, bool):
            raise FileFormatError(f"{AS_THEY_ARE} in [run] must be true or false, got {self.as_they_are!r}")

    @functools.cached_property
    def store(self) -> Store:
        """The store. It is made on first use, so that a sweep that is refused leaves nothing behind.

        Raises:
            FileFormatError: if the folder holds something else.
        """
        return Store(self.folder)

    def _pack_job(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return pack_job(values, follow=not self.as_they_are)

    def pack_jobs(self) -> list[dict[str, Any]]:
        """The jobs of the packs that must be made first.

        Raises:
            ValueError: for an impossible recipe.
        """
        wanted = {}
        for values in self.spec.combinations():
            all_ = {**self.spec.shared, **values}
            if "pack" not in all_:
                job = self._pack_job(all_)
                wanted[job["name"]] = job
        failed = self.store.failed()
        return [job for name, job in wanted.items() if name not in failed and not self.store.pack_at(name).is_file()]

    def check(self) -> None:
        """Refuse an impossible sweep before anything is computed, by making the experiments of some of its points.

        They take up to `CHECKED` values of every name in turn, on a shipped pack if their own does not exist yet. A
        point that is impossible only by a combination of values fails later, by itself.

        Raises:
            ValueError: for an unknown name or an impossible value.
            FileNotFoundError: if there is no such pack.
        """
        first = {name: values[0] for axis in self.spec.axes for name, values in axis.items()}
        tried = [first, *self.spec.extra[:CHECKED]]
        for axis in self.spec.axes:
            count = len(next(iter(axis.values())))
            places = sorted({round(step * (count - 1) / CHECKED) for step in range(CHECKED + 1)})
            tried += [{**first, **{name: values[place] for name, values in axis.items()}} for place in places]
        for values in tried:
            all_ = {**self.spec.shared, **values}
            require_kinds(all_)
            if "pack" not in all_:
                self._pack_job(all_)
            self._experiment(all_, self._packs(str(all_.get("pack", ANY_PACK))))

    def _experiment(self, values: Mapping[str, Any], pack: Pack) -> Experiment:
        own = {name: value for name, value in values.items() if name != "pack" and not name.startswith(PREPARE)}
        if "pack" in values and (odd := [name for name in values if name.startswith(PREPARE)]):
            raise ValueError(f"a point has a pack and {odd[0]!r} of one to be made; give one of them")
        own = with_protocol(own, lambda name: self._protocols(json.dumps(name, default=str)))
        found = named_experiment(pack, own, self._signals(*waveforms_of(own)))
        if "pack" in values and not self.as_they_are:
            require_prepared(found, str(values["pack"]))
        return found

    def pack_of(self, values: Mapping[str, Any]) -> Pack:
        """The pack of a point.

        Args:
            values: values of the point, the shared ones included.

        Raises:
            RunFailedError: if it could not be made.
            FileNotFoundError: if there is no such pack, or it is not made yet.
            FileFormatError: if its file is damaged, or belongs to another pack.
        """
        if "pack" in values:
            return self._packs(str(values["pack"]))
        name = self._pack_job(values)["name"]
        if not self.store.pack_at(name).is_file() and (reason := self.store.failed().get(name)):
            raise RunFailedError(f"its pack could not be made: {reason}")
        path = self.store.pack_at(name)
        pack = self._packs(str(path))
        if pack.name != name:
            raise FileFormatError(
                f"{path}: is the pack {pack.name}, not the one of its name: files were exchanged; "
                "remove it, and the sweep makes it again"
            )
        return pack

    def packs(self, executor: Executor, progress: Progress) -> list[Pack]:
        """The packs of all points, in order; those that do not exist yet are made.

        Raises:
            RunFailedError: if one could not be made, or workers die again and again.
            OSError: if no worker can be started.
            FileNotFoundError: if there is no such pack.
        """
        if makes := self.pack_jobs():
            self._announce(f"{plural(len(makes), 'pack')} to be made", makes, executor)
            self._finish(executor, makes, progress, "packs")
        return [self.pack_of({**self.spec.shared, **values}) for values in self.spec.combinations()]

    def points(self) -> list[Point]:
        """All possible points, once their packs exist; the others are put into `impossible` with their reasons."""
        found = []
        self.impossible = []
        for values in self.spec.combinations():
            all_ = {**self.spec.shared, **values}
            try:
                found.append(point(values, self._experiment(all_, self.pack_of(all_))))
            except (ValueError, FileNotFoundError, RunFailedError) as error:
                self.impossible.append((values, " ".join(str(error).split())))
        return found

    def run(self, executor: Executor, progress: Progress) -> None:
        """Make all packs and run all points that are missing.

        Raises:
            RunFailedError: if workers die again and again.
            OSError: if no worker can be started.
        """
        if makes := self.pack_jobs():
            self._announce(f"{plural(len(makes), 'pack')} to be made", makes, executor)
            if later := self.points_to_come():
                self._announce(f"then {plural(len(later), 'point')} on them", later, executor)
            self._finish(executor, makes, progress, "packs")
        points = self.points()
        failed = [(digest([self.spec.shared, values]), values, reason) for values, reason in self.impossible]
        self.store.write_manifest(
            points, self.spec.shared, self.spec.names, [(key, values) for key, values, _ in failed]
        )
        for key, _, reason in failed:
            self.store.fail(key, reason)
        for key in self.store.unreadable({one.key for one in points}):
            self.say(f"{self.store.at(key)}: damaged, or another point's; computed again")
            self.store.forget(key)
        known = self.store.done() | set(self.store.failed())
        memory = psutil.virtual_memory().available // executor.workers
        begun = self.store.begun({one.key for one in points} - set(self.store.failed()))
        under_way = {key for job in begun for key in job["points"]}
        jobs = begun + [job.asdict() for job in plan(points, known | under_way, memory, workers=executor.workers)]
        keys = {one.key for one in points}  # several points may have one key
        kept, told = len(keys & known), plural(len(keys), "point")
        if jobs:
            count = sum(len(job["points"]) for job in jobs)
            self._announce(f"{count} of {told} in {plural(len(jobs), 'run')}", jobs, executor)
            self._finish(executor, jobs, progress, "points")
        else:
            self.say(f"nothing to do: {kept} of {told} there")

    def points_to_come(self) -> list[dict[str, Any]]:
        """Work, replicas and bytes of each point on a pack that does not exist yet."""
        found = []
        for values in self.spec.combinations():
            all_ = {**self.spec.shared, **values}
            if "pack" in all_ or self.store.pack_at((job := self._pack_job(all_))["name"]).is_file():
                continue
            with contextlib.suppress(ValueError, FileNotFoundError):  # an impossible point is reported later
                like = self._experiment(all_, self._packs(ANY_PACK))
                grains = job["recipe"]["grains"]
                work = grains * like.timing.steps * replica_bins(like, like.signals.count)
                found.append({"work": work, "replicas": like.replicas, "bytes": recall_bytes(like)})
        return found

    def _announce(self, what: str, jobs: list[dict[str, Any]], executor: Executor) -> None:
        work = sum(job["work"] for job in jobs)
        widest = max(job["replicas"] for job in jobs)
        workers = min(executor.workers, len(jobs))
        where = "here" if self.cost != SECONDS_PER_GRAIN_STEP else FREE_CORES
        cost = f"{work:.2g} grain-steps, {in_time(seconds_of(jobs, self.cost))} {where}"
        self.say(f"{what}, {plural(widest, 'replica')} side by side at most, workers: {workers}; {cost}")

    def _finish(self, executor: Executor, jobs: list[dict[str, Any]], progress: Progress, what: str) -> None:
        self.store.order(jobs)
        executor.finish(self.store, jobs, lambda fraction: progress(what + executor.waiting, 0.0, fraction))
