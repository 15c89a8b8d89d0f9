"""The folder of a sweep: its points and results, failures with their reasons, and workers.

    sweep.json         the points: their values and keys, in order; the marker of the folder, see `gmem_jax.files.ours`
    jobs/              the jobs to be done, one file each
    points/<key>.h5    recalls, as `gmem recall` writes them; each names its key
    failed/<key>.json  reasons of failures
    packs/<key>.h5     packs made for this sweep
    parts/<job>/       parts of unfinished jobs; and the file of a job that is not in jobs/ now
    workers/           progress and log of each worker, and its process or SLURM job

A point's key is a hash of everything that its numbers depend on: a result with this key is never computed again.
"""

import contextlib
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.recall import Recall
from gmem_jax.files.atomic import atomic
from gmem_jax.files.checkpoints import PART_FILES, is_locked, locked
from gmem_jax.files.ours import WRITTEN, Folder, remove_leftovers
from gmem_jax.files.printing import printable
from gmem_jax.files.recalls import load_recall, save_recall
from gmem_jax.files.schemas import SWEEP
from gmem_jax.files.validation import NAME, is_number, source, title, whole
from gmem_jax.sweeps.plan import Point

SWEEP_MARKER = "sweep.json"
FREE_BYTES = 1 << 20  # bytes that must be free on the disk: some points of a small pack
JOB = "job.json"  # the file of a job beside its parts, while other jobs are in jobs/
FOLDERS = ("jobs", "points", "failed", "packs", "parts", "workers")
_KEY = r"[0-9a-z]{1,40}"
_JOB = rf"{_KEY}(?:-[0-9]{{1,6}})*"
_OWN = re.compile(
    rf"sweep\.json|trial|jobs/[0-9]{{5}}-{_JOB}\.json|jobs/{_JOB}|(?:points|packs)/{_KEY}\.h5|failed/{_KEY}\.json"
    rf"|parts/{_JOB}/(?:{PART_FILES})|workers/[a-z]+(?:-[0-9]+)?\.(?:json|log|run)"
)


