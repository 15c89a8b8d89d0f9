"""Reading spheres of rigid grains from files of other programs: LAMMPS data files and GSD."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gmem_jax.errors import FileFormatError
from gmem_jax.files.lammpsdata import PERIODIC, SAME, Read, density_of, read_lammps
from gmem_jax.files.validation import optional, refusing, require, require_finite
from gmem_jax.physics.grain import require_radii

LARGEST = 1 << 30  # bytes, of the largest file
_GSD = b"\xdf\x65\xdf\x65\xdf\x65\xdf\x65"
_CONVERTED = "write a LAMMPS data file or GSD from it (LAMMPS: write_data; OVITO: Export File)"
_OTHERS = (  # files that cannot be imported: how they begin, what they are, and what to do
    (rb"\x1f\x8b|BZh[1-9]1AY|\xfd7zXZ|\x28\xb5\x2f\xfd|PK\x03\x04", "a compressed file", "unpack it first"),
    (
        rb"gmem sha256|.{0,2048}\x89HDF\r\n",
        "an HDF5 file",
        "packs of gmem are used as they are, `gmem export` writes them for others",
    ),
    (rb"ITEM: [A-Z]", "a LAMMPS dump", _CONVERTED),
    (rb"LammpS RestartT", "a LAMMPS restart file", _CONVERTED),
    (rb"\s*\d+\s*\n[^\n]*(Lattice|Properties) *=", "an extended XYZ file", _CONVERTED),
    (rb"\s*\d+\s*\n[^\n]*\n\s*[A-Za-z]+(\s+[-+.\d][-+.\deE]*){3}", "an XYZ file", _CONVERTED),
    (rb"<\?xml|<VTKFile|# vtk DataFile", "a VTK file", _CONVERTED),
    (rb".{0,4096}\x00", "a file that is no text", _CONVERTED),
)


@dataclass(frozen=True)
class Spheres:
    """N grains of K spheres each, in R.

    Attributes:
        centres: centres of the spheres, in the order of the file within a grain, [N, K, 3].
        radii: radii of the spheres, [N, K].
        lower: lower planes of the box, [3].
        upper: upper planes, [3].
        density: density of the spheres, in the file's units; None if it has none.
        notes: remarks on other content of the file, such as what was left out.
    """

    centres: np.ndarray
    radii: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    density: float | None = None
    notes: tuple[str, ...] = ()


def load_spheres(path: Path, radius: float = 1.0) -> Spheres:
    """The grains of a LAMMPS data file (molecules) or a GSD file (bodies; its last frame).

    Args:
        path: the file; it is GSD if it begins so or its suffix is .gsd, and LAMMPS otherwise.
        radius: R in the file's unit of length; for equal spheres it is their radius.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file cannot be read or holds things that no pack has; if its spheres all have another
            radius than `radius`, have radii that no pack can have, or differ in density; or if its grains differ in
            their number of spheres.
        ValueError: if the radius is not positive, or the package gsd is not there.
    """
    if not 0.0 < radius < np.inf:
        raise ValueError(f"--radius must be positive, got {radius:g}")
    path = Path(path)
    gsd = path.suffix.lower() == ".gsd"
    with refusing(path, "GSD file" if gsd else "LAMMPS data file"):
        require(path.stat().st_size <= LARGEST, f"it is larger than {LARGEST >> 20} MB")
        with path.open("rb") as file:
            begins = file.read(1 << 13)
        gsd = gsd or begins.startswith(_GSD)
        for pattern, what, how in () if begins.startswith(_GSD) else _OTHERS:
            require(not re.match(pattern, begins, re.DOTALL), f"it is {what}; {how}")
        centres, grain, radii, box, density, notes = _gsd(path, radius) if gsd else read_lammps(path, radius)
        require_finite({"positions": centres, "planes of the box": box})
        radii = radii / radius if len(radii) else np.ones(len(centres))
        radii = np.where(np.abs(radii - 1.0) <= SAME, 1.0, radii)
        require_finite({"radii": radii})
        require(len(radii) > 0, "it holds no spheres")
        how = "the radius in the file's lengths is given by --radius"
        alike = np.ptp(radii) <= SAME * np.max(radii)
        require(
            not alike or np.all(radii == 1.0),
            f"its spheres must have radius {radius:g}, found {radius * np.max(radii):g}; {how}",
        )
        try:
            require_radii(radii)
        except ValueError as error:
            raise FileFormatError(f"{error}; {how}") from error
        _, counts = np.unique(grain, return_counts=True)
        told = "; ".join([f"its grains have {counts.min()} to {counts.max()} spheres, all must have the same", *notes])
        require(counts == counts[0], told)
        order = np.argsort(grain, kind="stable")
        lower, upper = box / radius
        shaped = centres[order].reshape(len(counts), counts[0], 3) / radius
        return Spheres(shaped, radii[order].reshape(shaped.shape[:2]), lower, upper, density, notes)


def _gsd(path: Path, radius: float) -> Read:
    with optional("gsd.hoomd", "export").open(path, "r") as file:
        frame = file[-1]
    own: Any = frame.particles
    body, kind = np.asarray(own.body, np.int64), np.asarray(own.typeid)
    lengths, tilts = np.asarray(frame.configuration.box[:3], float), frame.configuration.box[3:]
    require(np.asarray(tilts) == 0.0, "its box is not rectangular")
    require(np.asarray(frame.log.get("periodic", 0)) == 0, PERIODIC)  # our exports log it: GSD has no field for it
    free = body < 0
    grain = np.where(free, len(body) + np.arange(len(body)), body)
    # HOOMD gives each rigid body a central particle, of a type of its own; its body is its own number.
    _, place, members = np.unique(grain, return_inverse=True, return_counts=True)
    central = ~free & (body == np.arange(len(body))) & (members[place] > 1)
    of_types = np.isin(kind, kind[central]) & ~np.isin(kind, kind[~central])
    kept = ~of_types
    require(
        np.asarray(own.image)[kept] == 0, "its particles have images: a pack lies within walls, not in a periodic box"
    )
    centres, radii = np.asarray(own.position, float)[kept], 0.5 * np.asarray(own.diameter, float)[kept]
    require(radii > 0.0, "a diameter is not positive")
    unequal = np.ptp(radii) > SAME * radii.max() if len(radii) else False
    density = density_of(np.asarray(own.mass, float)[kept], radii if unequal else radius)
    notes = ["its velocities are left out"] * bool(np.any(own.velocity))
    if free.any():
        notes.append(f"{free.sum()} of its particles belong to no body: each is a grain of one sphere")
    box = np.stack([-0.5 * lengths, 0.5 * lengths])
    return Read(centres, grain[kept], radii, box, density, tuple(notes))
