"""The neighbour lists of a run: their skin, the search, and how much of the skin is used up."""

from typing import Any

import jax
import numpy as np

from gmem_jax.native.search import search as native_search
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.pairs import slack, sphere_centres
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Box, State
from gmem_jax.physics.system import System

SKIN = 0.3
"""Skin of the neighbour list of an experiment, in R. Measured non-affine displacements over a full compression stay
below 0.11 R at N = 325 to 3267, so one list serves a whole experiment; the margin covers the shear and a repeat."""
WIDE_SKIN = 2.0  # R. A run whose list goes stale within a bin is broken beyond this skin if grains are fast,
LARGEST_SKIN = 6.0  # and beyond this one in any case: a frictionless grain in its cage may move by R in a long bin
FAST = 0.1  # R / t_c; of 3,267 frictionless grains in slow cycles the fastest had 0.01, those of unstable steps pass 1


def pair_finder(clump: Clump, extent: np.ndarray, skin: float, **sizes: Any) -> PairFinder:
    """A `PairFinder` with the search of the native library, if that is available."""
    return PairFinder(clump, extent, skin, search=native_search(), **sizes)


def skin_left(system: System, state: State, box: Box) -> jax.Array:
    """The part of the list's skin that is not used up, [B], in R; see `pairs.slack`."""
    spheres = sphere_centres(state.grains, system.clump)
    return slack(system.pairs, spheres, box, system.clump.sphere_radii(len(spheres)))
