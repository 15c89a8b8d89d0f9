"""The processes of a command: what they import, how they end, what is said when somebody ends them."""

import importlib
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from scenes import TETRA_27, gmem

from gmem_jax.command import recalls
from gmem_jax.files import checkpoints
from gmem_jax.files.checkpoints import Checkpoints, part_with
from gmem_jax.sweeps import executors, processes
from gmem_jax.sweeps.processes import end, job_name, known_by, python, safe_path, stop, waiting
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.work import Requeued

HELPERS = importlib.import_module("submitit.helpers")  # here, since it sets up logging, which closes captured streams
PACK = TETRA_27
ENTRY = "from gmem_jax.command.app import main; main()"
LONG = f"""[experiment]
pack = "{PACK}"
t0 = 180000
[vary]
mu = [0.2, 1.0]
[run]
workers = 2
"""


@pytest.fixture
def sleeper(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process that sleeps, does not listen to TERM, and has the log of a worker open."""
    command, log = ["sh", "-c", "trap '' TERM; echo ready; exec sleep 60"], Store(tmp_path / "mu").log_of("worker-1")
    with log.open("ab") as file, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=file) as process:
        assert process.stdout
        process.stdout.readline()
        yield process
        process.kill()


def test_a_worker_ends_when_its_parent_does() -> None:
    code = "import time; from gmem_jax.sweeps.processes import end_with_parent; end_with_parent(); time.sleep(60)"
    with subprocess.Popen(python("-c", code), stdin=subprocess.PIPE) as worker:
        assert worker.stdin
        worker.stdin.close()  # as the operating system does when the parent is killed
        assert worker.wait(timeout=30) == 1


def test_a_stopped_worker_is_not_waited_for(sleeper: subprocess.Popen[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "EXIT_TIMEOUT", 0.2)
    sleeper.send_signal(signal.SIGSTOP)
    chosen = executors.Processes(1)
    chosen._running["worker-0"] = sleeper
    chosen.stop()
    assert sleeper.returncode == -signal.SIGKILL


def test_stop_ends_what_works_on_a_sweep_and_nobody_else(
    sleeper: subprocess.Popen[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(processes, "EXIT_TIMEOUT", 0.2)
    store, who = Store(tmp_path / "mu"), known_by(sleeper.pid)
    store.record("worker-0", {**who, "born": who["born"] - 1.0})  # its number was given to another since
    store.record("worker-1", {**who, "host": "elsewhere"})
    store.record("worker-2", {"pid": "1", "host": who["host"]})
    ended, left = stop(store)
    assert ended == []
    assert left == ["worker-1: was started on elsewhere; stop it there"]
    assert sleeper.poll() is None
    assert set(store.records()) == {"worker-1"}
    sleeper.send_signal(signal.SIGSTOP)
    store.record("worker-1", who)
    assert stop(store) == ([f"worker-1, process {sleeper.pid}"], [])
    assert not psutil.pid_exists(sleeper.pid)


def test_stop_leaves_the_record_of_a_worker_of_another_user(
    sleeper: subprocess.Popen[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def denied(self: psutil.Process) -> Any:
        raise psutil.AccessDenied(self.pid)

    store = Store(tmp_path / "mu")
    store.record("worker-0", known_by(sleeper.pid))
    monkeypatch.setattr(psutil.Process, "open_files", denied)
    assert gmem(monkeypatch, "sweep", "stop", tmp_path / "mu") == 1
    said = capsys.readouterr()
    assert f"worker-0, process {sleeper.pid}: belongs to another user, who can stop it" in said.err
    assert said.out == ""
    monkeypatch.undo()
    assert stop(store) == ([f"worker-0, process {sleeper.pid}"], [])


def test_stop_in_a_copy_of_a_sweep_ends_nobody_at_the_original(
    sleeper: subprocess.Popen[bytes], tmp_path: Path
) -> None:
    Store(tmp_path / "mu").record("worker-1", known_by(sleeper.pid))
    shutil.copytree(tmp_path / "mu", tmp_path / "copy")
    assert stop(Store(tmp_path / "copy")) == ([], [])
    assert sleeper.poll() is None


def test_children_of_a_worker_end_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "EXIT_TIMEOUT", 0.2)
    code = "import subprocess, time; subprocess.Popen(['sleep', '60']); time.sleep(60)"
    with subprocess.Popen(python("-c", code)) as worker:
        known = psutil.Process(worker.pid)
        deadline = time.monotonic() + 20.0
        while not known.children() and time.monotonic() < deadline:
            time.sleep(0.02)
        (child,) = known.children()
        end(known)
    assert not child.is_running() or child.status() == psutil.STATUS_ZOMBIE


def test_processes_that_others_start_for_us_take_no_module_from_the_working_folder(tmp_path: Path) -> None:
    (tmp_path / "h5py.py").write_text("raise SystemExit('planted')")
    command = [sys.executable, "-c", "import h5py; print(h5py.__version__)"]
    assert "planted" in subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stderr
    with safe_path():
        safe = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert safe.returncode == 0, safe.stderr
    assert "PYTHONSAFEPATH" not in os.environ


# SLURM, by programs of its names.


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a squeue that prints the file `queue`, and a scancel that writes down whom it was told."""
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "squeue").write_text(f"#!/bin/sh\ncat {tmp_path}/queue\n")
    (programs / "scancel").write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/cancelled\n')
    for path in programs.iterdir():
        path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    return tmp_path


