"""Frames: grains, walls and contact forces of one replica at some moments of a run.

Watching changes nothing: frames are recorded from states that a run goes through anyway, or goes through again.
"""

import itertools
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.boundary import WALLS, PeriodicAxes
from gmem_jax.physics.contact.wall import PLANES, wall_forces
from gmem_jax.physics.forces import contact_loads, relative_motion, sphere_table, wall_loads
from gmem_jax.physics.grain import Clump, radii_of_spheres
from gmem_jax.physics.numbers import require_numbers
from gmem_jax.physics.pairs import sphere_places
from gmem_jax.physics.pytree import map_numbers, pytree, short_repr, static
from gmem_jax.physics.state import State, still_box
from gmem_jax.physics.system import System
from gmem_jax.simulation.observers import Chunk, Observer
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.sharding import to_host
from gmem_jax.simulation.stage import Stage

FEWEST_FRAMES = 2  # the first configuration and the last


@pytree
@dataclass(frozen=True)
class Frame:
    """One configuration of N grains with M touching pairs of spheres; see `Frames`."""

    time: np.ndarray
    u: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    spheres: np.ndarray
    normal_force: np.ndarray
    friction_force: np.ndarray
    wall_friction: np.ndarray | None = None


@pytree
@dataclass(frozen=True)
class Frames:
    """F configurations of one replica, in the order of the run (R = E = rho = 1).

    Sphere k of grain n, centred at offsets[k] in the grain's frame, has the number n K + k. Contacts of all frames
    stand one after the other: those of frame f are start[f] to start[f + 1].

    Attributes:
        time: time since the beginning of the run, [F], in t_c.
        u: compression, 0 to 1, [F].
        position: grain centres, [F, N, 3], in R.
        quaternion: body-to-lab rotations (w, x, y, z), [F, N, 4].
        lower: lower planes of the box, [F, 3], in R.
        upper: upper planes, [F, 3].
        start: where the contacts of a frame begin, and where the last ends, whole, [F + 1].
        spheres: numbers i < j of the two spheres that touch, whole, [M, 2]; walls are not listed.
        normal_force: repulsive normal force, [M], in E R^2.
        friction_force: tangential force on sphere i, the opposite of that on j, [M, 3], in E R^2.
        offsets: sphere centres of a grain of size 1 in its own frame, [K, 3], in R.
        stages: the stage that each frame ends or is in, [F].
        signal: number of the replica's signal, from 1; 0 for no signal.
        periodic: the periodic axes of the box; grains may have left it through these faces.
        radii: radii of the spheres of a grain of size 1, [K], in R; None where all are 1.
        sizes: factors on the lengths of each grain, [N]; None where all are 1.
        wall_friction: tangential forces of the planes on every sphere, the lower planes of x, y and z, then the upper
            ones, [F, N K, 6, 3], in E R^2; None between smooth walls.
    """

    time: np.ndarray
    u: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    start: np.ndarray
    spheres: np.ndarray
    normal_force: np.ndarray
    friction_force: np.ndarray
    offsets: np.ndarray
    stages: tuple[str, ...] = static(())
    signal: int = static(0)
    periodic: PeriodicAxes = static(WALLS)
    radii: np.ndarray | None = None
    sizes: np.ndarray | None = None
    wall_friction: np.ndarray | None = None

    __repr__ = short_repr

    @property
    def count(self) -> int:
        """Number of configurations F."""
        return len(self.stages)

    @property
    def sphere_radii(self) -> np.ndarray:
        """Radii of all spheres, [N K], in R."""
        return radii_of_spheres(self.position.shape[1], len(self.offsets), self.radii, self.sizes)

    def centres(self, frame: int) -> np.ndarray:
        """Sphere centres of a frame, [N K, 3], in R."""
        return sphere_places(self.position[frame], self.quaternion[frame], self.offsets, self.sizes)


def images_met(frames: Frames, number: int) -> np.ndarray:
    """The displacement that brings the second sphere of each contact to its image beside the first, [M, 3], in R."""
    centres, lengths = frames.centres(number), frames.upper[number] - frames.lower[number]
    one, other = frames.spheres[slice(*frames.start[number : number + 2])].T
    nearest = -lengths * np.rint((centres[other] - centres[one]) / lengths)
    return np.where(frames.periodic, nearest, 0.0)


Recorded = Mapping[str, tuple[Frame, ...]]
"""Frames by stage, in the order of the run: an ordered dictionary, since JAX sorts the keys of plain ones."""


@dataclass(frozen=True)
class FrameSchedule:
    """Which configurations of a run are recorded.

    Attributes:
        wanted: numbers of finished bins after which a configuration is recorded, by the name of the stage.
        replica: the replica that is recorded, once there are several.
    """

    wanted: Mapping[str, Sequence[int]] = field(default_factory=dict)
    replica: int = 0


