"""Configurations along a run in HDF5 files: the group /frames."""

import json
from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np

from gmem_jax.experiment.frames import Frames
from gmem_jax.files.checked import Array, refusing, require, require_finite, title, whole
from gmem_jax.files.hdf5 import Content, reading

GROUP = "frames"
_DECLARED = {  # kind, shape, unit, what it is
    "time": (Array("real", ("F",)), "t_c", "since the beginning"),
    "u": (Array("real", ("F",)), "1", "compression, from 0 to 1"),
    "position": (Array("real", ("F", "N", 3)), "R", "grain centres"),
    "quaternion": (Array("real", ("F", "N", 4)), "1", "body-to-lab rotations (w, x, y, z)"),
    "lower": (Array("real", ("F", 3)), "R", "lower planes of the box"),
    "upper": (Array("real", ("F", 3)), "R", "upper planes of the box"),
    "start": (Array("whole", ("starts",)), "1", "contacts of frame f are rows start[f] to start[f + 1]"),
    "spheres": (Array("whole", ("M", 2)), "1", "the two spheres i < j that touch; sphere k of grain n is n K + k"),
    "normal_force": (Array("real", ("M",)), "E R^2", "by which they repel each other"),
    "friction_force": (Array("real", ("M", 3)), "E R^2", "tangential force on sphere i, the opposite of that on j"),
    "offsets": (Array("real", ("K", 3)), "R", "sphere centres of a grain in its own frame"),
}


def write_frames(file: h5py.File, frames: Frames) -> None:
    """Write them into a file that is open."""
    group = file.create_group(GROUP)
    group.attrs["stages"] = json.dumps(frames.stages)
    group.attrs["signal"] = frames.signal
    for name, (_, unit, words) in _DECLARED.items():
        array = group.create_dataset(name, data=np.asarray(getattr(frames, name)))
        array.attrs["units"], array.attrs["description"] = unit, words


def read_frames(content: Content) -> Frames | None:
    """The frames of an open file; None if it has none.

    Raises:
        FileFormatError: if they are incomplete, or do not fit each other.
    """
    if GROUP not in content.attributes:
        return None
    found = content.arrays({f"{GROUP}/{name}": array for name, (array, *_) in _DECLARED.items()})
    stages, signal = json.loads(content.text("stages", GROUP)), content.attributes[GROUP].get("signal")
    require(isinstance(stages, list) and all(map(title, stages)), "the stages of its frames are no names")
    require(isinstance(signal, np.integer) and whole(int(signal)), "the signal of its frames is no number")
    own = {name: found[f"{GROUP}/{name}"] for name in _DECLARED}
    frames = Frames(**own, stages=tuple(stages), signal=int(signal))  # type: ignore[arg-type]
    _check(frames)
    return frames


def _check(frames: Frames) -> None:
    require_finite({f"frames/{entry.name}": getattr(frames, entry.name) for entry in fields(frames)[:11]})
    start, spheres = frames.start, frames.spheres
    count, per_grain = frames.position.shape[1] * len(frames.offsets), len(frames.offsets)
    require(len(frames.time) == frames.count > 0, "its frames and their stages are not of one number")
    require(count > 0, "its frames hold no spheres")
    require(frames.lower < frames.upper, "a frame has a lower wall that is not below the upper one")
    require(np.abs(np.linalg.norm(frames.quaternion, axis=-1) - 1.0) < 1e-9, "a frame has a quaternion not of length 1")
    whole_list = len(start) == frames.count + 1 and start[0] == 0 and start[-1] == len(spheres)
    require(whole_list and np.all(np.diff(start) >= 0), "the contacts of its frames are not one after the other")
    in_range = (spheres[:, 0] >= 0) & (spheres[:, 1] < count)
    apart = spheres[:, 0] // per_grain < spheres[:, 1] // per_grain
    require(in_range & apart, "a contact of its frames is none of two grains")


def load_frames(path: Path) -> Frames | None:
    """The configurations along the run that made a pack or a recall; None if none were kept.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is damaged, or they do not fit each other.
    """
    with refusing(path, "file with frames"), reading(path) as content:
        return read_frames(content)
