"""Finished parts and checkpoints of a long run, kept beside its output until it is whole.

A part is a sealed .npz file: its arrays, and how they make up a pytree (JSON). Nothing in it is code.
"""

import contextlib
import json
import os
import shutil
import time
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gmem_jax.errors import FileFormatError, RunFailedError
from gmem_jax.files.atomic import atomic, sweep
from gmem_jax.files.checked import json_of, read_npy, refusing, require
from gmem_jax.files.seal import BLOCK, seal, sealed
from gmem_jax.physics.pytree import KINDS
from gmem_jax.simulation.checkpoints import Checkpoint, ResultCache

PART_SCHEMA = "gmem-part/2"
EVERY = 120.0  # s between checkpoints of an unfinished part: doing it again must cost more than writing them
AT_MILESTONES = 20.0  # s likewise, where a stage has just ended


def _taken_apart(tree: Any, arrays: list[np.ndarray]) -> Any:
    """How a tree of arrays is made up, as JSON; its arrays are added to the list.

    Raises:
        TypeError: for what is neither an array, a tuple, a dictionary nor a pytree of this package.
    """
    if isinstance(tree, np.ndarray | np.generic | jax.Array):
        arrays.append(np.asarray(tree))
        return {"array": len(arrays) - 1}
    if isinstance(tree, tuple):
        return {"tuple": [_taken_apart(item, arrays) for item in tree]}
    if isinstance(tree, dict):
        return {"ordered": [[name, _taken_apart(item, arrays)] for name, item in tree.items()]}
    if is_dataclass(tree) and KINDS.get(type(tree).__name__) is type(tree):
        own = {entry.name: _taken_apart(getattr(tree, entry.name), arrays) for entry in fields(tree)}
        return {"kind": type(tree).__name__, "fields": own}
    raise TypeError(f"a {type(tree).__name__} cannot be kept in a file")


def _put_together(form: Any, arrays: list[np.ndarray]) -> Any:
    """The tree that `_taken_apart` took apart."""
    if "array" in form:
        return arrays[form["array"]]
    if "tuple" in form:
        return tuple(_put_together(item, arrays) for item in form["tuple"])
    if "ordered" in form:
        return OrderedDict((name, _put_together(item, arrays)) for name, item in form["ordered"])
    return KINDS[form["kind"]](**{name: _put_together(item, arrays) for name, item in form["fields"].items()})


def save_part(path: Path, tree: Any) -> None:
    """Write a tree of arrays.

    Raises:
        TypeError: if it holds something else.
        OSError: if the path cannot be written.
    """
    arrays: list[np.ndarray] = []
    head = json.dumps({"schema": PART_SCHEMA, "form": _taken_apart(tree, arrays)}).encode()
    named = {f"array_{number:03d}": array for number, array in enumerate(arrays)}
    with atomic(path) as temporary:
        with temporary.open("wb") as file:
            file.write(bytes(BLOCK))
            np.savez(file, head=np.frombuffer(head, np.uint8), **named)  # type: ignore[arg-type]
        seal(temporary)


def load_part(path: Path) -> Any:
    """Read what `save_part` wrote, arrays as numpy arrays.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is damaged, or none of this schema.
    """
    with refusing(path, "part of a run"), path.open("rb") as opened:
        if not sealed(opened, path):
            raise FileFormatError(f"{path}: not a readable part of a run (no checksum); remove it")
        with zipfile.ZipFile(opened) as archive:
            found = _members(archive, path.stat().st_size)
        head = json_of(found.pop("head", np.zeros(0, np.uint8)).tobytes(), "head")
        if head.get("schema") != PART_SCHEMA:
            raise FileFormatError(f"{path}: schema is {head.get('schema')!r}, expected {PART_SCHEMA!r}")
        return _put_together(head["form"], [found[name] for name in sorted(found)])


def _members(archive: zipfile.ZipFile, size: int) -> dict[str, np.ndarray]:
    """The arrays of an archive, none of which is larger than the file says: nothing in it is compressed.

    Raises:
        FileFormatError: if one is.
    """
    found = {}
    for member in archive.infolist():
        plain = member.compress_type == zipfile.ZIP_STORED and member.file_size == member.compress_size <= size
        require(plain, f"{member.filename!r} is compressed, or larger than the file")
        with archive.open(member) as file:
            found[member.filename.removesuffix(".npy")] = read_npy(file, member.file_size, member.filename)  # type: ignore[arg-type]
    return found


