"""Grains: rigid clumps of spheres, and their mass properties.

A grain is a rigid union of spheres, of radius 1 unless others are given. The solid union (overlaps counted once) sets
volume, mass and inertia; they are computed by summing exact one-dimensional sections of the union along a fine grid
of lines.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from gmem_jax.physics.numbers import is_real, require_numbers, said
from gmem_jax.physics.pytree import Scalar, label, pytree, static, traced
from gmem_jax.physics.rules import usual_rules

_LINES = 700  # lines per side of the integration grid: volume and inertia to about 1e-5
RADII = 0.1, 10.0  # R, allowed range of radii: the skin of lists and the stiffness of law H do not scale with them
LARGEST_RATIO = 10.0  # of two radii in a pack; a cell as wide as a large sphere holds up to ratio^3 small ones


@pytree
@dataclass(frozen=True)
class Clump:
    """A rigid grain of K spheres, in its principal frame with the centre of mass at the origin (R = rho = 1).

    `clump`, `tetra` and `sphere` make it. If the grains of a pack differ in size, all attributes but `sizes` are those
    of a grain of size 1.

    Attributes:
        offsets: centres of the spheres, [K, 3], in R.
        mass: mass, equal to the volume of the union of the spheres, in rho R^3.
        inertia: principal moments of inertia, [3], in rho R^5.
        diameter: diameter of the smallest sphere about the centre of mass that holds the grain, in R.
        isotropic: whether the three moments are equal, so that no gyroscopic term is needed.
        shape: a name for logs and files.
        radii: radii of the spheres, [K], in R; None if all are 1.
        sizes: factors on all lengths of each grain of a pack, [N]; None if all are 1.
    """

    offsets: jax.Array
    mass: jax.Array
    inertia: jax.Array
    diameter: jax.Array
    isotropic: bool = static(True)
    shape: str = label("clump")
    radii: jax.Array | None = None
    sizes: jax.Array | None = None

    @property
    def spheres(self) -> int:
        """Number of spheres K in one grain."""
        return len(self.offsets)

    @property
    def equal(self) -> bool:
        """Whether all spheres of a pack are of radius 1."""
        return self.radii is None and self.sizes is None

    @property
    def masses(self) -> jax.Array:
        """Mass of each grain, in rho R^3; shaped as by `scaled`."""
        return self.scaled(self.mass, 3)

    @property
    def smallest(self) -> Scalar:
        """Size of the smallest grain."""
        return 1.0 if self.sizes is None else jnp.min(self.sizes)

    @property
    def largest(self) -> Scalar:
        """Size of the largest grain."""
        return 1.0 if self.sizes is None else jnp.max(self.sizes)

    @property
    def widest(self) -> Scalar:
        """Diameter of the largest sphere, in R: two spheres whose centres are further apart cannot touch."""
        return 2.0 * self.largest if self.radii is None else 2.0 * self.largest * jnp.max(self.radii)

    def scaled(self, value: jax.Array, power: int) -> jax.Array:
        """A quantity of each grain that grows with a power of its size.

        Args:
            value: the quantity for a grain of size 1; scalar, [B] or [3, B].
            power: the power.

        Returns:
            The quantity with an axis of grains, [N, ...], or `value` itself if all grains have size 1.
        """
        return value if self.sizes is None else value * self.sizes[:, None, None] ** power

    def sphere_radii(self, spheres: int) -> jax.Array | None:
        """Radii of all `spheres` = N K spheres of a pack, [N K], in R; None if all are 1."""
        if self.equal:
            return None
        own = jnp.ones(self.spheres) if self.radii is None else self.radii
        sizes = jnp.ones(spheres // self.spheres) if self.sizes is None else self.sizes
        return (sizes[:, None] * own).reshape(-1)

    def volume(self, grains: int) -> jax.Array:
        """Volume of all `grains` of a pack together, in R^3; scalar or [B]."""
        return grains * self.mass if self.sizes is None else jnp.sum(self.sizes**3) * self.mass


def radii_of_spheres(
    grains: int, per_grain: int, radii: ArrayLike | None = None, sizes: ArrayLike | None = None
) -> np.ndarray:
    """Radii of the spheres of N grains, [N K], in R; `radii` and `sizes` are those of a `Clump`."""
    of_one, of_grains = (
        np.ones(count) if own is None else np.asarray(own) for count, own in ((per_grain, radii), (grains, sizes))
    )
    return np.outer(of_grains, of_one).ravel()


def words_of_sizes(clump: Clump) -> str:
    """How the spheres of a pack differ in radius, like "sizes 0.74 to 1.31, SD 0.1"; "" where all are of radius 1."""
    found = []
    if clump.sizes is not None:
        sizes = np.asarray(clump.sizes)
        found.append(f"sizes {sizes.min():.3g} to {sizes.max():.3g}, SD {sizes.std():.2g}")
    if clump.radii is not None:
        found.append(f"spheres of radii {float(clump.radii.min()):.3g} to {float(clump.radii.max()):.3g} R")
    return "; ".join(found)


@functools.lru_cache(maxsize=64)
def _sections(spheres: tuple[tuple[float, ...], ...]) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, first moment [3] and second moment [3, 3] of a union of spheres, each given as x, y, z and radius.

    Along each line parallel to z the union is a set of intervals whose ends are known exactly; only the two
    transverse directions are discretised (midpoint rule). That takes 0.3 s, and sweeps ask for one grain many times.
    """
    table = np.asarray(spheres)
    offsets, radii = table[:, :3], table[:, 3]
    low, high = (offsets[:, :2] - radii[:, None]).min(axis=0), (offsets[:, :2] + radii[:, None]).max(axis=0)
    step = (high - low) / _LINES
    x = low[0] + step[0] * (np.arange(_LINES) + 0.5)
    y = low[1] + step[1] * (np.arange(_LINES) + 0.5)
    grid_x, grid_y = (g.ravel() for g in np.meshgrid(x, y, indexing="ij"))
    reach2 = radii**2 - (grid_x[:, None] - offsets[:, 0]) ** 2 - (grid_y[:, None] - offsets[:, 1]) ** 2
    hit = reach2 > 0.0
    half = np.sqrt(np.where(hit, reach2, 0.0))
    start = np.where(hit, offsets[:, 2] - half, np.inf)
    order = np.argsort(start, axis=1)
    start = np.take_along_axis(start, order, axis=1)
    stop = np.take_along_axis(np.where(hit, offsets[:, 2] + half, -np.inf), order, axis=1)
    # Clip every interval to what the earlier ones have not covered; empty intervals get zero length.
    covered = np.maximum.accumulate(stop, axis=1)
    start[:, 1:] = np.maximum(start[:, 1:], covered[:, :-1])
    start = np.where(np.isfinite(start), start, 0.0)
    stop = np.maximum(np.where(np.isfinite(stop), stop, 0.0), start)

    length = np.sum(stop - start, axis=1)
    first_z = np.sum(stop**2 - start**2, axis=1) / 2.0
    second_z = np.sum(stop**3 - start**3, axis=1) / 3.0
    area = float(step[0] * step[1])
    volume = area * float(length.sum())
    first = area * np.array([(length * grid_x).sum(), (length * grid_y).sum(), first_z.sum()])
    xx, yy, zz = (length * grid_x**2).sum(), (length * grid_y**2).sum(), second_z.sum()
    xy, xz, yz = (length * grid_x * grid_y).sum(), (first_z * grid_x).sum(), (first_z * grid_y).sum()
    return volume, first, area * np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@usual_rules()
