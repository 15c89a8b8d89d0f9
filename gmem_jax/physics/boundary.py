"""The boundary of the box on each axis: rigid walls, or periodic."""

from typing import Any

import numpy as np

PeriodicAxes = tuple[bool, bool, bool]
"""Whether a box is periodic along x, y and z."""

WALLS: PeriodicAxes = (False, False, False)
_WORDS = ("walls", "periodic")


def periodic_axes(boundary: Any) -> PeriodicAxes:
    """The axes of a boundary in words.

    Args:
        boundary: "walls" or "periodic"; or these for x, y and z, as in "periodic,periodic,walls" or a tuple of words.

    Raises:
        ValueError: for other words.
    """
    words = boundary.split(",") if isinstance(boundary, str) else list(boundary) if np.iterable(boundary) else []
    words = words * 3 if len(words) == 1 else words
    if len(words) != 3 or any(word not in _WORDS for word in words):
        raise ValueError(
            f'boundary must be walls or periodic, or these for each axis as in "periodic,periodic,walls"; '
            f"got {boundary!r:.60}"
        )
    x, y, z = (word == "periodic" for word in words)
    return x, y, z


def boundary_of(periodic: PeriodicAxes) -> str:
    """The boundary in words: one word if all axes are alike, else one for each axis."""
    words = [_WORDS[bool(axis)] for axis in periodic]
    return words[0] if len(set(words)) == 1 else ",".join(words)


def require_room(lengths: np.ndarray, periodic: PeriodicAxes, reach: float, diameter: float) -> None:
    """Refuse a box in which two spheres could be listed through two images, or a grain could touch its own image.

    Args:
        lengths: edges of the box at its smallest, [3], in R.
        periodic: its periodic axes.
        reach: largest listed distance of two spheres, in R.
        diameter: outer diameter of a grain, in R.

    Raises:
        ValueError: naming the smallest edge that is allowed.
    """
    least = max(2.0 * reach, diameter)
    if any(edge < least for edge, axis in zip(lengths, periodic, strict=True) if axis):
        edges = " x ".join(f"{edge:.1f}" for edge in lengths)
        raise ValueError(
            f"a periodic box of {edges} R is too small: its periodic edges must be {least:.1f} R at least, twice the "
            f"reach of the neighbour list and no less than a grain; take more grains"
        )
