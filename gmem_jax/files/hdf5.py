"""What all HDF5 files of this package have in common: a seal, a schema, the configuration that made them, samples.

A file is sealed (see `seal`), holds nothing but what `tree` allows, and every array is compared with a declaration
before it is read.
"""

import io
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gmem_jax.errors import FileFormatError
from gmem_jax.files.atomic import atomic
from gmem_jax.files.schemas import DIMENSIONS, STAGE, other_kind
from gmem_jax.files.seal import BLOCK, HDF5, require_sealed, seal
from gmem_jax.files.tree import Tree
from gmem_jax.files.validation import Array, fit, refusing
from gmem_jax.simulation.protocol import BINS
from gmem_jax.simulation.sample import Sample

_SAMPLE = tuple(entry.name for entry in fields(Sample))


class Content(Tree):
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
            found = self.arrays({path + name: STAGE[name] for name in _SAMPLE})
            own: Any = {name: found[path + name] for name in _SAMPLE}
            stages[stage] = Sample(**{**own, "u": np.broadcast_to(own["u"][:, None], own["filling"].shape)})
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
def reading(path: Path, schema: str = "") -> Iterator[Content]:
    """The content of an HDF5 file of a schema; of any if none is given.

    Raises:
        FileNotFoundError: if there is none.
        FileFormatError: if it is damaged, is not HDF5, holds what it must not, or has another schema; and for whatever
            goes wrong in the block.
    """
    path = Path(path)
    with refusing(path, HDF5), path.open("rb") as raw:
        require_sealed(raw, HDF5)
        with h5py.File(raw, "r") as file:
            content = Content(file)
            if schema and content.schema != schema:
                raise FileFormatError(f"{path}: {other_kind(content.schema, schema)}")
            yield content


def schema_of(path: Path) -> str:
    """The schema of a file.

    Raises:
        FileNotFoundError: if there is none.
        FileFormatError: if it is not a readable HDF5 file.
    """
    with reading(path) as content:
        return content.schema


def write_arrays(group: h5py.Group, declared: Mapping[str, Array], values: Mapping[str, Any]) -> None:
    """Write arrays at their paths, each with its units, its description, and scales for its dimensions.

    The scale of a dimension is the array of that name, in the group or in the file; where there is none, one that
    counts from 0 is put into the file.

    Raises:
        FileFormatError: if a value is missing, or has another shape or kind than declared.
    """
    arrays = {path: np.asarray(values[path]) for path in declared if path in values}
    fit(declared, arrays)
    written = {path: _described(group, path, arrays[path], declared[path]) for path in declared}
    for path, dataset in written.items():
        for place, name in enumerate(map(str, declared[path].shape)):
            if path != name:
                dataset.dims[place].attach_scale(_scale(group, name, dataset.shape[place]))


def _described(group: h5py.Group, path: str, values: np.ndarray, declared: Array) -> h5py.Dataset:
    dataset = group.create_dataset(path, data=values)
    dataset.attrs["units"], dataset.attrs["description"] = declared.units, declared.words
    if values.dtype.kind == "S":
        dataset.attrs["_Encoding"] = "utf-8"  # tells xarray that these bytes are texts
    return dataset


def _scale(group: h5py.Group, name: str, length: int) -> h5py.Dataset:
    at = group if name in group else group.file
    if name not in at:
        _described(at, name, np.arange(length, dtype="i4"), Array("whole", (name,), "1", DIMENSIONS[name]))
    if not at[name].is_scale:
        at[name].make_scale(name)
    return at[name]


def write_samples(group: h5py.Group, stages: Mapping[str, Sample]) -> None:
    """A group for every stage, in order, with a dataset for each quantity."""
    passed = 0
    for number, (name, sample) in enumerate(stages.items()):
        stage = group.create_group(name)
        stage.attrs["order"] = number
        bins, wide = np.shape(sample.filling)
        ends = np.arange(1, bins + 1)
        values = {**vars(sample), "time": (passed + ends) / BINS, "u": np.asarray(sample.u)[:, 0]}
        passed += bins
        write_arrays(stage, STAGE if wide > 1 else _COMMON, values)


_COMMON = {
    name: array._replace(shape=tuple("common" if one == "replica" else one for one in array.shape))
    for name, array in STAGE.items()
}
