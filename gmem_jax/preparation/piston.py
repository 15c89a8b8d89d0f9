"""The +z wall under pressure: a speed-limited servo, and the free flight of the gas (a servo of zero speed).

In a periodic box the cell is strained along z instead, and carries its grains along.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.native.backend import ResolvedBackend
from gmem_jax.physics.pairs import slack_of
from gmem_jax.physics.pytree import Scalar, pytree
from gmem_jax.physics.state import Box, State
from gmem_jax.physics.system import System
from gmem_jax.simulation.sample import check
from gmem_jax.simulation.strain import servo_rate

STEPS_PER_CHECK = 8  # steps between two checks of the neighbour list: grains may fly freely here


@pytree
@dataclass(frozen=True)
class Servo:
    """The wall moves at gain * (p_z / target - 1), at most at `speed`.

    Attributes:
        target: p_z wanted, in E.
        speed: largest wall speed, in R / t_c; 0 keeps the wall where it is.
        gain: wall speed per relative pressure error, in R / t_c.
        error: relative error of p_z that counts as settled.
        quiet: largest grain speed that counts as settled, in R / t_c; 0 never settles.
    """

    target: Scalar
    speed: Scalar
    gain: Scalar
    error: Scalar
    quiet: Scalar


@pytree
@dataclass(frozen=True)
class Pressed:
    """The state of a servo run, with one replica.

    Attributes:
        state: the grains.
        box: the walls.
        pressure: p_z averaged over the last block, [1].
        blocks: number of blocks of `STEPS_PER_CHECK` steps that the last call has run.
        settled: whether pressure and speed are within the servo's bounds.
        crowded: whether the neighbour list must be rebuilt before going on.
    """

    state: State
    box: Box
    pressure: jax.Array
    blocks: jax.Array
    settled: jax.Array
    crowded: jax.Array


def largest_speed(state: State) -> jax.Array:
    """Largest grain speed over grains and replicas, in R / t_c."""
    return jnp.sqrt(jnp.max(jnp.sum(state.grains.velocity**2, axis=1)))


def press(
    system: System, pressed: Pressed, servo: Servo, dt: Scalar, drag: Scalar, blocks: int, backend: ResolvedBackend
) -> Pressed:
    """Run up to `blocks` blocks of steps; stop early when settled, when the list needs a rebuild, or on a status bit.

    The wall moves steadily during a block, at a speed set by p_z averaged over the previous block. The run stops before
    the list can become incomplete: the skin that is left must cover the next block at the speed of the fastest sphere.
    """
    clump = system.clump
    reach = clump.largest * jnp.sqrt(jnp.max(jnp.sum(clump.offsets**2, axis=1)))
    times = dt * jnp.arange(1.0, STEPS_PER_CHECK + 1.0)

    def block(now: Pressed) -> Pressed:
        velocity = servo_rate(now.pressure, servo.target, servo.gain, servo.speed)
        climb = jnp.zeros_like(now.box.upper).at[2].set(velocity)
        still, (lower, upper) = jnp.zeros_like(climb), (now.box.lower, now.box.upper)
        boxes = jax.vmap(lambda time: Box(lower, upper + time * climb, still, climb, now.box.periodic))(times)
        state, total = backend.march(system, now.state, boxes, dt, drag)
        box = jax.tree.map(lambda leaf: leaf[-1], boxes)
        census = backend.census(system, state, box)
        state = check(system, state, box, census)
        fastest = jnp.max(census.largest_speed)
        spin = jnp.sqrt(jnp.max(jnp.sum(state.grains.spin**2, axis=1)))
        ahead = 2.0 * STEPS_PER_CHECK * dt * (1.2 * (fastest + reach * spin) + servo.speed)
        radii = clump.sphere_radii(system.pairs.incidence.shape[0])
        room = jnp.min(slack_of(system.pairs, census.deviation, box, radii))
        pressure = total[2] / STEPS_PER_CHECK
        met = jnp.max(jnp.abs(pressure / servo.target - 1.0)) < servo.error
        return Pressed(
            state=state,
            box=box,
            pressure=pressure,
            blocks=now.blocks + 1,
            settled=met & (fastest < servo.quiet),
            crowded=room < ahead,
        )

    def goes_on(now: Pressed) -> jax.Array:
        return (now.blocks < blocks) & ~now.settled & ~now.crowded & (now.state.status[0] == 0)

    no = jnp.asarray(False)
    return lax.while_loop(goes_on, block, replace(pressed, blocks=jnp.asarray(0), settled=no, crowded=no))
