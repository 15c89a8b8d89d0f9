"""Checks of an experiment when it is made or run, beyond the ranges of numbers and the shapes of arrays."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.readings import Readings
from gmem_jax.physics.boundary import PeriodicAxes
from gmem_jax.physics.contact.creep import RelaxingLaw
from gmem_jax.physics.contact.friction import CoulombLaw, FrictionLaw
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.material import Material
from gmem_jax.physics.numbers import require_numbers, said
from gmem_jax.physics.pairs import sphere_offsets
from gmem_jax.physics.pytree import Scalar, interval, traced
from gmem_jax.physics.rotation import unit
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stage import BINS
from gmem_jax.simulation.strain import COMPRESSIONS

FASTEST_CREEP = 0.05  # part of an elastic force that may relax in a bin: creep acts once in each bin


def static_number(name: str, value: Any) -> float:
    """A number for which a program is compiled, as a float.

    Raises:
        ValueError: if it is traced, not a number, negative, or not finite.
    """
    if traced(value) or value is None or np.ndim(value):
        raise ValueError(f"{name} is fixed when a program is compiled: it must be a number, got {said(value)}")
    require_numbers(**{name: value})
    number = float(value)
    if not 0.0 <= number < math.inf:
        raise ValueError(f"{name} must be in [0, inf), got {value}")
    return number


def require_data(**parts: Any) -> None:
    """Refuse leaves that JAX cannot compute with, in a law or waveforms of the user's own.

    Raises:
        ValueError: naming the first such leaf.
    """
    for name, part in parts.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(part):
            if not (hasattr(leaf, "dtype") or isinstance(leaf, bool | int | float)):
                raise ValueError(
                    f"{name}{jax.tree_util.keystr(path)} is no number: {said(leaf)}; make it static, so that programs "
                    "are compiled for it"
                )


def require_host(what: str, experiment: Any) -> None:
    """Refuse the function `what`, which works on the host, if the experiment is traced or inside `jax.jit`.

    Raises:
        ValueError: saying what to use instead.
    """
    if traced(experiment, jnp.zeros(())):  # inside jax.jit the zero is traced, whatever the experiment is
        raise ValueError(f"{what} works on the host; inside jax.jit, jax.vmap or jax.grad use gm.recall")


def require_inside(pack: Pack) -> None:
    """Refuse a pack that does not lie in its box.

    Raises:
        ValueError: naming the first grain outside the box and its centre, or the first whose numbers are not finite.
    """
    spheres = np.asarray(_spheres(pack.position, pack.quaternion, pack.clump))
    inside = (spheres >= np.asarray(pack.lower)) & (spheres <= np.asarray(pack.upper))
    out = ~np.all(inside | (np.asarray(pack.periodic) & np.isfinite(spheres)), axis=(1, 2))
    if np.any(out):
        grain = int(np.argmax(out))
        if not np.all(np.isfinite(spheres[grain])):
            raise ValueError(f"pack {pack.name}: grain {grain + 1}: a number is not finite, or its quaternion is zero")
        place, lower, upper = (np.round(np.asarray(one), 3) for one in (pack.position[grain], pack.lower, pack.upper))
        raise ValueError(
            f"pack {pack.name}: grain {grain + 1} does not lie in the box: its centre is at {place}, the box is from "
            f"{lower} to {upper} (R)"
        )


@jax.jit
def _spheres(position: jax.Array, quaternion: jax.Array, clump: Clump) -> jax.Array:
    """Centres of spheres, [N, K, 3]."""
    return (position[:, None, :, None] + sphere_offsets(unit(quaternion[..., None]), clump))[..., 0]


def require_walls(periodic: PeriodicAxes, material: Material, wall_mu: Scalar | None = None) -> None:
    """Refuse a rigidity of walls other than the default, and friction of walls, in a box without walls.

    Raises:
        ValueError: naming the parameter.
    """
    rigidity = material.wall_rigidity
    if all(periodic) and not traced(rigidity) and np.any(np.asarray(rigidity) != Material.wall_rigidity):
        raise ValueError("wall_rigidity: a box that is periodic along all axes has no walls")
    if all(periodic) and wall_mu is not None:
        raise ValueError("wall_mu: a box that is periodic along all axes has no walls")


def require_slippery(friction: FrictionLaw, wall_mu: Scalar | None) -> None:
    """Refuse wall friction under a law without mu, since `wall_mu` replaces mu at walls.

    Raises:
        ValueError: naming the law.
    """
    if wall_mu is not None and not isinstance(friction, CoulombLaw):
        raise ValueError(
            f"wall_mu takes the place of mu at walls, and {type(friction).__name__} has no mu: leave wall_mu out, or "
            "use another friction law"
        )


def require_slow_creep(friction: FrictionLaw, creep: Scalar | None, fades: Scalar | None, t0: Scalar) -> None:
    """Refuse creep under a law without elastic forces, and creep that is too fast for the bins between which it acts.

    Raises:
        ValueError: saying which of the two.
    """
    if creep is None:
        if fades is not None:
            raise ValueError("creep_fades is a time after which creep slows, and creep is missing: give creep, a rate")
        return
    if not isinstance(friction, RelaxingLaw):
        raise ValueError(f"creep: {type(friction).__name__} has no elastic forces that could relax")
    in_a_bin = creep * t0 / BINS
    if not traced(in_a_bin) and np.max(np.asarray(in_a_bin)) > FASTEST_CREEP:
        raise ValueError(
            f"creep relaxes {np.max(np.asarray(in_a_bin)):.2g} of a force in a bin of t0 / 256, must be at most "
            f"{FASTEST_CREEP}; use a smaller creep"
        )


def require_memory(protocol: Protocol, background: str) -> None:
    """Refuse a protocol that does not begin at u = 0, does not write and read, or does not fit the background.

    Raises:
        ValueError: saying what it lacks.
    """
    first = protocol.stages[0]
    if first.start != 0.0:
        raise ValueError(f"the pack rests at u = 0, and stage {first.name!r} begins at u = {first.start:g}")
    if not protocol.reads:
        raise ValueError("the protocol has no stage that reads, as gm.read() is one")
    hasty = [name for name in protocol.reads if not protocol.stage(name).length]
    if hasty:
        raise ValueError(f"stage {hasty[0]!r} reads in no time; give it a length, in t0")
    if not protocol.channels:
        raise ValueError("the protocol writes no waveforms of the replicas, as gm.write() does")
    if background != "sub0" and len(protocol.reads) != 2:
        raise ValueError(
            f"background {background!r} needs two reads, the second for the background of the first; the protocol has "
            f"{len(protocol.reads)}"
        )
    if background != "sub0":
        first, second = (protocol.stage(name) for name in protocol.reads)
        if first.ends != second.ends:
            raise ValueError(
                f"background {background!r} needs two reads over the same u; {first.name!r} goes from u = "
                f"{first.ends[0]:g} to {first.ends[1]:g}, and {second.name!r} from {second.ends[0]:g} to "
                f"{second.ends[1]:g}"
            )
        if background == "sub2-bl" and first.moves and set(first.ends) != {0.0, 1.0}:
            raise ValueError(f"background 'sub2-bl' takes off a straight line over all u; {first.name!r} ends before")


def require_told_apart(readings: Readings, integrals: np.ndarray) -> None:
    """Refuse waveforms of several channels that are too alike to tell their recalls apart.

    Args:
        readings: the reads and channels of the protocol.
        integrals: J, [R, C, S, bins], without axes of length one.

    Raises:
        ValueError: saying what to do.
    """
    channels = readings.channels
    for templates in integrals.reshape(-1, len(channels), integrals.shape[-2] * integrals.shape[-1]):
        loud = templates[np.any(templates, axis=1)]
        unit = loud / np.linalg.norm(loud, axis=1, keepdims=True)
        if len(loud) > 1 and np.linalg.svd(unit, compute_uv=False)[-1] < 1e-3:
            raise ValueError(
                f"the waveforms of channels {' and '.join(channels)} are alike in all replicas: what one gives back "
                "cannot be told from the other's; store them in different orders, or one set with its signs changed"
            )


def require_finite_waveforms(ends: np.ndarray, integrals: np.ndarray) -> None:
    """Refuse waveforms that are not finite numbers everywhere.

    Args:
        ends: the waveforms at u = 0 and u = 1, [2, S].
        integrals: their integrals, averaged over each bin, [S, bins].

    Raises:
        ValueError: naming the first such waveform.
    """
    odd = ~(np.all(np.isfinite(ends), axis=0) & np.all(np.isfinite(integrals), axis=1))
    if np.any(odd):
        raise ValueError(f"waveform {np.argmax(odd) + 1} is not a finite number at every u")


def require_pack(pack: Pack) -> None:
    """Refuse a pack whose arrays have wrong shapes, or whose numbers cannot be those of a pack.

    Raises:
        ValueError: naming the first such array or number.
    """
    if jnp.ndim(pack.position) != 2:
        raise ValueError(
            f"an experiment has one pack: positions [N, 3], got {jnp.shape(pack.position)}; put a stack of "
            "packs into jax.vmap"
        )
    grain, spheres = pack.clump, len(pack.pairs.reference)
    shapes = {
        "position": (pack.position, (pack.grains, 3)),
        "quaternion": (pack.quaternion, (pack.grains, 4)),
        "lower": (pack.lower, (3,)),
        "upper": (pack.upper, (3,)),
        "delta0": (pack.delta0, ()),
        "clump.offsets": (grain.offsets, (spheres // pack.grains, 3)),
        "clump.mass": (grain.mass, ()),
        "clump.inertia": (grain.inertia, (3,)),
    }
    for name, (value, wanted) in shapes.items():
        if jnp.shape(value) != wanted:
            raise ValueError(f"pack.{name} must have the shape {wanted}, got {jnp.shape(value)}")
    if not traced(pack.delta0) and not interval(COMPRESSIONS).holds(np.asarray(pack.delta0)):
        raise ValueError(f"pack.delta0 must be in {COMPRESSIONS}, got {float(pack.delta0):g}")
    for name, value in (("mass", grain.mass), ("inertia", grain.inertia)):
        if not traced(value) and not np.all(np.asarray(value) > 0.0):
            raise ValueError(f"pack.clump.{name} must be positive, got {said(value)}")
    if grain.isotropic and not traced(grain.inertia):
        moments = np.asarray(grain.inertia)
        if np.ptp(moments) > 1e-3 * np.mean(moments):
            few = ", ".join(f"{moment:g}" for moment in moments)
            raise ValueError(f"pack.clump is marked isotropic, but its moments are {few}: set isotropic=False")


def require_seen(middles: np.ndarray, integrals: np.ndarray) -> None:
    """Refuse waveforms that are zero in the middle of every bin although their integrals are not.

    Args:
        middles: the waveforms in the middle of each bin, [bins, S].
        integrals: their integrals, averaged over each bin, [S, bins].

    Raises:
        ValueError: naming the first such waveform.
    """
    unseen = np.any(integrals, axis=1) & ~np.any(middles, axis=0)
    if np.any(unseen):
        raise ValueError(
            f"waveform {np.argmax(unseen) + 1} is zero in the middle of every bin of u: make it wider than a bin, "
            f"1 / {len(middles)}"
        )
