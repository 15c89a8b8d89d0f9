"""The group /frames of HDF5 files: configurations along a run."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from gmem_jax.files.hdf5 import Content, reading, stored_axes, write_arrays
from gmem_jax.files.schemas import FRAMES, RUBBED, UNEQUAL
from gmem_jax.files.validation import Array, fit, refusing, require, require_finite, require_sizes, title, whole
from gmem_jax.physics.boundary import boundary_of
from gmem_jax.simulation.frames import Frames

GROUP = "frames"
_SOME = UNEQUAL | RUBBED  # arrays that not all frames have


def write_frames(file: h5py.File, frames: Frames) -> None:
    """Write frames into an open file."""
    group = file.create_group(GROUP)
    group.attrs["stages"] = json.dumps(frames.stages)
    group.attrs["signal"] = frames.signal
    if any(frames.periodic):
        group.attrs["boundary"] = boundary_of(frames.periodic)
    write_arrays(group, _declared(vars(frames)), vars(frames))


def _declared(found: Mapping[str, Any]) -> dict[str, Array]:
    """The declarations of the arrays that frames with these fields have."""
    return FRAMES | {name: array for name, array in _SOME.items() if found.get(name) is not None}


def read_frames(content: Content) -> Frames | None:
    """The frames of an open file; None if it has none.

    Raises:
        FileFormatError: if they are incomplete, or inconsistent.
    """
    if GROUP not in content.attributes:
        return None
    declared = _declared({name: content.datasets.get(f"{GROUP}/{name}") for name in _SOME})
    found = content.arrays({f"{GROUP}/{name}": array for name, array in declared.items()})
    stages, signal = json.loads(content.text("stages", GROUP)), content.attributes[GROUP].get("signal")
    require(isinstance(stages, list), "the stages of its frames must be a list of names")
    require(
        isinstance(signal, np.integer) and whole(int(signal)), "the signal of its frames must be a whole number from 0"
    )
    own = {name: found[f"{GROUP}/{name}"] for name in declared}
    periodic = stored_axes(content, GROUP)
    frames = Frames(**own, stages=tuple(stages), signal=int(signal), periodic=periodic)  # type: ignore[arg-type]
    check_frames(frames)
    return frames


def check_frames(frames: Frames) -> None:
    """Refuse frames that are inconsistent; a file with such frames cannot be read.

    Raises:
        FileFormatError: saying what is wrong.
    """
    fit(_declared(vars(frames)), vars(frames))
    require(all(map(title, frames.stages)), "the stages of its frames must be a list of names")
    require_finite({f"frames/{name}": getattr(frames, name) for name in FRAMES})
    start, spheres, rubbed = frames.start, frames.spheres, frames.wall_friction
    count, per_grain = frames.position.shape[1] * len(frames.offsets), len(frames.offsets)
    require_sizes(frames.radii, frames.sizes)
    if rubbed is not None:
        require_finite({"frames/wall_friction": rubbed})
        require(
            rubbed.shape[1] == count, f"the wall friction of its frames must have a row for each of its {count} spheres"
        )
    require(
        len(frames.time) == frames.count > 0,
        "its frames must have one time and one stage each, and there must be a frame",
    )
    require(count > 0, "its frames hold no spheres")
    require(frames.lower < frames.upper, "a frame has a lower wall that is not below the upper one")
    require(np.abs(np.linalg.norm(frames.quaternion, axis=-1) - 1.0) < 1e-9, "a frame has a quaternion not of length 1")
    whole_list = len(start) == frames.count + 1 and start[0] == 0 and start[-1] == len(spheres)
    require(
        whole_list and np.all(np.diff(start) >= 0), "the contacts of its frames must follow each other, frame by frame"
    )
    in_range = (spheres[:, 0] >= 0) & (spheres[:, 1] < count)
    apart = spheres[:, 0] // per_grain < spheres[:, 1] // per_grain
    require(in_range & apart, "a contact of its frames must be between spheres of two of its grains")


def load_frames(path: Path) -> Frames | None:
    """The configurations along the run that made a pack or a recall; None if none were kept.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is damaged, or its frames are inconsistent.
    """
    with refusing(path, "file with frames"), reading(path) as content:
        return read_frames(content)
