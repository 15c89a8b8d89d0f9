"""Spheres of rigid grains read from files of others: LAMMPS data files and GSD."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gmem_jax.files.atomic import FileFormatError
from gmem_jax.files.checked import optional, refusing, require, require_finite

LARGEST = 1 << 30  # bytes of a file
_STYLES = {  # of LAMMPS atoms that belong to molecules: columns
    "molecular": "id mol type x y z",
    "bond": "id mol type x y z",
    "angle": "id mol type x y z",
    "full": "id mol type q x y z",
    "hybrid sphere molecular": "id type x y z diameter density mol",
    "hybrid molecular sphere": "id type x y z mol diameter density",
    "sphere": "id type diameter density x y z",  # molecules in a section of their own
}
_SAME = 1e-5  # by which radii may differ from the one that is meant; GSD is in single precision


@dataclass(frozen=True)
class Spheres:
    """N grains of K spheres each, in R.

    Attributes:
        centres: in the order of the file within a grain, [N, K, 3].
        lower: lower planes of the box, [3].
        upper: upper planes, [3].
    """

    centres: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def load_spheres(path: Path, radius: float = 1.0) -> Spheres:
    """The grains of a LAMMPS data file (molecules) or a GSD file (bodies; its last frame).

    Args:
        path: a file; GSD by its suffix .gsd, LAMMPS otherwise.
        radius: of the spheres in the file's unit of length, which becomes R.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it cannot be read, its radii are others, or its grains differ in their number of spheres.
        ValueError: if the radius is not positive, or the package gsd is not there.
    """
    if not 0.0 < radius < np.inf:
        raise ValueError(f"--radius must be positive, got {radius:g}")
    gsd = Path(path).suffix.lower() == ".gsd"
    with refusing(path, "GSD file" if gsd else "LAMMPS data file"):
        require(Path(path).stat().st_size <= LARGEST, f"it is larger than {LARGEST >> 20} MB")
        centres, grain, radii, box = (_gsd if gsd else _lammps)(Path(path))
        require_finite({"positions": centres, "planes of the box": box})
        odd = np.abs(radii - radius) > _SAME * radius
        require(
            ~odd,
            f"its spheres must have radius {radius:g}, found {radii[odd][0] if odd.any() else 0:g}; "
            "the radius in the file's lengths is given by --radius",
        )
        _, counts = np.unique(grain, return_counts=True)
        require(len(counts) > 0, "it holds no spheres")
        require(
            counts == counts[0], f"its grains have {counts.min()} to {counts.max()} spheres, all must have the same"
        )
        order = np.argsort(grain, kind="stable")
        lower, upper = box / radius
        return Spheres(centres[order].reshape(len(counts), counts[0], 3) / radius, lower, upper)


_Read = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Centres [S, 3], grains [S], radii [S] (none where there are none), and planes of the box [2, 3]."""


def _gsd(path: Path) -> _Read:
    with optional("gsd.hoomd", "export").open(path, "r") as file:
        frame = file[-1]
    own: Any = frame.particles
    body, kind = np.asarray(own.body, np.int64), np.asarray(own.typeid)
    lengths, tilts = np.asarray(frame.configuration.box[:3], float), frame.configuration.box[3:]
    require(np.asarray(tilts) == 0.0, "its box is not rectangular")
    free = body < 0
    grain = np.where(free, len(body) + np.arange(len(body)), body)
    central = ~free & (body == np.arange(len(body)))  # HOOMD marks each rigid body by a particle of a type of its own
    of_types = np.isin(kind, kind[central]) & ~np.isin(kind, kind[~central])
    kept = ~of_types
    centres, diameter = np.asarray(own.position, float), np.asarray(own.diameter, float)
    return centres[kept], grain[kept], 0.5 * diameter[kept], np.stack([-0.5 * lengths, 0.5 * lengths])


def _lammps(path: Path) -> _Read:
    lines = path.read_text(encoding="utf-8").splitlines()
    head, sections = _sections(lines)
    bounds = [head.get(f"{axis}lo {axis}hi") for axis in "xyz"]
    require(all(bound is not None and len(bound) == 2 for bound in bounds), "it has no rectangular box (xlo xhi, ...)")
    require("xy xz yz" not in head, "its box is not rectangular")
    style, rows = next(((hint, rows) for name, (hint, rows) in sections.items() if name == "Atoms"), ("", []))
    require(
        style in _STYLES,
        f"its atoms are of style {style[:40]!r}, must be (in a comment, as in 'Atoms # molecular') one of "
        f"{', '.join(_STYLES)}",
    )
    columns = _STYLES[style].split()
    table = _table(rows, len(columns))
    declared = head.get("atoms", ["no"])[0]
    require(declared == str(len(table)), f"it declares {declared} atoms and holds {len(table)}")
    named = dict(zip(columns, table.T, strict=False))
    table = table[np.argsort(named["id"], kind="stable")]
    named = dict(zip(columns, table.T, strict=False))
    if "mol" not in named:
        require("Molecules" in sections, "its atoms belong to no molecules")
        molecules = _table(sections["Molecules"][1], 2)
        require(len(molecules) == len(table), "not every atom is in its section of molecules")
        named["mol"] = molecules[np.argsort(molecules[:, 0], kind="stable"), 1]
    centres = np.stack([named[axis] for axis in "xyz"], axis=1)
    radii = 0.5 * named.get("diameter", np.zeros(0))
    return centres, named["mol"].astype(np.int64), radii, np.array(bounds, float).T


def _sections(lines: list[str]) -> tuple[dict[str, list[str]], dict[str, tuple[str, list[str]]]]:
    """The header's numbers by their keywords; the sections by name, with the comment behind it and their rows."""
    head: dict[str, list[str]] = {}
    sections: dict[str, tuple[str, list[str]]] = {}
    rows: list[str] | None = None
    for line in lines[1:]:
        text, _, comment = (part.strip() for part in line.partition("#"))
        if not text:
            continue
        if text[0].isalpha():
            rows = []
            sections[text] = (" ".join(comment.split()), rows)
        elif rows is not None:
            rows.append(text)
        else:
            words = text.split()
            numbers = [word for word in words if not word[0].isalpha()]
            head[" ".join(words[len(numbers) :])] = numbers
    return head, sections


def _table(rows: list[str], columns: int) -> np.ndarray:
    require(len(rows) > 0, "a section of it holds no rows")
    table = np.loadtxt(rows, ndmin=2)
    if table.shape[1] < columns:
        raise FileFormatError(f"its rows have {table.shape[1]} columns, must have {columns}")
    return np.asarray(table)
