"""Reading and writing packs: files, the packs that ship with the package, and those made by name."""

import re
from collections import OrderedDict
from importlib import resources
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.pack import Pack
from gmem_jax.files import pack_validation
from gmem_jax.files.cache import kept_pack, list_packs
from gmem_jax.files.frames import check_frames, write_frames
from gmem_jax.files.hdf5 import reading, stored_axes, write_arrays, write_samples, writing
from gmem_jax.files.schemas import PACK, UNEQUAL
from gmem_jax.files.validation import fit, json_of, refusing, require, title
from gmem_jax.physics.boundary import PeriodicAxes, boundary_of
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.pairs import listed_candidates, tabulate
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.frames import Frames
from gmem_jax.simulation.sample import Sample

STANDARD_NAME = re.compile(r"tetra-([1-9][0-9]{1,6})-([a-z])")
"""Names of standard packs: the number of tetra grains, and a letter for the seed, a for 1."""

_CLUMP = [path.removeprefix("clump/") for path in PACK.arrays if path.startswith("clump/")]
_PAIRS = [path.removeprefix("pairs/") for path in PACK.arrays if path.startswith("pairs/")]
_OWN = [path for path in PACK.arrays if "/" not in path]


def _arrays(pack: Pack) -> dict[str, Any]:
    """The arrays of a pack that `PACK` declares, by path."""
    values: dict[str, Any] = {name: getattr(pack, name) for name in _OWN}
    values |= {f"clump/{name}": getattr(pack.clump, name) for name in _CLUMP}
    values |= {f"clump/{name}": own for name in UNEQUAL if (own := getattr(pack.clump, name)) is not None}
    values |= {f"pairs/{name}": getattr(pack.pairs, name) for name in ("smallest", "reach")}
    reference = np.asarray(pack.pairs.reference)[..., 0]
    return {**values, "pairs/candidates": listed_candidates(pack.pairs), "pairs/reference": reference}


@usual_rules()
def save_pack(
    path: str | Path, pack: Pack, stages: dict[str, Sample] | None = None, frames: Frames | None = None
) -> None:
    """Write a pack to an HDF5 file.

    Args:
        path: the file.
        pack: the pack.
        stages: samples of the stages of its preparation by name (`log` of `prepare`); default none.
        frames: configurations along its preparation (`film` of `prepare`); default none.

    Raises:
        FileFormatError: if `load_pack` would refuse it, saying why; nothing is written.
        OSError: if the path cannot be written.
    """
    require_kind("save_pack(path, pack)", pack, Pack)
    try:
        check_pack(pack)
        if frames is not None:
            check_frames(frames)
        for name in stages or {}:
            require(title(name) and name.strip(".") and "/" not in name, f"{name!r:.50} is no name of a stage")
    except FileFormatError as error:
        raise FileFormatError(f"{path}: is not written, since it could not be read: {error}") from error
    clump, values = pack.clump, _arrays(pack)
    with writing(Path(path), PACK.name) as file:
        file.attrs["name"] = pack.name
        file.attrs["record"] = pack.record
        if any(pack.periodic):
            file.attrs["boundary"] = boundary_of(pack.periodic)
        write_arrays(file, PACK.declared(values), values)
        file["clump"].attrs["shape"] = clump.shape
        file["clump"].attrs["isotropic"] = clump.isotropic
        if stages:
            write_samples(file.create_group("stages"), stages)
        if frames is not None:
            write_frames(file, frames)


def check_pack(pack: Pack) -> None:
    """Refuse a pack that could not be read from its file; see `pack_validation`.

    Raises:
        FileFormatError: saying what is wrong.
    """
    arrays = {path: np.asarray(array) for path, array in _arrays(pack).items()}
    fit(PACK.declared(arrays), arrays)
    require(
        all(array.dtype != np.float32 for array in arrays.values()),
        'its numbers are in single precision: call jax.config.update("jax_enable_x64", True) before it is made or read',
    )
    _check(arrays, pack.periodic, pack.clump.isotropic, pack.name, pack.clump.shape, pack.record)


def _check(
    found: dict[str, np.ndarray], periodic: PeriodicAxes, isotropic: Any, label: Any, shape: Any, record: Any
) -> None:
    """The checks of a pack that is written or read."""
    require(
        isinstance(isotropic, bool | np.bool_), "incomplete file, attribute 'isotropic' is missing or not a truth value"
    )
    require(title(label) and title(shape), "its name or that of its grain is not a short line of text")
    pack_validation.check_arrays(found, isotropic=bool(isotropic), record=json_of(record, "record"), periodic=periodic)


@usual_rules()
def load_pack(source: str | Path) -> Pack:
    """Read a pack, its neighbour list included.

    Args:
        source: path of a file, name of a shipped pack (see `list_packs`), or name of one that `gmem prepare NAME` made.

    Raises:
        FileNotFoundError: if there is no such file or pack.
        FileFormatError: if the file is damaged, is no complete pack, or its numbers cannot be those of grains at rest
            in their box (see `gmem_jax.files.pack_validation`).
    """
    path = _path_of(source)
    with refusing(path, "pack"):
        with reading(path, PACK.name) as content:
            found = content.arrays(PACK.declared(content.datasets))
            label, record, shape = content.text("name"), content.text("record"), content.text("shape", "clump")
            isotropic, periodic = content.attributes["clump"].get("isotropic"), stored_axes(content)
        _check(found, periodic, isotropic, label, shape, record)
        require(
            path != pack_called(str(source)) or label == str(source),
            f"it is the pack {label}, not {source}: files were exchanged; make it again with gmem prepare",
        )
        own = {key: jnp.asarray(found[f"clump/{key}"]) for key in (*_CLUMP, *UNEQUAL) if f"clump/{key}" in found}
        clump = Clump(**own, isotropic=bool(isotropic), shape=shape)
        listed, reference, smallest, reach = (found[f"pairs/{key}"] for key in _PAIRS)
        radii = clump.sphere_radii(len(reference))
        pairs = tabulate(
            listed, reference[..., None], smallest, float(reach), clump.spheres, periodic=periodic, radii=radii
        )
        numbers: dict[str, Any] = {key: jnp.asarray(found[key]) for key in _OWN}
        return Pack(
            clump=clump, pairs=pairs, periodic=periodic, name=label, record=record, source=str(source), **numbers
        )


def load_stages(source: str | Path) -> OrderedDict[str, Sample]:
    """The samples of a pack's preparation, where its file keeps them; else empty.

    Raises:
        FileNotFoundError: if there is no such file or pack; see `load_pack`.
        FileFormatError: if they are incomplete.
    """
    path = _path_of(source)
    with refusing(path, "pack"), reading(path, PACK.name) as content:
        return content.samples("stages")


def _path_of(source: str | Path) -> Path:
    name, path = str(source), Path(source)
    if known := pack_called(name):
        return known
    if not path.is_file() and path.suffix == "":
        how = f"; `gmem prepare {name}` makes it" if STANDARD_NAME.fullmatch(name) else ""
        raise FileNotFoundError(f"{name}: neither a file nor a shipped pack ({', '.join(list_packs())}){how}")
    return path


def pack_called(name: str) -> Path | None:
    """The file of a pack that ships with the package or was made by its name; None if there is no such pack."""
    if name in list_packs():
        return Path(str(resources.files("gmem_jax") / "packs" / f"{name}.h5"))
    made = kept_pack(name)
    return made if made and STANDARD_NAME.fullmatch(name) and made.is_file() else None
