"""Reading LAMMPS data files: spheres and their molecules; errors name the line."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gmem_jax.errors import FileFormatError
from gmem_jax.files.validation import require

SAME = 1e-5  # relative difference up to which radii, masses or densities count as equal; GSD is in single precision
_STYLES = {  # columns of each style of atoms
    "molecular": "id mol type x y z",
    "bond": "id mol type x y z",
    "angle": "id mol type x y z",
    "full": "id mol type q x y z",
    "hybrid sphere molecular": "id type x y z diameter density mol",
    "hybrid molecular sphere": "id type x y z mol diameter density",
    "sphere": "id type diameter density x y z",  # molecules in a section of their own, or none
}
_HYBRID = ("hybrid sphere molecular", "hybrid molecular sphere")  # LAMMPS itself writes only "hybrid"
_READ = ("Atoms", "Molecules", "Masses", "Atom Type Labels")
PERIODIC = "its box is periodic: a pack to be imported lies within walls"
_PERIODIC = re.compile(r"^gmem: .*, boundary [fp ]*p")
_ATOMS = re.compile(r"\s*\S+\s+atoms\s*(#.*)?")
_WHOLE = re.compile(r"[+-]?[0-9]{1,15}")
_REAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_MOST, _TINY = np.finfo(float).max, np.finfo(float).tiny
_REALS = (_REAL, -_MOST, _MOST, "a finite number")
_COLUMNS = {  # columns that are not any real number: pattern, least and largest value, in words
    "id": (_WHOLE, 1.0, _MOST, "a whole number from 1"),
    "mol": (_WHOLE, 0.0, _MOST, "a whole number from 0"),  # 0: no molecule
    "type": (_WHOLE, 1.0, _MOST, "a label, or a whole number from 1"),
    "diameter": (_REAL, _TINY, _MOST, "a positive number"),
    "density": (_REAL, _TINY, _MOST, "a positive number"),
    "mass": (_REAL, 0.0, _MOST, "a number from 0"),
    "q": (_REAL, 0.0, 0.0, "0: grains carry no charge"),
    "image flag": (_WHOLE, 0.0, 0.0, "0: a pack lies within walls, not in a periodic box"),
    "tilt": (_REAL, 0.0, 0.0, "0: the box of a pack is rectangular"),
}
_SHOWN = 40  # characters of a wrong text that an error shows


class Read(NamedTuple):
    """The S spheres in a file of another program, in the file's unit of length.

    Attributes:
        centres: centres of the spheres, [S, 3].
        grain: a whole number for each sphere that is the same for all spheres of a grain, [S].
        radii: radii of the spheres, [S]; empty if the file has none.
        box: lower and upper planes, [2, 3].
        density: density of the spheres; None if the file has none.
        notes: remarks on other content of the file, such as what was left out.
    """

    centres: np.ndarray
    grain: np.ndarray
    radii: np.ndarray
    box: np.ndarray
    density: float | None = None
    notes: tuple[str, ...] = ()


class _Row(NamedTuple):
    line: int
    words: list[str]


class _Section(NamedTuple):
    hint: str
    rows: list[_Row]


def read_lammps(path: Path, radius: float) -> Read:
    """The spheres of a LAMMPS data file in the order of their ids; atoms without a molecule are grains of their own.

    Args:
        path: the file.
        radius: radius of equal spheres, by which the columns of `Atoms # hybrid` are recognised.

    Raises:
        OSError: if the file cannot be read.
        FileFormatError: naming the line that is wrong, or the part that is missing.
    """
    with path.open(encoding="utf-8", errors="backslashreplace") as file:  # a title may be in any encoding
        lines = file.read().split("\n")
    require(any(map(_ATOMS.fullmatch, lines)), "it is no LAMMPS data file, which has a line 'N atoms', and no GSD file")
    require(not _PERIODIC.search(lines[0]), PERIODIC)  # only the title of our exports says it
    head, sections = _parts(lines)
    box = _box(head)
    atoms = sections.get("Atoms", _Section("", []))
    style = _style_of(atoms, radius)
    labels = {words[-1]: words[0] for _, words in sections.get("Atom Type Labels", _Section("", [])).rows}
    types = _count(head, "atom types")
    named = _table(atoms, _STYLES[style].split(), types, labels)
    declared, found = _count(head, "atoms"), len(named["id"])
    require(declared == found, f"line {head['atoms'].line}: it declares {declared} atoms and holds {found}")
    if "mol" not in named:
        named["mol"] = _molecules(sections, named["id"])
    left = [name[:_SHOWN] for name in sections if name not in _READ]
    notes = [f"its sections {', '.join(left)} are left out"] if left else []
    grain, loose = named["mol"].astype(np.int64), named["mol"] == 0.0
    if loose.any():
        notes.append(f"{loose.sum()} of its atoms belong to no molecule: each is a grain of one sphere")
        grain[loose] = grain.max() + 1 + np.arange(loose.sum())
    order = np.argsort(named["id"])
    centres = np.stack([named[axis] for axis in "xyz"], axis=1)
    density = one_value("density", named["density"]) if "density" in named else None
    if density is None and "Masses" in sections:
        masses = _table(sections["Masses"], ["type", "mass"], types, labels)
        density = density_of(masses["mass"][np.isin(masses["type"], named["type"])], radius)
    radii = 0.5 * named["diameter"][order] if "diameter" in named else np.zeros(0)
    return Read(centres[order], grain[order], radii, box, density, tuple(notes))


def one_value(what: str, values: np.ndarray) -> float:
    """The one value that all spheres have.

    Raises:
        FileFormatError: if they differ.
    """
    low, high = values.min(initial=np.inf), values.max(initial=-np.inf)
    require(high - low <= SAME * abs(high), f"its spheres have a {what} of {low:g} to {high:g}, all must have the same")
    return float(high)


def density_of(masses: np.ndarray, radii: np.ndarray | float) -> float | None:
    """The density of spheres of these masses; None if all masses are 1, as written by programs without masses.

    Raises:
        FileFormatError: if the densities differ, or the masses of equal spheres.
    """
    if np.all(masses == 1.0):
        return None
    volume = 4.0 * np.pi / 3.0 * radii**3
    return one_value("density", masses / volume) if np.ndim(radii) else one_value("mass", masses) / float(volume)


def _parts(lines: list[str]) -> tuple[dict[str, _Row], dict[str, _Section]]:
    """The lines of the header by keyword, and the sections by name."""
    head: dict[str, _Row] = {}
    sections: dict[str, _Section] = {}
    rows: list[_Row] | None = None
    for line, whole in enumerate(lines[1:], 2):
        text, _, comment = (part.strip() for part in whole.partition("#"))
        words = text.split()
        if not words:
            continue
        if all(word[0].isalpha() for word in words):
            name, rows = " ".join(words), []
            require(name not in sections or name not in _READ, f"line {line}: a second section {name!r}")
            sections[name] = _Section(" ".join(comment.split()), rows)
        elif rows is not None:
            rows.append(_Row(line, words))
        else:
            numbers = [word for word in words if not word[0].isalpha()]
            name = " ".join(words[len(numbers) :])
            known = words[0] in numbers and name not in head
            require(known, f"line {line}: {text[:_SHOWN]!r} is no line of a header, or one that was there before")
            head[name] = _Row(line, numbers)
    return head, sections


def _count(head: Mapping[str, _Row], name: str) -> int:
    require(name in head, f"it has no line 'N {name}', as a LAMMPS data file has")
    line, words = head[name]
    require(len(words) == 1 and _WHOLE.fullmatch(words[0]), f"line {line}: must be 'N {name}' with a whole number N")
    return int(words[0])


def _box(head: Mapping[str, _Row]) -> np.ndarray:
    """Lower and upper planes of the box, [2, 3]."""
    bounds = []
    for axis in "xyz":
        name = f"{axis}lo {axis}hi"
        require(name in head, "it has no rectangular box (xlo xhi, ...)")
        line, words = head[name]
        values = _column(name, words, [line] * len(words))
        require(len(values) == 2 and values[0] < values[-1], f"line {line}: must be {name}, the first the smaller")
        bounds.append(values)
    if "xy xz yz" in head:
        line, words = head["xy xz yz"]
        _column("tilt", words, [line] * len(words))
    return np.array(bounds).T


def _style_of(atoms: _Section, radius: float) -> str:
    """The style of the atoms, from the comment after `Atoms`.

    If it says only "hybrid", as LAMMPS writes it, the style is that in which all diameters are twice the radius. If
    there is none, the spheres are unequal, and the style is that in which all densities are equal.
    """
    if atoms.hint != "hybrid":
        require(
            atoms.hint in _STYLES,
            f"its atoms are of style {atoms.hint[:_SHOWN]!r}, must be (in a comment, as in 'Atoms # molecular') one of "
            f"{', '.join(_STYLES)}",
        )
        return atoms.hint
    meant, dense = [], []
    for style in _HYBRID:
        names = _STYLES[style].split()
        rows = [dict(zip(names, row.words, strict=False)) for row in atoms.rows]
        whole = all(_WHOLE.fullmatch(row.get("mol", "")) for row in rows)
        numbers = [[row.get(name, "") for row in rows] for name in ("diameter", "density")]
        if not (whole and all(_REAL.fullmatch(word) for column in numbers for word in column)):
            continue
        sizes, densities = (np.array(column, float) for column in numbers)
        if np.all(np.abs(sizes - 2.0 * radius) <= SAME * radius):
            meant.append(style)
        if np.ptp(densities) <= SAME * np.max(densities, initial=0.0):
            dense.append(style)
    fits = meant or dense
    require(len(fits) < 2, f"'Atoms # hybrid' does not tell its columns: write {' or '.join(_HYBRID)} in that comment")
    return fits[0] if fits else _HYBRID[0]


def _table(section: _Section, names: list[str], types: int, labels: Mapping[str, str]) -> dict[str, np.ndarray]:
    """The columns of a section by name, as real numbers; whole numbers of up to 15 digits are exact."""
    rows = section.rows
    require(len(rows) > 0, "a section of it holds no rows")
    flags = 3 * (names[0] == "id" and len(rows[0].words) == len(names) + 3)
    width = len(names) + flags
    for line, words in rows:
        if len(words) != width:
            told = f"{width} ({' '.join(names)}{', and image flags' if flags else ''})"
            raise FileFormatError(f"line {line}: {len(words)} columns, must be {told}")
    lines, found = [row.line for row in rows], {}
    for place, name in enumerate([*names, *["image flag"] * flags]):
        known = labels if name == "type" else {}
        words = [known.get(row.words[place], row.words[place]) for row in rows]
        most = types if name == "type" else np.inf
        found[name] = _column(name, words, lines, most)
    if names[0] == "id":
        _require_once(found["id"], lines)
    return found


def _column(name: str, words: list[str], lines: list[int], most: float = np.inf) -> np.ndarray:
    form, low, high, told = _COLUMNS.get(name, _REALS)
    values = np.array([float(word) if form.fullmatch(word) else np.nan for word in words])
    for odd in np.flatnonzero(~((low <= values) & (values <= min(high, most)))):
        upto = f" to {most:g}" if most < np.inf else ""
        raise FileFormatError(f"line {lines[odd]}: {name} is {words[odd][:_SHOWN]!r}, must be {told}{upto}")
    return values


def _require_once(ids: np.ndarray, lines: list[int]) -> None:
    order = np.argsort(ids, kind="stable")
    for place in np.flatnonzero(np.diff(ids[order]) == 0.0):
        first, second = order[place : place + 2]
        raise FileFormatError(f"line {lines[second]}: atom {ids[second]:.0f} stands in line {lines[first]}, too")


def _molecules(sections: Mapping[str, _Section], ids: np.ndarray) -> np.ndarray:
    """The molecule of every atom from the section Molecules; 0 for all atoms without such a section."""
    if "Molecules" not in sections:
        return np.zeros(len(ids))
    rows = sections["Molecules"].rows
    table = _table(sections["Molecules"], ["id", "mol"], 0, {})
    for odd in np.flatnonzero(~np.isin(table["id"], ids)):
        raise FileFormatError(f"line {rows[odd].line}: there is no atom {table['id'][odd]:.0f}")
    for absent in ids[~np.isin(ids, table["id"])]:
        raise FileFormatError(f"atom {absent:.0f} is not in its section Molecules")
    order = np.argsort(table["id"])
    return np.asarray(table["mol"][order][np.searchsorted(table["id"][order], ids)])