class _StoredCheckpoint(Checkpoint):
    """How far a part is, in two generations: whenever a writer dies, one of them is whole."""

    def __init__(self, stem: Path) -> None:
        self._now, self._before = stem.with_name(f"{stem.name}.now"), stem.with_name(f"{stem.name}.before")
        self._last, self._keeps = time.monotonic(), True

    def restore(self) -> Any:
        for path in (self._now, self._before):
            with contextlib.suppress(FileFormatError, FileNotFoundError):
                return load_part(path)
        return None

    def maybe_save(self, state: Callable[[], Any], *, milestone: bool = False) -> None:
        passed = time.monotonic() - self._last
        if not self._keeps or passed < (AT_MILESTONES if milestone else EVERY):
            return
        if self._now.exists():
            self._now.replace(self._before)
        try:
            save_part(self._now, state())
        except TypeError:  # a law of the user's may remember in classes of its own: there is nothing to go on from
            self._keeps = False
        self._last = time.monotonic()

    def discard(self) -> None:
        """Remove both."""
        for path in (self._now, self._before):
            path.unlink(missing_ok=True)


class Checkpoints(ResultCache):
    """Checkpoints of a long run, in a folder beside its output: what `gm.run` and others take as `cache`.

    What is finished is kept as it is, what is not as a checkpoint of every few minutes.

    Args:
        folder: made if it is not there.
        key: what the parts depend on; stored with them.
        restart: discard what is there.

    Raises:
        FileFormatError: if the folder holds finished parts of another run.
        OSError: if it cannot be written.
    """

    def __init__(self, folder: Path, key: dict[str, Any], *, restart: bool = False) -> None:
        self.folder = Path(folder)
        if restart or not (self.finished() or self.begun()):
            shutil.rmtree(self.folder, ignore_errors=True)  # a folder without parts is worth nothing
        found, wanted = self.key_of(self.folder), json.loads(json.dumps(key))
        other = [name for name in wanted if found and found.get(name) != wanted[name]]
        if other:
            raise FileFormatError(
                f"{self.folder}: holds parts of an interrupted run with another {other[0]} "
                f"({_short(found.get(other[0]))}, now {_short(wanted[other[0]])}); begin anew with "
                "--restart, or choose another output"
            )
        self.folder.mkdir(exist_ok=True)
        sweep(self.folder)
        with atomic(self.folder / "run.json") as temporary:
            temporary.write_text(json.dumps(wanted, indent=1), encoding="utf-8")

    @staticmethod
    def key_of(folder: Path) -> dict[str, Any]:
        """The key stored in a folder of parts; empty if there is none that can be read."""
        card = Path(folder) / "run.json"
        try:
            key = json.loads(card.read_text(encoding="utf-8")) if card.is_file() else {}
        except (ValueError, OSError):
            key = {}
        return key if isinstance(key, dict) else {}

    def __call__(self, name: str, run: Callable[[Checkpoint], Any]) -> Any:
        """The part of that name, its arrays as numpy arrays: read if it is there, else run from its checkpoint on."""
        path = self.folder / f"{name}.npz"
        if path.is_file():
            return load_part(path)
        checkpoint = _StoredCheckpoint(self.folder / name)
        try:
            result = jax.tree.map(np.asarray, run(checkpoint))
        except RunFailedError:
            checkpoint.discard()  # whoever tries again changes something
            raise
        with contextlib.suppress(TypeError):  # see `_StoredCheckpoint`
            save_part(path, result)
        checkpoint.discard()
        return result

    def finished(self) -> int:
        """Number of parts there are."""
        return len(list(self.folder.glob("*.npz")))

    def begun(self) -> int:
        """Number of parts that are not finished, but have a checkpoint."""
        return len({path.stem for pattern in ("*.now", "*.before") for path in self.folder.glob(pattern)})

    def discard(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


@contextlib.contextmanager
def locked(output: Path) -> Iterator[None]:
    """Keep an output to oneself: a second run into it is refused as long as the first one lives.

    Raises:
        FileFormatError: if another process holds it.
    """
    import fcntl  # where there is none, as on Windows, there is no lock either

    lock = output.with_name(f".{output.name}.lock")
    with lock.open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(file.fileno()).st_ino != lock.stat().st_ino:
                raise OSError  # who had it before us has removed it, and somebody else may have made another
        except OSError:
            raise FileFormatError(f"{output}: another run is writing it; name another output") from None
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                os.unlink(lock)
