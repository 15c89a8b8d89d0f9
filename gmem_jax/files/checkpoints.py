"""Finished parts and checkpoints of a long run, kept beside its output until it is whole.

A part is a sealed .npz file: its arrays, and how they make up a pytree (JSON). Nothing in it is code.
"""

import contextlib
import errno
import hashlib
import json
import os
import re
import stat
import time
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gmem_jax.errors import FileFormatError, NotAtRestError, RunFailedError, warn_caller
from gmem_jax.files.atomic import atomic
from gmem_jax.files.ours import Folder, release, remove_leftovers
from gmem_jax.files.seal import BLOCK, PART, require_sealed, seal
from gmem_jax.files.validation import json_of, read_npy, refusing, require
from gmem_jax.physics.numbers import said
from gmem_jax.physics.pytree import REGISTERED
from gmem_jax.simulation.checkpoints import Checkpoint, ResultCache

PART_SCHEMA = "gmem-part/0.1"
PARTS_SCHEMA = "gmem-parts/0.1"
RUN_MARKER = "run.json"
PART_FILES = r"[\w.+-]+\.(?:npz|now|before)|(?:run|job)\.json"
"""Names of files in a folder of parts; a sweep puts the file of their job there too."""
ANEW = "remove it, or begin anew with --restart"
FIRST = 5.0  # s before the first checkpoint of an unfinished part; each further interval is twice as long
CHECKPOINT_INTERVAL = 120.0  # s, longest interval: the steps between checkpoints must cost more than writing them
AT_MILESTONES = 20.0  # s, longest interval at the end of a stage


def _taken_apart(tree: Any, arrays: list[np.ndarray]) -> Any:
    """The structure of a tree of arrays as JSON; its arrays are added to the list.

    Raises:
        TypeError: for any node but an array, a truth value, None, a tuple, a dictionary or a pytree of this package.
    """
    if isinstance(tree, np.ndarray | np.generic | jax.Array):
        arrays.append(np.asarray(tree))
        return {"array": len(arrays) - 1}
    if tree is None:
        return {"none": 0}
    if isinstance(tree, bool):
        return {"truth": tree}
    if isinstance(tree, tuple):
        return {"tuple": [_taken_apart(item, arrays) for item in tree]}
    if isinstance(tree, dict):
        return {"ordered": [[name, _taken_apart(item, arrays)] for name, item in tree.items()]}
    if is_dataclass(tree) and REGISTERED.get(type(tree).__name__) is type(tree):
        own = {entry.name: _taken_apart(getattr(tree, entry.name), arrays) for entry in fields(tree)}
        return {"kind": type(tree).__name__, "fields": own}
    raise TypeError(f"a {type(tree).__name__} cannot be kept in a file")


def _put_together(form: Any, arrays: list[np.ndarray]) -> Any:
    """The tree that `_taken_apart` took apart."""
    if "none" in form:
        return None
    if "truth" in form:
        return bool(form["truth"])
    if "array" in form:
        return arrays[form["array"]]
    if "tuple" in form:
        return tuple(_put_together(item, arrays) for item in form["tuple"])
    if "ordered" in form:
        return OrderedDict((name, _put_together(item, arrays)) for name, item in form["ordered"])
    return REGISTERED[form["kind"]](**{name: _put_together(item, arrays) for name, item in form["fields"].items()})


def save_part(path: Path, tree: Any, of: str = "") -> None:
    """Write a tree of arrays.

    Args:
        path: path of the file.
        tree: the tree.
        of: name of the part and of its run, which `load_part` compares.

    Raises:
        TypeError: if the tree holds something else than arrays.
        OSError: if the path cannot be written.
    """
    arrays: list[np.ndarray] = []
    head = json.dumps({"schema": PART_SCHEMA, "of": of, "form": _taken_apart(tree, arrays)}).encode()
    named = {f"array_{number:03d}": array for number, array in enumerate(arrays)}
    with atomic(path) as temporary:
        with temporary.open("wb") as file:
            file.write(bytes(BLOCK))
            np.savez(file, head=np.frombuffer(head, np.uint8), **named)  # type: ignore[arg-type]
        seal(temporary)


