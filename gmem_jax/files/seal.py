"""The seal of a file: its first 512 bytes hold the SHA-256 of all others, so that no flipped byte passes.

HDF5 calls such bytes a user block, zip archives a prefix; their readers step over them. The seal is checked on the raw
bytes, before any parser sees them. It shows damage, not forgery: whoever can write a file can seal it.
"""

import hashlib
import os
from pathlib import Path
from typing import BinaryIO

from gmem_jax.errors import FileFormatError

BLOCK = 512  # the smallest user block of HDF5
PART = "part of a run"
HDF5 = "HDF5 file"  # with `PART`, the kinds of files that `require_sealed` takes
_MARK = b"gmem sha256 "
_HDF5 = b"\x89HDF\r\n\x1a\n"
_PIECE = 1 << 20


def _block(file: BinaryIO) -> bytes:
    """The seal that belongs to the bytes of a file after the first 512."""
    file.seek(BLOCK)
    digest = hashlib.sha256()
    while piece := file.read(_PIECE):
        digest.update(piece)
    return (_MARK + digest.hexdigest().encode() + b"\n").ljust(BLOCK, b"\0")


def seal(path: Path) -> None:
    """Write the seal of a file whose first 512 bytes were left free.

    Raises:
        OSError: if it cannot be written.
    """
    with path.open("r+b") as file:
        block = _block(file)
        file.seek(0)
        file.write(block)


def _foreign(file: BinaryIO, what: str) -> str:
    """The kind of a file without a seal, as a reason to refuse it."""
    size = file.seek(0, os.SEEK_END)
    places = [0, *(BLOCK << shift for shift in range(max(0, (size // BLOCK).bit_length())))]  # where HDF5 may begin
    for place in places:
        file.seek(place)
        if file.read(len(_HDF5)) == _HDF5:
            return "it is HDF5 without our checksum, made or changed by another program"
    file.seek(0)
    begins = file.read(BLOCK)
    if not any(begins) or _MARK.startswith(begins):
        return "it was cut off" if size else "it is empty"
    return "it is not HDF5 at all" if what == HDF5 else "it has no checksum of ours: another program made it"


def require_sealed(file: BinaryIO, what: str) -> None:
    """Refuse a file, open for reading, whose seal does not fit.

    Args:
        file: the file; afterwards it stands at byte 512.
        what: the kind of file that is wanted, `PART` or `HDF5`.

    Raises:
        FileFormatError: if it has no seal, or was damaged after it was sealed.
    """
    file.seek(0)
    found = file.read(BLOCK)
    if not found.startswith(_MARK):
        raise FileFormatError(f"not a readable {what}: {_foreign(file, what)}")
    if found != _block(file):
        advice = "" if what == PART else "; restore it, or make it anew"
        raise FileFormatError(f"damaged, its checksum does not fit its content{advice}")
    file.seek(BLOCK)
