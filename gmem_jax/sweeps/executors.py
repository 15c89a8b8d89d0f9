"""Executors of the jobs of a sweep: processes on this machine, or SLURM.

An executor keeps workers alive as long as there are unfinished jobs; the workers find their jobs in the store.
"""

import itertools
import os
import shlex
import subprocess
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gmem_jax.errors import RunFailedError
from gmem_jax.files.validation import optional
from gmem_jax.native.library import cpus, require_threads
from gmem_jax.sweeps import slurm, work
from gmem_jax.sweeps.processes import EXIT_TIMEOUT, RUNNER, job_name, known_by, python, safe_path, stderr_into
from gmem_jax.sweeps.store import Store

POLL = 0.5  # s
DEATHS = 3  # a sweep ends when all workers have died so often without any progress in between
CORES = 8  # CPUs of a worker: more gain little at N = 325
THREADS = "GMEM_THREADS"  # environment variable: threads of a process
TIMEOUTS = 1000  # times that a job may run out of its time and be queued again


class Executor(ABC):
    """Workers on a store."""

    workers: int
    waiting: str = ""
    """The reason why workers have not begun, in brackets."""

    @abstractmethod
    def start(self, store: Store, name: str) -> None:
        """Start a worker.

        Raises:
            OSError: if it cannot be started.
        """

    @abstractmethod
    def alive(self) -> set[str]:
        """The names of the workers that run or are queued."""

    @abstractmethod
    def stop(self) -> None:
        """Stop all workers."""

    def finish(self, store: Store, jobs: list[dict[str, Any]], told: Callable[[float], None]) -> None:
        """Keep workers running until the jobs are done; `told` is called with the fraction of their work that is done.

        Raises:
            RunFailedError: if workers die again and again.
            OSError: if a worker cannot be started.
        """
        names = [f"worker-{number}" for number in range(min(self.workers, max(1, len(jobs))))]
        total = sum(job["work"] for job in jobs) or 1.0
        deaths, furthest, open_ = 0, -1.0, jobs
        store.record(RUNNER, known_by(os.getpid()))
        own = store.held(RUNNER)
        try:
            while True:
                open_ = [job for job in open_ if not store.finished(job)]
                now = total - sum(job["work"] for job in open_)
                fractions = {one["job"]: float(one["fraction"]) for one in store.progress()}
                now += sum(min(1.0, fractions.get(job["name"], 0.0)) * job["work"] for job in open_)
                told(now / total)
                if not open_:
                    return
                if now > furthest:  # there was progress before a worker ended, as at the end of its time
                    deaths, furthest = 0, now
                alive = self.alive()
                if not alive and not any(store.taken(job) for job in open_):
                    if deaths == DEATHS:
                        store.require_room()
                        raise RunFailedError(f"workers end without doing their jobs: {self._last_words(store)}")
                    deaths += 1
                for name in names[: len(open_)]:
                    if name not in alive:
                        self.start(store, name)
                time.sleep(POLL)
        finally:
            self.stop()
            own.close()
            for name in (RUNNER, *names):
                store.erase(name)

    def said(self, store: Store) -> str:
        """The output of the workers."""
        return store.logs()

    def _last_words(self, store: Store) -> str:
        lines = [line.strip() for line in self.said(store).splitlines() if line.strip()]
        return lines[-1] if lines else "they said nothing"


def cores() -> list[int]:
    """The CPUs that this process may use; not more of them than the quota of its container allows."""
    own = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    return sorted(own)[: cpus()]


def threads(cpus: int) -> str:
    """Number of threads of a worker with `cpus` CPUs, as a text: one on each, or fewer if GMEM_THREADS says so."""
    told = os.environ.get(THREADS, "")
    more = told.isdecimal() and int(told) > cpus
    return told if told and not more else str(cpus)  # if it is not a number, the worker refuses it