def test_a_job_that_waits_says_for_what(
    slurm: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    store = Store(slurm / "mu")
    store.record("worker-0", {"slurm": "7", "name": job_name(store, "worker-0")})
    (slurm / "queue").write_text("7|PENDING|PartitionTimeLimit|gmem-mu-worker-0\n")
    assert waiting(store) == ["worker-0 waits (PartitionTimeLimit)"]
    assert gmem(monkeypatch, "sweep", "status", slurm / "mu") == 0
    assert "worker-0 waits (PartitionTimeLimit)" in capsys.readouterr().out
    chosen = executors.executor("local", 1, {})
    assert isinstance(chosen, executors.Submitted)
    chosen._cluster, chosen._jobs = "slurm", {"worker-0": type("Job", (), {"job_id": "7"})()}
    assert chosen.alive() == {"worker-0"}
    assert chosen.waiting == " (waiting: PartitionTimeLimit)"
    (slurm / "queue").write_text("7|RUNNING|None|gmem-mu-worker-0\n")
    assert chosen.alive() == {"worker-0"}
    assert chosen.waiting == ""
    (slurm / "queue").write_text("")
    assert chosen.alive() == set()


def test_stop_cancels_jobs_of_this_sweep_only(slurm: Path) -> None:
    store = Store(slurm / "mu")
    for worker, number in (("worker-0", "7"), ("worker-1", "8"), ("worker-2", "9; rm -r x")):
        store.record(worker, {"slurm": number, "name": job_name(store, worker)})
    (slurm / "queue").write_text("7|RUNNING|None|gmem-mu-worker-0\n8|RUNNING|None|somebody's\n")
    assert stop(store) == (["worker-0, job 7"], [])
    assert (slurm / "cancelled").read_text() == "7\n"


def test_a_submitted_worker_is_put_into_the_queue_again() -> None:
    """A worker as submitit keeps it, and what it asks for before the time is over."""
    worker = pickle.loads(pickle.dumps(Requeued()))
    again = worker.checkpoint(["folder", "worker-0"])
    assert isinstance(again.function, Requeued)
    assert again.args == (["folder", "worker-0"],)
    assert isinstance(again, HELPERS.DelayedSubmission)


# Checkpoints.


def test_first_checkpoints_come_soon_and_later_ones_seldom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, kept = [0.0], []
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: now[0])

    def run(checkpoint: Any) -> np.ndarray:
        for second in range(1000):
            now[0] = float(second)
            checkpoint.maybe_save(lambda: kept.append(now[0]) or np.zeros(1))
        return np.zeros(1)

    Checkpoints(tmp_path / "parts", {})("one", run)
    assert kept[:6] == [5.0, 15.0, 35.0, 75.0, 155.0, 275.0]
    assert set(np.diff(kept[5:])) == {120.0}


def test_who_must_leave_keeps_a_checkpoint_first(tmp_path: Path) -> None:
    kept = Checkpoints(tmp_path / "parts", {})

    def run(checkpoint: Any) -> None:
        checkpoint.maybe_save(lambda: np.zeros(3))
        assert kept.begun() == 0
        part_with(lambda: sys.exit(7))
        checkpoint.maybe_save(lambda: np.ones(3))

    with pytest.raises(SystemExit, match="7"):
        kept("one", run)
    assert kept.begun() == 1
    went_on = kept("one", lambda checkpoint: checkpoint.restore())
    np.testing.assert_array_equal(went_on, np.ones(3))


# What is said.


