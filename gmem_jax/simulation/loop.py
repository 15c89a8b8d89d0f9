"""The loop of a run: a bin is some steps under prescribed walls; a rollout is one bin after the other.

Everything that moves grains along a protocol goes through `bin_step`: the rollout of a whole protocol in one traced
computation, and the chunks of the host (`simulation.runner`), forwards and for derivatives.
"""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gmem_jax.native.backend import ResolvedBackend, resolve
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.census import overlaps
from gmem_jax.physics.contact.creep import RelaxingLaw, relaxation
from gmem_jax.physics.contact.friction import CoulombLaw
from gmem_jax.physics.pairs import Pairs
from gmem_jax.physics.pytree import Scalar, pytree, static, with_field
from gmem_jax.physics.state import Box, Grains, HeldWalls, State
from gmem_jax.physics.step import mark_varying
from gmem_jax.physics.system import System
from gmem_jax.simulation import scan
from gmem_jax.simulation.sample import Sample, end_bin
from gmem_jax.simulation.stage import Bin, Columns, Stage, table
from gmem_jax.simulation.strain import StrainPath, servo_strain, stretched

Observe = Callable[["Simulation", State], Any]
"""A function of (simulation, state) to an array [..., B], in plain JAX: jitted, vmapped and differentiated with the
steps."""


class Mark(NamedTuple):
    """The configuration with which observers compare: a state without its histories, and its walls."""

    grains: Grains
    box: Box
    touching: jax.Array  # number of pairs of spheres that touch, [B]


@pytree
@dataclass(frozen=True)
class Simulation:
    """The constants of a rollout.

    Attributes:
        system: grains, law, candidates, material.
        path: how the walls move.
        dt: time step, in t_c; scalar or [B].
        drag: viscous drag while the walls stand still, 1 / t_c; scalar or [B].
        steps: steps in a bin.
        backend: the backend that runs the steps; see `gmem_jax.native.resolve`.
        precision: precision of contacts, likewise.
        creep: rate at which elastic tangential forces relax, 1 / t_c; scalar or [B], None for never.
        creep_fades: time in a stage after which that rate falls, in t_c; see `relaxation`.
        columns: the columns of the table of bins.
        observe: names and functions of (simulation, state), called at the end of each bin. Their results, arrays
            [..., B], are kept in `Sample.observed`. The simulation that they get holds the walls in `box`, the sample
            in `sample`, and the drag and the friction that act in the bin.
        mark: the configuration with which observers may compare.
        box: walls at the end of the bin, for observers.
        sample: sample of the bin, for observers.
    """

    system: System
    path: StrainPath
    dt: Scalar
    drag: Scalar = 0.0
    steps: int = static(1)
    backend: str = static("auto")
    precision: str = static("double")
    creep: Scalar | None = None
    creep_fades: Scalar | None = None
    columns: Columns = static(Columns())
    observe: tuple[tuple[str, Observe], ...] = static(())
    mark: Mark | None = None
    box: Box | None = None
    sample: Sample | None = None

    @property
    def resolved(self) -> ResolvedBackend:
        """The backend that runs the steps; one object for all simulations with equal settings."""
        return resolve(self.backend, self.precision, self.system.friction)

    def marked(self, state: State, stage: Stage) -> "Simulation":
        """This simulation, with its mark at a state at the beginning of a stage; unchanged without observers."""
        if not self.observe:
            return self
        box = self.box_before(self.rows(stage, 0), state.servo)
        wide = jax.tree.map(lambda leaf: jnp.broadcast_to(_padded(leaf, state.replicas), (3, state.replicas)), box)
        apart = overlaps(self.system, state)
        return replace(self, mark=Mark(state.grains, wide, jnp.sum(apart > 0.0, axis=0)))

    def with_pairs(self, pairs: Pairs) -> "Simulation":
        """This simulation with another list of candidates."""
        return replace(self, system=replace(self.system, pairs=pairs))

    def duration(self, bins: int) -> float:
        """Simulated time of `bins` bins, in t_c; the longest of all replicas."""
        return bins * self.steps * float(np.max(np.asarray(self.dt)))

    def rows(self, stage: Stage, first: Any, count: int | None = None) -> Bin:
        """Bins of a stage with the columns of this simulation; see `Stage.rows`."""
        return stage.rows(first, count, self.columns)

    def box_before(self, row: Bin, servo: HeldWalls | None = None) -> Box:
        """The walls at the beginning of a bin; their velocities are in R per bin."""
        box = self.path.box_at(row, jnp.asarray(row.number, float), jnp.asarray(row.bins, float))
        return box if servo is None else stretched(box, servo.stretch)