def clump(
    offsets: Sequence[Sequence[float]] | np.ndarray,
    shape: str = "clump",
    *,
    radii: Sequence[float] | np.ndarray | None = None,
) -> Clump:
    """A rigid grain of spheres centred at `offsets`.

    Mass and inertia are those of the solid union of the spheres, to about 1e-5. The offsets are shifted to the centre
    of mass and rotated to the principal axes.

    Args:
        offsets: centres of the spheres, [K, 3], in R, in any frame.
        shape: a name for logs and files.
        radii: radii of the spheres, [K], in R; default all 1.

    Raises:
        ValueError: if `offsets` is not a finite [K, 3] array with K >= 1, a radius is outside [0.1, 10], or the largest
            is more than 10 times the smallest.
    """
    if not is_real(offsets):
        raise ValueError(f"clump offsets must be numbers, [K, 3], got {said(offsets)}")
    centres = np.asarray(offsets, dtype=float)
    if centres.ndim != 2 or centres.shape[0] < 1 or centres.shape[1] != 3 or not np.all(np.isfinite(centres)):
        raise ValueError(f"clump offsets must be a finite [K, 3] array, got shape {centres.shape}")
    own = _lengths("clump radii", np.ones(len(centres)) if radii is None else radii, len(centres))
    require_radii(own)
    volume, first, second = _sections(tuple(map(tuple, np.column_stack([centres, own]).tolist())))
    centre = first / volume
    second = second - volume * np.outer(centre, centre)
    inertia = np.trace(second) * np.eye(3) - second
    moments, axes = np.linalg.eigh(inertia)
    isotropic = bool(np.ptp(moments) < 1e-4 * moments.mean())
    centres = centres - centre
    if isotropic:  # every frame is principal: keep the caller's axes
        moments = np.full(3, moments.mean())
    else:
        axes = axes * np.sign(np.linalg.det(axes))
        centres = centres @ axes
    return Clump(
        offsets=jnp.asarray(centres),
        mass=jnp.asarray(volume),
        inertia=jnp.asarray(moments),
        diameter=jnp.asarray(2.0 * (own + np.linalg.norm(centres, axis=1)).max()),
        isotropic=isotropic,
        shape=shape,
        radii=None if np.all(own == 1.0) else jnp.asarray(own),
    )