class FrameRecorder(Observer):
    """Records configurations. For a configuration within a chunk, the bins of the chunk up to it are run again."""

    def __init__(self, schedule: FrameSchedule) -> None:
        self.schedule = schedule
        self.recorded: OrderedDict[str, tuple[Frame, ...]] = OrderedDict()

    def step(self, chunk: Chunk) -> None:
        """Record the configuration before the first bin of a stage, if it is wanted."""
        name, path = chunk.stage.name, chunk.simulation.path
        if chunk.first == 0 and 0 in self.schedule.wanted.get(name, ()) and name not in self.recorded:
            self.record(chunk, chunk.state, np.asarray(path.lower), np.asarray(path.upper), chunk.stage.ends[0])

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        """Record the wanted configurations of a chunk."""
        for done in self.schedule.wanted.get(chunk.stage.name, ()):
            bins = done - chunk.first
            if not 0 < bins <= chunk.count:
                continue
            then, then_sample = (state, sample) if bins == chunk.count else chunk.run(bins)
            half = 0.5 * chunk.gather(then_sample.lengths)[bins - 1]
            path, stage = chunk.simulation.path, chunk.stage
            centre = 0.5 * np.asarray(path.lower + path.upper)
            start, stop = stage.ends
            u = start + (stop - start) * done / stage.bins
            self.record(chunk, then, centre - half, centre + half, u, chunk.simulation.duration(bins))

    def record(
        self, chunk: Chunk, state: State, lower: np.ndarray, upper: np.ndarray, u: float, later: float = 0.0
    ) -> None:
        """Record a configuration.

        Args:
            chunk: the chunk in which it lies.
            state: the state at this moment.
            lower: lower planes of the box, [3, 1] or [3, B].
            upper: upper planes, likewise.
            u: compression.
            later: time since the beginning of the chunk, in t_c.
        """
        name, simulation, replicas = chunk.stage.name, chunk.simulation, state.replicas
        one = self.schedule.replica if replicas > 1 else 0

        def of_one(number: Any) -> np.ndarray:
            return to_host(number)[one : one + 1] if np.shape(number) == (replicas,) else to_host(number)

        friction = map_numbers(of_one, simulation.system.friction, deeper=to_host)
        wall_mu = jax.tree.map(of_one, simulation.system.wall_mu)
        dt = to_host(simulation.dt)  # of B replicas, without the copies that pad them to the number of devices
        state, lower, upper = jax.tree.map(
            lambda leaf: leaf[..., one : one + 1] if np.shape(leaf)[-1] > 1 else leaf,
            (chunk.gather(state), lower, upper),
        )
        time = (chunk.time + later) * float(dt[one] if dt.ndim else dt) / float(np.max(dt))
        system = replace(jax.tree.map(to_host, simulation.system), friction=friction, wall_mu=wall_mu)
        frame = configuration(system, state, lower[:, 0], upper[:, 0], time, u)
        self.recorded = OrderedDict({**self.recorded, name: (*self.recorded.get(name, ()), frame)})

    def saved(self) -> OrderedDict[str, tuple[Frame, ...]]:
        """The configurations recorded so far."""
        return self.recorded

    def restore(self, saved: OrderedDict[str, tuple[Frame, ...]]) -> None:
        """Go on after the configurations `saved`."""
        self.recorded = OrderedDict(saved)


def places(stages: Sequence[Stage], count: int, every: int) -> dict[str, list[int]]:
    """Moments of `count` configurations along some stages, as finished bins by the stage's name.

    The first are the beginning and the end of the run. Each further one divides the longest stretch between two chosen
    moments, as close to its middle as possible: at the end of a stage, if one lies in the middle half of the stretch;
    else after a multiple of `every` bins of a stage, if one lies there; else in the middle. So the ends of encoding,
    storage and readout are among five or more moments, and the moments for a smaller count are among those for a
    larger one.

    Args:
        stages: stages with different names.
        count: number of configurations, at least 2.
        every: number of bins that are run in one call: to stop after a call costs nothing.

    Raises:
        ValueError: if `count` is below 2, or above the number of bins plus 1.
    """
    ends = list(itertools.accumulate(stage.bins for stage in stages))
    if not FEWEST_FRAMES <= count <= ends[-1] + 1:
        raise ValueError(f"frames must be 0 for none, or {FEWEST_FRAMES} to {ends[-1] + 1} for this run; got {count}")
    starts = [0, *ends[:-1]]
    cheap = [place for start, end in zip(starts, ends, strict=True) for place in range(start + every, end, every)]
    chosen = [0, ends[-1]]
    while len(chosen) < count:
        first, last = max(itertools.pairwise(chosen), key=lambda stretch: stretch[1] - stretch[0])
        middle, quarter = (first + last) // 2, (last - first) / 4
        near = [[place for place in known if abs(place - middle) <= quarter] for known in (ends, cheap)]
        chosen = sorted([*chosen, min(near[0] or near[1] or [middle], key=lambda place: abs(place - middle))])
    found = {stages[0].name: [0]}
    for place in chosen[1:]:
        number = next(number for number, end in enumerate(ends) if place <= end)
        found.setdefault(stages[number].name, []).append(place - starts[number])
    return found


