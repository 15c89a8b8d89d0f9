"""A sweep on SLURM, one worker of which is cancelled on the way and one told that its time is over: it is requeued.

The same points, bit for bit, as without SLURM; a sweep whose jobs may run for a minute, less than it goes between
checkpoints, gets on by those that it leaves when SLURM warns it; a sweep that cannot begin says why, and is stopped:
`make cluster`, or `make cluster CASES=minute` for one of disturbed, minute and waits.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import gmem_jax as gm

PACK = Path(__file__).parents[1] / "data" / "tetra-27.h5"
ENTRY = "from gmem_jax.command.app import main; main()"
SWEEP = f"""[experiment]
pack = "{PACK}"
t0 = 36000
[vary]
mu = [0.2, 0.5, 1.0]
friction = ["H", "M1"]
[run]
executor = "{{executor}}"
workers = {{workers}}
{{more}}
"""


# What every Python in a folder begins with: no checkpoint comes by itself.
SELDOM = "import gmem_jax.files.checkpoints as kept\nkept.FIRST = kept.CHECKPOINT_INTERVAL = kept.AT_MILESTONES = 1e6\n"


def gmem(*arguments: object, **environment: str) -> subprocess.Popen[str]:
    """Start a command."""
    command = [sys.executable, "-c", ENTRY, *map(str, arguments)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **environment})


def told(*command: str) -> list[str]:
    """What one of SLURM's commands says, in words."""
    return subprocess.run(command, capture_output=True, text=True).stdout.split()


def running() -> list[str]:
    """Numbers of the jobs that run now."""
    return told("squeue", "--noheader", "--states=RUNNING", "--format=%A")


def disturbed(sweep: subprocess.Popen[str], store: Path) -> int:
    """Cancel a worker that has left a checkpoint, then send one the signal that its time is over; how often."""
    done = 0
    while sweep.poll() is None:
        time.sleep(0.5)
        begun = [path for path in store.glob("parts/*/*") if path.suffix in (".now", ".npz")]
        if done < 2 and len(begun) > done and (jobs := running()):
            subprocess.run(["scancel", *(["--signal=USR2"] if done else []), jobs[0]], check=False)
            done += 1
            print(("cancelled", "signalled")[done - 1], jobs[0], flush=True)
        begin_now()
    return done


def begin_now() -> None:
    """Let requeued jobs begin at once, and not two minutes later, as SLURM would."""
    for job in told("squeue", "--noheader", "--states=PENDING", "--format=%A"):
        subprocess.run(["scontrol", "update", f"JobId={job}", "StartTime=now"], check=False)


def gets_on_by_the_minute(folder: Path) -> None:
    """Jobs of a minute do a run of several, which leaves a checkpoint only when SLURM warns of the end of one."""
    (folder / "sitecustomize.py").write_text(SELDOM)
    paths = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
    text = (
        SWEEP.replace("t0 = 36000", "t0 = 144000").replace("[0.2, 0.5, 1.0]", "[0.5]").replace('["H", "M1"]', '["H"]')
    )
    for name, executor, more in (("minute", "slurm", "timeout_min = 1"), ("whole", "processes", "")):
        (folder / f"{name}.toml").write_text(text.format(executor=executor, workers=1, more=more))
    sweep = gmem("sweep", folder / "minute.toml", PYTHONPATH=paths)
    kept = 0.0
    while sweep.poll() is None:
        time.sleep(0.5)
        kept = max([kept, *(path.stat().st_mtime for path in (folder / "minute").glob("parts/*/*.now"))])
        begin_now()
    assert sweep.returncode == 0, sweep.communicate()[1]
    logs = "".join(path.read_text() for path in (folder / "minute" / "workers" / "submitit").glob("*_log.*"))
    times = logs.count("Requeued job")
    assert times >= 1, logs
    assert kept > 0.0, "no checkpoint was left"
    assert gmem("sweep", folder / "whole.toml").wait() == 0
    (point,) = (folder / "whole" / "points").glob("*.h5")
    one, two = (gm.load_recall(folder / store / "points" / point.name) for store in ("minute", "whole"))
    np.testing.assert_array_equal(one.p_sig, two.p_sig)
    print(f"a run in jobs of a minute, {times} times requeued, the same bits", flush=True)


def waits_and_stops(folder: Path) -> None:
    """A job that may begin in an hour waits, says for what, and is ended by `gmem sweep stop`."""
    more = "slurm_additional_parameters = {begin = 'now+1hour'}"
    (folder / "waits.toml").write_text(SWEEP.format(executor="slurm", workers=1, more=more))
    sweep = gmem("sweep", folder / "waits.toml")
    while not (jobs := told("squeue", "--noheader", "--format=%j|%r")):
        assert sweep.poll() is None, sweep.communicate()[1]
        time.sleep(0.5)
    assert jobs[0].startswith("gmem-waits-worker-0|"), jobs
    sweep.kill()  # what it began outlives it
    command = [sys.executable, "-c", ENTRY, "sweep"]
    said = subprocess.run([*command, "status", str(folder / "waits")], capture_output=True, text=True).stdout
    assert "worker-0 waits (" in said, said
    said = subprocess.run([*command, "stop", str(folder / "waits")], capture_output=True, text=True).stdout
    assert "ended worker-0, job" in said, said
    time.sleep(2.0)
    assert not told("squeue", "--noheader", "--format=%A")
    print("a job that waited said why, and was stopped", flush=True)


def goes_on_disturbed(folder: Path) -> None:
    """A sweep on SLURM with two disturbances, and without SLURM: the same bits."""
    settings = {"slurm": ("slurm", 2, "timeout_min = 10\nmem_gb = 2"), "here": ("processes", 1, "")}
    for file, (executor, workers, more) in settings.items():
        text = SWEEP.format(executor=executor, workers=workers, more=more)
        (folder / f"{file}.toml").write_text(text)
    sweep = gmem("sweep", folder / "slurm.toml")
    done = disturbed(sweep, folder / "slurm")
    assert sweep.returncode == 0, sweep.communicate()[1]
    assert done == 2, "the sweep was done before its workers could be disturbed"
    logs = "".join(path.read_text() for path in (folder / "slurm" / "workers" / "submitit").glob("*_log.*"))
    assert logs.count("Requeued job") == 1, logs
    other = gmem("sweep", folder / "here.toml")
    assert other.wait() == 0
    points = sorted(path.name for path in (folder / "here" / "points").glob("*.h5"))
    assert len(points) == 6
    for point in points:
        one, two = (gm.load_recall(folder / store / "points" / point) for store in ("slurm", "here"))
        np.testing.assert_array_equal(one.p_sig, two.p_sig)
    print("six points, the same bits", flush=True)


CASES = {"disturbed": goes_on_disturbed, "minute": gets_on_by_the_minute, "waits": waits_and_stops}


def main() -> None:
    """Run the cases that are named, or all."""
    for case in sys.argv[1:] or CASES:
        with tempfile.TemporaryDirectory() as name:
            CASES[case](Path(name))


if __name__ == "__main__":
    main()
