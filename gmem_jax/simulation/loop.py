"""The one loop: a bin is some steps under prescribed walls; a rollout is one bin after the other.

Everything that moves grains along a protocol goes through `bin_step`: the rollout of a whole protocol in one traced
computation, and the chunks of the host (`simulation.runner`), forwards and for derivatives.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gmem_jax import native
from gmem_jax.physics.pairs import Pairs
from gmem_jax.physics.pytree import Scalar, pytree, static
from gmem_jax.physics.state import Box, State
from gmem_jax.physics.step import System, mark_varying
from gmem_jax.simulation import scan
from gmem_jax.simulation.protocol import Bin
from gmem_jax.simulation.sample import Sample, end_bin
from gmem_jax.simulation.strain import StrainPath


@pytree
@dataclass(frozen=True)
class Simulation:
    """What a rollout is told, and does not change.

    Attributes:
        system: grains, law, candidates, material.
        path: how the walls move.
        dt: time step, in t_c; scalar or [B].
        drag: viscous drag while the walls stand still, 1 / t_c; scalar or [B].
        steps: steps in a bin.
        backend: who does them; see `native.resolve`.
        precision: of contacts, likewise.
    """

    system: System
    path: StrainPath
    dt: Scalar
    drag: Scalar = 0.0
    steps: int = static(1)
    backend: str = static("auto")
    precision: str = static("double")

    @property
    def resolved(self) -> native.ResolvedBackend:
        """What does the steps; the same object for all simulations that ask for the same."""
        return native.resolve(self.backend, self.precision, self.system.friction)

    def with_pairs(self, pairs: Pairs) -> "Simulation":
        """The same with another list of candidates."""
        return replace(self, system=replace(self.system, pairs=pairs))

    def duration(self, bins: int) -> float:
        """How long some bins take, in t_c; the longest of the replicas."""
        return bins * self.steps * float(np.max(np.asarray(self.dt)))

    def box_before(self, row: Bin) -> Box:
        """The walls at the beginning of a bin; their velocities are per bin here."""
        return self.path.box_at(row, jnp.asarray(float(row.number)), float(row.bins))


def walls(simulation: Simulation, row: Bin, replicas: int) -> Box:
    """The walls at the end of each step of a bin, leaves [steps, 3, B]."""
    dt, steps = jnp.asarray(simulation.dt), simulation.steps
    count = row.number * steps + 1 + jnp.arange(steps)
    times = count.reshape(-1, *(1 for _ in dt.shape)) * dt
    boxes = jax.vmap(lambda time: simulation.path.box_at(row, time, (row.bins * steps) * dt))(times)
    wide: Box = jax.tree.map(lambda leaf: jnp.broadcast_to(_padded(leaf, replicas), (steps, 3, replicas)), boxes)
    return wide


def _padded(leaf: Any, replicas: int) -> Any:
    """A number for each replica, also for the copies of replica 0 that fill up devices (see `sharding`)."""
    known = jnp.shape(leaf)[-1] if jnp.ndim(leaf) else 1
    if not 1 < known < replicas:
        return leaf
    return jnp.concatenate([leaf, jnp.repeat(leaf[..., :1], replicas - known, axis=-1)], axis=-1)


def bin_step(simulation: Simulation, state: State, row: Bin) -> tuple[State, Sample]:
    """One bin: its steps, the checks at its end, its sample."""
    with jax.named_scope("walls"):
        boxes = walls(simulation, row, state.replicas)
        still = (row.start == row.stop) & ~jnp.asarray(row.sheared, bool)
        drag = _padded(jnp.where(still, simulation.drag, 0.0), state.replicas)
    with jax.named_scope("steps"):
        dt = _padded(simulation.dt, state.replicas)
        state, total = simulation.resolved.march(simulation.system, state, boxes, dt, drag)
    with jax.named_scope("sample"):
        last = jax.tree.map(lambda leaf: leaf[-1], boxes)
        return end_bin(simulation.system, state, last, total / simulation.steps, row.u)


def rollout(simulation: Simulation, state: State, rows: Bin) -> tuple[State, Sample]:
    """The bins of a table one after the other; the state after them, and their samples with a leading axis.

    Reverse mode keeps states at two levels and computes the rest again (see `scan.scan`).
    """
    state, _ = mark_varying((state, simulation))
    return scan.scan(lambda state, row: bin_step(simulation, state, row), state, rows)


def rollout_chunk(
    simulation: Simulation, state: State, first: Bin, count: jax.Array, most: int
) -> tuple[State, Sample]:
    """`count` bins of one stage from the bin `first`, in a program for any count up to `most`; not for reverse mode.

    Returns:
        The state, and samples with a leading axis [most], zero beyond `count`.
    """

    def one(place: jax.Array, carry: tuple[State, Any]) -> tuple[State, Any]:
        state, kept = carry
        state, sample = bin_step(simulation, state, first._replace(number=first.number + place))
        return state, jax.tree.map(lambda all_, new: all_.at[place].set(new), kept, sample)

    shape = jax.eval_shape(lambda: bin_step(simulation, state, first)[1])
    blank = jax.tree.map(lambda leaf: jnp.zeros((most, *leaf.shape), leaf.dtype), shape)
    done: tuple[State, Sample] = lax.fori_loop(0, count, one, (state, blank))
    return done
