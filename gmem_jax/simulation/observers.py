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
    """The `count` that `rollout_chunk` is told: none for a whole chunk on a GPU, which then need not wait for the host.

    CPUs have nothing to wait for, and run one program for all counts.
    """
    return None if count == most and jax.default_backend() != "cpu" else count


Move = Callable[[Any, Any], Any]
"""From a history of an old list and a blank one of the new, to the history of the new: linear in both."""


@dataclass(frozen=True)
class Chunk:
    """Some bins of a stage, before they are run.

    Attributes:
        simulation: what is run.
        state: at their beginning.
        stage: theirs.
        first: number of the first of them in the stage.
        count: how many there are.
        time: at their beginning, since that of the run, in t_c.
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
        """Whether its last bin is the stage's."""
        return self.first + self.count == self.stage.bins

    def run(self, bins: int | None = None, program: Compiled = forward) -> tuple[State, Any]:
        """Run it, or its first bins; samples have a leading axis of `CHUNK`, of which the bins that were run count.

        Another program is `rollout_chunk` that keeps more than samples.
        """
        count = told_of(self.count if bins is None else bins, CHUNK)
        done: tuple[State, Any] = program(self.simulation, self.state, self.row, count, most=CHUNK)
        return done


class Observer:
    """Looks at a run, and leaves its numbers as they are. This one sees nothing."""

    def step(self, chunk: Chunk) -> tuple[State, Sample] | None:
        """A chunk is about to be run. Whoever must look inside runs it, and returns what `Chunk.run` would."""
        return None

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        """A chunk was run and stands: the state after it, and the samples of its bins."""

    def rebuild(self, history: Any, move: Move, blank: Any) -> None:
        """The neighbour list was built anew: `history` became `move(history, blank)`."""

    def saved(self) -> Any:
        """What a resumed run needs of it, a tree of arrays."""
        return ()

    def restore(self, saved: Any) -> None:
        """Go on from what `saved` gave."""


class SampleRecorder(Observer):
    """Keeps the samples of every stage."""

    def __init__(self) -> None:
        self._chunks: OrderedDict[str, list[Sample]] = OrderedDict()

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        """Keep the samples, as numpy arrays."""
        own = jax.tree.map(lambda leaf: leaf[: chunk.count], chunk.gather(sample))
        self._chunks.setdefault(chunk.stage.name, []).append(own)

    def bins(self, stage: str) -> int:
        """Bins of a stage that are there."""
        return sum(len(sample.pressure) for sample in self._chunks.get(stage, []))

    def saved(self) -> OrderedDict[str, Sample]:
        """The samples of every stage, with a leading axis of bins."""
        return OrderedDict(
            (name, jax.tree.map(lambda *parts: np.concatenate(parts), *chunks)) for name, chunks in self._chunks.items()
        )

    def restore(self, saved: OrderedDict[str, Sample]) -> None:
        """Go on after these."""
        self._chunks = OrderedDict((name, [sample]) for name, sample in saved.items())


class CheckpointWriter(Observer):
    """Saves where a run stands.

    Args:
        checkpoint: where to.
        snapshot: what to.
    """

    def __init__(self, checkpoint: Checkpoint, snapshot: Callable[[], Any]) -> None:
        self._checkpoint, self._snapshot = checkpoint, snapshot

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        """Save if it is time."""
        self._checkpoint.maybe_save(self._snapshot, milestone=chunk.ends_stage)
