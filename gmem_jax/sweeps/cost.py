"""Estimates of the cost of a sweep, without running it."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import psutil

from gmem_jax.files.ours import Folder
from gmem_jax.files.schemas import SWEEP
from gmem_jax.files.sizes import in_bytes, in_time, pack_bytes, recall_bytes
from gmem_jax.physics.numbers import plural
from gmem_jax.sweeps.plan import plan
from gmem_jax.sweeps.spec import Spec
from gmem_jax.sweeps.store import SWEEP_MARKER, Store
from gmem_jax.sweeps.sweep import FREE_CORES, SweepRunner, seconds_of


class Cost(NamedTuple):
    """The work that is left of a sweep.

    Attributes:
        points: number of points of the sweep, each counted once.
        there: number of points whose results are in the folder.
        failed: number of points that failed before or are impossible.
        packs: number of packs to be made first.
        runs: largest number of runs for the missing points; each point on a pack to be made counts as one.
        grain_steps: grain-steps of all these packs and runs.
        seconds: time that they take on two free cores, with the native backend and law H.
        disk_bytes: size of their results.
        damaged: number of results that are damaged or belong to another point; they are computed again.
        others: number of results in the folder of points that are not asked for; they stay.
        begun: number of unfinished runs in the folder, which are continued.
    """

    points: int
    there: int
    failed: int
    packs: int
    runs: int
    grain_steps: float
    seconds: float
    disk_bytes: float
    damaged: int
    others: int
    begun: int

    @property
    def lines(self) -> list[str]:
        """The estimate as lines of text."""
        counts = [f"{self.there} there", *([f"{self.failed} failed or impossible"] if self.failed else [])]
        found = {
            f"{plural(self.damaged, 'file')} damaged, or another point's: to be computed again": self.damaged,
            f"{plural(self.others, 'result')} of points that are not asked for, which stay": self.others,
            f"{plural(self.begun, 'unfinished run')} to be gone on with": self.begun,
        }
        return [
            f"points: {self.points}, {', '.join(counts)}; {plural(self.runs, 'run')} at most",
            *(f"in the folder: {words}" for words, count in found.items() if count),
            f"packs to be made: {self.packs}",
            f"time: {self.grain_steps:.2g} grain-steps, {in_time(self.seconds)} {FREE_CORES}",
            f"disk: {in_bytes(self.disk_bytes)}; nothing was run or written",
        ]


def cost_of(spec: Spec, folder: Path, *, workers: int = 1, only_packs: bool = False) -> Cost:
    """The work that is left of a sweep, or of its packs only, in a folder; it need not exist, and is not made.

    Raises:
        FileFormatError: if the folder holds something else.
        ValueError: if a point is impossible (see `SweepRunner.check`).
        FileNotFoundError: if there is no such pack.
    """
    with TemporaryDirectory() as nowhere:
        runner = SweepRunner(spec, Path(nowhere) / "sweep", lambda _: None)
        if Folder.is_there(folder, SWEEP_MARKER, SWEEP.name):
            runner.store = Store(folder, make=False)
        runner.check()
        makes = runner.pack_jobs()
        later, points = ([], []) if only_packs else (runner.points_to_come(), runner.points())
        asked = {one.key: one for one in points}
        failed, kept = set(runner.store.failed()), runner.store.done()
        damaged = set(runner.store.unreadable(set(asked)))
        begun = len(runner.store.begun(asked.keys() - failed))
    known = kept - damaged
    missing = [one for key, one in asked.items() if key not in known | failed]
    memory = psutil.virtual_memory().available // workers
    jobs = [job.asdict() for job in plan(missing, set(), memory, workers=workers)]
    work = [*makes, *later, *jobs]
    disk = sum(pack_bytes(job["recipe"]["grains"]) for job in makes) + sum(one["bytes"] for one in later)
    return Cost(
        points=len(asked) + len(runner.impossible),
        there=len(asked.keys() & known),
        failed=len(asked.keys() & failed) + len(runner.impossible) - len(later),
        packs=len(makes),
        runs=len(jobs) + len(later),
        grain_steps=float(sum(job["work"] for job in work)),
        seconds=seconds_of(work),
        damaged=len(damaged),
        others=0 if only_packs else len(kept - asked.keys()),
        begun=begun,
        disk_bytes=disk + sum(recall_bytes(one.experiment) for one in missing),
    )
