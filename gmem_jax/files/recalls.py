"""Recall files: what was measured, and the configuration that it belongs to."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gmem_jax.experiment.recall import Recall
from gmem_jax.files.atomic import atomic
from gmem_jax.files.hdf5 import read_samples, reading, write_samples

RECALL_SCHEMA = "gmem-recall/1"


def save_recall(path: Path, recall: Recall, configuration: dict[str, Any]) -> None:
    """Write a recall with its resolved configuration.

    Raises:
        OSError: if the path cannot be written.
    """
    with atomic(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["schema"] = RECALL_SCHEMA
        file.attrs["configuration"] = json.dumps(configuration)
        file.attrs["units"] = "R = E = rho = 1"
        for entry in fields(recall):
            if entry.name != "stages":
                file.create_dataset(entry.name, data=np.asarray(getattr(recall, entry.name)))
        write_samples(file.create_group("stages"), recall.stages)


def load_recall(path: Path) -> tuple[Recall, dict[str, Any]]:
    """Read a recall and its configuration.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is not a complete recall of this schema.
    """
    with reading(path, RECALL_SCHEMA) as file:
        values = {entry.name: file[entry.name][()] for entry in fields(Recall) if entry.name != "stages"}
        return Recall(**values, stages=read_samples(file["stages"])), json.loads(file.attrs["configuration"])