def places_at(stages: Sequence[Stage], compressions: Sequence[float]) -> dict[str, list[int]]:
    """The moments at which a run passes chosen compressions, to the next bin: once in every stage that changes u.

    Args:
        stages: stages with different names.
        compressions: values of u, each 0 to 1.

    Returns:
        Finished bins by the stage's name, as from `places`; the beginning of a stage is the end of the one before.

    Raises:
        ValueError: if one is not within 0 and 1.
    """
    found: dict[str, set[int]] = {}
    for u in compressions:
        require_numbers(**{"u of a frame": u})
        if not 0.0 <= u <= 1.0:
            raise ValueError(f"frames at u = {u:g}: u goes from 0, not compressed, to 1, fully compressed")
        for number, stage in enumerate(stages):
            start, stop = stage.ends
            if start == stop or not min(stage.ends) <= u <= max(stage.ends):
                continue
            bins = round(stage.bins * (u - start) / (stop - start))
            at, bins = (stage, bins) if bins or not number else (stages[number - 1], stages[number - 1].bins)
            found.setdefault(at.name, set()).add(bins)
    return {stage.name: sorted(found[stage.name]) for stage in stages if stage.name in found}


@jax.jit
def _contacts(system: System, state: State) -> tuple[jax.Array, jax.Array, jax.Array]:
    """For every candidate: whether it touches and its normal force, [P, 1, B] each; its tangential force, [P, 3, B]."""
    table, _ = sphere_table(system.clump, state.grains, state.cell)
    still = jnp.zeros(())  # dt = 0: contacts slide no further
    motion = relative_motion(system, table, state.cell)
    kin, normal, friction, _ = contact_loads(system, *motion, state.history, still)
    return kin.touching, normal, friction


@jax.jit
def _rubbing(system: System, state: State, lower: jax.Array, upper: jax.Array) -> jax.Array:
    """Tangential forces of the planes on every sphere, [S, 6, 3, B], limited by mu times the elastic normal forces."""
    cell = state.cell
    box = still_box(lower, upper) if cell is None else replace(cell, lower=lower, upper=upper)
    table, _ = sphere_table(system.clump, state.grains, cell)
    radii = system.clump.sphere_radii(len(table))
    normal = wall_forces(table, box, system.material, 0.0, radii)
    _, force, _, _ = wall_loads(system, state.grains, box, *normal, state.wall_history, jnp.zeros(()))
    return force.reshape(-1, PLANES, *force.shape[1:])


def configuration(system: System, state: State, lower: np.ndarray, upper: np.ndarray, time: float, u: float) -> Frame:
    """The configuration of one replica in a state.

    Args:
        system: the system of the state.
        state: the state of one replica.
        lower: lower planes of the box, [3].
        upper: upper planes, [3].
        time: time since the beginning, in t_c.
        u: compression.
    """
    touching, normal, friction = (np.asarray(leaf)[..., 0] for leaf in _contacts(system, state))
    listed = np.flatnonzero(touching[:, 0])
    spheres = np.stack([np.asarray(system.pairs.first), np.asarray(system.pairs.second)], axis=1)
    position, quaternion = np.asarray(state.grains.position), np.asarray(state.grains.quaternion)
    planes = lower[:, None], upper[:, None]
    return Frame(
        time=np.asarray(time, float),
        u=np.asarray(u, float),
        position=position[..., 0],
        quaternion=quaternion[..., 0],
        lower=np.array(lower, float),
        upper=np.array(upper, float),
        spheres=spheres[listed],
        normal_force=normal[listed, 0],
        friction_force=friction[listed],
        wall_friction=None if system.wall_mu is None else np.asarray(_rubbing(system, state, *planes))[..., 0],
    )


def concatenate(
    recorded: Recorded,
    clump: Clump,
    signal: int = 0,
    centre: np.ndarray | float = 0.0,
    periodic: PeriodicAxes = WALLS,
) -> Frames:
    """Recorded frames, joined as `Frames`.

    Args:
        recorded: frames by stage, at least one.
        clump: the grain.
        signal: number of the replica's signal.
        centre: the point that becomes the origin, [3].
        periodic: the periodic axes of the box.
    """
    every = [frame for frames in recorded.values() for frame in frames]
    stacked = {name: np.stack([getattr(frame, name) for frame in every]) for name in ("time", "u", "quaternion")}
    moved = {
        name: np.stack([getattr(frame, name) - centre for frame in every]) for name in ("position", "lower", "upper")
    }
    contacts = {
        name: np.concatenate([getattr(frame, name) for frame in every])
        for name in ("spheres", "normal_force", "friction_force")
    }
    rubbed = [frame.wall_friction for frame in every if frame.wall_friction is not None]
    return Frames(
        **stacked,
        **moved,
        **contacts,
        start=np.cumsum([0, *(len(frame.spheres) for frame in every)]),
        offsets=np.asarray(clump.offsets),
        stages=tuple(name for name, frames in recorded.items() for _ in frames),
        signal=signal,
        periodic=periodic,
        radii=None if clump.radii is None else np.asarray(clump.radii),
        sizes=None if clump.sizes is None else np.asarray(clump.sizes),
        wall_friction=np.stack(rubbed) if rubbed else None,
    )
