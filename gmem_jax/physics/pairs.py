"""Candidate contacts: which sphere pairs may touch, one list shared by all replicas (`search` makes it).

It is a half list, sorted by (i, j), with an incidence table by which the forces on each sphere are gathered. Its
capacities are rounded up to a few sizes, so that lists of packs of one size fit one compiled program.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from gmem_jax.physics.boundary import WALLS, PeriodicAxes
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.pytree import pytree
from gmem_jax.physics.rotation import matrix, matrix_rows
from gmem_jax.physics.state import Box, Grains


def bucket(count: int) -> int:
    """The capacity allocated for `count` rows: the next of eight sizes to an octave, so at most an eighth more."""
    grain = max(1, 1 << max(0, count.bit_length() - 4))
    return -(-count // grain) * grain


@pytree
@dataclass(frozen=True)
class Pairs:
    """Candidate contacts of S = N K spheres; sphere s belongs to grain s // K.

    Attributes:
        first: sphere i of each candidate, int32 [P], i < j; padding is (0, 0).
        second: sphere j, int32 [P].
        valid: False for padding, [P].
        incidence: for each sphere, the rows of its contacts in the stack of forces: c where it is sphere i of candidate
            c, P + c where it is sphere j, and 2 P for padding, [S, C].
        grain_pair: number of the grain pair each candidate belongs to, below P; padding has one of its own, [P].
        reference: sphere centres in box coordinates (0 to 1) when the list was built, [S, 3, B], or [S, 3, 1] for
            replicas that were still alike.
        smallest: edge lengths of the box in which distances were measured, [3].
        reach: largest listed distance of centres in that box, the diameter of the largest sphere + skin; pairs of
            smaller spheres are listed up to R_i + R_j + skin.
        radii: radii of the spheres when the list was built, [S], in R; None where all were 1.
        image: the image of sphere j that is listed: the number of edges of the box by which it is moved along each
            axis, int8 [P, 3]; None between walls.
    """

    first: jax.Array
    second: jax.Array
    valid: jax.Array
    incidence: jax.Array
    grain_pair: jax.Array
    reference: jax.Array
    smallest: jax.Array
    reach: jax.Array
    image: jax.Array | None = None
    radii: jax.Array | None = None

    @property
    def capacity(self) -> int:
        """Number of rows P, padding included."""
        return int(self.first.shape[-1])


def sphere_offsets(quaternion: jax.Array, clump: Clump) -> jax.Array:
    """Sphere centres relative to their grain's centre in the lab frame, [N, K, 3, B], of quaternions [N, 4, B]."""
    body = clump.offsets.reshape(*clump.offsets.shape[:2], -1)[None, :, None]
    if clump.sizes is not None:
        body = body * clump.sizes[:, None, None, None, None]
    return jnp.sum(matrix(quaternion)[:, None] * body, axis=-2)


def sphere_centres(grains: Grains, clump: Clump) -> jax.Array:
    """Sphere centres, [S, 3, B]."""
    centres = grains.position[:, None] + sphere_offsets(grains.quaternion, clump)
    return centres.reshape(-1, *centres.shape[2:])


def sphere_places(
    position: ArrayLike, quaternion: ArrayLike, offsets: ArrayLike, sizes: ArrayLike | None = None
) -> np.ndarray:
    """Sphere centres [N K, 3] of grains [N, 3], [N, 4]; `sphere_centres` without JAX, which compiles for each N.

    Args:
        position: grain centres, in R.
        quaternion: body-to-lab rotations (w, x, y, z).
        offsets: sphere centres in the grain's frame, [K, 3], in R.
        sizes: sizes of the grains, [N]; None where all are 1.
    """
    turned = np.einsum("ijn,kj->nki", np.array(matrix_rows(*np.asarray(quaternion).T)), np.asarray(offsets))
    if sizes is not None:
        turned = turned * np.asarray(sizes)[:, None, None]
    return np.asarray((np.asarray(position)[:, None] + turned).reshape(-1, 3))


def touching_distance(pairs: Pairs, clump: Clump) -> jax.Array | float:
    """R_i + R_j of every candidate, [P, 1], in R; 2 where all radii are 1."""
    radii = clump.sphere_radii(pairs.incidence.shape[-2])
    return 2.0 if radii is None else (radii[pairs.first] + radii[pairs.second])[:, None]


