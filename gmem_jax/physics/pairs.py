"""Candidate contacts: which sphere pairs may touch, found by jax-md and shared by all replicas.

The list is a half list in canonical (i, j) order. It is built on positions mapped affinely into the smallest box of
the coming motion, so that only non-affine displacements use up its skin (a whole experiment needs about 0.2 R).
"""

import functools
import warnings
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.grain import Clump
from gmem_jax.physics.rotation import matrix
from gmem_jax.physics.state import Box, Grains

_SPARE = 1.15  # capacity allocated over what is needed now


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pairs:
    """Candidate contacts of S = N K spheres; sphere s belongs to grain s // K.

    Attributes:
        first: sphere i of each candidate, int32 [P], i < j; padding is (0, 0).
        second: sphere j, int32 [P].
        valid: False for padding, [P].
        incidence: for each sphere the rows of its contacts in the stack (as i: c; as j: P + c; padding: 2 P), [S, C].
        grain_pair: number of the grain pair each candidate belongs to, [P].
        reference: sphere centres in box coordinates (0 to 1) when the list was built, [S, 3, B], or [S, 3, 1] for
            replicas that had not parted yet.
        smallest: edge lengths of the box the distances were measured in, [3].
        reach: largest centre distance listed there, 2 R + skin.
    """

    first: jax.Array
    second: jax.Array
    valid: jax.Array
    incidence: jax.Array
    grain_pair: jax.Array
    reference: jax.Array
    smallest: jax.Array
    reach: jax.Array

    @property
    def capacity(self) -> int:
        """Number of rows P, padding included."""
        return int(self.first.shape[-1])


def sphere_offsets(quaternion: jax.Array, clump: Clump) -> jax.Array:
    """Sphere centres relative to their grain's centre in the lab frame, [N, K, 3, B], of quaternions [N, 4, B]."""
    body = clump.offsets[None, :, None, :, None]
    return jnp.sum(matrix(quaternion)[:, None] * body, axis=-2)


def sphere_centres(grains: Grains, clump: Clump) -> jax.Array:
    """Sphere centres, [S, 3, B]."""
    centres = grains.position[:, None] + sphere_offsets(grains.quaternion, clump)
    return centres.reshape(-1, *centres.shape[2:])


def slack(pairs: Pairs, spheres: jax.Array, box: Box) -> jax.Array:
    """How much closer two unlisted spheres may still come before they could touch, [B], in R.

    Positive while the list is certainly complete: unlisted spheres are at least ratio * reach apart after the affine
    part of their motion, and the non-affine part brings them together by at most twice the largest deviation.
    """
    lengths = box.lengths
    affine = box.lower + pairs.reference * lengths
    deviation = jnp.sqrt(jnp.max(jnp.sum((spheres - affine) ** 2, axis=1), axis=0))
    ratio = jnp.minimum(1.0, jnp.min(lengths / pairs.smallest[:, None], axis=0))
    return ratio * pairs.reach - 2.0 - 2.0 * deviation


def tabulate(
    found: np.ndarray,
    reference: np.ndarray,
    smallest: np.ndarray,
    reach: float,
    spheres_per_grain: int,
    *,
    capacity: int = 0,
    per_sphere: int = 0,
    spare: float = _SPARE,
) -> Pairs:
    """`Pairs` from sorted sphere pairs [2, n]: padded to capacity, with the incidence table.

    Capacities too small for what was found are raised, and then allocated `spare` times over (1 for a list that is
    not expected to be rebuilt: padding costs as much as candidates do); the other arguments are fields of `Pairs`.
    """
    pairs, count = found.shape[1], reference.shape[0]
    if pairs > capacity or capacity == 0:
        capacity = max(8, int(pairs * spare))  # a gas may have no candidates, but arrays need rows
    owners = found.ravel()
    rows = np.concatenate([np.arange(pairs), capacity + np.arange(pairs)])
    order = np.argsort(owners, kind="stable")
    owners, rows = owners[order], rows[order]
    place = np.arange(2 * pairs) - np.searchsorted(owners, owners)
    if pairs and place.max() >= per_sphere:
        per_sphere = int(place.max() * spare) + 1
    incidence = np.full((count, max(1, per_sphere)), 2 * capacity, dtype=np.int32)
    incidence[owners, place] = rows
    padded = np.zeros((2, capacity), dtype=np.int32)
    padded[:, :pairs] = found
    grains = padded // spheres_per_grain
    _, grain_pair = np.unique(grains[0].astype(np.int64) * count + grains[1], return_inverse=True)
    return Pairs(
        first=jnp.asarray(padded[0]),
        second=jnp.asarray(padded[1]),
        valid=jnp.asarray(np.arange(capacity) < pairs),
        incidence=jnp.asarray(incidence),
        grain_pair=jnp.asarray(grain_pair.astype(np.int32)),
        reference=jnp.asarray(reference),
        smallest=jnp.asarray(smallest),
        reach=jnp.asarray(reach),
    )


def candidates(pairs: Pairs) -> np.ndarray:
    """The listed sphere pairs without padding, [2, n]."""
    real = np.asarray(pairs.valid)
    listed: np.ndarray = np.stack([np.asarray(pairs.first)[real], np.asarray(pairs.second)[real]])
    return listed


