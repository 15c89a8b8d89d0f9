"""Atomic writing: files are written under a temporary name, flushed to disk, and moved into place."""

import contextlib
import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gmem_jax.files.ours import drop, place, temporary

_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG)


@contextmanager
def atomic(path: Path, *, flush: bool = True) -> Iterator[Path]:
    """A temporary path beside `path`; it takes the place of `path` if the block succeeds, and vanishes if it fails.

    Args:
        path: path of the file. If a command promised a new file, one that came there since is not replaced; see `ours`.
        flush: whether to flush the file to the disk, so that it survives a crash of the machine.

    Raises:
        FileExistsError: if there is a file where a new one was promised.
        OSError: if there is no such folder, or it cannot be written.
    """
    path, made = Path(path), None
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: folder {path.parent} does not exist")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder, and a file is needed; move it away, or name another")
    try:
        made = temporary(path)
        yield made
        if flush:
            with made.open("rb") as file:
                os.fsync(file.fileno())
        place(made, path)
    except BaseException as error:
        if made:
            drop(made)
        if isinstance(error, OSError) and (reason := _of_the_disk(error)):
            raise OSError(f"{path}: cannot be written ({reason}); whatever was there is untouched") from error
        raise


def _of_the_disk(error: OSError) -> str:
    """The reason in words if the disk refused to write, else ""; h5py gives the error number in its message only."""
    told = re.search(r"errno = (\d+)", str(error))
    number = error.errno or (int(told[1]) if told else 0)
    return os.strerror(number) if number in _DISK else ""


def probe(path: Path) -> None:
    """Make sure that a file of this name can be written.

    Raises:
        OSError: if it cannot.
    """
    with contextlib.suppress(FileNotFoundError):
        path.lstat()  # fails if the name is too long for the file system
    drop(temporary(path))
