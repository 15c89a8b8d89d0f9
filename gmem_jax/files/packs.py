"""Pack files, and the packs that ship with the package."""

from importlib import resources
from pathlib import Path
from typing import Any

import h5py
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.pack import Pack
from gmem_jax.files.atomic import FileFormatError, atomic
from gmem_jax.files.hdf5 import reading, write_samples
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.pairs import candidates, tabulate
from gmem_jax.physics.sample import Sample

PACK_SCHEMA = "gmem-pack/1"


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
            write_samples(file.create_group("stages"), stages)


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
    with reading(path, PACK_SCHEMA) as file:
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
    pairs = tabulate(found, reference[..., None], smallest, float(reach), clump.spheres)
    numbers: dict[str, Any] = {key: jnp.asarray(array) for key, array in arrays.items()}
    return Pack(clump=clump, pairs=pairs, name=title, record=record, source=name, **numbers)


def list_packs() -> list[str]:
    """Names of the packs that ship with the package."""
    folder = resources.files("gmem_jax") / "packs"
    if not folder.is_dir():
        return []
    return sorted(entry.name.removesuffix(".h5") for entry in folder.iterdir() if entry.name.endswith(".h5"))
