"""What all HDF5 files of this package have in common: a seal, a schema, the configuration that made them, samples.

A file is sealed (see `seal`), holds nothing but what `tree` allows, and every array is compared with a declaration
before it is read. Files from before there were seals are copied into sealed ones on the fly.
"""

import io
import json
import subprocess
import sys
import tempfile
import warnings
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np

from gmem_jax.files import tree
from gmem_jax.files.atomic import FileFormatError, atomic
from gmem_jax.files.checked import Array, fit, refusing
from gmem_jax.files.seal import BLOCK, seal, sealed
from gmem_jax.physics.sample import Sample

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_PATIENCE, _PACE = 5.0, 2e7  # seconds, and bytes a second, that copying an old file may take
_SAMPLE = {  # what a stage records, by bins and replicas
    entry.name: ("bins", 3, "replicas") if entry.name in ("pressure", "lengths") else ("bins", "replicas")
    for entry in fields(Sample)
}
_LATER = "wall_contacts"  # NaN in older files, which lack it


class Content(tree.Tree):
    """A file that is open for reading: its attributes, and its arrays once they are found to be as declared."""

    @property
    def schema(self) -> str:
        """What kind of file it is, and in which version."""
        return str(self.attributes[""].get("schema", "none"))

    def text(self, name: str, group: str = "") -> str:
        """An attribute that is a text.

        Raises:
            FileFormatError: if it is missing, or none.
        """
        value = self.attributes.get(group, {}).get(name)
        if not isinstance(value, str):
            raise FileFormatError(f"incomplete file, attribute {name!r} is missing or not a text")
        return value

    def arrays(self, declared: Mapping[str, Array]) -> dict[str, np.ndarray]:
        """Arrays by path.

        Raises:
            FileFormatError: if one is missing, or has another shape or kind than declared.
        """
        fit(declared, self.datasets)
        return {path: self.datasets[path][()] for path in declared}

    def samples(self, group: str) -> OrderedDict[str, Sample]:
        """What `write_samples` wrote.

        Raises:
            FileFormatError: if it is incomplete, or shapes do not fit each other.
        """
        orders: dict[str, Any] = {
            path.removeprefix(f"{group}/"): own.get("order")
            for path, own in self.attributes.items()
            if path.startswith(f"{group}/")
        }
        if not all(isinstance(order, np.integer) for order in orders.values()):
            raise FileFormatError(f"incomplete file, the stages of {group!r} have no order")
        stages = OrderedDict()
        for stage in sorted(orders, key=orders.__getitem__):
            path = f"{group}/{stage}/"
            known = [name for name in _SAMPLE if name != _LATER or path + name in self.datasets]
            found = self.arrays({path + name: Array("real", _SAMPLE[name]) for name in known})
            own: Any = {name: found[path + name] for name in known}
            own.setdefault(_LATER, np.full_like(own["contacts"], np.nan))
            stages[stage] = Sample(**own)
        return stages


@contextmanager
def writing(path: Path, schema: str) -> Iterator[h5py.File]:
    """A new HDF5 file of a schema, which is sealed and takes its place if the block succeeds.

    Raises:
        OSError: if the path cannot be written.
    """
    # In memory first: libhdf5 may crash when a disk is full.
    content = io.BytesIO()
    with h5py.File(content, "w", userblock_size=BLOCK) as file:
        file.attrs["schema"] = schema
        file.attrs["units"] = "R = E = rho = 1"
        yield file
    with atomic(path) as temporary:
        temporary.write_bytes(content.getbuffer())
        seal(temporary)


@contextmanager
def reading(path: Path, *schemas: str) -> Iterator[Content]:
    """The content of an HDF5 file of one of these schemas; of any if none is given.

    Raises:
        FileNotFoundError: if there is none.
        FileFormatError: if it is damaged, is not HDF5, holds what it must not, or has another schema; and for whatever
            goes wrong in the block.
    """
    path = Path(path)
    with refusing(path, "HDF5 file"), path.open("rb") as raw, tempfile.TemporaryDirectory() as folder:
        if sealed(raw, path):
            source: BinaryIO = raw
        else:
            copied = _resealed(path, raw, Path(folder) / "copy.h5")
            source = copied.open("rb")
        with source, h5py.File(source, "r") as file:
            content = Content(file)
            if schemas and content.schema not in schemas:
                raise FileFormatError(f"{path}: schema is {content.schema[:40]!r}, expected {schemas[0]!r}")
            yield content


def _resealed(path: Path, raw: BinaryIO, copied: Path) -> Path:
    """A copy of a file that was written without a seal, made in a process of its own: libhdf5 trusts what it parses."""
    raw.seek(0)
    if raw.read(len(_SIGNATURE)) != _SIGNATURE:
        raise FileFormatError(f"{path}: not a readable HDF5 file (truncated?)")
    command = [sys.executable, "-I", tree.__file__, str(path.absolute()), str(copied)]
    patience = _PATIENCE + path.stat().st_size / _PACE
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=patience)
    except subprocess.TimeoutExpired:
        raise FileFormatError(f"{path}: not a readable HDF5 file (libhdf5 went on for {patience:.0f} s)") from None
    if done.returncode:
        said = done.stderr.strip().rpartition("\n")[2][:160] if done.returncode == 2 else "libhdf5 broke down"
        raise FileFormatError(f"{path}: not a readable HDF5 file (truncated?): {said}")
    warnings.warn(f"{path}: written before files had checksums: its numbers are plausible, no more", stacklevel=2)
    return copied


def schema_of(path: Path) -> str:
    """The schema of a file.

    Raises:
        FileNotFoundError: if there is none.
        FileFormatError: if it is not a readable HDF5 file.
    """
    with reading(path) as content:
        return content.schema


def write_samples(group: h5py.Group, stages: dict[str, Sample]) -> None:
    """A group for every stage, in order, with a dataset for each quantity."""
    for number, (name, sample) in enumerate(stages.items()):
        stage = group.create_group(name)
        stage.attrs["order"] = number
        for entry in fields(sample):
            stage.create_dataset(entry.name, data=np.asarray(getattr(sample, entry.name)))


def save_arrays(path: Path, schema: str, configuration: dict[str, Any], **arrays: np.ndarray | float) -> None:
    """Write named arrays with the configuration that made them.

    Raises:
        OSError: if the path cannot be written.
    """
    with writing(path, schema) as file:
        file.attrs["configuration"] = json.dumps(configuration)
        for name, array in arrays.items():
            file.create_dataset(name, data=np.asarray(array))
