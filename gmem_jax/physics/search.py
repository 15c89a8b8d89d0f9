"""The search for candidate contacts, by jax-md.

The list is built on positions mapped affinely into the smallest box of the coming motion, so that only non-affine
displacements use up its skin (a whole experiment needs about 0.2 R).
"""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.boundary import PeriodicAxes, require_room
from gmem_jax.physics.grain import Clump, require_radii
from gmem_jax.physics.pairs import Pairs, sphere_centres, tabulate
from gmem_jax.physics.state import Box, Grains

Search = Callable[[np.ndarray, int, float], np.ndarray]
"""A function of sphere centres [S, 3], the number of spheres per grain and a distance. It returns the sorted numbers
i S + j of all pairs i < j of spheres of different grains that are closer than that distance."""

_centres = jax.jit(sphere_centres)
_SPARE = 1.15  # capacity over what is needed now, so that the next list fits the same compiled program


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
        search: finds the same pairs in place of jax-md.

    Raises:
        ValueError: if the skin is not positive, or spheres differ too much in radius (see `require_radii`).
    """

    def __init__(
        self,
        clump: Clump,
        extent: np.ndarray,
        skin: float,
        *,
        capacity: int = 0,
        per_sphere: int = 0,
        search: Search | None = None,
    ) -> None:
        if not skin > 0.0:
            raise ValueError(f"the skin of a neighbour list must be positive, got {skin}")
        self.skin = float(skin)
        self._extent = np.asarray(extent, dtype=float)
        self._spheres_per_grain = clump.spheres
        self._capacity = int(capacity)
        self._per_sphere = int(per_sphere)
        self._search = search
        self._neighbors: Any = None
        body, own = np.asarray(clump.offsets), np.ones(1) if clump.radii is None else np.asarray(clump.radii)
        largest = float(clump.largest)
        require_radii(np.outer([clump.smallest, largest], own))
        self._widest = float(clump.widest)
        self._cutoff = 2.0 * largest * float((own + np.linalg.norm(body - body.mean(axis=0), axis=1)).max()) + skin
        self._diameter = largest * float(clump.diameter)

    @functools.cached_property
    def _list(self) -> tuple[Any, Any]:
        """jax-md's function that allocates a list for positions, and a jitted one that updates it."""
        # Imported here because jax-md takes seconds to load, and most commands never look for neighbours.
        from jax_md import space

        # jax-md keeps box and cutoff in float32 and wraps its cells around: a margin keeps every centre inside, and the
        # float32 rounding of the cutoff harmless.
        allocate, update = self._functions(space.free()[0], self._extent + 1.0)
        return allocate, jax.jit(lambda positions, neighbors: update(positions, neighbors))

    @functools.cached_property
    def _periodic_list(self) -> tuple[Any, Any]:
        """As `_list`, in a periodic box: both functions take positions in units of its edges, and the edges."""
        from jax_md import space

        edges = jnp.asarray(self._extent)
        displacement, _ = space.periodic_general(edges, fractional_coordinates=True)
        allocate, update = self._functions(displacement, edges, fractional_coordinates=True)
        return allocate, jax.jit(lambda places, neighbors, box: update(places, neighbors, box=box))

    def _functions(self, displacement: Any, edges: Any, **more: bool) -> tuple[Any, Any]:
        from jax_md import partition

        functions = partition.neighbor_list(
            displacement,
            edges,
            r_cutoff=self._cutoff + 1e-4,
            dr_threshold=0.0,
            capacity_multiplier=_SPARE,
            format=partition.OrderedSparse,
            **more,
        )
        return functions.allocate, functions.update

    def kept(self) -> dict[str, np.ndarray]:
        """Arguments, apart from `clump` and `search`, of a finder whose lists have the capacities of this one's."""
        numbers = {"skin": self.skin, "capacity": self._capacity, "per_sphere": self._per_sphere}
        return {"extent": self._extent, **{name: np.asarray(number) for name, number in numbers.items()}}

    def _grain_pairs(self, centres: np.ndarray, smallest: np.ndarray, periodic: PeriodicAxes) -> np.ndarray:
        """Pairs (i < j) of grains whose centres [N, 3] are within the cutoff, [2, n]."""
        with warnings.catch_warnings():
            # jax-md 0.2.29 scatters 64-bit indices into its 32-bit tables, and jax warns of it.
            warnings.filterwarnings("ignore", message="scatter inputs have incompatible types")
            if any(periodic):
                # Along an axis with walls the box is so long that nothing meets an image.
                edges = np.where(periodic, smallest, self._extent + self._cutoff + 1.0)
                self._renew(self._periodic_list, jnp.asarray(centres / edges % 1.0), box=jnp.asarray(edges))
            else:
                self._renew(self._list, jnp.asarray(centres))
        found = np.sort(np.asarray(self._neighbors.idx), axis=0)
        return found[:, found[1] < len(centres)]

    def _renew(self, functions: tuple[Any, Any], positions: jax.Array, **box: jax.Array) -> None:
        """Bring jax-md's list to new positions, with larger arrays if it needs them."""
        allocate, update = functions
        if self._neighbors is not None:
            self._neighbors = update(positions, self._neighbors, **box)
        known = self._neighbors
        # A new list is needed where arrays are too small, or the box shrank so far that its cells are too narrow.
        if known is None or bool(known.did_buffer_overflow) or bool(known.cell_size_too_small):
            self._neighbors = allocate(positions, **box)

    def _keys(
        self, mapped: np.ndarray, radii: np.ndarray | None, smallest: np.ndarray, periodic: PeriodicAxes
    ) -> np.ndarray:
        """Pairs i < j of spheres of different grains within reach, as sorted numbers i S + j; centres are [S, 3]."""
        spheres = np.int64(len(mapped))
        if self._search and not any(periodic):
            found = self._search(mapped, self._spheres_per_grain, self._widest + self.skin)
            if radii is None:
                return found
            one, other = np.divmod(found, spheres)
            gap = np.linalg.norm(mapped[one] - mapped[other], axis=-1) - radii[one] - radii[other]
            return np.asarray(found[gap < self.skin])
        mapped = mapped.reshape(-1, self._spheres_per_grain, 3)
        one, other = self._grain_pairs(mapped.mean(axis=1), smallest, periodic)
        apart = mapped[one][:, :, None] - mapped[other][:, None, :]
        apart -= np.where(periodic, smallest * np.rint(apart / smallest), 0.0)
        distance = np.linalg.norm(apart, axis=-1)
        reach: np.ndarray | float = self._widest + self.skin
        if radii is not None:
            own = radii.reshape(-1, self._spheres_per_grain)
            reach = own[one][:, :, None] + own[other][:, None, :] + self.skin
        pair, sphere_i, sphere_j = np.nonzero(distance < reach)
        first, second = (side[pair] * self._spheres_per_grain for side in (one, other))
        keys: np.ndarray = np.sort((first + sphere_i) * spheres + second + sphere_j)
        return keys

    def __call__(self, grains: Grains, clump: Clump, box: Box, smallest: np.ndarray | None = None) -> Pairs:
        """The candidate list of `grains` in `box`: all pairs that any of the replicas needs.

        Args:
            grains: the grains.
            clump: their shape.
            box: the walls now.
            smallest: edge lengths of the smallest box of the coming motion, [3]; default the present box.

        Raises:
            ValueError: if a periodic box is too small; see `require_room`.
        """
        lengths = np.asarray(box.lengths)
        now = lengths.min(axis=1)  # shear makes the boxes of replicas differ
        smallest = now if smallest is None else np.minimum(smallest, now)
        require_room(smallest, box.periodic, self._widest + self.skin, self._diameter)
        reference = (np.asarray(_centres(grains, clump)) - np.asarray(box.lower)) / lengths
        if np.all(reference == reference[..., :1]):
            reference = reference[..., :1]
        spheres = reference.shape[0]
        own = clump.sphere_radii(spheres)
        radii = None if own is None else np.asarray(own)
        mapped = (reference[..., b] * smallest for b in range(reference.shape[-1]))
        keys = [self._keys(one, radii, smallest, box.periodic) for one in mapped]
        found = np.stack(np.divmod(functools.reduce(np.union1d, keys), spheres))
        if found.shape[1] > self._capacity > 0:
            self._capacity = int(_SPARE * found.shape[1])
        pairs = tabulate(
            found,
            reference,
            smallest,
            self._widest + self.skin,
            self._spheres_per_grain,
            capacity=self._capacity,
            per_sphere=self._per_sphere,
            periodic=box.periodic,
            radii=own,
        )
        self._capacity, self._per_sphere = pairs.capacity, int(pairs.incidence.shape[-1])
        return pairs
