"""A worker: takes jobs that no other worker has, until none is left.

    python -P -m gmem_jax.sweeps.work FOLDER NAME [CPUS [attached]]

An attached worker ends as soon as its stdin is closed.

Any number of workers, on any machines that see the folder, share a sweep. A worker that is killed loses its work since
the last checkpoint.
"""

import contextlib
import functools
import importlib
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from gmem_jax.errors import FileFormatError, RunFailedError
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.pack_warnings import OtherCompressionWarning, OtherGravityWarning, other_weight
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.run import run
from gmem_jax.experiment.several import run_several
from gmem_jax.files.checkpoints import Checkpoints, part_with
from gmem_jax.files.compilation_cache import keep_programs
from gmem_jax.files.configuration import from_dict
from gmem_jax.files.packs import load_pack, save_pack
from gmem_jax.physics.material import Material
from gmem_jax.preparation.preparation import prepare
from gmem_jax.preparation.recipe import Recipe
from gmem_jax.simulation.checkpoints import no_cache
from gmem_jax.simulation.progress import Progress, silent
from gmem_jax.simulation.sample import Sample
from gmem_jax.sweeps.making import clump_of
from gmem_jax.sweeps.processes import end_with_parent
from gmem_jax.sweeps.store import Store

ATTACHED = "attached"
REPORT_INTERVAL = 1.0  # s between two reports of progress
WARNED = "warnings"  # in the configuration of a point: warnings of its run that the status does not include


def run_group(
    keys: Sequence[str],
    experiments: Sequence[Experiment],
    *,
    store: Store | None = None,
    batch: int | None = None,
    cache: Checkpoints | None = None,
    progress: Progress = silent,
) -> dict[str, Recall]:
    """Run points that match each other, and write their recalls into a store, if any; gives the recalls by key.

    Raises:
        RunFailedError: if the simulation broke down.
    """
    heard: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as heard:
            if len(experiments) == 1:
                recalls = [run(experiments[0], batch=batch, cache=cache or no_cache, progress=progress)]
            else:
                recalls = run_several(experiments, cache=cache or no_cache, progress=progress)
    finally:
        for one in heard:  # pass them on to the log or the caller
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    if store:
        for key, experiment, recall in zip(keys, experiments, recalls, strict=True):
            words = [*warned(heard), *filter(None, [other_weight(experiment)])]
            store.save(key, recall.described({**recall.configuration, **({WARNED: words} if words else {})}))
    if cache:
        cache.discard()
    return dict(zip(keys, recalls, strict=True))


def parts_of_job(store: Store, job: dict[str, Any]) -> Checkpoints:
    """The parts of an unfinished job; parts with another batch are discarded."""
    key, advice = {"job": job["name"], "batch": job.get("batch")}, "remove it, and do the sweep with --retry"
    folder = store.parts(job)
    return Checkpoints(folder, key, restart=bool(Checkpoints.other_run(folder, key)), advice=advice)


def warned(heard: Sequence[warnings.WarningMessage]) -> list[str]:
    """The texts of warnings, each once, without those of delta0 and gravity, which each point gets by itself."""
    own = (OtherCompressionWarning, OtherGravityWarning)
    texts = [" ".join(str(one.message).split()) for one in heard if one.category not in own]
    return list(dict.fromkeys(texts))


class _Worker:
    def __init__(self, store: Store, name: str) -> None:
        self.store, self.name, self.packs = store, name, functools.cache(load_pack)
        self._told = 0.0

    def progress(self, job: str) -> Callable[[str, float, float], None]:
        def tell(stage: str, _: float, fraction: float) -> None:
            if time.monotonic() - self._told > REPORT_INTERVAL or fraction >= 1.0:
                self._told = time.monotonic()
                self.store.tell(self.name, job, fraction, stage)

        return tell

    def do(self, job: dict[str, Any]) -> None:
        """Do a job; if its run fails, write the reason down."""
        keys = [job["name"]] if job["kind"] == "pack" else job["points"]
        try:
            (self._prepare if job["kind"] == "pack" else self._run)(job)
        except (RunFailedError, ValueError, FileNotFoundError) as error:
            reason = " ".join(str(error).split())
            if len(keys) > 1:  # one of the points failed; the others may be sound
                self._one_by_one(job)
            else:
                self.store.fail(keys[0], reason)
                print(f"{keys[0]}: {reason}", file=sys.stderr, flush=True)

    def _prepare(self, job: dict[str, Any]) -> None:
        parts = parts_of_job(self.store, job)
        stages: dict[str, Sample] = {}
        say = self.progress(job["name"])
        made_of: Any = {"grain": clump_of(job["grain"]), "material": Material(**job["material"]), "name": job["name"]}
        pack = prepare(Recipe(**job["recipe"]), **made_of, cache=parts, progress=say, log=stages)
        save_pack(self.store.pack_at(job["name"]), pack, stages)
        parts.discard()

    def _experiments(self, job: dict[str, Any]) -> list[Experiment]:
        try:
            return [from_dict(one, self.packs(one["pack"]["source"])) for one in job["configurations"]]
        except (KeyError, TypeError, AttributeError) as error:
            raise FileFormatError(f"a job whose experiments are none: {error}") from error

    def _run(self, job: dict[str, Any]) -> None:
        say, cache = self.progress(job["name"]), parts_of_job(self.store, job)
        run_group(
            job["points"], self._experiments(job), store=self.store, batch=job["batch"], cache=cache, progress=say
        )

    def _one_by_one(self, job: dict[str, Any]) -> None:
        for number, key in enumerate(job["points"]):
            if not self.store.at(key).is_file():
                alone = {"points": [key], "configurations": [job["configurations"][number]]}
                self.do({**job, **alone, "name": f"{job['name']}-{number}"})


def work(folder: Path, name: str) -> int:
    """Take jobs until none is left that no other worker has; gives the number of jobs done.

    Raises:
        FileFormatError: if the folder holds no sweep.
        OSError: if it cannot be written.
    """
    worker, done = _Worker(Store(folder), name), 0
    for job in worker.store.jobs():
        with contextlib.ExitStack() as mine:
            try:
                mine.enter_context(worker.store.lock(job))
            except FileFormatError:  # another worker has it
                continue
            if not worker.store.finished(job):
                worker.do(job)
                done += 1
    return done


class Requeued:
    """A worker as a job of submitit: before its time is over it writes a checkpoint and is queued again."""

    def __call__(self, arguments: list[str]) -> int:
        """Work."""
        if hasattr(signal, "SIGUSR2") and callable(leave := signal.getsignal(signal.SIGUSR2)):
            signal.signal(signal.SIGUSR2, lambda *which: part_with(lambda: leave(*which)))
        return run_worker(arguments)

    def checkpoint(self, arguments: list[str]) -> Any:
        """The same job again, for submitit to queue."""
        return importlib.import_module("submitit.helpers").DelayedSubmission(self, arguments)


def run_worker(arguments: list[str]) -> int:
    """Entry point of a worker's process; gives its exit code, 0 if all jobs were tried."""
    if ATTACHED in arguments[3:]:
        end_with_parent()
    jax.config.update("jax_enable_x64", True)
    keep_programs()
    if len(arguments) > 2 and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, [int(number) for number in arguments[2].split(",")])  # before XLA makes its threads
    try:
        work(Path(arguments[0]), arguments[1])
    except OSError as error:
        print(f"{arguments[0]}: {error}", file=sys.stderr, flush=True)
        return 2
    except Exception:
        traceback.print_exc()
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(run_worker(sys.argv[1:]))