def _lengths(name: str, values: Any, count: int | None = None) -> np.ndarray:
    """Positive numbers as an array [count].

    Raises:
        ValueError: if they are not positive numbers, or not `count` of them.
    """
    found = np.asarray(values, float) if is_real(values) else np.zeros(0)
    if found.ndim != 1 or found.size == 0 or found.size != (count or found.size) or not np.all(found > 0.0):
        raise ValueError(f"{name} must be {count or 'N'} positive numbers, got {said(values)}")
    return found


def require_radii(radii: np.ndarray) -> None:
    """Refuse spheres that cannot be listed together: lists have one skin and one size of cells.

    Args:
        radii: radii of all spheres of a pack, in R.

    Raises:
        ValueError: if one is outside `RADII`, or no number; or if the largest is more than `LARGEST_RATIO` times the
            smallest.
    """
    (low, high), least, most = RADII, float(np.min(radii)), float(np.max(radii))
    if not low <= least <= most <= high:
        raise ValueError(f"radii of spheres must be in [{low:g}, {high:g}] R, got {least:g} to {most:g}")
    if most > LARGEST_RATIO * least:
        raise ValueError(
            f"spheres of radii {least:g} to {most:g} R cannot be listed together: the largest may be {LARGEST_RATIO:g} "
            "times the smallest"
        )


@usual_rules()
def sized(clump: Clump, sizes: Sequence[float] | np.ndarray | jax.Array) -> Clump:
    """A grain for a pack whose grains differ in size, as by `gm.lognormal` or `gm.mixture`.

    Lengths grow with the size, mass with its cube and moments of inertia with its fifth power.

    Args:
        clump: the grain of size 1.
        sizes: factors on all lengths of each grain, [N]; may be traced.

    Raises:
        ValueError: if they are no positive numbers, the radius of a sphere is outside [0.1, 10], or the largest radius
            is more than 10 times the smallest.
    """
    if traced(clump, sizes):
        return replace(clump, sizes=jnp.asarray(sizes))
    found = _lengths("sizes", sizes)
    own = np.ones(1) if clump.radii is None else np.asarray(clump.radii)
    require_radii(np.outer([found.min(), found.max()], own))
    return replace(clump, sizes=None if np.all(found == 1.0) else jnp.asarray(found))


@usual_rules()
def sphere() -> Clump:
    """A grain of one unit sphere; mass and inertia are exact."""
    mass = 4.0 * np.pi / 3.0
    return Clump(
        offsets=jnp.zeros((1, 3)),
        mass=jnp.asarray(mass),
        inertia=jnp.full(3, 0.4 * mass),
        diameter=jnp.asarray(2.0),
        isotropic=True,
        shape="sphere",
    )


@usual_rules()
def tetra(overlap: float = 0.6) -> Clump:
    """Four unit spheres on a regular tetrahedron of edge 2 (1 - overlap).

    Args:
        overlap: O, 0 for touching spheres, towards 1 for coincident ones; default the paper's 0.6.

    Raises:
        ValueError: if `overlap` is outside [0, 1).
    """
    require_numbers(**{"tetra overlap": overlap})
    if not 0.0 <= overlap < 1.0:
        raise ValueError(f"tetra overlap must be in [0, 1), got {overlap}")
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
    edge = 2.0 * (1.0 - overlap)
    return clump(corners * edge / np.sqrt(8.0), shape=f"tetra({overlap:g})")
