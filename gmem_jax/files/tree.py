"""Checks of the structure of an HDF5 file before anything is read.

Files of this package hold groups, short attributes, and arrays of numbers or names that are stored in one piece.
Everything else that HDF5 can hold is refused: links and data in other files, virtual, compressed or unwritten data,
objects, and strings of variable length.
"""

from typing import Any

import h5py

DEPTH = 4  # most levels of groups within groups
ITEMS = 10_000  # most datasets and groups of a file
ATTRIBUTE = 1 << 26  # most bytes of an attribute
DTYPE_KINDS = "fiubS"  # kinds of numpy: real numbers, integers, booleans, texts of fixed length


class Tree:
    """The items of an open HDF5 file.

    Attributes:
        attributes: attributes of every group by its path ("" is the file).
        datasets: datasets by path; none has been read. Their attributes (units, descriptions, scales) are for other
            programs and are never read.

    Raises:
        ValueError: if there is anything that a file of this package never holds, naming it.
    """

    def __init__(self, file: h5py.File) -> None:
        self.attributes: dict[str, dict[str, Any]] = {"": _attributes(file, "the file")}
        self.datasets: dict[str, h5py.Dataset] = {}
        self._walk(file, "", DEPTH)

    def _walk(self, group: h5py.Group, above: str, depth: int) -> None:
        if depth == 0:
            raise ValueError(f"groups lie more than {DEPTH} deep")
        for name in group:
            path = f"{above}{name}"
            if len(self.attributes) + len(self.datasets) > ITEMS:
                raise ValueError(f"it holds more than {ITEMS} items")
            if type(group.get(name, getlink=True)) is not h5py.HardLink:
                raise ValueError(f"{path!r} is a link to elsewhere")
            item = group[name]
            if isinstance(item, h5py.Dataset):
                _require_plain(item, path)
                self.datasets[path] = item
            elif isinstance(item, h5py.Group):
                self.attributes[path] = _attributes(item, path)
                self._walk(item, f"{path}/", depth - 1)
            else:
                raise ValueError(f"{path!r} is neither a group nor an array")


def _attributes(item: h5py.Group, path: str) -> dict[str, Any]:
    found = {}
    for name in item.attrs:
        known = item.attrs.get_id(name)
        if known.shape != () or known.get_storage_size() > ATTRIBUTE:
            raise ValueError(f"attribute {name!r} of {path} is not a single value")
        if known.dtype.kind not in DTYPE_KINDS and h5py.check_string_dtype(known.dtype) is None:
            raise ValueError(f"attribute {name!r} of {path} is neither a number nor a text")
        value = item.attrs[name]
        found[name] = value.decode() if isinstance(value, bytes) else value
    return found


def _require_plain(array: h5py.Dataset, path: str) -> None:
    """Refuse an array that is not stored whole in this file, in one piece and uncompressed."""
    made = array.id.get_create_plist()
    if array.shape is None or array.dtype.kind not in DTYPE_KINDS:
        raise ValueError(f"{path!r} is not an array of numbers")
    if made.get_layout() not in (h5py.h5d.CONTIGUOUS, h5py.h5d.COMPACT) or made.get_nfilters():
        raise ValueError(f"{path!r} is not stored in one piece (chunked, compressed or virtual)")
    if made.get_external_count():
        raise ValueError(f"{path!r} is stored in another file")
    declared = array.dtype.itemsize
    for length in array.shape:
        declared *= int(length)
    stored = array.id.get_storage_size()
    if declared != stored or declared > array.file.id.get_filesize():
        raise ValueError(f"{path!r} declares shape {array.shape}, {declared} bytes; the file holds {stored} of them")
