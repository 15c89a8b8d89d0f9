"""Pack files, and the packs that ship with the package."""

from importlib import resources
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.frames import Frames
from gmem_jax.experiment.pack import Pack
from gmem_jax.files import soundness
from gmem_jax.files.checked import Array, json_of, refusing, require, title
from gmem_jax.files.frames import write_frames
from gmem_jax.files.hdf5 import reading, write_samples, writing
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.pairs import candidates, tabulate
from gmem_jax.physics.sample import Sample

PACK_SCHEMA = "gmem-pack/2"
_BEFORE = "gmem-pack/1"  # the same, without a seal

_OWN = {
    "position": Array("real", ("N", 3)),
    "quaternion": Array("real", ("N", 4)),
    "lower": Array("real", (3,)),
    "upper": Array("real", (3,)),
    "delta0": Array("real"),
    "ringing_period": Array("real"),
}
_CLUMP = {
    "offsets": Array("real", ("K", 3)),
    "mass": Array("real"),
    "inertia": Array("real", (3,)),
    "diameter": Array("real"),
}
_PAIRS = {
    "candidates": Array("whole", (2, "listed")),
    "reference": Array("real", ("spheres", 3)),
    "smallest": Array("real", (3,)),
    "reach": Array("real"),
}
_DECLARED = (
    _OWN
    | {f"clump/{name}": array for name, array in _CLUMP.items()}
    | {f"pairs/{name}": array for name, array in _PAIRS.items()}
)


def save_pack(path: Path, pack: Pack, stages: dict[str, Sample] | None = None, frames: Frames | None = None) -> None:
    """Write a pack, and the time series of its preparation and configurations along it if given.

    Raises:
        OSError: if the path cannot be written.
    """
    with writing(path, PACK_SCHEMA) as file:
        file.attrs["name"] = pack.name
        file.attrs["record"] = pack.record
        for key in _OWN:
            file.create_dataset(key, data=np.asarray(getattr(pack, key)))
        clump = file.create_group("clump")
        clump.attrs["shape"] = pack.clump.shape
        clump.attrs["isotropic"] = pack.clump.isotropic
        for key in _CLUMP:
            clump.create_dataset(key, data=np.asarray(getattr(pack.clump, key)))
        pairs = file.create_group("pairs")
        pairs.create_dataset("candidates", data=candidates(pack.pairs))
        pairs.create_dataset("reference", data=np.asarray(pack.pairs.reference)[..., 0])
        for key in ("smallest", "reach"):
            pairs.create_dataset(key, data=np.asarray(getattr(pack.pairs, key)))
        if stages:
            write_samples(file.create_group("stages"), stages)
        if frames is not None:
            write_frames(file, frames)


def load_pack(source: str | Path) -> Pack:
    """Read a pack from a file, or a shipped one by name (see `list_packs`), neighbour list included.

    Raises:
        FileNotFoundError: if there is neither such a file nor such a shipped pack.
        FileFormatError: if the file is damaged, not a complete pack of this schema, or its numbers are not those of
            grains at rest in their box (see `soundness`).
    """
    name = str(source)
    if name in list_packs():
        path = Path(str(resources.files("gmem_jax") / "packs" / f"{name}.h5"))
    else:
        path = Path(source)
        if not path.is_file() and path.suffix == "":
            raise FileNotFoundError(f"{name}: neither a file nor a shipped pack ({', '.join(list_packs())})")
    with refusing(path, "pack"):
        with reading(path, PACK_SCHEMA, _BEFORE) as content:
            found = content.arrays(_DECLARED)
            label, record, shape = content.text("name"), content.text("record"), content.text("shape", "clump")
            isotropic = content.attributes["clump"].get("isotropic")
        require(
            isinstance(isotropic, np.bool_), "incomplete file, attribute 'isotropic' is missing or not a truth value"
        )
        require(title(label) and title(shape), "its name or that of its grain is not a short line of text")
        soundness.check(found, isotropic=bool(isotropic), record=json_of(record, "record"))
        clump = Clump(
            **{key: jnp.asarray(found[f"clump/{key}"]) for key in _CLUMP}, isotropic=bool(isotropic), shape=shape
        )
        listed, reference, smallest, reach = (found[f"pairs/{key}"] for key in _PAIRS)
        pairs = tabulate(listed, reference[..., None], smallest, float(reach), clump.spheres)
        numbers: dict[str, Any] = {key: jnp.asarray(found[key]) for key in _OWN}
        return Pack(clump=clump, pairs=pairs, name=label, record=record, source=name, **numbers)


def list_packs() -> list[str]:
    """Names of the packs that ship with the package."""
    folder = resources.files("gmem_jax") / "packs"
    if not folder.is_dir():
        return []
    return sorted(entry.name.removesuffix(".h5") for entry in folder.iterdir() if entry.name.endswith(".h5"))