def load_part(path: Path, of: str = "") -> Any:
    """Read what `save_part` wrote, arrays as numpy arrays.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is damaged, of another schema, or not the part `of`.
    """
    with refusing(path, PART), path.open("rb") as opened:
        require_sealed(opened, PART)
        with zipfile.ZipFile(opened) as archive:
            found = _members(archive, path.stat().st_size)
        head = json_of(found.pop("head", np.zeros(0, np.uint8)).tobytes(), "head")
        if head.get("schema") != PART_SCHEMA:
            raise FileFormatError(f"{path}: schema is {head.get('schema')!r}, expected {PART_SCHEMA!r}")
        if head.get("of") != of:
            raise FileFormatError(
                f"{path}: says that it is {said(head.get('of'))}, not {said(of)}: files were exchanged"
            )
        return _put_together(head["form"], [found[name] for name in sorted(found)])


def _members(archive: zipfile.ZipFile, size: int) -> dict[str, np.ndarray]:
    """The arrays of an archive by name. They are not compressed, so that none can be larger than the file.

    Raises:
        FileFormatError: if one is compressed, or declares more bytes than the file has.
    """
    found = {}
    for member in archive.infolist():
        plain = member.compress_type == zipfile.ZIP_STORED and member.file_size == member.compress_size <= size
        require(plain, f"{member.filename!r} is compressed, or larger than the file")
        with archive.open(member) as file:
            found[member.filename.removesuffix(".npy")] = read_npy(file, member.file_size, member.filename)  # type: ignore[arg-type]
    return found


class _StoredCheckpoint(Checkpoint):
    """The checkpoint of an unfinished part, kept in two generations: if a writer dies, one of them is whole."""

    def __init__(self, own: Folder, name: str, of: str) -> None:
        self._own, self._names, self._of = own, (f"{name}.now", f"{name}.before"), f"{of}, unfinished"
        self._last, self._wait, self._keeps = time.monotonic(), min(FIRST, CHECKPOINT_INTERVAL), True

    def restore(self) -> Any:
        for name in self._names:
            with contextlib.suppress(FileFormatError, FileNotFoundError):
                return load_part(self._own.at(name), self._of)
        return None

    def maybe_save(self, state: Callable[[], Any], *, milestone: bool = False) -> None:
        wait = min(self._wait, AT_MILESTONES) if milestone else self._wait
        if self._keeps and (time.monotonic() - self._last >= wait or _parting):
            self.save(state)
        while _parting:
            _parting.pop()()

    def save(self, state: Callable[[], Any]) -> None:
        now, before = self._names
        if self._own.at(now).exists():
            self._own.move(now, before)
        try:
            save_part(self._own.at(now), state(), self._of)
        except TypeError:  # a user's law may keep its history in a class of its own: then there are no checkpoints
            self._keeps = False
        self._last, self._wait = time.monotonic(), min(CHECKPOINT_INTERVAL, 2.0 * self._wait)

    def discard(self) -> None:
        """Remove both generations."""
        for name in self._names:
            self._own.remove(name)


_parting: list[Callable[[], None]] = []


def part_with(leave: Callable[[], None]) -> None:
    """Have `leave` called after the next checkpoint, which is written at once; for handlers of signals."""
    _parting.append(leave)


