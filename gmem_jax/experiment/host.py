"""The host loop: chunks of bins outside jit, with checks, rebuilt neighbour lists and progress.

Nothing here is physics; `dynamics.advance` is. A chunk that ends with a stale list is thrown away, the list is
rebuilt from the chunk's start, and the chunk is done again.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax import native
from gmem_jax.experiment.protocol import Motion
from gmem_jax.physics.pairs import PairFinder, carry_history
from gmem_jax.physics.state import Box, Scalar, State, Status, explain
from gmem_jax.physics.step import Sample, System

Progress = Callable[[str, float, float], None]
"""Called with the stage's name, the simulated time so far (t_c) and the fraction of the whole work done (0 to 1)."""

CHUNK = 32  # bins per compiled call: some seconds of work at most, a few milliseconds of overhead


class RunFailedError(RuntimeError):
    """A run whose numbers are meaningless: a grain escaped, a number overflowed, an overlap left the law's range."""


def silent(stage: str, time: float, fraction: float) -> None:
    """Report nothing."""


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit` with the compiler settings that suit this code on the default device.

    On CPUs XLA's newer fusion emitters do not vectorise the contact law over the replicas; the older ones do, and
    make a step 1.3 times faster (8 replicas, jax 0.9.2).
    """
    settings = {"xla_cpu_use_fusion_emitters": False} if jax.default_backend() == "cpu" else None
    return jax.jit(function, compiler_options=settings, **options)


def require_x64() -> None:
    """Refuse to simulate in single precision: a contact slides about 1e-6 R in a step.

    Raises:
        ValueError: if JAX's 64-bit mode is off.
    """
    if jnp.zeros(()).dtype != jnp.float64:
        raise ValueError(
            'float64 is needed but JAX runs in 32 bits: call jax.config.update("jax_enable_x64", True) first'
        )


def refuse(status: int, where: str) -> None:
    """Raise if `status` says that the numbers are meaningless.

    Raises:
        RunFailedError: naming the stage and what happened.
    """
    if Status(status).fatal:
        raise RunFailedError(f"{where}: {explain(status)}")


@functools.cache
def compiled_advance(backend: str) -> Any:
    """`advance` of a backend ("auto", "jax" or "native"), compiled once for the process."""
    return compiled(native.pick(backend), static_argnames=("bins", "steps"))


def worst(state: State) -> int:
    """All status bits of all replicas."""
    return int(np.bitwise_or.reduce(np.asarray(state.status)))


@dataclass
class Runner:
    """A system on its way through the stages of an experiment.

    Attributes:
        system: changes only in its pairs.
        state: now.
        box: the walls now.
        dt: time step, in t_c.
        finder: rebuilds the pairs; made when first needed if not given.
        skin: of that neighbour list, in R.
        smallest: smallest box of the motion to come, [3], for the neighbour list.
        chunk: bins per compiled call; halved where the list does not last as long.
        backend: of `advance`; see `native.pick`.
        progress: see `Progress`.
        time: simulated time so far, in t_c.
        work: work done so far, in replica-steps; `total_work` is all there is to do.
    """

    system: System
    state: State
    box: Box
    dt: Scalar
    finder: PairFinder | None = None
    skin: float = 0.3
    smallest: np.ndarray | None = None
    chunk: int = CHUNK
    backend: str = "auto"
    progress: Progress = silent
    time: float = 0.0
    work: float = 0.0
    total_work: float = 1.0
    rebuilds: int = 0
    _rebuilt_at: tuple[str, float] | None = None

    def rebuild(self) -> None:
        """Build the neighbour list anew where the grains are now, and carry the histories over."""
        if self.finder is None:
            self.finder = PairFinder(self.system.clump, np.asarray(self.box.lengths)[:, 0], self.skin)
        old = self.system.pairs
        pairs = self.finder(self.state.grains, self.system.clump, self.box, self.smallest)
        blank = self.system.friction.init(pairs.capacity, self.state.replicas, self.state.grains.position.dtype)
        history = carry_history(self.state.history, blank, old, pairs)
        self.system = replace(self.system, pairs=pairs)
        self.state = replace(self.state, history=history)
        self.rebuilds += 1

    def report(self, name: str, replica_steps: float, time: float) -> None:
        """Count finished work and tell the progress callback."""
        self.work += replica_steps
        self.time += time
        self.progress(name, self.time, min(1.0, self.work / self.total_work))

    def stage(self, name: str, motion: Motion, *, bins: int, steps: Any, drag: Scalar = 0.0) -> Sample:
        """Run one stage under prescribed walls.

        Returns:
            The samples of its bins, numpy arrays with a leading axis [bins].

        Raises:
            RunFailedError: if the numbers became meaningless.
        """
        move = compiled_advance(self.backend)
        samples, done = [], 0
        while done < bins:
            while True:
                count = min(self.chunk, bins - done)
                state, sample = move(
                    self.system, self.state, motion, self.dt, first_bin=done, bins=count, steps=steps, drag=drag
                )
                status = worst(state)
                if not status & Status.STALE_PAIRS:
                    break
                self._renew(name)
            refuse(status, name)
            self.state = state
            done += count
            self.box = motion.box_at(jnp.asarray(done * steps * self.dt))
            samples.append(jax.tree.map(np.asarray, sample))
            self.report(name, state.replicas * count * steps, count * steps * float(np.max(self.dt)))
        joined: Sample = jax.tree.map(lambda *parts: np.concatenate(parts), *samples)
        return joined

    def _renew(self, name: str) -> None:
        """Rebuild a stale list before its chunk is redone; if that was just done, shorten the chunk or widen the skin.

        Frictionless grains turn and fly freely in their cages: what a list must allow for grows with the time it lasts.
        """
        if self._rebuilt_at == (name, self.time):
            if self.chunk > 1:
                self.chunk = max(1, self.chunk // 4)
                return
            self.skin *= 1.5
            self.finder = None
            if self.skin > 2.0:
                raise RunFailedError(f"{name}: {explain(int(Status.STALE_PAIRS))}")
        self._rebuilt_at = (name, self.time)
        self.rebuild()