def at_rest(simulation: Simulation, state: State, box: Box) -> HeldWalls:
    """The servo of a pack at rest in a box: no stretch, and the pressures on its walls."""
    replicas = state.replicas
    wide = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (1, 3, replicas)), box)
    nothing = jnp.zeros(())
    _, pressure = dynamics.march(simulation.system, replace(state, servo=None), wide, nothing, nothing)
    return HeldWalls(jnp.zeros((3, replicas)), pressure)


def walls(simulation: Simulation, row: Bin, state: State) -> tuple[Box, HeldWalls | None]:
    """The walls at the end of each step of a bin, leaves [steps, 3, B]; and the servo at its end, None without one."""
    replicas = state.replicas
    dt, steps = jnp.asarray(simulation.dt), simulation.steps
    count = row.number * steps + 1 + jnp.arange(steps)
    times = count.reshape(-1, *(1 for _ in dt.shape)) * dt
    boxes = jax.vmap(lambda time: simulation.path.box_at(row, time, (row.bins * steps) * dt))(times)
    wide: Box = jax.tree.map(lambda leaf: jnp.broadcast_to(_padded(leaf, replicas), (steps, 3, replicas)), boxes)
    if state.servo is None or row.pressure is None:
        return wide, None
    strain, servo = servo_strain(state.servo, jnp.stack([jnp.asarray(p) for p in row.pressure])[:, None]), state.servo
    passed = (1.0 + jnp.arange(steps))[:, None, None] / steps
    rate = strain / (steps * _padded(dt, replicas))
    moved = stretched(wide, servo.stretch + passed * strain, rate)
    return moved, replace(servo, stretch=servo.stretch + strain)


def _padded(leaf: Any, replicas: int) -> Any:
    """Numbers [..., B] with more copies of replica 0's, up to `replicas` (see `sharding`); others as they are."""
    known = jnp.shape(leaf)[-1] if jnp.ndim(leaf) else 1
    if not 1 < known < replicas:
        return leaf
    return jnp.concatenate([leaf, jnp.repeat(leaf[..., :1], replicas - known, axis=-1)], axis=-1)


def _with_padded(of: Any, names: tuple[str, ...], replicas: int) -> Any:
    """An object whose fields `names` are `_padded`, except those that are None."""
    known = {name: value for name in names if (value := getattr(of, name)) is not None}
    return replace(of, **{name: _padded(value, replicas) for name, value in known.items()})


def bin_step(simulation: Simulation, state: State, row: Bin) -> tuple[State, Sample]:
    """One bin: its steps, the checks at its end, its sample."""
    with jax.named_scope("walls"):
        boxes, servo = walls(simulation, row, state)
        drag = jnp.where(jnp.asarray(row.still, bool), simulation.drag, 0.0)
        drag = _padded(drag if row.drag is None else drag + row.drag, state.replicas)
    with jax.named_scope("steps"):
        dt = _padded(simulation.dt, state.replicas)
        system = _rubbing(simulation.system, row)
        state, total = simulation.resolved.march(system, replace(state, servo=None), boxes, dt, drag)
        state = _crept(simulation, state, row)
    with jax.named_scope("sample"):
        pressure = total / simulation.steps
        if servo is not None:
            state = replace(state, servo=replace(servo, pressure=pressure))
        last = jax.tree.map(lambda leaf: leaf[-1], boxes)
        state, sample = end_bin(simulation.system, state, last, pressure, row.u, simulation.resolved.census)
        if not simulation.observe:
            return state, sample
        path = _with_padded(simulation.path, ("delta0", "gamma0", "share"), state.replicas)
        seen = replace(simulation, system=system, path=path, dt=dt, drag=drag, box=last, sample=sample)
        seen = _with_padded(seen, ("creep", "creep_fades"), state.replicas)
        # An ordered dictionary, as in checkpoints: JAX sorts the keys of plain ones.
        observed = OrderedDict(
            (name, _of_replicas(name, reduce(seen, state), state)) for name, reduce in simulation.observe
        )
        return state, replace(sample, observed=observed)


