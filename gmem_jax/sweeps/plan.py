"""The jobs of a sweep: points that may run side by side become one run; missing packs are made first."""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gmem_jax.experiment.cost import default_batch, steps_of_grains
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.record import key_of_run, to_dict
from gmem_jax.experiment.several import match

ABREAST = 64  # most replicas of a run: whole vectors on every CPU, and enough for every thread


@dataclass(frozen=True)
class Point:
    """An experiment of a sweep.

    Attributes:
        values: the values by name that differ between points.
        experiment: the experiment.
        key: hash of everything that its numbers depend on.
    """

    values: dict[str, Any]
    experiment: Experiment
    key: str


@dataclass(frozen=True)
class Job:
    """Points that are run together.

    Attributes:
        name: name of the job, a hash of its points.
        points: keys of the points.
        configurations: their experiments in written form.
        batch: number of signals that run together, if there is one point.
        replicas: number of replicas side by side.
        work: number of grain-steps (one grain, one step, one replica).
    """

    name: str
    points: tuple[str, ...]
    configurations: tuple[dict[str, Any], ...]
    batch: int
    replicas: int
    work: float

    def asdict(self) -> dict[str, Any]:
        """The job as a dictionary that JSON can hold."""
        return {"kind": "run", **asdict(self)}


def digest(value: Any) -> str:
    """A hash of a JSON value, in twenty hexadecimal digits."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:20]


def point(values: Mapping[str, Any], experiment: Experiment) -> Point:
    """A point of a sweep, with its key."""
    return Point(dict(values), experiment, digest(key_of_run(experiment)))


def groups(points: Sequence[Point], abreast: int, memory: int) -> Iterator[list[Point]]:
    """Groups of points that may run side by side, with at most `abreast` replicas and half of `memory` bytes each."""
    open_: list[list[Point]] = []
    for one in points:
        for group in open_:
            replicas = sum(other.experiment.replicas for other in (*group, one))
            most = min(abreast, 1 + default_batch(one.experiment, memory))
            if replicas <= most and match(group[0].experiment, one.experiment):
                group.append(one)
                break
        else:
            open_.append([one])
    yield from open_


def job(group: Sequence[Point], memory: int) -> Job:
    """The job of a group of points."""
    keys = tuple(one.key for one in group)
    experiments = [one.experiment for one in group]
    configurations = tuple(_found_anywhere(to_dict(each)) for each in experiments)
    batch = min(default_batch(experiments[0], memory), experiments[0].signals.count)
    work = sum(steps_of_grains(each, batch) for each in experiments)
    replicas = sum(each.replicas for each in experiments) if len(group) > 1 else batch + 1
    return Job(digest(keys), keys, configurations, batch, replicas, float(work))


def _found_anywhere(configuration: dict[str, Any]) -> dict[str, Any]:
    """A written experiment with an absolute path to its pack, so that workers in any folder find it."""
    of_pack = configuration["pack"]
    path = Path(of_pack["source"])
    return {**configuration, "pack": {**of_pack, "source": str(path.absolute())}} if path.is_file() else configuration


def plan(points: Sequence[Point], done: set[str], memory: int, *, workers: int = 1) -> list[Job]:
    """The jobs for the missing points, the longest first. A point that occurs several times is computed once.

    Args:
        points: points of the sweep.
        done: keys of points that need not be computed.
        memory: memory of one worker, in bytes.
        workers: number of workers; runs are kept small enough that each worker gets one.
    """
    missing = list({one.key: one for one in points if one.key not in done}.values())
    replicas = sum(one.experiment.replicas for one in missing)
    abreast = max(1, min(ABREAST, math.ceil(replicas / max(1, workers))))
    return sorted((job(group, memory) for group in groups(missing, abreast, memory)), key=lambda one: -one.work)
