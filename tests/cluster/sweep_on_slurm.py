"""Sweeps on SLURM that are disturbed: the same points, bit for bit, as without it.

Two workers, one of which is cancelled on the way, and one told that its time is over, so that it is requeued; a node
that goes down and a controller that is away; jobs that may run for a minute, less than they go between checkpoints,
and get on by those that they leave when SLURM warns them; a job that cannot begin says why, and is stopped:
`make cluster`, or `make cluster CASES=minute` for one of disturbed, down, minute and waits.
"""

import argparse
import json
import os
import signal
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
t0 = 18000
[vary]
mu = [0.2, 0.5, 1.0]
friction = ["H", "M1"]
[run]
executor = "{{executor}}"
workers = {{workers}}
{{more}}
"""


# What every Python in a folder begins with: no checkpoint comes by itself, and whether one is due is asked so slowly
# that a run takes more than a minute on any machine, and little of its CPU.
SELDOM = """import time
import gmem_jax.files.checkpoints as kept
kept.FIRST = kept.CHECKPOINT_INTERVAL = kept.AT_MILESTONES = 1e6
asked = kept._StoredCheckpoint.maybe_save
kept._StoredCheckpoint.maybe_save = lambda *which, **more: (time.sleep(1.5), asked(*which, **more))[1]
"""


started: list[subprocess.Popen[str]] = []


def gmem(*arguments: object, **environment: str) -> subprocess.Popen[str]:
    """Start a command."""
    command = [sys.executable, "-c", ENTRY, *map(str, arguments)]
    started.append(subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **environment}))
    return started[-1]


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


def gets_on_by_the_minute(folder: Path) -> dict[str, int]:
    """Jobs of a minute do a run of several, which leaves a checkpoint only when SLURM warns of the end of one."""
    (folder / "sitecustomize.py").write_text(SELDOM)
    paths = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))
    text = SWEEP.replace("t0 = 18000", "t0 = 9000").replace("[0.2, 0.5, 1.0]", "[0.5]").replace('["H", "M1"]', '["H"]')
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
    return {"requeued at the end of their minute": times, "points": same_bits(folder, "minute", "whole")}


def waits_and_stops(folder: Path) -> dict[str, int]:
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
    return {"jobs that waited, said for what, and were stopped": 1}


def same_bits(folder: Path, store: str, other: str) -> int:
    """The number of points of two sweeps, which must be equal."""
    points = sorted(path.name for path in (folder / other / "points").glob("*.h5"))
    assert points
    for point in points:
        one, two = (gm.load_recall(folder / name / "points" / point) for name in (store, other))
        np.testing.assert_array_equal(one.p_sig, two.p_sig)
    return len(points)


def written(folder: Path) -> None:
    """Two files of the same sweep, slurm.toml with two workers and here.toml, which is done."""
    settings = {"slurm": ("slurm", 2, "timeout_min = 10\nmem_gb = 2"), "here": ("processes", 1, "")}
    for file, (executor, workers, more) in settings.items():
        (folder / f"{file}.toml").write_text(SWEEP.format(executor=executor, workers=workers, more=more))
    assert gmem("sweep", folder / "here.toml").wait() == 0


def goes_on_disturbed(folder: Path) -> dict[str, int]:
    """A sweep on SLURM with two disturbances."""
    written(folder)
    sweep = gmem("sweep", folder / "slurm.toml")
    done = disturbed(sweep, folder / "slurm")
    assert sweep.returncode == 0, sweep.communicate()[1]
    assert done == 2, "the sweep was done before its workers could be disturbed"
    logs = "".join(path.read_text() for path in (folder / "slurm" / "workers" / "submitit").glob("*_log.*"))
    assert logs.count("Requeued job") == 1, logs
    return {"workers": 2, "cancelled": 1, "requeued": 1, "points": same_bits(folder, "slurm", "here")}


def goes_on_after_outages(folder: Path) -> dict[str, int]:
    """A sweep whose node goes down, and later the controller, for 20 and 10 seconds; the node may be back by itself."""
    written(folder)
    (node,) = told("sinfo", "--noheader", "--format=%n")
    controller = Path(os.environ["SLURM_CONF"]).with_name("slurmctld.pid")
    sweep, store = gmem("sweep", folder / "slurm.toml"), folder / "slurm"

    def until(points: int) -> None:
        while len(list(store.glob("points/*.h5"))) < points or not running():
            assert sweep.poll() is None, f"the sweep ended before {points} points: {sweep.communicate()[1]}"
            begin_now()
            time.sleep(0.5)

    until(0)
    while not list(store.glob("parts/*/*")):
        time.sleep(0.5)
    ended = len(running())
    subprocess.run(["scontrol", "update", f"NodeName={node}", "State=DOWN", "Reason=tried"], check=True)
    time.sleep(2.0)
    assert not running()
    time.sleep(18.0)  # until its processes have ended; requeued jobs would wait for two minutes
    subprocess.run(["scontrol", "update", f"NodeName={node}", "State=RESUME"], stderr=subprocess.DEVNULL, check=False)
    until(2)
    os.kill(int(controller.read_text()), signal.SIGTERM)
    time.sleep(10.0)
    assert sweep.poll() is None
    subprocess.run(["slurmctld"], check=True)
    while sweep.poll() is None:
        begin_now()
        time.sleep(0.5)
    assert sweep.returncode == 0, sweep.communicate()[1]
    found = {"workers": 2, "lost with their node": ended, "controllers away": 1}
    return {**found, "points": same_bits(folder, "slurm", "here")}


CASES = {
    "disturbed": goes_on_disturbed,
    "down": goes_on_after_outages,
    "minute": gets_on_by_the_minute,
    "waits": waits_and_stops,
}


def main() -> None:
    """Run the cases that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--json", type=Path, help="write what was counted there")
    options = parser.parse_args()
    found = {}
    for case in options.cases or CASES:
        with tempfile.TemporaryDirectory() as name:
            began = time.monotonic()
            try:
                found[case] = CASES[case](Path(name))
            finally:
                for process in started:
                    process.kill()
        print(f"{case}, {time.monotonic() - began:.0f} s: {found[case]}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
