"""The data of a 3D picture of a pack: grains, their quantities, and contact forces, frame by frame.

All that a picture shows is computed here; `web/view.js` only draws it.
"""

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gmem_jax.physics.material import Material
from gmem_jax.simulation.frames import Frames, images_met

COLOUR_RANGE = 0.995  # part of all values that a colour bar spans; the few larger ones have the last colour
MILLI = 1e3
_LEVELS = 65535  # steps of a number in a page: 1e-3 R in a box of 60 R


@dataclass(frozen=True)
class Colouring:
    """A quantity by which grains are coloured.

    Attributes:
        label: name of the quantity.
        unit: unit of the values; "" for a plain number.
        values: value of every grain in every frame, never below zero, [F, N].
    """

    label: str
    unit: str
    values: np.ndarray

    @property
    def top(self) -> float:
        """Highest value of the colours; 1 if all values are zero, or there are none."""
        if not self.values.size:
            return 1.0
        return float(np.quantile(self.values, COLOUR_RANGE)) or float(self.values.max()) or 1.0


@dataclass(frozen=True)
class Links:
    """Forces between grains that touch, of all frames one after the other.

    Attributes:
        start: rows of frame f are start[f] to start[f + 1], [F + 1].
        grains: numbers of both grains, [L, 2].
        force: size of their total force, friction included: the sum over the contacts of their spheres, [L], in E R^2.
    """

    start: np.ndarray
    grains: np.ndarray
    force: np.ndarray


def links(frames: Frames) -> Links:
    """The force network of grains from the contacts of their spheres."""
    pairs, forces = [], []
    for frame in range(frames.count):
        own = slice(frames.start[frame], frames.start[frame + 1])
        one, other = frames.spheres[own].T
        centres = frames.centres(frame)
        normal = centres[other] - centres[one] + images_met(frames, frame)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        force = frames.friction_force[own] - frames.normal_force[own, None] * normal
        touching, place = np.unique(frames.spheres[own] // len(frames.offsets), axis=0, return_inverse=True)
        total = np.zeros((len(touching), 3))
        np.add.at(total, place.ravel(), force)
        pairs.append(touching)
        forces.append(np.linalg.norm(total, axis=1))
    start = np.cumsum([0, *map(len, pairs)])
    return Links(start, np.concatenate(pairs), np.concatenate(forces))


def _of_grains(frames: Frames, start: np.ndarray, pairs: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sums [F, N] for each grain of the values [M] of its pairs [M, 2]; the rows of frame f begin at start[f]."""
    grains = frames.position.shape[1]
    frame = np.repeat(np.arange(frames.count), np.diff(start))
    sums = sum(np.bincount(frame * grains + side, values, frames.count * grains) for side in pairs.T)
    return np.asarray(sums).reshape(frames.count, grains)


def quantities(frames: Frames, network: Links, newton: float) -> list[Colouring]:
    """The quantities by which grains can be coloured, without those that are zero everywhere.

    Args:
        frames: the configurations; displacements are relative to the first.
        network: the forces between grains.
        newton: one E R^2, in N.
    """
    lower, lengths = frames.lower[:, None], (frames.upper - frames.lower)[:, None]
    carried = lower + (frames.position[:1] - lower[:1]) / lengths[:1] * lengths
    owners = frames.spheres // len(frames.offsets)
    friction = np.linalg.norm(frames.friction_force, axis=1)
    pushed, rubbed = (_of_grains(frames, frames.start, owners, x) for x in (frames.normal_force, friction))
    moved = [
        Colouring("displacement", "R", np.linalg.norm(frames.position - frames.position[:1], axis=2)),
        Colouring("non-affine displacement", "R", np.linalg.norm(frames.position - carried, axis=2)),
    ]
    sizes = [] if frames.sizes is None else [Colouring("size", "", np.tile(frames.sizes, (frames.count, 1)))]
    found = [
        Colouring("coordination", "", _of_grains(frames, network.start, network.grains, np.ones(len(network.force)))),
        Colouring("normal force, sum over contacts", "mN", MILLI * newton * pushed),
        Colouring("friction force, sum over contacts", "mN", MILLI * newton * rubbed),
    ]
    return (moved if frames.count > 1 else []) + [one for one in found if one.values.any()] + sizes


def packed(frames: Frames, captions: list[str], material: Material = Material()) -> str:
    """All data of a 3D view as one text: a line of JSON and the arrays that it lists, deflated and in base64.

    Numbers are kept in 16 bits, between their smallest and their largest.

    Args:
        frames: the configurations.
        captions: a caption of each configuration, [F].
        material: material of the grains, for forces in mN.
    """
    newton = float(material.modulus) * float(material.radius) ** 2
    network = links(frames)
    coloured = quantities(frames, network, newton)
    force = Colouring("force between grains", "mN", MILLI * newton * network.force)
    radii = np.ones(len(frames.offsets)) if frames.radii is None else frames.radii
    arrays: dict[str, np.ndarray] = {
        "position": frames.position,
        "quaternion": frames.quaternion,
        "lower": frames.lower,
        "upper": frames.upper,
        "start": network.start.astype(np.uint32),
        "ends": network.grains.astype(np.uint16 if frames.position.shape[1] <= _LEVELS else np.uint32),
        "force": force.values,
        "sizes": np.ones(frames.position.shape[1]) if frames.sizes is None else frames.sizes,
        **{f"quantity-{number}": one.values for number, one in enumerate(coloured)},
    }
    told, parts = [], []
    for name, array in arrays.items():
        row, raw = _short(array)
        told.append({"name": name, **row})
        parts.append(raw.tobytes() + bytes(-raw.nbytes % 4))
    scene = {
        "captions": captions,
        "grains": frames.position.shape[1],
        "spheres": np.column_stack([frames.offsets, radii]).tolist(),
        "quantities": [{"name": f"quantity-{number}", **_told(one)} for number, one in enumerate(coloured)],
        "force": _told(force),
        "arrays": told,
    }
    line = json.dumps(scene).encode() + b"\n"
    content = line + bytes(-len(line) % 4) + b"".join(parts)
    return base64.b64encode(zlib.compress(content, 9)).decode()


def _told(quantity: Colouring) -> dict[str, Any]:
    most = float(quantity.values.max(initial=0.0))
    return {"label": quantity.label, "unit": quantity.unit, "top": quantity.top, "most": most}


def _short(array: np.ndarray) -> tuple[Mapping[str, Any], np.ndarray]:
    """How to read an array, and the array as whole numbers; real numbers become 16-bit steps from the smallest."""
    if array.dtype.kind == "u":
        return {"kind": f"u{array.dtype.itemsize}", "length": array.size}, array
    low, high = float(array.min(initial=np.inf)), float(array.max(initial=-np.inf))
    if not high > low:  # no numbers, or all the same
        low, high = (low, low + 1.0) if array.size else (0.0, 1.0)
    step = (high - low) / _LEVELS
    levels = np.rint((array - low) / step).astype(np.uint16)
    return {"kind": "u2", "length": array.size, "low": low, "step": step}, levels
