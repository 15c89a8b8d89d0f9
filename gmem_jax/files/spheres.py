"""Reading a grain from a text file with a sphere in every line."""

from pathlib import Path

import numpy as np

from gmem_jax.errors import FileFormatError
from gmem_jax.files.pack_validation import MOST_SPHERES
from gmem_jax.files.validation import NAME, refusing, require, require_sizes, title
from gmem_jax.physics.grain import Clump, clump

_LARGEST = 1 << 16  # bytes: 256 lines of four long numbers
_COLUMNS = "x y z r"


def load_clump(path: Path) -> Clump:
    """The grain whose spheres a file lists: x, y, z and r of a sphere in every line, separated by spaces or commas.

    Lines that begin with # are comments. Lengths are in R.

    Args:
        path: the file; the grain gets its name.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is not of this format, naming the line.
    """
    path = Path(path)
    with refusing(path, "file of spheres"):
        require(path.stat().st_size <= _LARGEST, f"more than {MOST_SPHERES} lines of four numbers")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        rows = [
            _sphere(number, line) for number, line in enumerate(lines, 1) if line.strip() and line.strip()[0] != "#"
        ]
        require(
            0 < len(rows) <= MOST_SPHERES,
            f"it lists {len(rows)} spheres, must be 1 to {MOST_SPHERES}: {_COLUMNS} in every line",
        )
        name = path.stem[:NAME]
        found = np.asarray(rows)
        require_sizes(found[:, 3], None)
        made = clump(found[:, :3], shape=name if title(name) else "clump", radii=found[:, 3])
    return made


def _sphere(number: int, line: str) -> list[float]:
    """Centre and radius of the sphere in a line."""
    try:
        found = [float(cell) for cell in line.replace(",", " ").split()]
    except ValueError:
        found = []
    if len(found) != 4 or not np.all(np.abs(found) < 1e3):
        raise FileFormatError(f"line {number}: must be four numbers {_COLUMNS}, got {line.strip()[:40]!r}")
    require(found[3] > 0.0, f"line {number}: r is {found[3]:g}, must be positive")
    return found
