"""Cheap checks that the numbers of a pack can be those of grains at rest in their box.

They take some 0.1 s at N = 10,240. The mass of a grain is not integrated anew; it must fit the filling on record.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from gmem_jax.errors import FileFormatError
from gmem_jax.files.validation import (
    is_number,
    numbers,
    require,
    require_fields,
    require_finite,
    require_sizes,
    title,
    whole,
)
from gmem_jax.physics.boundary import WALLS, PeriodicAxes, require_room
from gmem_jax.physics.grain import radii_of_spheres
from gmem_jax.physics.pairs import nearest_images, sphere_places
from gmem_jax.physics.pytree import interval
from gmem_jax.simulation.strain import COMPRESSIONS

UNIT = 1e-9  # tolerance of a quaternion's length and of numbers that are computed again; round-off is below 1e-14
LARGEST_OVERLAP = 0.5  # R, overlap of spheres at rest; packs are at 0.1, and at 0.5 Hertz's law is far from valid
GRAZING = 1e-9  # R: distances that may round to either side of a limit
LOOSEST, DENSEST = 0.1, 0.85  # filling; packs are at 0.68, one squeezed to 0.9 would have 0.93
LARGEST_BOX = 1e5  # R, longest edge of a box
MOST_SPHERES = 256  # spheres of a grain
LARGEST_SPEED = 1.0  # R / t_c, speed of sound in a rod of the solid; in packs 0.46 at 2e-3 E, and about as p^(1/6)
LISTENED = 40.0  # t_c per R of the longest edge: duration of the measurement of T_1, some 15 periods
PERIODS = 3  # fewest periods in that time that can be told from drift
_BALL = 4.0 * np.pi / 3.0

Found = Mapping[str, np.ndarray]


@np.errstate(over="ignore", invalid="ignore")
def check_arrays(found: Found, *, isotropic: bool, record: dict[str, Any], periodic: PeriodicAxes = WALLS) -> None:
    """Refuse a pack that is impossible.

    Args:
        found: the arrays of a pack by their path in its file, of the right shapes.
        isotropic: whether the clump claims to be isotropic.
        record: recipe and measurements of the preparation; may be empty.
        periodic: the periodic axes of its box.

    Raises:
        FileFormatError: saying what is wrong.
    """
    require_finite(found)
    own, sizes = found.get("clump/radii"), found.get("clump/sizes")
    require_sizes(own, sizes)
    _check_clump(found, isotropic)
    _check_box(found)
    spheres = sphere_places(found["position"], found["quaternion"], found["clump/offsets"], sizes)
    radii = radii_of_spheres(len(found["position"]), len(found["clump/offsets"]), own, sizes)
    lower, upper, axes = found["lower"], found["upper"], np.asarray(periodic)
    require((spheres > lower) & (spheres < upper) | axes, "a grain lies outside the box")
    centres = found["position"]
    require((centres >= lower) & (centres <= upper), "a grain's centre lies outside the box")
    _check_list(found, spheres, radii, periodic)
    first, second = found["pairs/candidates"]
    apart = spheres[second] - spheres[first]
    if any(periodic):
        reference = found["pairs/reference"][..., None]
        apart += nearest_images(found["pairs/candidates"], reference, found["pairs/smallest"], periodic) * (
            upper - lower
        )
    overlap = radii[first] + radii[second] - np.linalg.norm(apart, axis=1)
    walls = np.where(axes, 0.0, radii[:, None] - np.minimum(spheres - lower, upper - spheres))
    deepest = max(overlap.max(initial=0.0), walls.max())
    require(
        deepest < LARGEST_OVERLAP,
        f"grains or walls overlap by {deepest:.2f} R, must be below {LARGEST_OVERLAP} R: this is no pack at rest",
    )
    _check_record(found, record, overlap)


def _check_clump(found: Found, isotropic: bool) -> None:
    """Check the mass properties against bounds that hold for any union of K spheres."""
    offsets, mass = found["clump/offsets"], float(found["clump/mass"])
    inertia, diameter = found["clump/inertia"], float(found["clump/diameter"])
    require(0 < len(offsets) <= MOST_SPHERES, f"its grain has {len(offsets)} spheres, must have 1 to {MOST_SPHERES}")
    radii = radii_of_spheres(1, len(offsets), found.get("clump/radii"))
    extent = 2.0 * float((radii + np.linalg.norm(offsets, axis=1)).max())
    require(abs(diameter - extent) < UNIT * extent, f"the grain's diameter is {diameter:g}, its spheres say {extent:g}")
    balls = _BALL * radii**3
    require(
        0.999 * balls.max() < mass < 1.001 * balls.sum(), f"the mass {mass:g} is not that of {len(offsets)} spheres"
    )
    second = 0.5 * float(inertia.sum())  # the integral of r^2 over the grain
    least, most = 0.6 * mass * (mass / _BALL) ** (2 / 3), mass * (0.5 * extent) ** 2
    triangle = 2.0 * inertia <= inertia.sum() * (1.0 + UNIT)
    require(inertia > 0.0, "a moment of inertia is not positive")
    require(
        np.all(triangle) and 0.999 * least < second < most, "the moments of inertia are not those of the grain's mass"
    )
    require(not isotropic or np.ptp(inertia) < 1e-3 * inertia.mean(), "the moments of a grain marked isotropic differ")


def _check_box(found: Found) -> None:
    lower, upper, delta0 = found["lower"], found["upper"], float(found["delta0"])
    require(len(found["position"]) > 0, "it holds no grains")
    require(lower < upper, "a lower edge of the box is not below the upper one")
    require(interval(COMPRESSIONS).holds(delta0), f"delta0 must be in {COMPRESSIONS}, got {delta0:g}")
    require(
        upper - lower < LARGEST_BOX, f"an edge of the box is longer than {LARGEST_BOX:g} R: this is no pack at rest"
    )
    filling = _filling(found)
    require(
        LOOSEST < filling < DENSEST,
        f"grains fill {filling:.3g} of the box, must be between {LOOSEST} and {DENSEST}: this is no pack at rest",
    )
    norm = np.linalg.norm(found["quaternion"], axis=1)
    require(np.abs(norm - 1.0) < UNIT, "a quaternion is not of length 1")
    period, (shortest, longest) = float(found["ringing_period"]), period_bounds(upper - lower)
    require(
        shortest <= period <= longest,
        f"its ringing period is {period:g} t_c, must be between {shortest:.3g} and {longest:.3g} in a box of this size",
    )


def period_bounds(lengths: np.ndarray) -> tuple[float, float]:
    """Shortest and longest T_1 of a box with these edges [3], in t_c: a wave across the box is no faster than in the
    solid, and a slower mode could not be measured."""
    return float(np.min(lengths)) / LARGEST_SPEED, LISTENED * float(np.max(lengths)) / PERIODS


def _filling(found: Found) -> float:
    count = float(np.sum(radii_of_spheres(len(found["position"]), 1, None, found.get("clump/sizes")) ** 3))
    return count * float(found["clump/mass"]) / float(np.prod(found["upper"] - found["lower"]))


def _check_list(found: Found, spheres: np.ndarray, radii: np.ndarray, periodic: PeriodicAxes) -> None:
    """Check that the neighbour list is sorted, in range, not stale, and has all pairs in reach and no others."""
    listed, reference = found["pairs/candidates"].astype(np.int64), found["pairs/reference"]
    smallest, reach = found["pairs/smallest"], float(found["pairs/reach"])
    count, per_grain = len(spheres), len(found["clump/offsets"])
    lengths = found["upper"] - found["lower"]
    require(len(reference) == count, f"its list was made of {len(reference)} spheres, but it has {count}")
    widest, largest = 2.0 * float(radii.max()), float(found.get("clump/sizes", np.ones(1)).max())
    require(
        widest < reach < widest + 2.0,
        f"the reach of its list must be in ({widest:g}, {widest + 2.0:g}) R, got {reach:g}",
    )
    require(
        (smallest > 0.5 * lengths) & (smallest <= lengths * (1.0 + UNIT)), "its list was made in a box of another size"
    )
    within = (reference > 0.0) & (reference < 1.0)
    require(within | np.asarray(periodic), "its list was made of spheres outside the box")
    try:
        require_room(smallest, periodic, reach, largest * float(found["clump/diameter"]))
    except ValueError as error:
        raise FileFormatError(str(error)) from error
    require((listed >= 0) & (listed < count), f"a candidate names a sphere that is not among its {count}")
    require(
        listed[0] // per_grain < listed[1] // per_grain, "a candidate pairs a grain with itself, or is out of order"
    )
    keys = listed[0] * count + listed[1]
    require(np.diff(keys) > 0, "its candidates are not sorted, or listed twice")
    moved = float(np.linalg.norm(spheres - found["lower"] - reference * lengths, axis=1).max())
    require(2.0 * moved < reach - widest, f"its list is stale: a sphere has moved by {moved:.2f} R since it was made")
    mapped = reference * smallest
    lines = mapped[listed[1]] - mapped[listed[0]]
    if any(periodic):
        lines += nearest_images(listed, reference[..., None], smallest, periodic) * smallest
    apart = np.linalg.norm(lines, axis=1)
    gaps = apart - radii[listed[0]] - radii[listed[1]]
    require(gaps < reach - widest + GRAZING, "its list pairs spheres that are out of reach of each other")
    # No listed pair is out of reach or listed twice: the list is complete if there are no more pairs than listed ones.
    require(
        pairs_within(mapped, reach - GRAZING, per_grain, smallest, periodic, radii) <= len(keys),
        "its list misses spheres that are in reach of each other",
    )


def pairs_within(
    centres: np.ndarray,
    reach: float,
    per_grain: int,
    edges: np.ndarray | None = None,
    periodic: PeriodicAxes = WALLS,
    radii: np.ndarray | None = None,
) -> int:
    """Number of pairs of spheres of different grains within reach, by cells of this edge; scipy takes longer to load.

    Args:
        centres: centres of the spheres, [S, 3].
        reach: largest distance of the centres, for two of the largest spheres.
        per_grain: spheres of a grain.
        edges: edges of the box, [3], if any of its axes is periodic.
        periodic: the periodic axes.
        radii: radii of the spheres, [S], if they differ; the reach of two surfaces is the same for all.

    Raises:
        FileFormatError: if the spheres lie in a heap, which has more pairs than time and memory allow.
    """
    owner, short = np.arange(len(centres)), None if radii is None else radii.max() - radii
    for axis in np.flatnonzero(periodic) if edges is not None else ():
        # Spheres near the lower face get an image beyond the upper one. A pair may be found twice, but counts once:
        # the box is too large for two images of it in reach.
        centres = np.where(np.arange(3) == axis, centres % edges, centres)
        low = np.flatnonzero(centres[:, axis] < reach)
        centres = np.concatenate([centres, centres[low] + edges * (np.arange(3) == axis)])
        owner = np.concatenate([owner, owner[low]])
    cell = np.floor((centres - centres.min(axis=0)) / reach).astype(np.int64) + 1
    rows, columns = cell[:, 1].max() + 2, cell[:, 2].max() + 2
    key = (cell[:, 0] * rows + cell[:, 1]) * columns + cell[:, 2]
    order = np.argsort(key, kind="stable")
    key, centres, owner = key[order], centres[order], owner[order]
    here, grain = np.arange(len(key)), owner // per_grain
    crowd = 1.0 if radii is None else float(radii.max() ** 3 / np.mean(radii**3))  # small spheres about a large one
    found: list[np.ndarray] = []
    for over, along in ((0, 0), (0, 1), (1, -1), (1, 0), (1, 1)):  # half of the columns of cells around
        column = key + (over * rows + along) * columns
        first = np.searchsorted(key, column - 1) if over or along else here + 1
        count = np.searchsorted(key, column + 1, side="right") - first
        require(
            count.sum() <= (100 + 30 * per_grain) * crowd * len(key),
            "its grains lie in a heap: this is no pack at rest",
        )
        one = np.repeat(here, count)
        other = np.arange(len(one)) + np.repeat(first - (np.cumsum(count) - count), count)
        far = centres[one] - centres[other]
        most = reach if short is None else reach - short[owner[one]] - short[owner[other]]
        near = (np.einsum("pi,pi->p", far, far) < most**2) & (grain[one] != grain[other])
        pair = np.stack([owner[one[near]], owner[other[near]]])
        found.append(pair.min(axis=0) * len(key) + pair.max(axis=0))
    pairs = np.concatenate(found)
    return len(np.unique(pairs) if any(periodic) else pairs)


def _check_record(found: Found, record: dict[str, Any], overlap: np.ndarray) -> None:
    """Check that the measurements on record agree with the numbers of the pack."""
    if "recipe" in record:
        require_fields(record["recipe"], "recipe", seed=whole, t0=is_number)
        require_fields(record["recipe"], "recipe", **dict.fromkeys({"gravity"} & record["recipe"].keys(), is_number))
    if "material" in record:
        require_fields(record["material"], "material", wall_rigidity=is_number)
    if "at_rest" not in record:
        return
    triple = {"pressure": numbers, "lengths": numbers}
    counted = ("coordination", "contacts", "wall_contacts")
    single = dict.fromkeys(("filling", *counted, "largest_speed", "largest_overlap"), is_number)
    rest = record["at_rest"]
    require_fields(rest, "record", **triple, **single)
    require(
        all(np.shape(rest[name]) == (3,) for name in triple), "its record does not name three pressures and lengths"
    )
    require(title(record.get("grain", "")), "its record names no grain")
    lengths, grains = found["upper"] - found["lower"], len(found["position"])
    touching = overlap > 0.0
    grazing = int(np.sum(np.abs(overlap) < GRAZING))
    same = {
        "box": np.allclose(rest["lengths"], lengths, rtol=UNIT, atol=0.0),
        "filling": np.isclose(rest["filling"], _filling(found), rtol=UNIT, atol=0.0),
        "largest overlap": np.isclose(rest["largest_overlap"], overlap.max(initial=-1.0), rtol=0.0, atol=GRAZING),
        "contacts": abs(0.5 * rest["contacts"] * grains - int(touching.sum())) < grazing + 0.5,
    }
    other = [name for name, holds in same.items() if not holds]
    require(not other, f"the {' and '.join(other)} on record are not those of its grains: they have been changed since")