def slack(pairs: Pairs, spheres: jax.Array, box: Box, radii: jax.Array | None = None) -> jax.Array:
    """The distance by which two unlisted spheres may still come closer before they could touch, [B], in R.

    Positive while the list is certainly complete: unlisted spheres are at least ratio * reach apart after the affine
    part of their motion, and the non-affine part brings them together by at most twice the largest deviation. Among
    unequal spheres the slack is least for the largest, since the ratio is at most 1. `radii` [S] are the present radii;
    they may have grown since the list was built.
    """
    return slack_of(pairs, largest_deviation(pairs, spheres, box), box, radii)


def slack_of(pairs: Pairs, deviation: jax.Array, box: Box, radii: jax.Array | None = None) -> jax.Array:
    """`slack` from a known `largest_deviation`."""
    touching: jax.Array | float = 2.0
    if radii is not None or pairs.radii is not None:
        before, now = (jnp.ones(1) if own is None else own for own in (pairs.radii, radii))
        touching = 2.0 * (jnp.max(before) + jnp.max(now - before))
    ratio = jnp.minimum(1.0, jnp.min(box.lengths / pairs.smallest[:, None], axis=0))
    return ratio * pairs.reach - touching - 2.0 * deviation


def largest_deviation(pairs: Pairs, spheres: jax.Array, box: Box) -> jax.Array:
    """Largest distance of a sphere from where affine motion since the list was built would have brought it, [B]."""
    affine = box.lower + pairs.reference * box.lengths
    return jnp.sqrt(jnp.max(jnp.sum((spheres - affine) ** 2, axis=1), axis=0))


def image_shifts(pairs: Pairs, lengths: jax.Array) -> jax.Array | float:
    """The displacement of the listed image of sphere j from sphere j, for each candidate, [P, 3, B]; 0 between walls.

    `lengths` are the edges of the box, [3, B]. If they are the rates at which the edges grow, the result is the
    velocity of the image relative to sphere j.
    """
    return 0.0 if pairs.image is None else pairs.image[..., None] * lengths


def nearest_images(
    found: np.ndarray, reference: np.ndarray, smallest: np.ndarray, periodic: PeriodicAxes
) -> np.ndarray:
    """`Pairs.image` of sphere pairs `found` [2, n]: the nearest image, in the replica where it comes nearest.

    The other arguments are those of `Pairs` and `Box`.
    """
    apart = reference[found[1]] - reference[found[0]]
    turns = np.where(np.asarray(periodic)[:, None], -np.rint(apart), 0.0)
    nearest = np.argmin(np.sum(((apart + turns) * np.asarray(smallest)[:, None]) ** 2, axis=1), axis=-1)
    images: np.ndarray = np.take_along_axis(turns, nearest[:, None, None], axis=-1)[..., 0].astype(np.int8)
    return images


