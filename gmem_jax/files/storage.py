"""HDF5 files: packs and recalls, each with a schema version and the configuration that made it.

A file is written under a temporary name, flushed to disk, and renamed: what carries the final name is complete.
"""

import json
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from importlib import resources
from pathlib import Path
from typing import Any

import h5py
import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.signals import Samples
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.pairs import candidates, tabulate
from gmem_jax.physics.step import Sample

PACK_SCHEMA = "gmem-pack/1"
RECALL_SCHEMA = "gmem-recall/1"


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
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def _reading(path: Path, schema: str) -> Iterator[h5py.File]:
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


def _write_samples(group: h5py.Group, stages: dict[str, Sample]) -> None:
    for number, (name, sample) in enumerate(stages.items()):
        stage = group.create_group(name)
        stage.attrs["order"] = number
        for entry in fields(sample):
            stage.create_dataset(entry.name, data=np.asarray(getattr(sample, entry.name)))


def _read_samples(group: h5py.Group) -> dict[str, Sample]:
    stages = sorted(group.items(), key=lambda item: int(item[1].attrs["order"]))
    return {name: Sample(**{entry.name: stage[entry.name][()] for entry in fields(Sample)}) for name, stage in stages}


def save_pack(path: Path, pack: Pack, stages: dict[str, Sample] | None = None) -> None:
    """Write a pack, and the time series of its preparation if given.

    Raises:
        OSError: if the path cannot be written.
    """
    with atomic(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["schema"] = PACK_SCHEMA
        file.attrs["name"] = pack.name
        file.attrs["record"] = pack.record
        file.attrs["units"] = "R = E = rho = 1"
        for key in ("position", "quaternion", "lower", "upper", "delta0", "ringing_period"):
            file.create_dataset(key, data=np.asarray(getattr(pack, key)))
        clump = file.create_group("clump")
        clump.attrs["shape"] = pack.clump.shape
        clump.attrs["isotropic"] = pack.clump.isotropic
        for key in ("offsets", "mass", "inertia", "diameter"):
            clump.create_dataset(key, data=np.asarray(getattr(pack.clump, key)))
        pairs = file.create_group("pairs")
        pairs.create_dataset("candidates", data=candidates(pack.pairs))
        pairs.create_dataset("reference", data=np.asarray(pack.pairs.reference)[..., 0])
        for key in ("smallest", "reach"):
            pairs.create_dataset(key, data=np.asarray(getattr(pack.pairs, key)))
        if stages:
            _write_samples(file.create_group("stages"), stages)


def load_pack(source: str | Path) -> Pack:
    """Read a pack from a file, or a shipped one by name (see `list_packs`), neighbour list included.

    Raises:
        FileNotFoundError: if there is neither such a file nor such a shipped pack.
        FileFormatError: if the file is not a complete pack of this schema.
    """
    name = str(source)
    if name in list_packs():
        path = Path(str(resources.files("gmem_jax") / "packs" / f"{name}.h5"))
    else:
        path = Path(source)
        if not path.is_file() and path.suffix == "":
            raise FileNotFoundError(f"{name}: neither a file nor a shipped pack ({', '.join(list_packs())})")
    with _reading(path, PACK_SCHEMA) as file:
        group = file["clump"]
        clump = Clump(
            **{key: jnp.asarray(group[key][()]) for key in ("offsets", "mass", "inertia", "diameter")},
            isotropic=bool(group.attrs["isotropic"]),
            shape=str(group.attrs["shape"]),
        )
        arrays = {
            key: file[key][()] for key in ("position", "quaternion", "lower", "upper", "delta0", "ringing_period")
        }
        listed = file["pairs"]
        found, reference, smallest, reach = (
            listed[key][()] for key in ("candidates", "reference", "smallest", "reach")
        )
        title, record = str(file.attrs["name"]), str(file.attrs["record"])
    for key, array in arrays.items():
        if not np.all(np.isfinite(array)):
            raise FileFormatError(f"{path}: {key} holds numbers that are not finite")
    pairs = tabulate(found, reference[..., None], smallest, float(reach), clump.spheres, spare=1.0)
    return Pack(
        clump=clump, pairs=pairs, name=title, record=record, **{key: jnp.asarray(a) for key, a in arrays.items()}
    )


def list_packs() -> list[str]:
    """Names of the packs that ship with the package."""
    folder = resources.files("gmem_jax") / "packs"
    if not folder.is_dir():
        return []
    return sorted(entry.name.removesuffix(".h5") for entry in folder.iterdir() if entry.name.endswith(".h5"))


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
        _write_samples(file.create_group("stages"), recall.stages)


def load_recall(path: Path) -> tuple[Recall, dict[str, Any]]:
    """Read a recall and its configuration.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is not a complete recall of this schema.
    """
    with _reading(path, RECALL_SCHEMA) as file:
        values = {entry.name: file[entry.name][()] for entry in fields(Recall) if entry.name != "stages"}
        return Recall(**values, stages=_read_samples(file["stages"])), json.loads(file.attrs["configuration"])


class Parts:
    """Finished parts of a long run, in a folder beside its output: what `run_memory` takes as `keep`.

    Args:
        folder: made if it is missing.
        key: what the parts depend on; stored with them.

    Raises:
        FileFormatError: if the folder holds parts of another run.
        OSError: if it cannot be written.
    """

    def __init__(self, folder: Path, key: dict[str, Any]) -> None:
        self.folder = Path(folder)
        self.folder.mkdir(exist_ok=True)
        found, wanted = self.key_of(self.folder), json.loads(json.dumps(key))
        other = [name for name in wanted if found and found.get(name) != wanted[name]]
        if other:
            raise FileFormatError(
                f"{self.folder}: holds parts of an interrupted run with another {other[0]} "
                f"({found.get(other[0])!r}, now {wanted[other[0]]!r}); remove it, or choose another output"
            )
        with atomic(self.folder / "run.json") as temporary:
            temporary.write_text(json.dumps(wanted, indent=1))

    @staticmethod
    def key_of(folder: Path) -> dict[str, Any]:
        """The key stored in a folder of parts; empty if there is none."""
        card = Path(folder) / "run.json"
        key: dict[str, Any] = json.loads(card.read_text()) if card.is_file() else {}
        return key

    def __call__(self, name: str, run: Callable[[], Any]) -> Any:
        """The part of that name, its arrays as numpy arrays: read if it is there, else run and stored."""
        path = self.folder / f"{name}.pickle"
        if path.is_file():
            return pickle.loads(path.read_bytes())
        result = jax.tree.map(np.asarray, run())
        with atomic(path) as temporary:
            temporary.write_bytes(pickle.dumps(result))
        return result

    def finished(self) -> int:
        """Number of parts there are."""
        return len(list(self.folder.glob("*.pickle")))

    def discard(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder)


def load_waveforms(path: Path) -> np.ndarray:
    """Waveform samples [S, n] from a CSV (one column per signal) or NPY ([n] or [S, n]) file.

    Row k is I at u = k / (n + 1), k = 1..n. A CSV may have one header line.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it cannot be read as numbers, is ragged, or holds numbers that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        if path.suffix.lower() == ".npy":
            values = np.atleast_2d(np.asarray(np.load(path, allow_pickle=False), dtype=float))
        else:
            lines = [line for line in path.read_text().splitlines() if line.strip()]
            try:
                [float(cell) for cell in lines[0].split(",")] if lines else []
            except ValueError:
                lines = lines[1:]
            values = np.loadtxt(lines, delimiter=",", ndmin=2).T
    except (ValueError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path}: not a table of numbers ({error})") from error
    if values.ndim != 2 or values.shape[1] < 2:
        raise FileFormatError(f"{path}: a waveform needs at least 2 samples; found an array of shape {values.shape}")
    if not np.all(np.isfinite(values)):
        where = np.argwhere(~np.isfinite(values))[0]
        raise FileFormatError(f"{path}: sample {where[1] + 1} of signal {where[0] + 1} is not a finite number")
    return values


def save_waveforms(path: Path, signals: Samples) -> None:
    """Write waveforms as a CSV that `load_waveforms` and `gmem recall --signals` read: a column for every signal.

    Raises:
        OSError: if the path cannot be written.
    """
    values = np.asarray(signals.nodes)[:, 1:-1].T
    header = ",".join(f"signal_{number + 1}" for number in range(values.shape[1]))
    with atomic(path) as temporary:
        np.savetxt(temporary, values, delimiter=",", header=header, comments="", fmt="%.17g")


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