class Checkpoints(ResultCache):
    """Parts of a long run, in a folder beside its output: a `cache` for `gm.run` and others.

    Finished parts are kept as files; of an unfinished part there is a checkpoint every few minutes. Each file names its
    run and its part.

    Args:
        folder: the folder; it is made if it does not exist.
        key: the values that the parts depend on; stored with them.
        restart: whether to discard the parts that are there.
        advice: advice in the error about a part that cannot be read.

    Raises:
        FileFormatError: if the folder holds parts of another run, or is not a folder of parts.
        OSError: if it cannot be written.
    """

    def __init__(self, folder: Path, key: dict[str, Any], *, restart: bool = False, advice: str = ANEW) -> None:
        self.folder, self._advice = Path(folder), advice
        wanted = json.loads(json.dumps(key))
        self._run = hashlib.sha256(json.dumps(wanted, sort_keys=True).encode()).hexdigest()[:20]
        self._own = Folder(self.folder, RUN_MARKER, PARTS_SCHEMA, re.compile(PART_FILES), {"key": wanted})
        if restart or not (self.finished() or self.begun()):
            self._own.clear(keep=True)
        elif other := self.other_run(self.folder, wanted):
            raise FileFormatError(f"{self.folder}: {other}; begin anew with --restart, or choose another output")
        remove_leftovers(self.folder)
        self._own.mark({"key": wanted})

    @classmethod
    def other_run(cls, folder: Path, key: dict[str, Any]) -> str:
        """A message if a folder holds parts of another run, with the first value that differs; else ""."""
        found, wanted = cls.key_of(folder), json.loads(json.dumps(key))
        if not found or found == wanted:
            return ""
        name, there, now = _difference(found, wanted)
        return f"holds parts of an interrupted run with another {name} ({said(there)}, now {said(now)})"

    @staticmethod
    def key_of(folder: Path) -> dict[str, Any]:
        """The key stored in a folder of parts; empty if there is none that can be read."""
        key = (Folder.about(Path(folder), RUN_MARKER, PARTS_SCHEMA) or {}).get("key")
        return key if isinstance(key, dict) else {}

    def __call__(self, name: str, run: Callable[[Checkpoint], Any]) -> Any:
        """The part of that name, with numpy arrays: it is read if it is finished, else run from its checkpoint on.

        Raises:
            FileFormatError: if the file of that name is damaged, or belongs to another part or run.
        """
        path, of = self._own.at(f"{name}.npz"), f"part {name} of run {self._run}"
        if path.is_file():
            try:
                return load_part(path, of)
            except FileFormatError as error:
                raise FileFormatError(f"{error}; {self._advice}") from error
        checkpoint = _StoredCheckpoint(self._own, name, of)
        try:
            result = jax.tree.map(np.asarray, run(checkpoint))
        except NotAtRestError:
            raise  # keeps its checkpoint, from which a run with more patience goes on
        except RunFailedError:
            checkpoint.discard()  # it would fail again: the next run must change something
            raise
        with contextlib.suppress(TypeError):  # see `_StoredCheckpoint`
            save_part(path, result, of)
        checkpoint.discard()
        return result

    def finished(self) -> int:
        """Number of finished parts."""
        return sum(path.suffix == ".npz" for path in self._own.files())

    def begun(self) -> int:
        """Number of unfinished parts that have a checkpoint."""
        return len({path.stem for path in self._own.files() if path.suffix in (".now", ".before")})

    def discard(self) -> None:
        """Remove the folder; if it holds other files too, remove only ours."""
        if left := self._own.clear():
            warn_caller(f"{self.folder}: not removed, since it holds {left[0]}, which was not written by the run")


def _difference(one: Any, other: Any, name: str = "") -> tuple[str, Any, Any]:
    """The dotted name of the first value in which two JSON objects differ, and both values."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return name, one, other
    differs = next(own for own in {**one, **other} if one.get(own) != other.get(own))
    return _difference(one.get(differs), other.get(differs), f"{name}.{differs}" if name else differs)


@contextlib.contextmanager
def locked(output: Path, taken: str = "") -> Iterator[None]:
    """Lock an output: a second run into it is refused as long as the first one lives.

    Args:
        output: a file or a folder.
        taken: the error message if another process holds it; default that another run is writing it.

    Raises:
        FileFormatError: if another process holds it.
    """
    lock = lock_of(output)
    try:
        handle = os.open(lock, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR):
            raise FileFormatError(f"{lock}: is a link or a folder where a lock should be; move it away") from None
        raise
    try:
        known = os.fstat(handle)
        if not stat.S_ISREG(known.st_mode) or known.st_size:
            raise FileFormatError(f"{lock}: is not a lock file of gmem, but has the name of one; move it away")
        if not _lock(handle) or not lock.exists() or known.st_ino != lock.stat().st_ino:
            # The process that held it has removed it meanwhile, and another may have made a new one.
            raise FileFormatError(taken or f"{output}: another run is writing it; name another output")
        try:
            yield
        finally:
            release(lock, known.st_ino)
    finally:
        os.close(handle)


def lock_of(output: Path) -> Path:
    """The file by which an output is locked."""
    output = output if output.name not in ("", "..") else output.resolve()  # Path(".") has no name
    return output.with_name(f".{output.name}.lock")


def _lock(handle: int) -> bool:
    import fcntl  # not on Windows, where there is no lock either

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def is_locked(output: Path) -> bool:
    """Whether a living process holds the lock of an output; nothing is made or changed."""
    try:
        handle = os.open(lock_of(output), os.O_RDONLY | os.O_NONBLOCK | getattr(os, "O_NOFOLLOW", 0))
    except OSError:
        return False
    try:
        return not _lock(handle)
    finally:
        os.close(handle)
