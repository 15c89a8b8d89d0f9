"""The interface of observers, which are called for each chunk of a run.

Samples, frames, derivatives and checkpoints are observers with the same three calls. A chunk is some bins of a stage
that are run in one call; one that ends with a stale neighbour list is run again, and committed once.
"""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from gmem_jax.physics.state import State
from gmem_jax.simulation.checkpoints import Checkpoint
from gmem_jax.simulation.compiled import Compiled
from gmem_jax.simulation.loop import Simulation, rollout_chunk
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.stage import Bin, Stage

CHUNK = 32  # bins per call: some seconds of work at most, a few milliseconds of overhead

forward = Compiled(rollout_chunk, static_argnames="most")
"""`rollout_chunk`, compiled once for all chunks and stages of one structure."""


def told_of(count: int, most: int) -> int | None:
    """The argument `count` of `rollout_chunk`: None for a whole chunk on a GPU, which then need not wait for the host.

    CPUs do not wait for a host, and run one program for all counts.
    """
    return None if count == most and jax.default_backend() != "cpu" else count


Move = Callable[[Any, Any], Any]
"""A function of a history for the old list and a blank one for the new list; it returns the history for the new list,
and is linear in both."""


@dataclass(frozen=True)
class Chunk:
    """Some bins of a stage, before they are run.

    Attributes:
        simulation: the simulation.
        state: the state at the beginning of the chunk.
        stage: the stage.
        first: number of the first bin in the stage.
        count: number of bins.
        time: simulated time from the beginning of the run to that of the chunk, in t_c.
        gather: brings arrays [..., B] of the run to this host, if they lie on several devices.
    """

    simulation: Simulation
    state: State
    stage: Stage
    first: int
    count: int
    time: float
    gather: Callable[[Any], Any]

    @property
    def row(self) -> Bin:
        """The first bin."""
        return self.simulation.rows(self.stage, self.first)

    @property
    def ends_stage(self) -> bool:
        """Whether its last bin is the last of the stage."""
        return self.first + self.count == self.stage.bins

    def run(self, bins: int | None = None, program: Compiled = forward) -> tuple[State, Any]:
        """Run the chunk, or its first `bins`; another `program` is a `rollout_chunk` that keeps more than samples.

        Samples have a leading axis of `CHUNK`, zero beyond the bins that were run.
        """
        count = told_of(self.count if bins is None else bins, CHUNK)
        done: tuple[State, Any] = program(self.simulation, self.state, self.row, count, most=CHUNK)
        return done


class Observer:
    """An observer of a run, which does not change its numbers. This base class does nothing."""

    def step(self, chunk: Chunk) -> tuple[State, Sample] | None:
        """Called before a chunk is run. An observer that must look inside runs it and returns the state and samples."""
        return None

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        """Called after a chunk was run and accepted, with the state after it and the samples of its bins."""

    def rebuild(self, history: Any, move: Move, blank: Any) -> None:
        """Called when the neighbour list was built anew: `history` becomes `move(history, blank)`."""

    def saved(self) -> Any:
        """The tree of arrays that this observer needs in a resumed run."""
        return ()

    def restore(self, saved: Any) -> None:
        """Go on from the result of an earlier `saved`."""


class SampleRecorder(Observer):
    """Keeps the samples of every stage."""

    def __init__(self) -> None:
        self._chunks: OrderedDict[str, list[Sample]] = OrderedDict()

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        """Keep the samples, as numpy arrays."""
        own = jax.tree.map(lambda leaf: leaf[: chunk.count], chunk.gather(sample))
        self._chunks.setdefault(chunk.stage.name, []).append(own)

    def bins(self, stage: str) -> int:
        """Number of bins of a stage whose samples are kept."""
        return sum(len(sample.pressure) for sample in self._chunks.get(stage, []))

    def saved(self) -> OrderedDict[str, Sample]:
        """The samples of every stage, with a leading axis of bins."""
        return OrderedDict(
            (name, jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)) for name, chunks in self._chunks.items()
        )

    def restore(self, saved: OrderedDict[str, Sample]) -> None:
        """Go on after the samples `saved`."""
        self._chunks = OrderedDict((name, [sample]) for name, sample in saved.items())


class CheckpointWriter(Observer):
    """Saves the state of a run after its chunks.

    Args:
        checkpoint: the checkpoint in which it is saved.
        snapshot: returns the tree of arrays that is saved.
    """

    def __init__(self, checkpoint: Checkpoint, snapshot: Callable[[], Any]) -> None:
        self._checkpoint, self._snapshot = checkpoint, snapshot

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        """Save if enough time has passed."""
        self._checkpoint.maybe_save(self._snapshot, milestone=chunk.ends_stage)