class Processes(Executor):
    """Worker processes on this machine, each on CPUs of its own.

    Args:
        workers: number of workers; default one for every eight CPUs.

    Raises:
        ValueError: if there are fewer CPUs than workers.
    """

    def __init__(self, workers: int | None = None) -> None:
        own = cores()
        self.workers = workers or max(1, len(own) // CORES)
        if self.workers > len(own):
            raise ValueError(f"{self.workers} workers need {self.workers} CPUs, but this process may use {len(own)}")
        ends = [len(own) * number // self.workers for number in range(self.workers + 1)]
        self._cores = [own[first:last] for first, last in itertools.pairwise(ends)]
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, store: Store, name: str) -> None:
        """Start a process whose log is in the store."""
        number = int(name.rpartition("-")[2])
        mine = self._cores[number]
        environment = {**os.environ, THREADS: threads(len(mine))}
        cpus = ",".join(map(str, mine))
        command = python("-m", work.__name__, str(store.folder), name, cpus, work.ATTACHED)
        streams: Any = {"stdin": subprocess.PIPE, "stderr": subprocess.STDOUT}
        with store.log_of(name).open("ab") as log:
            started = subprocess.Popen(command, stdout=log, env=environment, start_new_session=True, **streams)
        self._running[name] = started
        store.record(name, known_by(started.pid))

    def alive(self) -> set[str]:
        """The names of the workers that have not ended."""
        return {name for name, process in self._running.items() if process.poll() is None}

    def stop(self) -> None:
        """End all workers, also those that ignore a signal; their checkpoints stay."""
        for process in self._running.values():
            if process.poll() is None:
                process.terminate()
        last = time.monotonic() + EXIT_TIMEOUT
        for process in self._running.values():
            try:
                process.wait(max(0.0, last - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin:
                process.stdin.close()


class Submitted(Executor):
    """Workers as jobs of a cluster, by submitit.

    Args:
        cluster: "slurm", or "local" for submitit's own processes.
        workers: number of workers; default 1.
        options: options of submitit's executor, like slurm_partition, timeout_min (60), cpus_per_task (1), mem_gb.

    Raises:
        ValueError: if submitit is not installed, the scheduler cannot be reached, or submitit has no such option.
    """

    def __init__(self, cluster: str, workers: int | None = None, options: dict[str, Any] | None = None) -> None:
        self._submitit = optional("submitit", "slurm")
        self.workers, self._cluster = workers or 1, cluster
        given = {"timeout_min": 60, "cpus_per_task": 1, **(options or {})}
        self._options = {"slurm_signal_delay_s": _warning(given), **given}
        if cluster == "slurm":
            self._options["slurm_srun_args"] = _srun(self._options)
        self._jobs: dict[str, Any] = {}
        self._executor: Any = None
        if cluster == "slurm":
            slurm.require_slurm()
        try:
            self._submitting(Path())
        except (NameError, AssertionError) as error:
            raise ValueError(f"options of submitit: {str(error).splitlines()[0]}") from None

    def _submitting(self, logs: Path) -> Any:
        """Submitit's executor; it raises NameError or AssertionError for an unknown option or an impossible value."""
        safe = {"slurm_python": " ".join(map(shlex.quote, python())), "slurm_max_num_timeout": TIMEOUTS}
        made = self._submitit.AutoExecutor(logs, cluster=self._cluster, local_max_num_timeout=TIMEOUTS, **safe)
        made.update_parameters(**self._options)
        return made

    def start(self, store: Store, name: str) -> None:
        """Submit a job."""
        try:
            if self._executor is None:
                self._executor = self._submitting(store.folder / "workers" / "submitit")
            if "name" not in self._options:
                self._executor.update_parameters(name=job_name(store, name))
            with safe_path(), stderr_into(store.log_of(name)):  # a controller prints a traceback at its end
                job = self._executor.submit(work.Requeued(), [str(store.folder.absolute()), name])
        except (self._submitit.core.utils.FailedJobError, subprocess.SubprocessError, FileNotFoundError) as error:
            raise OSError(f"the scheduler takes no job: {' '.join(str(error).split())[-300:]}") from error
        self._jobs[name] = job
        here = self._cluster != "slurm"
        store.record(name, known_by(int(job.job_id)) if here else {"slurm": job.job_id, "name": job_name(store, name)})

    def said(self, store: Store) -> str:
        """The output of the workers, as far as submitit finds it."""
        return "\n".join(text for job in self._jobs.values() for text in (job.stdout(), job.stderr()) if text)

    def alive(self) -> set[str]:
        """The names of the workers that have not ended."""
        if self._cluster != "slurm" or not self._jobs:
            return {name for name, job in self._jobs.items() if not job.done(force_check=True)}
        queued = slurm.queue([str(job.job_id) for job in self._jobs.values()])
        if queued is None:
            return set(self._jobs)
        reasons = {one.reason for one in queued.values() if one.state == "PENDING"}
        self.waiting = f" (waiting: {', '.join(sorted(reasons))})" if reasons else ""
        return {name for name, job in self._jobs.items() if str(job.job_id) in queued}

    def stop(self) -> None:
        """End all workers; their checkpoints stay."""
        alive = self.alive()
        for name, job in self._jobs.items():
            if name in alive:
                job.cancel(check=False)


def _srun(options: dict[str, Any]) -> list[str]:
    """Arguments of srun, with the CPUs of a task: since SLURM 22.05 srun does not take them from its job."""
    told = options.get("slurm_srun_args", [])
    told = shlex.split(told) if isinstance(told, str) else list(told)
    known = any(one.startswith(("--cpus-per-task", "-c")) for one in told)
    cpus = options.get("slurm_cpus_per_task", options["cpus_per_task"])
    return told if known else [*told, f"--cpus-per-task={cpus}"]


def _warning(options: dict[str, Any]) -> int:
    """Seconds before the end of a job's time at which it is told to write a checkpoint; SLURM may be a minute early."""
    try:
        return int(max(5.0, min(90.0, 60.0 * float(options.get("slurm_time", options["timeout_min"])) / 4.0)))
    except (TypeError, ValueError):
        return 90


KINDS = ("processes", "slurm", "local")


def require_options(kind: str, options: dict[str, Any]) -> None:
    """Refuse an unknown executor, and options for one without any; submitit's own are checked when it is made.

    Raises:
        ValueError: naming the executor or the option.
    """
    if kind not in KINDS:
        raise ValueError(f"executor must be {', '.join(KINDS[:-1])} or {KINDS[-1]}, got {kind!r}")
    if kind == "processes" and options:
        raise ValueError(f"processes have no option {min(options)!r}; the executors slurm and local take submitit's")


def executor(kind: str, workers: int | None, options: dict[str, Any]) -> Executor:
    """An executor by name.

    Raises:
        ValueError: if there is no such executor, it cannot run here, or GMEM_THREADS is not a number of threads.
    """
    require_threads()
    require_options(kind, options)
    if kind == "processes":
        return Processes(workers)
    return Submitted(kind, workers, options)
