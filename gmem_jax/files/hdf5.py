"""What all HDF5 files of this package have in common: a schema, the configuration that made them, samples of stages."""

import json
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gmem_jax.files.atomic import FileFormatError, atomic
from gmem_jax.physics.sample import Sample


@contextmanager
def reading(path: Path, schema: str) -> Iterator[h5py.File]:
    """An HDF5 file of the given schema.

    Raises:
        FileNotFoundError: if there is none.
        FileFormatError: if it is truncated, is not HDF5, misses data, or has another schema.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            found = file.attrs.get("schema", "none")
            if found != schema:
                raise FileFormatError(f"{path}: schema is {found!r}, expected {schema!r}")
            yield file
    except OSError as error:
        raise FileFormatError(f"{path}: not a readable HDF5 file (truncated?)") from error
    except KeyError as error:
        raise FileFormatError(f"{path}: incomplete file, {error.args[0]}") from error


def schema_of(path: Path) -> str:
    """The schema of a file.

    Raises:
        FileNotFoundError: if there is none.
        FileFormatError: if it is not a readable HDF5 file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            return str(file.attrs.get("schema", "none"))
    except OSError as error:
        raise FileFormatError(f"{path}: not a readable HDF5 file (truncated?)") from error


def write_samples(group: h5py.Group, stages: dict[str, Sample]) -> None:
    """A group for every stage, in order, with a dataset for each quantity."""
    for number, (name, sample) in enumerate(stages.items()):
        stage = group.create_group(name)
        stage.attrs["order"] = number
        for entry in fields(sample):
            stage.create_dataset(entry.name, data=np.asarray(getattr(sample, entry.name)))


def read_samples(group: h5py.Group) -> OrderedDict[str, Sample]:
    """What `write_samples` wrote."""
    stages = sorted(group.items(), key=lambda item: int(item[1].attrs["order"]))
    names = [entry.name for entry in fields(Sample)]
    return OrderedDict((key, Sample(**{name: stage[name][()] for name in names})) for key, stage in stages)


def save_arrays(path: Path, schema: str, configuration: dict[str, Any], **arrays: np.ndarray | float) -> None:
    """Write named arrays with the configuration that made them.

    Raises:
        OSError: if the path cannot be written.
    """
    with atomic(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["schema"] = schema
        file.attrs["configuration"] = json.dumps(configuration)
        file.attrs["units"] = "R = E = rho = 1"
        for name, array in arrays.items():
            file.create_dataset(name, data=np.asarray(array))