@pytest.mark.parametrize("keeps", [True, False])
def test_ctrl_c_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, keeps: bool
) -> None:
    def run(*_: Any, cache: Checkpoints, **__: Any) -> None:
        if keeps:
            cache("batch-0000", lambda _: np.zeros(1))
        raise KeyboardInterrupt

    monkeypatch.setattr(recalls, "run", run)
    target = tmp_path / "o.h5"
    assert gmem(monkeypatch, "recall", PACK, "-o", target, "--t0", "60", "--no-picture") == 130
    said = capsys.readouterr().err
    words = f"goes on from {target}.parts" if keeps else "nothing was kept yet; the same command begins anew"
    assert f"gmem: interrupted; {'the same command ' * keeps}{words}" in said
    assert Path(f"{target}.parts").exists() == keeps


def test_ctrl_c_before_a_run_says_that_nothing_was_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(recalls, "batch_for", interrupt)
    assert gmem(monkeypatch, "recall", PACK, "-o", tmp_path / "o.h5") == 130
    assert "interrupted; nothing was written" in capsys.readouterr().err


def test_ctrl_c_while_a_picture_is_drawn_says_that_the_result_is_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gmem_jax.show.render_matplotlib.to_matplotlib", interrupt)
    target = tmp_path / "o.h5"
    assert gmem(monkeypatch, "recall", PACK, "-o", target, "--t0", "20", "--force") == 130
    assert f"interrupted; the result is written, its picture {target.with_suffix('.png')} is not" in " ".join(
        capsys.readouterr().err.split()
    )
    assert target.is_file()


@pytest.mark.parametrize(("where", "code", "words"), [(">&-", 0, ""), ("> /dev/full", 2, "stdout takes no result (No")])
def test_a_result_that_stdout_does_not_take(tmp_path: Path, where: str, code: int, words: str) -> None:
    for options in ("", "--json"):
        command = f'"$0" -c "$1" info {options} {where}'
        done = subprocess.run(["sh", "-c", command, sys.executable, ENTRY], capture_output=True, text=True)
        assert done.returncode == code, done.stderr
        assert words in done.stderr
        assert done.stderr.count("\n") == bool(words)
        assert not words or "files that were to be written are complete" in done.stderr


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_a_reader_that_has_left_is_no_error(options: list[str]) -> None:
    read, write = os.pipe()
    os.close(read)
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-c", ENTRY, "info", *options]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, env=buffered, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("why", ["the disk is full", "its reader is gone"])
def test_no_command_ends_because_its_log_is_not_taken(why: str) -> None:
    read, write = os.pipe()
    os.close(read)
    log = os.open("/dev/full", os.O_WRONLY) if "full" in why else write
    code = "from gmem_jax.command.console import log; log('10 %'); log('20 %'); print('done')"
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(python("-c", code), stdout=subprocess.PIPE, stderr=log, env=buffered, check=False)
    assert (done.returncode, done.stdout) == (0, b"done\n")


def _sweep(folder: Path) -> subprocess.Popen[str]:
    (folder / "mu.toml").write_text(LONG)
    command = [sys.executable, "-P", "-c", ENTRY, "sweep", "mu.toml"]
    return subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True)


def _workers(folder: Path, sweep: subprocess.Popen[str]) -> list[psutil.Process]:
    """The workers, once both have begun a run."""
    deadline = time.monotonic() + 240.0
    while len(list((folder / "mu" / "parts").glob("*/run.json"))) < 2:
        assert sweep.poll() is None, sweep.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.1)
    found = Store(folder / "mu", make=False).records()
    return [psutil.Process(who["pid"]) for worker, who in found.items() if worker != processes.RUNNER]


@pytest.mark.slow
@pytest.mark.parametrize("how", ["killed", "hung up", "interrupted", "stop"])
def test_no_worker_outlives_its_sweep(tmp_path: Path, how: str) -> None:
    """Nor does one import what lies in the working folder."""
    for name in ("h5py", "signal", "psutil"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('planted')")
    sweep = _sweep(tmp_path)
    workers = _workers(tmp_path, sweep)
    assert len(workers) == 2
    if how == "stop":
        command = [sys.executable, "-P", "-c", ENTRY, "sweep", "stop", "mu"]
        told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stdout
        assert "ended runner, process" in told
    elif how == "interrupted":
        workers[0].suspend()  # which would be waited for without end
        sweep.send_signal(signal.SIGINT)
    else:
        sweep.send_signal(signal.SIGKILL if how == "killed" else signal.SIGHUP)
    _, said = sweep.communicate(timeout=60)
    assert psutil.wait_procs(workers, 20)[1] == []
    if how == "interrupted":
        assert sweep.returncode == 130
        assert "interrupted; the same command goes on" in said
