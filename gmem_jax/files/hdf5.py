"""The common parts of all HDF5 files of this package: seal, schema, configuration, samples.

A file is sealed (see `seal`) and holds only items that `tree` allows. Every array is compared with its declaration
before it is read.
"""

import io
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
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
from gmem_jax.physics.boundary import WALLS, PeriodicAxes, periodic_axes
from gmem_jax.simulation.sample import MEASURED, Sample, ends_of_bins

OBSERVED = "observed_"  # prefix of the arrays of observers


class Content(Tree):
    """A file that is open for reading: its attributes, and its arrays, which are compared with their declarations."""

    @property
    def schema(self) -> str:
        """The kind of the file with its version, like "gmem-pack/0.1"."""
        return str(self.attributes[""].get("schema", "none"))

    def text(self, name: str, group: str = "") -> str:
        """An attribute that is a text.

        Raises:
            FileFormatError: if it is missing, or not a text.
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
        """The samples by stage that `write_samples` wrote.

        Raises:
            FileFormatError: if they are incomplete, or shapes do not fit each other.
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
            observed = {
                name.removeprefix(path): dataset
                for name, dataset in self.datasets.items()
                if name.startswith(path + OBSERVED)
            }
            declared = {name: STAGE[name] for name in MEASURED}
            declared |= {name: observed_array(name, len(dataset.shape)) for name, dataset in observed.items()}
            found = self.arrays({path + name: array for name, array in declared.items()})
            own: Any = {name: found[path + name] for name in MEASURED}
            seen = {name.removeprefix(OBSERVED): found[path + name] for name in observed}
            u = np.broadcast_to(own["u"][:, None], own["filling"].shape)
            stages[stage] = Sample(**{**own, "u": u}, observed=OrderedDict(seen) or None)
        return stages


def observed_array(name: str, dimensions: int, units: str = "", words: str = "") -> Array:
    """The declaration of an observer's array: bins, dimensions of its own, replicas."""
    own = (f"{name}_{number}" for number in range(1, dimensions - 1))
    return Array("real", ("time", *own, "replica"), units, words)


@contextmanager
def writing(path: Path, schema: str) -> Iterator[h5py.File]:
    """A new HDF5 file of a schema; it is sealed and moved to its path if the block succeeds.

    Raises:
        OSError: if the path cannot be written.
    """
    # It is made in memory first, since libhdf5 may crash when a disk is full.
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
    """The content of an HDF5 file of a schema, or of any schema if none is given.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it is damaged, is not HDF5, holds items that are not allowed, or has another schema; and for
            any error in the block.
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
        FileNotFoundError: if there is no such file.
        FileFormatError: if it is not a readable HDF5 file.
    """
    with reading(path) as content:
        return content.schema


def stored_axes(content: Content, group: str = "") -> PeriodicAxes:
    """The periodic axes according to the attribute `boundary`; none if it is missing.

    Raises:
        FileFormatError: if the attribute is not that of a boundary.
    """
    if "boundary" not in content.attributes.get(group, {}):
        return WALLS
    try:
        return periodic_axes(content.text("boundary", group))
    except ValueError as error:
        raise FileFormatError(str(error)) from error


def write_arrays(group: h5py.Group, declared: Mapping[str, Array], values: Mapping[str, Any]) -> None:
    """Write arrays at their paths, each with its units, its description, and scales for its dimensions.

    The scale of a dimension is the array of its name, in the group or in the file. If there is none, a scale that
    counts from 0 is added to the file.

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
    dataset.attrs.update(declared.attributes)
    if values.dtype.kind == "S":
        dataset.attrs["_Encoding"] = "utf-8"  # tells xarray that these bytes are texts
    return dataset


def _scale(group: h5py.Group, name: str, length: int) -> h5py.Dataset:
    at = group if name in group else group.file
    if name not in at:
        words = DIMENSIONS.get(name, "number")
        _described(at, name, np.arange(length, dtype="i4"), Array("whole", (name,), "1", words))
    if not at[name].is_scale:
        at[name].make_scale(name)
    return at[name]


def write_samples(
    group: h5py.Group,
    stages: Mapping[str, Sample],
    begins: Mapping[str, int] | None = None,
    observed: Mapping[str, Mapping[str, str]] | None = None,
) -> None:
    """Write a group for every stage, in order, with a dataset for each quantity.

    Args:
        group: the group that gets these groups.
        stages: samples by stage.
        begins: see `ends_of_bins`.
        observed: unit and description of the arrays of observers, by name.
    """
    times = ends_of_bins(stages, begins)
    for number, (name, sample) in enumerate(stages.items()):
        stage = group.create_group(name)
        stage.attrs["order"] = number
        wide = np.shape(sample.filling)[1]
        values = {**vars(sample), "time": times[name], "u": np.asarray(sample.u)[:, 0]}
        declared = dict(STAGE)
        for name, seen in (sample.observed or {}).items():
            known = (observed or {}).get(name, {})
            values[OBSERVED + name] = np.asarray(seen, float)
            declared[OBSERVED + name] = observed_array(OBSERVED + name, np.ndim(seen), **known)
        write_arrays(
            stage, declared if wide > 1 else {name: _common(array) for name, array in declared.items()}, values
        )


def _common(array: Array) -> Array:
    return array._replace(shape=tuple("common" if one == "replica" else one for one in array.shape))
