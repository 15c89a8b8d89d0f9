"""Prepared packs: grains at rest in their box, the start of every experiment."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.html import Facts, brief, facts, line
from gmem_jax.physics.boundary import WALLS, PeriodicAxes, boundary_of
from gmem_jax.physics.grain import Clump, words_of_sizes
from gmem_jax.physics.numbers import plural, require_double, said
from gmem_jax.physics.pairs import Pairs, listed_candidates, tabulate
from gmem_jax.physics.pytree import label, pytree, static
from gmem_jax.physics.rotation import unit
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import Box, Grains, still_box
from gmem_jax.simulation.neighbors import SKIN, pair_finder
from gmem_jax.simulation.strain import smallest_box


@pytree
@dataclass(frozen=True)
class Pack:
    """N grains at rest in their box at u = 0 (R = E = rho = 1).

    Attributes:
        clump: the shape of the grains, and their sizes if they differ.
        position: centres of mass of the grains, [N, 3], in R.
        quaternion: body-to-lab rotations (w, x, y, z), [N, 4].
        lower: coordinates of the lower planes of the box, [3], in R.
        upper: coordinates of the upper planes, [3], in R.
        delta0: areal compression by which the pack was cycled.
        ringing_period: T_1, the period of the slowest shear mode of the box that wall motion excites, in t_c.
        pairs: neighbour list (candidate contacts) that is valid up to a compression by delta0.
        periodic: which axes of the box are periodic, three truth values. Along a periodic axis the centres of grains
            lie between the planes, and their spheres may reach beyond.
        name: a name for logs and files.
        record: JSON of the recipe of the preparation and of the measurements at its end.
        source: the file it was read from, or the name of a shipped pack.

    The last three are labels: programs are not compiled for them.
    """

    clump: Clump
    position: jax.Array
    quaternion: jax.Array
    lower: jax.Array
    upper: jax.Array
    delta0: jax.Array
    ringing_period: jax.Array
    pairs: Pairs
    periodic: PeriodicAxes = static(WALLS)
    name: str = label("pack")
    record: str = label("{}")
    source: str = label("")

    @property
    def grains(self) -> int:
        """Number of grains N."""
        return int(self.position.shape[-2])

    @property
    def box(self) -> Box:
        """The box at u = 0, of one replica."""
        return still_box(self.lower[:, None], self.upper[:, None], self.periodic)

    @property
    def info(self) -> dict[str, Any]:
        """`record` as a dictionary."""
        info: dict[str, Any] = json.loads(self.record)
        return info

    def _facts(self) -> Facts:
        rest = self.info.get("at_rest", {})
        measured = {"filling phi": "filling", "coordination Z": "coordination", "pressure (E)": "pressure"}
        rows = {
            "grains": f"{self.grains} {self.clump.shape}",
            **({} if self.clump.equal else {"unequal": words_of_sizes(self.clump)}),
            "box (R)": brief(self.upper - self.lower),
            **({"boundary": boundary_of(self.periodic)} if any(self.periodic) else {}),
            "delta0": self.delta0,
            "T1 (t_c)": self.ringing_period,
            **{label: rest[name] for label, name in measured.items() if name in rest},
        }
        return f"Pack {self.name}", rows

    def __repr__(self) -> str:
        return line(self, self._facts)

    def _repr_html_(self) -> str:
        return facts(*self._facts())


def find_pairs(clump: Clump, position: np.ndarray, quaternion: np.ndarray, box: Box, delta0: float) -> Pairs:
    """The candidate contacts of a whole experiment on a pack (positions [N, 3], quaternions [N, 4]).

    Raises:
        ValueError: if the grains have sizes, and their number differs from that of the grains.
    """
    if clump.sizes is not None and len(clump.sizes) != len(position):
        raise ValueError(f"a pack of {len(position)} grains needs a size for each grain, got {len(clump.sizes)} sizes")
    smallest = smallest_box(np.asarray(box.lower)[:, 0], np.asarray(box.upper)[:, 0], delta0)
    still = jnp.zeros((*np.shape(position), 1))
    grains = Grains(jnp.asarray(position)[..., None], jnp.asarray(quaternion)[..., None], still, still, still, still)
    return pair_finder(clump, smallest, SKIN)(grains, clump, box, smallest)


@usual_rules()
def pack_from(pack: Pack, *, position: jax.Array, quaternion: jax.Array, name: str = "") -> Pack:
    """A pack with the box and the grain of another, and other positions; its neighbour list is built anew.

    The record keeps no measurements of the old pack at rest.

    Args:
        pack: the pack whose box, grain, delta0 and ringing period are taken.
        position: centres of mass, [N, 3], in R.
        quaternion: body-to-lab rotations (w, x, y, z), [N, 4]; they are normalised.
        name: name of the new pack; default that of the old one.

    Raises:
        ValueError: if a number is not finite, a quaternion is zero, or shapes and sizes are not those of one pack.
    """
    position, quaternion = jnp.asarray(position, float), jnp.asarray(quaternion, float)
    if position.ndim != 2 or (position.shape[1], quaternion.shape) != (3, (len(position), 4)):
        raise ValueError(f"a pack has centres [N, 3] and quaternions [N, 4], got {position.shape}, {quaternion.shape}")
    quaternion = unit(quaternion[..., None])[..., 0]
    broken = ~np.all(np.isfinite(np.concatenate([position, quaternion], axis=1)), axis=1)
    if np.any(broken):
        raise ValueError(f"grain {np.argmax(broken) + 1}: a number is not finite, or its quaternion is zero")
    pairs = find_pairs(pack.clump, np.asarray(position), np.asarray(quaternion), pack.box, float(pack.delta0))
    record = json.dumps({key: value for key, value in pack.info.items() if key != "at_rest"})
    return replace(pack, position=position, quaternion=quaternion, pairs=pairs, name=name or pack.name, record=record)


@usual_rules()
def stack(packs: Sequence[Pack]) -> Pack:
    """Stack packs into one `Pack` whose arrays have a leading axis, for `jax.vmap`.

    Args:
        packs: packs with the same number of grains, shape of grain and boundary. If one grain is not isotropic, none of
            the stack counts as isotropic.

    Raises:
        ValueError: if there is no pack, they differ in one of these, or one is not in double precision.
    """
    if isinstance(packs, Pack) or not isinstance(packs, Iterable):
        given = packs.name if isinstance(packs, Pack) else said(packs)
        raise ValueError(f"stack takes several packs, in a list: got {given}")
    packs = tuple(packs)
    if not packs:
        raise ValueError("stack needs at least one pack")
    first = packs[0]
    for pack in packs:
        if not isinstance(pack, Pack):
            raise ValueError(f"stack takes packs, got {said(pack)}")
        if np.ndim(pack.position) != 2:
            raise ValueError(f"stack takes single packs; {pack.name} is a stack already")
        require_double(pack=pack)
    for pack in packs[1:]:
        if (own := _size_and_grain(pack)) != (its := _size_and_grain(first)):
            raise ValueError(
                f"packs to be stacked must have one size and grain: {first.name} has {its}, {pack.name} has {own}"
            )
        if any((one is None) != (other is None) for one, other in zip(*map(_unequal, (first, pack)), strict=True)):
            raise ValueError(f"either all packs of a stack have sizes, or none: {first.name} and {pack.name} differ")
        if pack.periodic != first.periodic:
            raise ValueError(
                f"packs to be stacked must have one boundary: {first.name} has {boundary_of(first.periodic)}, "
                f"{pack.name} has {boundary_of(pack.periodic)}"
            )
    capacity = max(pack.pairs.capacity for pack in packs)
    per_sphere = max(pack.pairs.incidence.shape[-1] for pack in packs)
    name = "+".join(pack.name for pack in packs)
    isotropic = all(pack.clump.isotropic for pack in packs)
    padded = [
        replace(
            pack,
            clump=replace(pack.clump, isotropic=isotropic),
            pairs=_widen(pack, capacity, per_sphere),
            name=name,
            record="{}",
        )
        for pack in packs
    ]
    stacked: Pack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)
    return stacked


def _size_and_grain(pack: Pack) -> str:
    return f"{pack.grains} {pack.clump.shape} of {plural(pack.clump.spheres, 'sphere')}"


def _unequal(pack: Pack) -> tuple[jax.Array | None, jax.Array | None]:
    return pack.clump.radii, pack.clump.sizes


def _widen(pack: Pack, capacity: int, per_sphere: int) -> Pairs:
    """The neighbour list of a pack in tables of a larger capacity."""
    pairs = pack.pairs
    return tabulate(
        listed_candidates(pairs),
        np.asarray(pairs.reference),
        np.asarray(pairs.smallest),
        float(pairs.reach),
        pack.clump.spheres,
        capacity=capacity,
        per_sphere=per_sphere,
        periodic=pack.periodic,
        radii=pairs.radii,
    )