def _of_replicas(name: str, value: Any, state: State) -> Any:
    """The result of an observer, checked while the program is traced: files hold real numbers [..., B] only.

    Raises:
        ValueError: naming the observer, and its result.
    """
    if jnp.shape(value)[-1:] != (state.replicas,) or jnp.iscomplexobj(value):
        given = f"{jnp.result_type(value)} {list(jnp.shape(value))}"
        raise ValueError(f"observer {name!r} must give real numbers [..., B], B = {state.replicas}; it gave {given}")
    return value


def _crept(simulation: Simulation, state: State, row: Bin) -> State:
    """The state after its histories have relaxed by the creep of one bin."""
    law = simulation.system.friction
    if simulation.creep is None or not isinstance(law, RelaxingLaw):
        return state
    length = simulation.steps * jnp.asarray(simulation.dt)
    begun = jnp.asarray(row.number * length)
    factor = relaxation(simulation.creep, simulation.creep_fades, begun, begun + length)
    factor = _padded(factor, state.replicas)

    def relaxed(history: Any) -> Any:
        return jax.tree.map(lambda new, old: new.astype(old.dtype), law.relaxed(history, factor), history)

    walls = None if state.wall_history is None else relaxed(state.wall_history)
    return replace(state, history=relaxed(state.history), wall_history=walls)


def _rubbing(system: System, row: Bin) -> System:
    """The system with its friction coefficients, or with zero ones in a stage without friction."""
    law = system.friction
    if row.friction is None or not isinstance(law, CoulombLaw):
        return system
    wall_mu: Any = None if system.wall_mu is None else system.wall_mu * row.friction
    return replace(system, friction=with_field(law, "mu", law.mu * row.friction), wall_mu=wall_mu)


def rollout(simulation: Simulation, state: State, rows: Bin) -> tuple[State, Sample]:
    """Run the bins of a table; return the state after them, and their samples with a leading axis of bins.

    Reverse mode keeps states at two levels and computes the rest again (see `scan.scan`).
    """
    state, _ = mark_varying((state, simulation))
    return scan.scan(lambda state, row: bin_step(simulation, state, row), state, rows)


def rollout_stages(simulation: Simulation, state: State, stages: tuple[Stage, ...]) -> tuple[Simulation, State, Sample]:
    """Run stages; return the simulation with its last mark, the state after the stages, and the samples."""
    parts, first = [], 0
    for place in range(1, len(stages) + 1):
        if place < len(stages) and not (stages[place].mark and simulation.observe):
            continue
        if stages[first].mark:
            simulation = simulation.marked(state, stages[first])
        state, sample = rollout(simulation, state, table(stages[first:place], simulation.columns))
        parts.append(sample)
        first = place
    joined: Sample = parts[0] if len(parts) == 1 else jax.tree.map(lambda *each: jnp.concatenate(each), *parts)
    return simulation, state, joined


Keep = Callable[[State, Sample], Any]
"""A function of the state before a bin and the sample of the bin; it returns the arrays that are kept of the bin."""


def sample_of(state: State, sample: Sample) -> Sample:
    """The `Keep` that keeps the sample alone."""
    return sample


def rollout_chunk(
    simulation: Simulation, state: State, first: Bin, count: jax.Array | None, most: int, keep: Keep = sample_of
) -> tuple[State, Any]:
    """Run `count` bins of one stage from the bin `first`, in a program for all counts up to `most`.

    It is not for reverse mode.

    If `count` is None, `most` bins are run. The program then knows their number, and a GPU does not wait for the host
    after each bin.

    Returns:
        The state after the bins, and the arrays of `keep` with a leading axis [most], zero beyond `count`.
    """

    def step(state: State, place: Any) -> tuple[State, Any]:
        after, sample = bin_step(simulation, state, first._replace(number=first.number + place))
        return after, keep(state, sample)

    def one(place: jax.Array, carry: tuple[State, Any]) -> tuple[State, Any]:
        state, kept = carry
        state, new = step(state, place)
        return state, jax.tree.map(lambda all_, leaf: lax.dynamic_update_index_in_dim(all_, leaf, place, 0), kept, new)

    shape = jax.eval_shape(lambda: step(state, 0)[1])
    blank = jax.tree.map(lambda leaf: jnp.zeros((most, *leaf.shape), leaf.dtype), shape)
    done: tuple[State, Any] = lax.fori_loop(0, most if count is None else count, one, (state, blank))
    return done
