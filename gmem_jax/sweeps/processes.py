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
RUNNER = "runner"  # name of the process that started the workers
SAFE = {"PYTHONSAFEPATH": "1"}
"""Environment of Python processes that another program starts for us; see `python`."""


def python(*more: str) -> list[str]:
    """The command of a Python process of ours; with -P it never imports a file of the working folder as a library."""
    return [sys.executable, "-P", *more]


@contextlib.contextmanager
def safe_path() -> Iterator[None]:
    """Let all Python processes that are started in the block follow the rule of `python`."""
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
    """Let all processes that are started in the block append their stderr to a log."""
    kept = os.dup(2)
    try:
        with log.open("ab") as file:
            os.dup2(file.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def end_with_parent() -> None:
    """End this process as soon as its parent has ended: the pipe to our stdin is then closed, whatever the reason."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)  # what is kept is whole at any moment

    threading.Thread(target=wait, daemon=True).start()


def known_by(number: int) -> dict[str, Any]:
    """The identity of a process: host, number and start, since numbers are used again."""
    return {"host": platform.node(), "pid": number, "born": psutil.Process(number).create_time()}


def _process(who: dict[str, Any], folder: Path) -> psutil.Process | None:
    """The process of a record, if it runs on this machine and has a file of this folder open.

    A folder that was copied, or made by another user, may hold records of processes that work elsewhere.

    Raises:
        psutil.AccessDenied: if it runs, and belongs to another user.
    """
    try:
        found = psutil.Process(int(who["pid"]))
        known = (who["host"], who["born"]) == (platform.node(), found.create_time())
        here = folder.resolve()
        return found if known and any(Path(one.path).is_relative_to(here) for one in found.open_files()) else None
    except psutil.AccessDenied:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, psutil.Error):
        return None


def end(found: psutil.Process) -> None:
    """End a process and its children: by TERM, then by KILL those that still run, such as stopped ones."""
    with contextlib.suppress(psutil.Error):
        family = [found, *found.children(recursive=True)]
        found.terminate()
        for one in psutil.wait_procs(family, EXIT_TIMEOUT)[1]:
            with contextlib.suppress(psutil.Error):
                one.kill()
        psutil.wait_procs(family, EXIT_TIMEOUT)


def stop(store: Store) -> tuple[list[str], list[str]]:
    """End all processes and jobs of a sweep: its `gmem sweep` first, which would start new workers.

    Returns:
        Two lists of lines: what was ended, and what cannot be ended from here.
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
        else:
            try:
                found = _process(who, store.folder)
            except psutil.AccessDenied:
                left.append(f"{worker}, process {who['pid']}: belongs to another user, who can stop it")
                continue
            if found:
                end(found)
                ended.append(f"{worker}, process {found.pid}")
            elif who.get("host", platform.node()) != platform.node():
                left.append(f"{worker}: was started on {who['host']}; stop it there")
                continue
        store.erase(worker)
    return ended, left


def job_name(store: Store, worker: str) -> str:
    """The name of a worker's job in the queue."""
    return f"gmem-{store.folder.absolute().name}-{worker}"


def waiting(store: Store) -> list[str]:
    """A line for each worker that waits in SLURM's queue, with the reason."""
    jobs = {str(who["slurm"]): worker for worker, who in store.records().items() if "slurm" in who}
    queued = (slurm.queue(list(jobs)) if jobs else None) or {}
    return [f"{jobs[number]} waits ({one.reason})" for number, one in queued.items() if one.state == "PENDING"]
