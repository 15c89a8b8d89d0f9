"""Starting, identifying and ending the processes of a sweep."""

import contextlib
import os
import platform
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from gmem_jax.sweeps import slurm
from gmem_jax.sweeps.store import Store

EXIT_TIMEOUT = 10.0  # s for a process to end by itself, before it is killed
RUNNER = "runner"  # whose workers they are
SAFE = {"PYTHONSAFEPATH": "1"}
"""Environment of Python processes that somebody else starts for us; see `python`."""


def python(*more: str) -> list[str]:
    """The command of a Python process of ours: a file in the working folder is never taken for a library (-P)."""
    return [sys.executable, "-P", *more]


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """Have the processes that are started in the block, by whomever, follow the rule of `python`."""
    before = {name: os.environ.get(name) for name in SAFE}
    os.environ.update(SAFE)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def stderr_into(log: Path) -> Iterator[None]:
    """Have the processes that are started in the block, by whomever, write to the end of a log what goes to stderr."""
    kept = os.dup(2)
    try:
        with log.open("ab") as file:
            os.dup2(file.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def end_with_parent() -> None:
    """End this process as soon as its parent is no more: however that ended, the pipe to our stdin is closed then."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)  # what is kept is whole at any moment

    threading.Thread(target=wait, daemon=True).start()


def known_by(number: int) -> dict[str, Any]:
    """What tells a process apart from all others, whenever they ran."""
    return {"host": platform.node(), "pid": number, "born": psutil.Process(number).create_time()}


def _process(who: dict[str, Any], folder: Path) -> psutil.Process | None:
    """The process of a record, if it runs on this machine and has a file of that very folder open.

    A folder that was copied, or made by somebody else, may hold records of processes that work elsewhere.
    """
    try:
        found = psutil.Process(int(who["pid"]))
        known = (who["host"], who["born"]) == (platform.node(), found.create_time())
        here = folder.resolve()
        return found if known and any(Path(one.path).is_relative_to(here) for one in found.open_files()) else None
    except (KeyError, TypeError, ValueError, OverflowError, psutil.Error):
        return None


def end(found: psutil.Process) -> None:
    """End a process and its children: by TERM, by KILL what does not listen, as one that was stopped."""
    with contextlib.suppress(psutil.Error):
        family = [found, *found.children(recursive=True)]
        found.terminate()
        for one in psutil.wait_procs(family, EXIT_TIMEOUT)[1]:
            with contextlib.suppress(psutil.Error):
                one.kill()
        psutil.wait_procs(family, EXIT_TIMEOUT)


def stop(store: Store) -> tuple[list[str], list[str]]:
    """End whoever works on a sweep: its `gmem sweep` first, which would start others.

    Returns:
        What was ended, and what cannot be from here.
    """
    ended, left = [], []
    records = store.records()
    for worker in sorted(records, key=lambda name: (name != RUNNER, name)):
        who = records[worker]
        if "slurm" in who:
            number = str(who["slurm"])
            queued = slurm.queue([number]) if number.isdecimal() else {}
            if queued is None:
                left.append(f"{worker}: SLURM's controller cannot be asked for job {number}")
                continue
            if number in queued and queued[number].name == who.get("name") == job_name(store, worker):
                slurm.cancel(number)
                ended.append(f"{worker}, job {number}")
        elif found := _process(who, store.folder):
            end(found)
            ended.append(f"{worker}, process {found.pid}")
        elif who.get("host", platform.node()) != platform.node():
            left.append(f"{worker}: was started on {who['host']}; stop it there")
            continue
        store.erase(worker)
    return ended, left


def job_name(store: Store, worker: str) -> str:
    """What a worker is called in a queue."""
    return f"gmem-{store.folder.absolute().name}-{worker}"


def waiting(store: Store) -> list[str]:
    """The workers that wait in SLURM's queue, and for what."""
    jobs = {str(who["slurm"]): worker for worker, who in store.records().items() if "slurm" in who}
    queued = (slurm.queue(list(jobs)) if jobs else None) or {}
    return [f"{jobs[number]} waits ({one.reason})" for number, one in queued.items() if one.state == "PENDING"]
