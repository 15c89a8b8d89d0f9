"""Rollouts on the host in chunks of bins, which rebuild stale lists, report progress and resume.

A chunk that ends with a stale list is thrown away, the list is built anew from the chunk's start, and the chunk is run
again. Observers look at the chunks: for samples, frames, derivatives in both modes, and checkpoints.
"""

import functools
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from gmem_jax.errors import RunFailedError
from gmem_jax.physics.pairs import carry_history
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Box, State, Status, combined_status, explain
from gmem_jax.simulation.checkpoints import NO_CHECKPOINT, Checkpoint, ResultCache
from gmem_jax.simulation.compiled import Compiled
from gmem_jax.simulation.loop import Mark, Simulation
from gmem_jax.simulation.neighbors import FAST, LARGEST_SKIN, SKIN, WIDE_SKIN, pair_finder, skin_left
from gmem_jax.simulation.observers import CHUNK, CheckpointWriter, Chunk, Observer, SampleRecorder
from gmem_jax.simulation.progress import Progress, silent, work_of_bin
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.sharding import Placement, to_host
from gmem_jax.simulation.stability import cause
from gmem_jax.simulation.stage import Bin, Stage


def status_of(state: State) -> int:
    """All status bits of all replicas."""
    return combined_status(to_host(state.status))


def raise_if_fatal(status: int, where: str, simulation: Simulation | None = None) -> None:
    """Raise if `status` says that the numbers are meaningless.

    Raises:
        RunFailedError: naming the stage and what happened; and the cause, where a parameter of the simulation is one.
    """
    if Status(status).fatal:
        why = "" if simulation is None else cause(simulation)
        raise RunFailedError("; ".join(filter(None, (f"{where}: {explain(status)}", why))))


def _same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


@Compiled
def _box_and_skin(simulation: Simulation, state: State, row: Bin) -> tuple[Box, jax.Array]:
    """The walls before a bin, and the skin that the list has left between them."""
    box = simulation.box_before(row, state.servo)
    return box, skin_left(simulation.system, state, box)


