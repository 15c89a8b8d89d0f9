"""The folder of a sweep: its points, their results by content, what failed and why, who is at work.

    sweep.json         the points: their values and keys, in order
    jobs/              what is to be computed, one file a job
    points/<key>.h5    recalls, as `gmem recall` writes them
    failed/<key>.json  reasons
    packs/<key>.h5     packs made for this sweep
    parts/<job>/       unfinished jobs; those that are not put up now with their file
    workers/           what each worker is doing, and what it said

A point's key stands for everything that its numbers depend on; what is there need not be computed again.
"""

import contextlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.recall import Recall
from gmem_jax.files.atomic import atomic, sweep
from gmem_jax.files.checkpoints import locked
from gmem_jax.files.recalls import load_recall, save_recall
from gmem_jax.sweeps.plan import Point

SWEEP_SCHEMA = "gmem-sweep/1"
ROOM = 1 << 20  # bytes that must be left on the disk: some points of a small pack
WRITTEN = 3600.0  # s in which a file is surely written: workers write while others look
JOB = "job.json"  # beside the parts of one that was put aside for others
FOLDERS = ("jobs", "points", "failed", "packs", "parts", "workers")


class Store:
    """The folder of a sweep.

    Args:
        folder: made if it is not there.

    Raises:
        FileFormatError: if it is there and holds something else.
        OSError: if it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise FileFormatError(f"{folder}: is a file; a sweep needs a folder of its own")
        if self.folder.is_dir() and any(self.folder.iterdir()) and not self._card.is_file():
            others = [entry.name for entry in self.folder.iterdir() if entry.name not in FOLDERS]
            if others:
                raise FileFormatError(f"{folder}: holds {others[0]} and no sweep; name a folder of its own")
        for name in FOLDERS:
            (self.folder / name).mkdir(parents=True, exist_ok=True)
            sweep(self.folder / name, age=WRITTEN)

    @property
    def _card(self) -> Path:
        return self.folder / "sweep.json"

    def remember(
        self,
        points: Sequence[Point],
        shared: dict[str, Any],
        names: Sequence[str],
        impossible: Sequence[tuple[str, dict[str, Any]]] = (),
    ) -> None:
        """Write down the points of the sweep; results of points that are no longer asked for stay.

        Args:
            points: that can be computed.
            shared: the values that all have.
            names: of what varies.
            impossible: keys and values of those that cannot.
        """
        rows = [{"key": one.key, "values": one.values} for one in points]
        rows += [{"key": key, "values": values} for key, values in impossible]
        self._write(self._card, {"schema": SWEEP_SCHEMA, "shared": shared, "names": list(names), "points": rows})

    def card(self) -> dict[str, Any]:
        """What `remember` wrote.

        Raises:
            FileFormatError: if there is nothing of the kind.
        """
        try:
            card = json.loads(self._card.read_text(encoding="utf-8"))
            if card["schema"] != SWEEP_SCHEMA:
                raise FileFormatError(f"{self._card}: schema is {card['schema']!r}, expected {SWEEP_SCHEMA!r}")
            found = {"shared": dict(card["shared"]), "names": [str(name) for name in card["names"]]}
            rows = [{"key": str(row["key"]), "values": dict(row["values"])} for row in card["points"]]
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(f"{self.folder}: no sweep here (no readable sweep.json)") from error
        return {**found, "points": rows}

    @staticmethod
    def _write(path: Path, value: Any) -> None:
        with atomic(path) as temporary:
            temporary.write_text(json.dumps(value, indent=1), encoding="utf-8")

    def at(self, key: str) -> Path:
        """The file of a point's recall."""
        return self.folder / "points" / f"{key}.h5"

    def pack_at(self, key: str) -> Path:
        """The file of a pack made for this sweep."""
        return self.folder / "packs" / f"{key}.h5"

    def done(self) -> set[str]:
        """Keys of the points that are computed."""
        return {path.stem for path in (self.folder / "points").glob("*.h5")}

    def failed(self) -> dict[str, str]:
        """Keys of the points that failed, and why."""
        found = {}
        for path in (self.folder / "failed").glob("*.json"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                found[path.stem] = str(json.loads(path.read_text(encoding="utf-8"))["reason"])
        return found

    def save(self, key: str, recall: Recall, configuration: dict[str, Any]) -> None:
        """Keep the recall of a point."""
        save_recall(self.at(key), recall, configuration)

    def load(self, key: str) -> tuple[Recall, dict[str, Any]]:
        """The recall of a point, and its configuration.

        Raises:
            FileNotFoundError: if it is not computed.
            FileFormatError: if its file is damaged.
        """
        return load_recall(self.at(key))

    def unreadable(self, keys: set[str]) -> list[str]:
        """Those of some points that are computed whose files cannot be read."""
        found = []
        for key in sorted(keys & self.done()):
            try:
                self.load(key)
            except FileFormatError:
                found.append(key)
        return found

    def require_room(self) -> None:
        """Make sure that the disk takes more.

        Raises:
            OSError: if it does not.
        """
        trial = self.folder / "trial"
        try:
            with atomic(trial) as temporary:
                temporary.write_bytes(bytes(ROOM))
        finally:
            trial.unlink(missing_ok=True)

    def fail(self, key: str, reason: str) -> None:
        """Write down why a point has no result."""
        self._write(self.folder / "failed" / f"{key}.json", {"reason": reason})

    def forgive(self) -> int:
        """Forget all failures, so that they are tried again; how many there were."""
        failed = list((self.folder / "failed").glob("*.json"))
        for path in failed:
            path.unlink()
        return len(failed)

    def order(self, jobs: Sequence[dict[str, Any]]) -> None:
        """Put up jobs in the place of those that were there. Of others what was begun stays, to be gone on with."""
        wanted = {f"{number:05d}-{job['name']}.json": job for number, job in enumerate(jobs)}
        for path in (self.folder / "jobs").glob("*.json"):
            if path.name not in wanted:
                begun = self.folder / "parts" / path.stem.partition("-")[2]
                path.replace(begun / JOB) if begun.is_dir() else path.unlink()
        for name, job in wanted.items():
            self._write(self.folder / "jobs" / name, job)
        names = {job["name"] for job in (*jobs, *self._interrupted()) if not self.finished(job)}
        for path in (self.folder / "parts").iterdir():
            name = path.name.partition("-")[0]  # points of a job that broke are run by themselves, numbered
            if path.is_dir() and name not in names and not self.taken({"name": name}):
                shutil.rmtree(path, ignore_errors=True)

    def _interrupted(self) -> list[dict[str, Any]]:
        """Jobs of which there are parts, and which are not put up."""
        found = []
        for path in (self.folder / "parts").glob(f"*/{JOB}"):
            with contextlib.suppress(OSError, ValueError):
                found.append(json.loads(path.read_text(encoding="utf-8")))
        return found

    def jobs(self) -> list[dict[str, Any]]:
        """The jobs that were put up, in order."""
        return [json.loads(path.read_text(encoding="utf-8")) for path in sorted((self.folder / "jobs").glob("*.json"))]

    def begun(self, keys: set[str]) -> list[dict[str, Any]]:
        """Unfinished runs of some points that a worker is at, or was: they go on as they were begun."""
        jobs = {job["name"]: job for job in (*self.jobs(), *self._interrupted())}.values()
        runs = [job for job in jobs if job["kind"] == "run" and keys.issuperset(job["points"])]
        return [job for job in runs if not self.finished(job) and (self.parts(job).is_dir() or self.taken(job))]

    def finished(self, job: dict[str, Any]) -> bool:
        """Whether nothing is left to do of a job."""
        if job["kind"] == "pack":
            return self.pack_at(job["name"]).is_file() or (self.folder / "failed" / f"{job['name']}.json").is_file()
        failed = self.folder / "failed"
        return all(self.at(key).is_file() or (failed / f"{key}.json").is_file() for key in job["points"])

    def parts(self, job: dict[str, Any]) -> Path:
        """Where the unfinished parts of a job are kept."""
        return self.folder / "parts" / str(job["name"])

    @contextlib.contextmanager
    def mine(self, job: dict[str, Any]) -> Iterator[None]:
        """Have a job to oneself: the operating system lets go of it when this process dies.

        Raises:
            FileFormatError: if another living process has it.
        """
        with locked(self.folder / "jobs" / str(job["name"])):
            yield

    def taken(self, job: dict[str, Any]) -> bool:
        """Whether a living process has a job."""
        try:
            with self.mine(job):
                return False
        except FileFormatError:
            return True

    def tell(self, worker: str, job: str, fraction: float, what: str) -> None:
        """Say what a worker is doing."""
        # Not flushed to the disk: it is said again within seconds.
        path = self.folder / "workers" / f"{worker}.json"
        temporary = path.with_suffix(f".{os.getpid()}")
        temporary.write_text(json.dumps({"job": job, "fraction": fraction, "what": what}), encoding="utf-8")
        temporary.replace(path)

    def told(self) -> list[dict[str, Any]]:
        """What the workers said last."""
        found = []
        for path in (self.folder / "workers").glob("*.json"):
            with contextlib.suppress(OSError, ValueError):
                found.append(json.loads(path.read_text(encoding="utf-8")))
        return found

    def log_of(self, worker: str) -> Path:
        """The file of what a worker says."""
        return self.folder / "workers" / f"{worker}.log"

    def said(self) -> str:
        """What the workers with such files said, who said something last at the end."""
        logs = (self.folder / "workers").glob("*.log")
        return "\n".join(
            path.read_text(encoding="utf-8", errors="replace")
            for path in sorted(logs, key=lambda path: path.stat().st_mtime)
        )
