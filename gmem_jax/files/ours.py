"""Removing, renaming and replacing files: only those that were proven to be the package's own.

A folder of ours holds a marker, written when the folder was made. A file in it is ours if it is a plain file whose name
fits the pattern of our names. Links are not followed. An output that was promised as new never replaces a file. All
code of this package that removes, renames or replaces files is here.
"""

import contextlib
import hashlib
import json
import os
import re
import secrets
import stat
import time
from pathlib import Path
from typing import Any

from gmem_jax.errors import FileFormatError

_TEMPORARY = re.compile(r"\.gmem-([0-9a-f]{12})-[0-9a-f]{12}\.tmp")
WRITTEN = 3600.0  # s after which a temporary file was left by a killed writer: others may be writing younger ones
_new: set[Path] = set()  # outputs that were free when a command claimed them


def _tag(name: str) -> str:
    return hashlib.sha256(os.fsencode(name)).hexdigest()[:12]


def temporary(path: Path) -> Path:
    """A new empty file beside `path`. Its short name holds a hash of the name of `path`; its mode follows the umask.

    Raises:
        OSError: if the folder cannot be written.
    """
    beside = path.with_name(f".gmem-{_tag(path.name)}-{secrets.token_hex(6)}.tmp")
    os.close(os.open(beside, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    return beside


def drop(made: Path) -> None:
    """Remove a file that `temporary` made, if it is still there."""
    assert _TEMPORARY.fullmatch(made.name)
    made.unlink(missing_ok=True)


def remove_leftovers(folder: Path, name: str = "", *, age: float = 0.0) -> None:
    """Remove the temporary files that killed writers left in a folder, for all files or for one.

    Args:
        folder: the folder.
        name: name of the one file; default all files.
        age: in s; younger temporary files stay, since their writers may be alive.
    """
    for left in Path(folder).glob(".gmem-*.tmp"):
        known = _TEMPORARY.fullmatch(left.name)
        if known and (not name or known[1] == _tag(name)):
            with contextlib.suppress(OSError):
                if _plain(left) and time.time() - left.stat().st_mtime >= age:
                    drop(left)


def remove_empty(folder: Path, ending: str) -> None:
    """Remove the files in a folder whose names end so and that hold nothing."""
    with os.scandir(folder) as entries:  # a folder may have thousands, and each command looks
        for entry in entries:
            with contextlib.suppress(OSError):
                if entry.name.endswith(ending) and entry.is_file(follow_symlinks=False) and not entry.stat().st_size:
                    os.unlink(entry)


def promise(path: Path, *, replace: bool) -> None:
    """Say whether `place` may replace a file at `path`, an output of this process."""
    (_new.discard if replace else _new.add)(path.absolute())


def place(made: Path, path: Path) -> None:
    """Move a file that `temporary` made to its path. If a new file was promised there, one that came since is kept.

    Raises:
        FileExistsError: if there is such a file.
        OSError: if the folder cannot be written.
    """
    if path.absolute() not in _new:
        os.replace(made, path)
        return
    try:
        try:
            os.link(made, path)  # a link never replaces a file
        except FileExistsError:
            raise
        except OSError:  # the file system has no hard links
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            os.replace(made, path)
    except FileExistsError:
        raise FileExistsError(
            f"{path}: was made by somebody else since this command began, and is untouched; "
            "move it away, or allow its replacement with --force"
        ) from None
    _new.discard(path.absolute())
    drop(made)


def release(lock: Path, number: int) -> None:
    """Remove a lock, which is an empty file, if it still has this inode number."""
    with contextlib.suppress(OSError):
        found = lock.lstat()
        if (found.st_ino, found.st_size) == (number, 0):
            lock.unlink()


def _plain(path: Path) -> bool:
    """Whether the path is a regular file, and not a link."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except OSError:
        return False


class Folder:
    """A folder of ours: a new one with its marker, or one whose marker is found.

    Args:
        path: path of the folder.
        marker: name of its marker.
        schema: schema of the marker.
        names: pattern of the paths of all files that we make in it, relative to the folder.
        about: fields of a new marker beside its schema.

    Raises:
        FileFormatError: if there is a folder that is not ours; nothing in it was touched.
        OSError: if it cannot be written.
    """

    def __init__(self, path: Path, marker: str, schema: str, names: re.Pattern[str], about: dict[str, Any]) -> None:
        self.path, self._marker, self._schema, self._names = path, marker, schema, names
        if not self.is_there(path, marker, schema):
            new = not path.exists()
            path.mkdir(exist_ok=True)
            try:
                self.mark(about)
            except OSError:
                if new:
                    with contextlib.suppress(OSError):
                        path.rmdir()
                raise

    @classmethod
    def is_there(cls, path: Path, marker: str, schema: str) -> bool:
        """Whether there is a folder with this marker; if not, there is nothing, or an empty folder.

        Raises:
            FileFormatError: if something else is there.
        """
        if path.is_symlink():
            raise FileFormatError(f"{path}: is a link, which is not followed; name a folder itself")
        if path.exists() and not path.is_dir():
            raise FileFormatError(f"{path}: is a file, and a folder is needed; name another")
        if cls.about(path, marker, schema) is not None:
            return True
        if path.is_dir():
            others = sorted(entry.name for entry in path.iterdir() if not _TEMPORARY.fullmatch(entry.name))
            if others:
                raise FileFormatError(
                    f"{path}: has no {marker} of {schema} but holds {others[0]}; "
                    "its files may be someone else's, so nothing was changed; move it away, or name another output"
                )
        return False

    @staticmethod
    def about(path: Path, marker: str, schema: str) -> dict[str, Any] | None:
        """The content of a folder's marker; None if it has no marker of this schema."""
        card = path / marker
        if os.path.islink(path) or not _plain(card):
            return None
        try:
            found = json.loads(card.read_text(encoding="utf-8"))
        except (ValueError, OSError, RecursionError):
            return None
        return found if isinstance(found, dict) and found.get("schema") == schema else None

    def mark(self, about: dict[str, Any]) -> None:
        """Write the marker anew.

        Raises:
            OSError: if it cannot be written.
        """
        made, card = None, self.path / self._marker
        try:
            made = temporary(card)
            made.write_text(json.dumps({"schema": self._schema, **about}, indent=1), encoding="utf-8")
            place(made, card)
        except OSError as error:
            raise OSError(f"{card}: cannot be written ({error.strerror}); whatever was there is untouched") from error
        finally:
            if made:
                drop(made)

    def at(self, name: str) -> Path:
        """The path of a file of ours in the folder; the file need not exist.

        Raises:
            FileFormatError: if the name is not one of ours, or a link is on the way.
        """
        if not self._names.fullmatch(name):
            raise FileFormatError(f"{self.path}: no file that is written there is named {name!r}; nothing was changed")
        path = self.path / name
        for step in (path, *path.parents):
            if step == self.path:
                break
            if step.is_symlink():
                raise FileFormatError(f"{step}: is a link, which is not followed; nothing was touched")
        return path

    def files(self, inner: str = "") -> list[Path]:
        """Our files in the folder, or in a folder within, sorted."""
        top = self.path / inner
        if top.is_symlink() or not top.is_dir():
            return []
        found = sorted(entry for entry in top.iterdir() if _plain(entry))
        return [entry for entry in found if self._names.fullmatch(entry.relative_to(self.path).as_posix())]

    def make(self, inner: str) -> None:
        """Make a folder within.

        Raises:
            FileFormatError: if a link or a file has its name.
        """
        path = self.path / inner
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise FileFormatError(f"{path}: is no folder, or a link to one, which is not followed; move it away")
        path.mkdir(exist_ok=True)

    def remove(self, name: str) -> None:
        """Remove a file of ours, if it is there.

        Raises:
            FileFormatError: see `at`.
        """
        path = self.at(name)
        if _plain(path):
            path.unlink(missing_ok=True)

    def move(self, name: str, to: str) -> None:
        """Give a file of ours another name of ours.

        Raises:
            FileFormatError: see `at`.
        """
        os.replace(self.at(name), self.at(to))

    def clear(self, inner: str = "", *, keep: bool = False) -> list[str]:
        """Remove our files in the folder (or in a folder within), and the folder if nothing else is left.

        Args:
            inner: the folder within.
            keep: whether to keep the folder and its marker.

        Returns:
            The names of the entries that were left, since they are not ours.
        """
        top, marker = self.path / inner, "" if inner else self._marker
        for path in self.files(inner):
            if path.name != marker:
                path.unlink(missing_ok=True)
        remove_leftovers(top)
        left = sorted(entry.name for entry in top.iterdir() if entry.name != marker) if top.is_dir() else []
        if not (left or keep or top.is_symlink()):
            if marker:
                (top / marker).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                top.rmdir()
        return left
