"""Queries of SLURM: whether it is there, and which jobs run or wait."""

import shutil
import subprocess
from typing import NamedTuple

SLURM_TIMEOUT = 30.0  # s for a controller to answer


class Queued(NamedTuple):
    """A job in the queue.

    Attributes:
        state: state, like PENDING or RUNNING.
        reason: reason for which the job waits.
        name: name of the job.
    """

    state: str
    reason: str
    name: str


def queue(numbers: list[str]) -> dict[str, Queued] | None:
    """The jobs among some numbers that run or wait; None if SLURM does not answer, since jobs outlive its controller.

    It asks squeue: sacct, which submitit asks, needs a data base that small clusters do not have.
    """
    command = ["squeue", "--noheader", "--format=%A|%T|%r|%j", f"--jobs={','.join(numbers)}"]
    try:
        told = subprocess.run(command, capture_output=True, text=True, timeout=SLURM_TIMEOUT)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if told.returncode != 0 and "Invalid job id" not in told.stderr:
        return None
    rows = (line.strip().split("|", 3) for line in told.stdout.splitlines())
    return {row[0]: Queued(*row[1:]) for row in rows if len(row) == 4}


def cancel(number: str) -> None:
    """End a job."""
    subprocess.run(["scancel", number], capture_output=True, timeout=SLURM_TIMEOUT, check=False)


def require_slurm() -> None:
    """Raise if jobs cannot be submitted from here; sbatch itself would print its own lines, or wait for minutes.

    Raises:
        ValueError: if there is no SLURM, or its controller does not answer.
    """
    elsewhere = "run the sweep where it does, or with --executor processes"
    if not all(map(shutil.which, ("sbatch", "scontrol"))):
        raise ValueError(f"no SLURM here, sbatch is not on the path; {elsewhere.replace('does', 'is')}")
    try:
        asked = subprocess.run(["scontrol", "ping"], capture_output=True, text=True, timeout=SLURM_TIMEOUT)
        if asked.returncode == 0:
            return
        answer = (asked.stdout.strip() or asked.stderr.strip() or "no reason given").splitlines()[0]
    except subprocess.TimeoutExpired:
        answer = f"scontrol waited {SLURM_TIMEOUT:.0f} s"
    raise ValueError(f"SLURM's controller does not answer ({answer}); {elsewhere}")