@dataclass
class Runner:
    """A pack on its way through stages.

    Attributes:
        simulation: the simulation; only its list and its mark change.
        state: the present state.
        smallest: smallest box of the motion to come, [3], for the neighbour list; default the present one.
        skin: skin of lists that are built anew, in R.
        chunk: largest number of bins per call; it becomes smaller where a list does not last as long.
        observers: the observers of every chunk.
        progress: see `Progress`.
        finder: builds lists; made when first needed if not given.
        time: simulated time so far, in t_c.
        work: work done so far.
        total_work: work of the whole run.
        rebuilds: number of lists built anew so far.
        placement: the distribution of the replicas over devices; None for one device.
        foresees: whether lists are built anew before they go stale rather than after. Where lists do not last long,
            every second or third chunk would be thrown away otherwise.
    """

    simulation: Simulation
    state: State
    smallest: np.ndarray | None = None
    skin: float = SKIN
    chunk: int = CHUNK
    observers: tuple[Observer, ...] = ()
    progress: Progress = silent
    finder: PairFinder | None = None
    time: float = 0.0
    work: float = 0.0
    total_work: float = 1.0
    rebuilds: int = 0
    placement: Placement | None = None
    foresees: bool = False
    _renewed_at: tuple[str, float] | None = None
    _lasted: int = 0  # bins since the list was built

    def fork(self, **changes: Any) -> "Runner":
        """A runner that begins in the state of this one, with a new finder and the usual skin and chunk."""
        return replace(self, **{"finder": None, "skin": SKIN, "chunk": CHUNK, **changes})

    def place_on(self, placement: Placement | None) -> None:
        """Put the replicas on several devices; None leaves them where they are."""
        self.placement = placement
        if placement:
            self.state = placement.put_state(self.state)
            self.simulation = placement.put_simulation(self.simulation)

    def gather(self, tree: Any) -> Any:
        """Arrays with the replica axis last, as numpy arrays on this host."""
        return jax.tree.map(np.asarray, tree) if self.placement is None else self.placement.gather(tree)

    def snapshot(self) -> dict[str, Any]:
        """All that `restore` needs to go on from here with the same bits, as a tree of arrays."""
        counters = np.asarray([self.time, self.work, self.rebuilds, self.skin, self.chunk, self._lasted], float)
        pairs = self.simulation.system.pairs
        if self.placement and pairs.reference.shape[-1] > 1:
            pairs = replace(pairs, reference=self.gather(pairs.reference))
        return {
            "state": self.gather(self.state) if self.placement else self.state,
            "pairs": jax.tree.map(to_host, pairs) if self.placement else pairs,
            "counters": counters,
            "finder": {} if self.finder is None else self.finder.kept(),
            "observers": tuple(observer.saved() for observer in self.observers),
            "mark": () if self.simulation.mark is None else self.gather(tuple(self.simulation.mark)),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from the point at which a runner of the same simulation gave `snapshot`."""
        mark = Mark(*snapshot["mark"]) if snapshot["mark"] else None
        listed = self.simulation.with_pairs(snapshot["pairs"])
        self.state, self.simulation = snapshot["state"], replace(listed, mark=mark)
        self.place_on(self.placement)
        self.time, self.work, rebuilds, self.skin, chunk, lasted = snapshot["counters"].tolist()
        self.rebuilds, self.chunk, self._lasted = int(rebuilds), int(chunk), int(lasted)
        finder = snapshot["finder"]
        if not _same(finder, self.finder.kept() if self.finder else {}):
            self.finder = pair_finder(self.simulation.system.clump, **finder) if finder else None
        for observer, saved in zip(self.observers, snapshot["observers"], strict=True):
            observer.restore(saved)

    def run_stages(self, *stages: Stage, checkpoint: Checkpoint = NO_CHECKPOINT) -> OrderedDict[str, Sample]:
        """Run stages one after the other.

        Args:
            stages: stages with different names.
            checkpoint: the checkpoint from which the run goes on, and in which it saves its state.

        Returns:
            The samples by the name of the stage, numpy arrays with a leading axis of bins.

        Raises:
            RunFailedError: if the numbers became meaningless.
        """
        samples = SampleRecorder()
        if saved := checkpoint.restore():
            self.restore(saved["runner"])
            samples.restore(saved["samples"])
        writer = CheckpointWriter(checkpoint, lambda: {"runner": self.snapshot(), "samples": samples.saved()})
        for stage in stages:
            while (done := samples.bins(stage.name)) < stage.bins:
                if stage.mark and done == 0:
                    self.simulation = self.simulation.marked(self.state, stage)
                self._run_chunk(stage, done, (*self.observers, samples), writer)
        found = samples.saved()
        return OrderedDict((stage.name, found[stage.name]) for stage in stages)

    def run_cached(self, name: str, cache: ResultCache, *stages: Stage) -> OrderedDict[str, Sample]:
        """Run stages as one part of a long run, or load it from the cache; the runner is then at its end.

        See `run_stages`.
        """

        def part(checkpoint: Checkpoint) -> Any:
            return self.run_stages(*stages, checkpoint=checkpoint), self.snapshot()

        samples, snapshot = cache(name, part)
        self.restore(snapshot)
        found: OrderedDict[str, Sample] = samples
        return found

    def _run_chunk(self, stage: Stage, done: int, observers: tuple[Observer, ...], last: Observer) -> None:
        """Run the next bins of a stage; or, if the list went stale in them, build it anew.

        Args:
            stage: the stage.
            done: number of its bins that are done.
            observers: the observers of the chunk.
            last: the observer that is called after the list for the next chunk was built.
        """
        count = min(self.chunk, stage.bins - done)
        chunk = Chunk(self.simulation, self.state, stage, done, count, self.time, self.gather)
        own = [ran for observer in observers if (ran := observer.step(chunk)) is not None]
        state, sample = own[0] if own else chunk.run()
        status = status_of(state)
        if status & Status.STALE_PAIRS:
            self._renew_stale(chunk, float(np.max(to_host(sample.largest_speed))))
            return
        raise_if_fatal(status, stage.name, self.simulation)
        for observer in observers:
            observer.commit(chunk, state, sample)
        self.state = state
        self._lasted += count
        self.report(stage.name, count, self.simulation.duration(count))
        if self.foresees and not chunk.ends_stage:
            self._foresee(stage, done + count)
        last.commit(chunk, state, sample)

    def report(self, name: str, bins: float, time: float) -> None:
        """Count finished bins and tell the progress callback."""
        self.work += bins * work_of_bin(self.state.replicas)
        self.time += time
        self.progress(name, self.time, min(1.0, self.work / self.total_work))

    def renew(self, box: Box) -> None:
        """Build the neighbour list anew where the grains are now, between the walls as they are now."""
        placement, self.placement = self.placement, None
        if placement:  # the search runs on the host
            snapshot = replace(self, placement=placement).snapshot()
            self.state, self.simulation = snapshot["state"], self.simulation.with_pairs(snapshot["pairs"])
            box = jax.tree.map(to_host, box)
        system, replicas = self.simulation.system, self.state.replicas
        if self.finder is None:
            self.finder = pair_finder(system.clump, np.asarray(box.lengths).max(axis=1), self.skin)
        pairs = self.finder(self.state.grains, system.clump, box, self.smallest)
        blank = system.friction.init(pairs.capacity, replicas, self.state.grains.position.dtype)
        move = functools.partial(carry_history, old=system.pairs, new=pairs)
        for observer in self.observers:
            observer.rebuild(self.state.history, move, blank)
        self.state = replace(self.state, history=move(self.state.history, blank))
        self.simulation = self.simulation.with_pairs(pairs)
        self.rebuilds += 1
        self._lasted = 0
        self.place_on(placement)

    def _foresee(self, stage: Stage, done: int) -> None:
        """Renew the list if, at the mean rate since it was built, the next chunk would use up its skin."""
        count = min(self.chunk, stage.bins - done)
        box, skins = _box_and_skin(self.simulation, self.state, self.simulation.rows(stage, done))
        left = float(np.min(np.asarray(skins)))
        if (self.skin - left) * (1.0 + count / self._lasted) > self.skin:
            self._renewed_at = (stage.name, self.time)
            self.renew(box)

    def _renew_stale(self, chunk: Chunk, speed: float) -> None:
        """Renew a stale list before its chunk is redone; if that was just done, shorten the chunk or widen the skin.

        Frictionless grains turn and fly freely in their cages: the skin that a list needs grows with the time it lasts.

        Args:
            chunk: the chunk that ended with a stale list.
            speed: largest speed of a grain in it, in R / t_c.
        """
        if self._renewed_at == (chunk.stage.name, self.time):
            if self.chunk > 1:
                self.chunk = max(1, self.chunk // 4)
                return
            self.skin *= 1.5
            self.finder = None
            if self.skin > (LARGEST_SKIN if speed < FAST else WIDE_SKIN):
                why = cause(self.simulation)
                why = why or "the steps are unstable; use a smaller dt, or check pack and friction law"
                raise RunFailedError(f"{chunk.stage.name}: grains moved by most of R within one bin: {why}")
        self._renewed_at = (chunk.stage.name, self.time)
        self.renew(self.simulation.box_before(chunk.row, chunk.state.servo))
