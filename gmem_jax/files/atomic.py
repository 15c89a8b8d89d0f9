"""Files that are whole or not there: written under a temporary name, flushed to disk, and renamed."""

import contextlib
import errno
import os
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG)


class FileFormatError(ValueError):
    """A file that is not what it should be; the message names the file, what is wrong and what would be right."""


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place, fsynced, if the block succeeds, and vanishes if it fails.

    Raises:
        OSError: if the folder cannot be written.
    """
    path = Path(path)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and (reason := _of_the_disk(error)):
            raise OSError(f"{path}: cannot be written ({reason}); whatever was there is untouched") from error
        raise


def _of_the_disk(error: OSError) -> str:
    """What a disk refused a writer, in words; h5py says the number in its message only."""
    told = re.search(r"errno = (\d+)", str(error))
    number = error.errno or (int(told[1]) if told else 0)
    return os.strerror(number) if number in _DISK else ""


def probe(folder: Path) -> None:
    """Make sure that a folder can be written.

    Raises:
        OSError: if it cannot.
    """
    handle, name = tempfile.mkstemp(dir=folder, prefix=".gmem-", suffix=".tmp")
    os.close(handle)
    Path(name).unlink()


def sweep(folder: Path, name: str = "", *, age: float = 0.0) -> None:
    """Remove what killed writers left behind: temporary files of the files in a folder (or of one of them).

    Args:
        folder: where they are.
        name: of the one file; default all.
        age: in s: younger ones may be those of living writers.
    """
    for left in Path(folder).glob(f".{name}.*.tmp" if name else ".*.tmp"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime >= age:
                left.unlink()
