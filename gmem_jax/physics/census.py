"""Counts and checks of one configuration: contacts, speeds, overlaps, grains outside the box."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.physics.pairs import image_shifts, largest_deviation, sphere_centres, touching_distance
from gmem_jax.physics.rotation import dot
from gmem_jax.physics.state import Box, State
from gmem_jax.physics.system import System


class Census(NamedTuple):
    """Counts and extremes of one configuration: arrays [B], float64. None of them has a derivative.

    Attributes:
        sphere_contacts: number of pairs of spheres that touch.
        grain_contacts: number of pairs of grains that touch.
        wall_contacts: number of contacts of spheres with walls.
        largest_overlap: largest overlap of two spheres, in R; negative where all are apart.
        largest_speed: largest speed of a grain, in R / t_c.
        deviation: largest distance of a sphere from where an affine motion since the list was made would have brought
            it, in R; see `gmem_jax.physics.pairs.slack`.
        outside: 1 where a sphere's centre is beyond a wall, else 0.
        finite: 1 where all positions, accelerations and spin rates of grains are finite, else 0.
    """

    sphere_contacts: jax.Array
    grain_contacts: jax.Array
    wall_contacts: jax.Array
    largest_overlap: jax.Array
    largest_speed: jax.Array
    deviation: jax.Array
    outside: jax.Array
    finite: jax.Array


TakeCensus = Callable[[System, State, Box], Census]
"""The signature of `take_census`."""


def overlaps(system: System, state: State) -> jax.Array:
    """Overlap of every candidate pair of spheres, [P, B], in R; negative where they are apart."""
    pairs, spheres = system.pairs, sphere_centres(state.grains, system.clump)
    apart = spheres[pairs.second] - spheres[pairs.first]
    if state.cell is not None:
        apart += image_shifts(pairs, state.cell.lengths)
    square = dot(apart, apart)[:, 0]
    reach = touching_distance(pairs, system.clump)
    return jnp.where(pairs.valid[:, None], reach - jnp.sqrt(jnp.where(pairs.valid[:, None], square, 1.0)), -1.0)


def take_census(system: System, state: State, box: Box) -> Census:
    """The census of a state between the walls `box`, leaves [3, B]. It defines what the native library counts."""
    system, state, box = lax.stop_gradient((system, state, box))
    grains, pairs = state.grains, system.pairs
    spheres, kind = sphere_centres(grains, system.clump), grains.position.dtype
    overlap = overlaps(system, state)
    # The sphere contacts of each pair of grains. Both counts follow from them, which saves a pass over the overlaps.
    touching = jax.ops.segment_sum((overlap > 0.0).astype(jnp.int32), pairs.grain_pair, num_segments=pairs.capacity)
    own = system.clump.sphere_radii(len(spheres))
    radii = 1.0 if own is None else own[:, None, None]
    at_walls = (spheres - box.lower < radii) * 1 + (box.upper - spheres < radii)
    beyond = (spheres < box.lower) | (spheres > box.upper)
    if any(box.periodic):
        at_walls, beyond = at_walls * ~box.images, beyond & ~box.images
    numbers = grains.position.sum((0, 1)) + grains.acceleration.sum((0, 1)) + grains.spin_rate.sum((0, 1))
    return Census(
        sphere_contacts=jnp.sum(touching, axis=0).astype(kind),
        grain_contacts=jnp.sum(touching > 0, axis=0).astype(kind),
        wall_contacts=jnp.sum(at_walls, axis=(0, 1)).astype(kind),
        largest_overlap=jnp.max(overlap, axis=0),
        largest_speed=jnp.sqrt(jnp.max(jnp.sum(grains.velocity**2, axis=1), axis=0)),
        deviation=largest_deviation(pairs, spheres, box),
        outside=jnp.any(beyond, axis=(0, 1)).astype(kind),
        finite=jnp.isfinite(numbers).astype(kind),
    )
