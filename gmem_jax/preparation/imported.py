"""Packs made of spheres from files of other programs: shape of the grain, positions and orientations."""

import itertools
import json
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gmem_jax.errors import FileFormatError, warn_caller
from gmem_jax.experiment.pack import Pack, find_pairs
from gmem_jax.experiment.provenance import provenance
from gmem_jax.files.importers import Spheres, load_spheres
from gmem_jax.files.lammpsdata import SAME
from gmem_jax.files.pack_validation import pairs_within
from gmem_jax.files.packs import check_pack
from gmem_jax.files.validation import require
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.grain import Clump, clump, sized, sphere, tetra
from gmem_jax.physics.material import Material
from gmem_jax.physics.pytree import interval
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import still_box
from gmem_jax.physics.system import System
from gmem_jax.preparation.ringing import ringing_period
from gmem_jax.simulation.neighbors import SKIN
from gmem_jax.simulation.progress import Progress, silent
from gmem_jax.simulation.strain import COMPRESSIONS

MISFIT = 1e-3  # R, largest distance of a sphere from its place in the rigid grain
_NAMED = 1e-4  # R, largest difference of the edges of a tetra grain; its overlap is rounded to 1e-4
_ORDERS = 6  # grains of up to this many spheres may list them in different orders
DT = 0.3  # t_c, time step of the run that measures the ringing period


def clump_of_centres(centres: np.ndarray, radii: np.ndarray) -> Clump:
    """The grain with spheres at `centres` [K, 3], of radii [K]; made by `sphere` or `tetra` if it is such a grain."""
    if np.any(radii != 1.0):
        return clump(centres, shape=f"clump-{len(centres)}", radii=radii)
    if len(centres) == 1:
        return sphere()
    edges = np.linalg.norm(centres[:, None] - centres, axis=-1)[np.triu_indices(len(centres), 1)]
    if len(centres) == 4 and np.ptp(edges) < _NAMED:
        overlap = round(1.0 - 0.5 * float(edges.mean()), 4)
        if 0.0 <= overlap < 1.0 and abs(1.0 - 0.5 * edges.mean() - overlap) < _NAMED:
            return tetra(overlap)
    return clump(centres, shape=f"clump-{len(centres)}")