def tabulate(
    found: np.ndarray,
    reference: np.ndarray,
    smallest: np.ndarray,
    reach: float,
    spheres_per_grain: int,
    *,
    capacity: int = 0,
    per_sphere: int = 0,
    periodic: PeriodicAxes = WALLS,
    radii: jax.Array | None = None,
) -> Pairs:
    """`Pairs` from sorted sphere pairs [2, n]: padded, with the incidence table.

    Args:
        found: i < j, sorted, [2, n].
        reference: see `Pairs`.
        smallest: see `Pairs`.
        reach: see `Pairs`.
        spheres_per_grain: K.
        capacity: rows to allocate at least; rounded up (see `bucket`), and raised to what was found.
        per_sphere: columns of the incidence table to allocate at least; rounded up to a multiple of four, and raised to
            what was found.
        periodic: the periodic axes of the box.
        radii: see `Pairs`.
    """
    pairs, count = found.shape[1], reference.shape[0]
    capacity = bucket(max(8, capacity, pairs))  # a gas may have no candidates, but arrays need rows
    found = found.astype(np.int32)
    # In the row of a sphere stand first the contacts whose sphere i it is, then the others, both in the list's order.
    as_first, as_second = (np.bincount(side, minlength=count).astype(np.int32) for side in found)
    per_sphere = -(-max(1, per_sphere, int((as_first + as_second).max(initial=0))) // 4) * 4
    incidence = np.full((count, per_sphere), 2 * capacity, dtype=np.int32)
    rows = np.arange(pairs, dtype=np.int32)
    # The columns of a sparse matrix are a stable sort by the second sphere, made by counting instead of comparing.
    from scipy import sparse  # half a second, which most commands never need

    entries = (rows, found[1], np.arange(pairs + 1, dtype=np.int32))
    by_second = sparse.csr_array(entries, shape=(pairs, count)).tocsc().data
    for order, owners, listed, number, after in (
        (rows, found[0], as_first, 0, 0 * as_first),
        (by_second, np.repeat(np.arange(count), as_second), as_second, capacity, as_first),
    ):
        place = rows + (after - np.cumsum(listed, dtype=np.int32) + listed)[owners]
        incidence[owners, place] = number + order
    padded = np.zeros((2, capacity), dtype=np.int32)
    padded[:, :pairs] = found
    # The listed pairs are nearly sorted, and a stable sort is fast on these; with the padding it took most of the time.
    one, other = found // spheres_per_grain
    keys = one.astype(np.int64) * count + other
    order = np.argsort(keys, kind="stable")
    grain_pair = np.zeros(capacity, dtype=np.int32)
    grain_pair[order] = int(pairs < capacity) + np.cumsum(np.diff(keys[order], prepend=keys[order[:1]]) != 0)
    image = None
    if any(periodic):
        image = np.zeros((capacity, 3), dtype=np.int8)
        image[:pairs] = nearest_images(found, reference, smallest, periodic)
    return Pairs(
        first=jnp.asarray(padded[0]),
        second=jnp.asarray(padded[1]),
        valid=jnp.asarray(np.arange(capacity) < pairs),
        incidence=jnp.asarray(incidence),
        grain_pair=jnp.asarray(grain_pair),
        reference=jnp.asarray(reference),
        smallest=jnp.asarray(smallest),
        reach=jnp.asarray(float(reach)),
        image=None if image is None else jnp.asarray(image),
        radii=radii,
    )


def listed_candidates(pairs: Pairs) -> np.ndarray:
    """The listed sphere pairs without padding, [2, n]."""
    real = np.asarray(pairs.valid)
    listed: np.ndarray = np.stack([np.asarray(pairs.first)[real], np.asarray(pairs.second)[real]])
    return listed


def carry_history(history: Any, blank: Any, old: Pairs, new: Pairs) -> Any:
    """Move contact histories from one list to the next; contacts that were not listed start blank.

    Args:
        history: pytree with leaves [P_old, ...].
        blank: histories of untouched contacts for the new list, leaves [P_new, ...].
        old: the list `history` belongs to.
        new: the list it moves to.
    """
    if not jax.tree.leaves(history):
        return blank
    spheres = np.int64(old.reference.shape[0])
    old_keys, new_keys = (one * spheres + other for one, other in (listed_candidates(old), listed_candidates(new)))
    place = np.minimum(np.searchsorted(old_keys, new_keys), max(0, old_keys.size - 1))
    known = (old_keys[place] == new_keys) if old_keys.size else np.zeros(new_keys.size, dtype=bool)
    # As long as the new list, so that lists of one capacity are moved by one program.
    source, carried = np.zeros(new.capacity, np.int32), np.zeros(new.capacity, dtype=bool)
    source[: place.size], carried[: place.size] = np.where(known, place, 0), known
    moved: Any = _carried(history, blank, jnp.asarray(source), jnp.asarray(carried))
    return moved


@jax.jit
def _carried(history: Any, blank: Any, source: jax.Array, carried: jax.Array) -> Any:
    """Rows `source` of a history where `carried`, else the rows of the blank one."""

    def chosen(leaf: jax.Array, empty: jax.Array) -> jax.Array:
        kept = carried.reshape(-1, *(1 for _ in empty.shape[1:]))
        return jnp.where(kept, leaf[source], empty)

    return jax.tree.map(chosen, history, blank)
