"""The largest stable time step: no perturbation of a pack at rest grows under the linearised step.

A mode of frequency w, whose velocity a dashpot damps at the rate c, is stable while (w dt)^2 + 2 c dt < 4
(docs/decisions/physics.md).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gmem_jax.physics import chance
from gmem_jax.physics.state import Box
from gmem_jax.physics.step import start
from gmem_jax.simulation.compiled import Compiled
from gmem_jax.simulation.loop import Simulation

SHORTEST_STEP, LONGEST_STEP = 0.1, 2.0  # t_c; beyond the latter p_sig is 3 % off or more, if anything is stable
CLOSE = 1.02  # the search ends at this ratio of a step that is not stable to one that is
GROWTH = 1e-4  # ln |z| in a step; slower growth needs ten thousand steps, and sliding contacts dissipate it
ROUNDS = 20  # rounds of the power iteration
DECAY = 8  # steps in a round, in which damped modes vanish
RISE = 2  # differences of successive steps in a round, in which slow modes vanish


def largest_stable_step(simulation: Simulation, position: jax.Array, quaternion: jax.Array, box: Box) -> float:
    """The largest time step that is stable for grains at rest, in all replicas, in t_c.

    Contacts stick: sliding ones are no stiffer. `growth` is evaluated once, or about four times.

    Args:
        simulation: system and backend; its parameters are scalars or [B].
        position: grain centres, [N, 3, B], in R.
        quaternion: orientations, [N, 4, B].
        box: walls at rest, [3, B].

    Returns:
        At most `LONGEST_STEP`; 0 if not even `SHORTEST_STEP` is stable.
    """
    return largest_without(partial(growth, simulation, position, quaternion, box))


def growth(simulation: Simulation, position: jax.Array, quaternion: jax.Array, box: Box, dt: float) -> float:
    """ln |z| of the mode that grows most, in all replicas, where z is its factor in a step of length `dt`.

    Beyond `GROWTH` the step is not stable. It takes some 200 steps with their tangents. The other arguments are those
    of `largest_stable_step`.
    """
    return float(np.max(np.asarray(_growth(simulation, position, quaternion, box, jnp.asarray(dt)))))


def largest_without(growth: Callable[[float], float]) -> float:
    """The longest dt, to 2 %, at which `growth` is at most `GROWTH`; 0 if `SHORTEST_STEP` is too long."""
    high = low = LONGEST_STEP
    below, above = CLOSE**0.5, CLOSE
    while not (grown := growth(low)) <= GROWTH:
        if low == SHORTEST_STEP:
            return 0.0
        high = low
        # An undamped mode that flips its sign in each step has (w dt)^2 = |z| + 2 + 1 / |z|; the limit is at 4.
        low = max(SHORTEST_STEP, float(high / np.cosh(0.5 * grown) / below))
        below **= 2
    while high > CLOSE * low:
        middle = min(above * low, (low * high) ** 0.5)
        if growth(middle) <= GROWTH:
            low, above = middle, above**2
        else:
            high = middle
    return low


def _dot(one: Any, other: Any) -> jax.Array:
    """The scalar product of two trees in every replica, [B]."""
    parts = jax.tree.map(lambda a, b: jnp.sum(a * b, axis=tuple(range(a.ndim - 1))), one, other)
    return sum(jax.tree.leaves(parts), jnp.zeros(()))


def _measured(simulation: Simulation, position: jax.Array, quaternion: jax.Array, box: Box, dt: jax.Array) -> jax.Array:
    """ln |z| of the mode that grows most in steps of `dt`, [B]."""
    rest = start(simulation.system, position, quaternion, box)
    still = jnp.zeros_like(position)
    at = (replace(rest.grains, acceleration=still, spin_rate=still), rest.history, rest.wall_history)
    walls = jax.tree.map(lambda leaf: leaf[None], box)

    def one_step(changing: Any) -> Any:
        grains, history, of_walls = changing
        now = replace(rest, grains=grains, history=history, wall_history=of_walls)
        state, _ = simulation.resolved.march(simulation.system, now, walls, dt, 0.0)
        return state.grains, state.history, state.wall_history

    def step(change: Any) -> Any:
        return jax.jvp(one_step, (at,), (change,))[1]

    def difference(change: Any) -> Any:
        return jax.tree.map(jnp.subtract, step(change), change)

    def one_round(_: Any, change: Any) -> Any:
        change = lax.fori_loop(0, DECAY, lambda _, now: step(now), change)
        change = lax.fori_loop(0, RISE, lambda _, now: difference(now), change)
        size = jnp.sqrt(_dot(change, change))
        return jax.tree.map(lambda leaf: leaf / size, change)

    kicks = jax.random.normal(chance.key(0), (2, *position.shape[:2], 1), position.dtype) + still
    blank = jax.tree.map(jnp.zeros_like, at)
    first = lax.fori_loop(0, ROUNDS, one_round, (replace(blank[0], velocity=kicks[0], spin=kicks[1]), *blank[1:]))
    second = step(first)
    third = step(second)
    # A pair of modes z: third = (sum of both) second - (their product) first.
    one, both, two = _dot(first, first), _dot(first, second), _dot(second, second)
    ahead, behind = _dot(third, second), _dot(third, first)
    apart = one * two - both * both
    total, product = (ahead * one - behind * both) / apart, (ahead * both - behind * two) / apart
    root = jnp.sqrt((0.25 * total * total - product).astype(complex))
    pair = jnp.maximum(jnp.abs(0.5 * total + root), jnp.abs(0.5 * total - root))
    return jnp.log(jnp.where(apart > 1e-12 * one * two, pair, jnp.sqrt(two / one)))


_growth = Compiled(_measured)