class Store:
    """The folder of a sweep.

    Args:
        folder: the folder.
        make: whether to make what is missing of it; if not, nothing in it is touched.

    Raises:
        FileFormatError: if the folder holds something else; or if it holds no sweep and `make` is False.
        OSError: if it cannot be written.
    """

    def __init__(self, folder: Path, *, make: bool = True) -> None:
        self.folder = Path(folder)
        if not (make or Folder.about(self.folder, SWEEP_MARKER, SWEEP.name)):
            raise FileFormatError(f"{folder}: no sweep here (no sweep.json of {SWEEP.name}, or behind a link)")
        self._own = Folder(self.folder, SWEEP_MARKER, SWEEP.name, _OWN, {"shared": {}, "names": [], "points": []})
        for name in FOLDERS if make else ():
            self._own.make(name)
            remove_leftovers(self.folder / name, age=WRITTEN)

    def write_manifest(
        self,
        points: Sequence[Point],
        shared: dict[str, Any],
        names: Sequence[str],
        impossible: Sequence[tuple[str, dict[str, Any]]] = (),
    ) -> None:
        """Write down the points of the sweep; results of points that are no longer asked for stay.

        Args:
            points: the points that can be computed.
            shared: the values that all points have.
            names: the names that vary.
            impossible: keys and values of the points that cannot be computed.
        """
        rows = [{"key": one.key, "values": one.values} for one in points]
        rows += [{"key": key, "values": values} for key, values in impossible]
        self._own.mark({"shared": shared, "names": list(names), "points": rows})

    def card(self) -> dict[str, Any]:
        """The content of sweep.json, as `write_manifest` wrote it.

        Raises:
            FileFormatError: if there is no such file, or it cannot be read.
        """
        card = Folder.about(self.folder, SWEEP_MARKER, SWEEP.name)
        try:
            if card is None:
                raise ValueError("there is none")
            shared, names = dict(card["shared"]), list(card["names"])
            rows = [{"key": str(row["key"]), "values": dict(row["values"])} for row in card["points"]]
        except (ValueError, KeyError, TypeError) as error:
            raise FileFormatError(f"{self.folder}: no sweep here (no readable sweep.json)") from error
        values: Iterator[tuple[str, Any]] = (pair for row in card["points"] for pair in dict(row["values"]).items())
        for name, value in [*shared.items(), *values]:
            if not title(name) or (isinstance(value, str) and not source(value)):
                raise FileFormatError(f"{self.folder / SWEEP_MARKER}: {printable(name)[:NAME]} is no name with a value")
        if not all(map(title, names)):
            raise FileFormatError(f"{self.folder / SWEEP_MARKER}: a name of what varies is no line of text")
        if odd := [str(row["key"]) for row in rows if not re.fullmatch(_KEY, str(row["key"]))]:
            raise FileFormatError(f"{self.folder / SWEEP_MARKER}: {printable(odd[0])[:NAME]!r} is no key of a point")
        return {"shared": shared, "names": names, "points": rows}

    @staticmethod
    def _write(path: Path, value: Any) -> None:
        with atomic(path) as temporary:
            temporary.write_text(json.dumps(value, indent=1), encoding="utf-8")

    def at(self, key: str) -> Path:
        """The file of a point's recall."""
        return self._own.at(f"points/{key}.h5")

    def pack_at(self, key: str) -> Path:
        """The file of a pack made for this sweep."""
        return self._own.at(f"packs/{key}.h5")

    def done(self) -> set[str]:
        """Keys of the points that are computed."""
        return {path.stem for path in self._own.files("points")}

    def failed(self) -> dict[str, str]:
        """The reasons of failures, by key of the point or pack."""
        found = {}
        for path in self._own.files("failed"):
            told = _json(path)
            if told.get("key") == path.stem:
                found[path.stem] = printable(told.get("reason"))
        return found

    def save(self, key: str, recall: Recall) -> None:
        """Write the recall of a point, with its key."""
        save_recall(self.at(key), recall.described({**recall.configuration, "key": key}))

    def load(self, key: str) -> Recall:
        """The recall of a point.

        Raises:
            FileNotFoundError: if it is not computed.
            FileFormatError: if its file is damaged, or belongs to another point.
        """
        found = load_recall(self.at(key))
        own = found.configuration.get("key")
        if own != key:
            raise FileFormatError(
                f"{self.at(key)}: holds {self._named(own)}, not {self._named(key)}: files were exchanged; give each "
                "its own name (KEY.h5) again, or remove it, and the sweep computes what is missing"
            )
        return found

    def _named(self, key: Any) -> str:
        """A point by its key and its values, for a message."""
        values = [row["values"] for row in self.card()["points"] if row["key"] == key]
        told = ", ".join(f"{name} = {value}" for name, value in values[0].items()) if values else "not of this sweep"
        return f"point {printable(key)[:NAME]} ({printable(told)[:NAME]})"

    def unreadable(self, keys: set[str]) -> list[str]:
        """The keys, among these, of points whose files exist and cannot be read."""
        found = []
        for key in sorted(keys & self.done()):
            try:
                self.load(key)
            except FileFormatError:
                found.append(key)
        return found

    def require_room(self) -> None:
        """Make sure that there is room on the disk.

        Raises:
            OSError: if `FREE_BYTES` cannot be written.
        """
        try:
            with atomic(self._own.at("trial")) as temporary:
                temporary.write_bytes(bytes(FREE_BYTES))
        finally:
            self._own.remove("trial")

    def fail(self, key: str, reason: str) -> None:
        """Write down why a point or a pack failed."""
        self._write(self._failed(key), {"key": key, "reason": reason})

    def forget(self, key: str) -> None:
        """Remove the recall of a point."""
        self._own.remove(f"points/{key}.h5")

    def clear_failures(self) -> int:
        """Forget all failures, so that they are tried again; gives their number."""
        failed = self._own.files("failed")
        for path in failed:
            self._own.remove(f"failed/{path.name}")
        return len(failed)

    def order(self, jobs: Sequence[dict[str, Any]]) -> None:
        """Replace the jobs in jobs/. Parts of other unfinished jobs stay with their file, so that these can go on."""
        wanted = {f"{number:05d}-{job['name']}.json": job for number, job in enumerate(jobs)}
        for path in self._own.files("jobs"):
            if path.suffix == ".json" and path.name not in wanted:
                name = path.stem.partition("-")[2]
                if (self.folder / "parts" / name).is_dir():
                    self._own.move(f"jobs/{path.name}", f"parts/{name}/{JOB}")
                else:
                    self._own.remove(f"jobs/{path.name}")
        for name, job in wanted.items():
            self._write(self._own.at(f"jobs/{name}"), job)
        names = {job["name"] for job in (*jobs, *self._interrupted()) if not self.finished(job)}
        for path in (self.folder / "parts").iterdir():
            name = path.name.partition("-")[0]  # if a job fails, its points are run one by one, in numbered parts
            if re.fullmatch(_JOB, path.name) and name not in names and not self.taken({"name": name}):
                self._own.clear(f"parts/{path.name}")

    def _interrupted(self) -> list[dict[str, Any]]:
        """Jobs that have parts, and are not in jobs/."""
        folders = (path for path in (self.folder / "parts").glob("*") if re.fullmatch(_JOB, path.name))
        found = (_job(self._own.at(f"parts/{path.name}/{JOB}"), path.name) for path in folders if not path.is_symlink())
        return [job for job in found if job]

    def jobs(self) -> list[dict[str, Any]]:
        """The jobs in jobs/, in order; files that do not hold a job are passed over."""
        found = (_job(path, path.stem.partition("-")[2]) for path in self._own.files("jobs"))
        return [job for job in found if job]

    def begun(self, keys: set[str]) -> list[dict[str, Any]]:
        """Unfinished runs whose points are all among `keys`, and that a worker has begun; they go on as they are."""
        jobs = {job["name"]: job for job in (*self.jobs(), *self._interrupted())}.values()
        runs = [job for job in jobs if job["kind"] == "run" and keys.issuperset(job["points"])]
        return [job for job in runs if not self.finished(job) and (self.parts(job).is_dir() or self.taken(job))]

    def finished(self, job: dict[str, Any]) -> bool:
        """Whether all points of a job, or its pack, are computed or have failed."""
        if job["kind"] == "pack":
            return self.pack_at(job["name"]).is_file() or self._failed(job["name"]).is_file()
        return all(self.at(key).is_file() or self._failed(key).is_file() for key in job["points"])

    def _failed(self, key: str) -> Path:
        return self._own.at(f"failed/{key}.json")

    def parts(self, job: dict[str, Any]) -> Path:
        """The folder of the parts of an unfinished job."""
        return self._own.at(f"parts/{job['name']}/{JOB}").parent

    @contextlib.contextmanager
    def lock(self, job: dict[str, Any]) -> Iterator[None]:
        """Lock a job; the operating system releases the lock when this process dies.

        Raises:
            FileFormatError: if another living process holds the lock.
        """
        own = self._own.at(f"jobs/{job['name']}")
        with locked(own, f"{self.folder}: another sweep computes these points; call again when it is done"):
            yield

    def taken(self, job: dict[str, Any]) -> bool:
        """Whether a living process holds the lock of a job."""
        return is_locked(self._own.at(f"jobs/{job['name']}"))

    def tell(self, worker: str, job: str, fraction: float, what: str) -> None:
        """Write down the progress of a worker."""
        # Not flushed to the disk: it is written again within seconds.
        with atomic(self._own.at(f"workers/{worker}.json"), flush=False) as temporary:
            temporary.write_text(json.dumps({"job": job, "fraction": fraction, "what": what}), encoding="utf-8")

    def progress(self) -> list[dict[str, Any]]:
        """The latest progress of each worker; other files are passed over."""
        said = (_json(path) for path in self._own.files("workers") if path.suffix == ".json")
        fits = {"job": title, "fraction": is_number, "what": title}
        return [one for one in said if all(name in one and fit(one[name]) for name, fit in fits.items())]

    def record(self, worker: str, who: dict[str, Any]) -> None:
        """Write down which process or job a worker is, so that it can be ended."""
        self._write(self._own.at(f"workers/{worker}.run"), who)

    def held(self, worker: str) -> BinaryIO:
        """The record of this process, opened: `processes.stop` ends only processes that have such a file open."""
        return self._own.at(f"workers/{worker}.run").open("rb")

    def records(self) -> dict[str, dict[str, Any]]:
        """The records that `record` wrote, by worker."""
        return {path.stem: _json(path) for path in self._own.files("workers") if path.suffix == ".run"}

    def erase(self, worker: str) -> None:
        """Remove the record of a worker that has ended."""
        self._own.remove(f"workers/{worker}.run")

    def log_of(self, worker: str) -> Path:
        """The log file of a worker."""
        return self._own.at(f"workers/{worker}.log")

    def logs(self) -> str:
        """The text of all log files; the one that was written last is at the end."""
        logs = [path for path in self._own.files("workers") if path.suffix == ".log"]
        return "\n".join(
            path.read_text(encoding="utf-8", errors="replace")
            for path in sorted(logs, key=lambda path: path.stat().st_mtime)
        )


def _json(path: Path) -> dict[str, Any]:
    """A JSON object from a file; an empty one if the file does not hold one."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _job(path: Path, name: str) -> dict[str, Any] | None:
    """The job of that name in a file; None if the file does not hold it."""
    job = _json(path)
    sizes = all(is_number(job.get(one)) for one in ("work", "replicas"))
    if job.get("name") != name or not sizes:
        return None
    if job.get("kind") == "pack":
        return job if all(isinstance(job.get(one), dict) for one in ("recipe", "grain")) else None
    points, written = job.get("points"), job.get("configurations")
    fits = isinstance(points, list) and isinstance(written, list) and len(written) == len(points)
    if job.get("kind") != "run" or not fits or not whole(job.get("batch")):
        return None
    return job if all(isinstance(key, str) and re.fullmatch(_KEY, key) for key in points or ()) else None