def sizes_of(radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of grains [N] from the radii of their spheres [N, K], and the radii of a grain of size 1, [K].

    If all spheres of each grain are equal, its size is their radius; otherwise the first grain has size 1.
    """
    totals = radii.mean(axis=1)
    equal = np.all(np.ptp(radii, axis=1) <= SAME * totals)
    sizes = totals if equal else totals / totals[0]
    sizes = np.where(np.abs(sizes - 1.0) <= SAME, 1.0, sizes)
    return sizes, np.ones(radii.shape[1]) if equal else radii[0]


def lay(
    centres: np.ndarray, offsets: np.ndarray, radii: np.ndarray | None = None, own: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Centres and orientations of grains, from the places of their spheres.

    Args:
        centres: sphere centres, [N, K, 3]; in any order within a grain of up to 6 spheres.
        offsets: sphere centres in the grain's frame, [K, 3].
        radii: radii of the spheres at `centres`, [N, K], if they differ.
        own: radii of the spheres at `offsets`, [K].

    Returns:
        Grain centres [N, 3] and body-to-lab quaternions (w, x, y, z) [N, 4]. A symmetric shape allows several
        orientations; one of them is returned.

    Raises:
        FileFormatError: if a grain has another shape.
    """
    count, spheres, _ = centres.shape
    turned, misfit = np.tile(np.eye(3), (count, 1, 1)), np.full(count, np.inf)
    middle = centres.mean(axis=1)
    orders = itertools.permutations(range(spheres)) if spheres <= _ORDERS else [tuple(range(spheres))]
    for order in orders:
        left = np.flatnonzero(misfit > MISFIT)
        if not len(left):
            break
        body = offsets[list(order)] - offsets.mean(axis=0)
        seen = centres[left] - middle[left, None]
        first, _, second = np.linalg.svd(np.einsum("nki,kj->nij", seen, body))
        first[:, :, 2] *= np.sign(np.linalg.det(first @ second))[:, None]
        found = first @ second
        far = np.linalg.norm(seen - np.einsum("nij,kj->nki", found, body), axis=2).max(axis=1)
        if radii is not None and own is not None:
            far = np.maximum(far, np.abs(radii[left] - own[list(order)]).max(axis=1))
        better = far < misfit[left]
        turned[left[better]], misfit[left[better]] = found[better], far[better]
    worst = int(np.argmax(misfit))
    require(
        misfit <= MISFIT,
        f"grain {worst + 1} has another shape than the first: a sphere is {misfit[worst]:.2g} R from its place"
        f"{'' if radii is None else ', or has another radius'}",
    )
    quaternion = Rotation.from_matrix(turned).as_quat()[:, [3, 0, 1, 2]]
    return middle - turned @ offsets.mean(axis=0), quaternion


@usual_rules()
def import_pack(
    path: Path,
    *,
    radius: float = 1.0,
    delta0: float = 0.05,
    name: str = "",
    friction: FrictionLaw | None = None,
    progress: Progress = silent,
) -> Pack:
    """A pack of the grains in a LAMMPS data file or a GSD file; see `gmem_jax.files.importers`.

    Args:
        path: the file.
        radius: the length R in the file's unit of length; for equal spheres, their radius.
        delta0: compression that the pack is meant for.
        name: name of the pack; default the file's name.
        friction: law under which the ringing period is measured; default `Hooke()`.
        progress: callback for the progress of that run.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it cannot be read, or is no pack at rest of grains of one shape in a box.
        ValueError: for an impossible radius or delta0, or if the pressure on the walls does not ring.
        RunFailedError: if the grains cannot be simulated.

    Warns:
        UserWarning: of what the file holds and the pack does not.
    """
    if not interval(COMPRESSIONS).holds(delta0):
        raise ValueError(f"delta0 must be in {COMPRESSIONS}, got {delta0:g}")
    read = load_spheres(path, radius)
    try:
        return _pack_of(read, Path(path), delta0, name or Path(path).stem, friction or Hooke(), radius, progress)
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {error}") from error


def _pack_of(
    read: Spheres, path: Path, delta0: float, name: str, law: FrictionLaw, radius: float, progress: Progress
) -> Pack:
    require((read.centres > read.lower) & (read.centres < read.upper), "a grain lies outside the box")
    _require_pressed(read)
    reach, flat = 2.0 * float(read.radii.max()) + SKIN, read.radii.ravel()
    pairs_within(read.centres.reshape(-1, 3), reach, read.centres.shape[1], radii=flat)  # refuses a heap
    sizes, own = sizes_of(read.radii)
    middle, scale = read.centres.mean(axis=1), sizes[:, None]
    alike = middle[:, None] + (read.centres - middle[:, None]) / scale[:, None]
    grain = clump_of_centres(alike[0], own)
    position, quaternion = lay(alike, np.asarray(grain.offsets), read.radii / scale, own)
    position, grain = middle + scale * (position - middle), sized(grain, sizes)
    box = still_box(jnp.asarray(read.lower)[:, None], jnp.asarray(read.upper)[:, None])
    notes = list(read.notes)
    # Packs are exported with this density: the mass of a grain over the volume of its spheres, which overlap.
    spread = float(grain.mass) / (np.sum(own**3) * 4.0 * np.pi / 3.0)
    if read.density is not None and not np.isclose(read.density, (1.0, spread), rtol=SAME).any():
        notes.append(f"the density {read.density:g} of its spheres is left out: that of grains is the unit rho")
    for note in notes:
        warn_caller(f"{path}: {note}")
    imported = {"file": path.name, "radius": radius, "notes": notes}
    record = {"imported": imported, "grain": grain.shape, **provenance()}
    made = Pack(
        clump=grain,
        position=jnp.asarray(position),
        quaternion=jnp.asarray(quaternion),
        lower=jnp.asarray(read.lower),
        upper=jnp.asarray(read.upper),
        delta0=jnp.asarray(delta0),
        ringing_period=jnp.asarray(float(np.max(read.upper - read.lower))),  # until it is measured
        pairs=find_pairs(grain, position, quaternion, box, delta0),
        name=name,
        record=json.dumps(record),
    )
    check_pack(made)
    system = System(grain, law, made.pairs, Material())
    at = (made.position[..., None], made.quaternion[..., None], made.box)
    return replace(made, ringing_period=jnp.asarray(ringing_period(system, *at, DT, progress)))


def _require_pressed(read: Spheres) -> None:
    """Refuse grains that touch no wall along x and y: the pressure on these walls could not ring."""
    radii = read.radii[..., None]
    lower, upper = (read.centres - read.lower < radii), (read.upper - read.centres < radii)
    require((lower | upper)[..., :2].any(), "its grains do not press on the walls: this is no pack at rest")