class PairFinder:
    """Builds `Pairs` from a jax-md neighbour list whose capacities grow when they must, and never shrink.

    jax-md lists pairs of grain centres within reach of each other's spheres; each is expanded into its K x K sphere
    pairs, of which those in reach are kept. That keeps spheres of one grain apart by construction, and is several
    times cheaper than a list of spheres (whose prune step scatters N K x 27 cells of candidates).

    Args:
        clump: the grain.
        extent: edge lengths of a box that contains all (mapped) positions of the coming builds, [3].
        skin: distance beyond contact that is still listed, in R.
        capacity: rows to allocate at least.
        per_sphere: contacts per sphere to allocate at least.

    Raises:
        ValueError: if the skin is not positive.
    """

    def __init__(
        self, clump: Clump, extent: np.ndarray, skin: float, *, capacity: int = 0, per_sphere: int = 0
    ) -> None:
        # Imported here because jax-md takes seconds to load, and most commands never look for neighbours.
        from jax_md import partition, space

        if not skin > 0.0:
            raise ValueError(f"the skin of a neighbour list must be positive, got {skin}")
        self.skin = skin
        self._spheres_per_grain = clump.spheres
        self._capacity = capacity
        self._per_sphere = per_sphere
        self._neighbors: Any = None
        free_displacement, _ = space.free()
        body = np.asarray(clump.offsets)
        cutoff = 2.0 * (1.0 + float(np.linalg.norm(body - body.mean(axis=0), axis=1).max())) + skin
        self._fns = partition.neighbor_list(
            free_displacement,
            # jax-md keeps box and cutoff in float32 and wraps its cells around: a margin keeps every centre inside,
            # and the float32 rounding of the cutoff harmless.
            np.asarray(extent, dtype=float) + 1.0,
            r_cutoff=cutoff + 1e-4,
            dr_threshold=0.0,
            capacity_multiplier=_SPARE,
            format=partition.OrderedSparse,
        )
        self._update = jax.jit(lambda positions, neighbors: neighbors.update(positions))

    def _grain_pairs(self, centres: np.ndarray) -> np.ndarray:
        """Pairs (i < j) of grains whose centres [N, 3] are within the cutoff, [2, n]."""
        positions = jnp.asarray(centres)
        with warnings.catch_warnings():
            # jax-md 0.2.29 scatters 64-bit indices into its 32-bit tables, and jax warns of it.
            warnings.filterwarnings("ignore", message="scatter inputs have incompatible types")
            if self._neighbors is not None:
                self._neighbors = self._update(positions, self._neighbors)
            if self._neighbors is None or bool(self._neighbors.did_buffer_overflow):
                self._neighbors = self._fns.allocate(positions)
        found = np.sort(np.asarray(self._neighbors.idx), axis=0)
        return found[:, found[1] < len(centres)]

    def _keys(self, mapped: np.ndarray) -> np.ndarray:
        """Pairs i < j of spheres of different grains within reach, of centres [S, 3], as sorted numbers i S + j."""
        spheres = np.int64(len(mapped))
        mapped = mapped.reshape(-1, self._spheres_per_grain, 3)
        one, other = self._grain_pairs(mapped.mean(axis=1))
        distance = np.linalg.norm(mapped[one][:, :, None] - mapped[other][:, None, :], axis=-1)
        pair, sphere_i, sphere_j = np.nonzero(distance < 2.0 + self.skin)
        first, second = (side[pair] * self._spheres_per_grain for side in (one, other))
        keys: np.ndarray = np.sort((first + sphere_i) * spheres + second + sphere_j)
        return keys

    def __call__(self, grains: Grains, clump: Clump, box: Box, smallest: np.ndarray | None = None) -> Pairs:
        """The candidate list of `grains` in `box`, which holds what any of the replicas needs.

        Args:
            grains: the grains.
            clump: their shape.
            box: the walls now.
            smallest: edge lengths of the smallest box of the coming motion, [3]; default the present box.
        """
        lengths = np.asarray(box.lengths)
        smallest = lengths[:, 0] if smallest is None else np.minimum(smallest, lengths[:, 0])
        reference = (np.asarray(sphere_centres(grains, clump)) - np.asarray(box.lower)) / lengths
        if np.all(reference == reference[..., :1]):
            reference = reference[..., :1]
        spheres = reference.shape[0]
        keys = [self._keys(reference[..., b] * smallest) for b in range(reference.shape[-1])]
        found = np.stack(np.divmod(functools.reduce(np.union1d, keys), spheres))
        pairs = tabulate(
            found,
            reference,
            smallest,
            2.0 + self.skin,
            self._spheres_per_grain,
            capacity=self._capacity,
            per_sphere=self._per_sphere,
        )
        self._capacity, self._per_sphere = pairs.capacity, int(pairs.incidence.shape[-1])
        return pairs


def carry_history(history: Any, blank: Any, old: Pairs, new: Pairs) -> Any:
    """Move contact histories from one list to the next; contacts that were not listed start blank.

    Args:
        history: pytree with leaves [P_old, ...].
        blank: the same for untouched contacts of the new list, leaves [P_new, ...].
        old: the list `history` belongs to.
        new: the list it moves to.
    """
    spheres = np.int64(old.reference.shape[0])

    old_keys, new_keys = (one * spheres + other for one, other in (candidates(old), candidates(new)))
    place = np.searchsorted(old_keys, new_keys)
    place = np.minimum(place, max(0, old_keys.size - 1))
    known = (old_keys[place] == new_keys) if old_keys.size else np.zeros(new_keys.size, dtype=bool)
    source, target = jnp.asarray(place[known]), jnp.asarray(np.flatnonzero(known))
    return jax.tree.map(lambda leaf, empty: empty.at[target].set(leaf[source]), history, blank)
