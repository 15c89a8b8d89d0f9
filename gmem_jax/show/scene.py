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

COLOUR_RANGE = 0.995  # part of all values that a colour bar spans: the few beyond it have the last colour
MILLI = 1e3
_LEVELS = 65535  # of a number in a page: 1e-3 R in a box of 60 R


@dataclass(frozen=True)
class Colouring:
    """What grains are coloured by.

    Attributes:
        label: what it is.
        unit: of the values; "" for a plain number.
        values: of every grain in every frame, none below zero, [F, N].
    """

    label: str
    unit: str
    values: np.ndarray

    @property
    def top(self) -> float:
        """Where the colours end; 1 where all is zero, or nothing is there."""
        if not self.values.size:
            return 1.0
        return float(np.quantile(self.values, COLOUR_RANGE)) or float(self.values.max()) or 1.0


@dataclass(frozen=True)
class Links:
    """Forces between grains that touch, of all frames one after the other.

    Attributes:
        start: where those of a frame begin, and where the last end, [F + 1].
        grains: the two, [L, 2].
        force: size of the sum over the contacts of their spheres, friction included, [L], in E R^2.
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
    """Sums [F, N] of values [M] over the pairs of grains [M, 2] that a grain is one of, frames beginning at `start`."""
    grains = frames.position.shape[1]
    frame = np.repeat(np.arange(frames.count), np.diff(start))
    sums = sum(np.bincount(frame * grains + side, values, frames.count * grains) for side in pairs.T)
    return np.asarray(sums).reshape(frames.count, grains)


def quantities(frames: Frames, network: Links, newton: float) -> list[Colouring]:
    """What grains can be coloured by; nothing that is zero everywhere, as friction in a pack at rest.

    Args:
        frames: the configurations; displacements are those since the first.
        network: their forces.
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
    """All that a 3D view draws as one text: base64 of deflated bytes, a line of JSON and the arrays that it lists.

    Numbers are kept in 16 bits, between their smallest and their largest.

    Args:
        frames: the configurations.
        captions: what is said of each, [F].
        material: of the grains, for forces in mN.
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
    """An array as whole numbers, and how to read them: real ones in 16 bits from their smallest in equal steps."""
    if array.dtype.kind == "u":
        return {"kind": f"u{array.dtype.itemsize}", "length": array.size}, array
    low, high = float(array.min(initial=np.inf)), float(array.max(initial=-np.inf))
    if not high > low:  # nothing, or all the same
        low, high = (low, low + 1.0) if array.size else (0.0, 1.0)
    step = (high - low) / _LEVELS
    levels = np.rint((array - low) / step).astype(np.uint16)
    return {"kind": "u2", "length": array.size, "low": low, "step": step}, levels
