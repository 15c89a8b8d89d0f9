"""Grains: rigid clumps of equal spheres, and their mass properties.

A grain is a rigid union of unit spheres. The solid union (overlaps counted once) sets volume, mass and inertia;
they are computed by summing exact one-dimensional sections of the union along a fine grid of lines.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.numbers import is_real, require_numbers, said
from gmem_jax.physics.pytree import label, pytree, static
from gmem_jax.physics.rules import usual_rules

_LINES = 700  # lines per side of the integration grid: volume and inertia to about 1e-5


@pytree
@dataclass(frozen=True)
class Clump:
    """One kind of grain, in its principal frame with the centre of mass at the origin (R = rho = 1).

    Attributes:
        offsets: sphere centres, [K, 3], in R.
        mass: mass, equal to the volume of the union, in rho R^3.
        inertia: principal moments, [3], in rho R^5.
        diameter: outer diameter, of the sphere about its centre of mass that holds it, in R.
        isotropic: whether the three moments are equal, so that no gyroscopic term is needed.
        shape: a name for logs and files.
    """

    offsets: jax.Array
    mass: jax.Array
    inertia: jax.Array
    diameter: jax.Array
    isotropic: bool = static(True)
    shape: str = label("clump")

    @property
    def spheres(self) -> int:
        """Number of spheres K in one grain."""
        return int(self.offsets.shape[-2])


def _sections(offsets: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, first moment [3] and second moment [3, 3] of a union of unit spheres.

    Along each line parallel to z the union is a set of intervals whose ends are known exactly; only the two
    transverse directions are discretised (midpoint rule).
    """
    low, high = offsets[:, :2].min(axis=0) - 1.0, offsets[:, :2].max(axis=0) + 1.0
    step = (high - low) / _LINES
    x = low[0] + step[0] * (np.arange(_LINES) + 0.5)
    y = low[1] + step[1] * (np.arange(_LINES) + 0.5)
    grid_x, grid_y = (g.ravel() for g in np.meshgrid(x, y, indexing="ij"))
    reach2 = 1.0 - (grid_x[:, None] - offsets[:, 0]) ** 2 - (grid_y[:, None] - offsets[:, 1]) ** 2
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
def clump(offsets: Sequence[Sequence[float]] | np.ndarray, shape: str = "clump") -> Clump:
    """A rigid grain of unit spheres centred at `offsets`.

    Mass properties are those of the solid union, to about 1e-5; the offsets are moved to the centre of mass and
    turned to the principal axes.

    Args:
        offsets: sphere centres, [K, 3], in R, in any frame.
        shape: a name for logs and files.

    Raises:
        ValueError: if `offsets` is not a finite [K, 3] array with K >= 1.
    """
    if not is_real(offsets):
        raise ValueError(f"clump offsets must be numbers, [K, 3], got {said(offsets)}")
    centres = np.asarray(offsets, dtype=float)
    if centres.ndim != 2 or centres.shape[0] < 1 or centres.shape[1] != 3 or not np.all(np.isfinite(centres)):
        raise ValueError(f"clump offsets must be a finite [K, 3] array, got shape {centres.shape}")
    volume, first, second = _sections(centres)
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
        diameter=jnp.asarray(2.0 * (1.0 + np.linalg.norm(centres, axis=1).max())),
        isotropic=isotropic,
        shape=shape,
    )


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
