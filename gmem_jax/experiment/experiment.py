"""The memory experiment as one pytree that can be run in pieces: what derivatives and designs are taken of.

`run_memory` is the whole experiment in one call. Here the same stages are cut into chunks of bins, so that a host
loop can keep the states between them, report progress, and go through them in either direction.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gmem_jax import native
from gmem_jax.experiment import analysis
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.protocol import Motion, Stage, clock, memory_protocol
from gmem_jax.experiment.recall import HOLD_DRAG, PAPER_T0
from gmem_jax.experiment.signals import Signals, bin_average
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.state import Scalar, State, replicate
from gmem_jax.physics.step import System, start

CHUNK = 32  # bins of one chunk, where a stage's bins can be divided so


class Leg(NamedTuple):
    """A stage as numbers: u at its begin and end, its bins, the drag during it."""

    start: jax.Array
    stop: jax.Array
    bins: jax.Array
    drag: jax.Array


@dataclass(frozen=True)
class Timing:
    """What is fixed when an experiment is compiled; arguments as of `run_memory`."""

    t0: float = 1.8e3
    dt: float = 0.3
    rest: float = 0.2
    hold: float = 0.2
    store: float = 2.0
    hold_drag: float | None = None
    backend: str = "auto"

    @property
    def step(self) -> float:
        """The time step, in t_c."""
        return float(clock(self.t0, self.dt)[0])

    @property
    def steps(self) -> int:
        """Steps in a bin."""
        return int(clock(self.t0, self.dt)[1])

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The stages of Sec. II."""
        return memory_protocol(self.rest, self.hold, self.store)

    def leg(self, stage: Stage) -> Leg:
        """The numbers of a stage."""
        drag = HOLD_DRAG if self.t0 < 0.999 * PAPER_T0 else 0.0
        drag = drag if self.hold_drag is None else self.hold_drag
        numbers = (stage.start, stage.stop, float(stage.bins), drag if stage.holds else 0.0)
        return Leg(*(jnp.asarray(number) for number in numbers))


def chunks(stage: Stage) -> Iterator[tuple[int, int]]:
    """The first bin and the number of bins of every chunk of a stage: equal pieces of at most `CHUNK` bins."""
    size = next(size for size in range(min(CHUNK, stage.bins), 0, -1) if stage.bins % size == 0)
    size = size if size > 4 else min(CHUNK, stage.bins)
    for first in range(0, stage.bins, size):
        yield first, min(size, stage.bins - first)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Experiment:
    """Everything a recall depends on.

    Attributes:
        pack: the pack at rest.
        signals: the waveforms, one replica each; replica 0 is the zero signal.
        friction: the friction law; parameters scalar or [S + 1].
        gamma0: shear amplitude; scalar or [S + 1].
        delta0: areal compression; default the pack's own.
        timing: the rest.
    """

    pack: Pack
    signals: Signals
    friction: FrictionLaw = field(default_factory=Hooke)
    gamma0: Scalar = 1e-3
    delta0: Scalar | None = None
    timing: Timing = field(default=Timing(), metadata={"static": True})

    @property
    def compression(self) -> Scalar:
        """delta0."""
        return self.pack.delta0 if self.delta0 is None else self.delta0

    @property
    def replicas(self) -> int:
        """S + 1."""
        return self.signals.count + 1

    @property
    def system(self) -> System:
        """The pack's grains and contacts with the friction law."""
        return System(self.pack.clump, self.friction, self.pack.pairs)

    def prefix_inputs(self) -> Any:
        """What the shear-free prefix depends on."""
        return self.pack, self.friction, self.compression

    def begin(self) -> State:
        """The pack at rest with friction switched on; one replica, or [S + 1] if parameters of the prefix are."""
        wide = any(jnp.ndim(leaf) for leaf in jax.tree.leaves((self.friction, self.compression)))
        position, quaternion = replicate(
            (self.pack.position[..., None], self.pack.quaternion[..., None]), self.replicas if wide else 1
        )
        return start(self.system, position, quaternion, self.pack.box)

    def fan_out(self, state: State) -> State:
        """One replica for every signal and one for the zero signal, if there is only one so far."""
        copies: State = replicate(state, self.replicas) if state.replicas == 1 < self.replicas else state
        return copies

    def part(self, state: State, leg: Leg, first_bin: Scalar, *, sheared: bool, bins: int) -> tuple[State, jax.Array]:
        """Some bins of a stage.

        Returns:
            The state after them, and (p_x, p_y, p_z) averaged over each bin, [bins, 3, B], in E.
        """
        timing = self.timing
        motion = Motion(
            lower=self.pack.box.lower,
            upper=self.pack.box.upper,
            delta0=self.compression,
            start=leg.start,
            stop=leg.stop,
            duration=leg.bins * (timing.steps * timing.step),
            gamma0=self.gamma0 if sheared else 0.0,
            signals=self.signals if sheared else None,
        )
        state, sample = native.pick(timing.backend)(
            self.system,
            state,
            motion,
            jnp.asarray(timing.step),
            first_bin=first_bin,
            bins=bins,
            steps=timing.steps,
            drag=leg.drag,
        )
        return state, sample.pressure

    def recalled(self, readout: jax.Array) -> jax.Array:
        """p_sig of every signal in ascending u, [S, 256], from the pressures of the readout [256, 3, S + 1]."""
        return analysis.subtract("sub0", analysis.recalled(readout))

    def integral(self) -> jax.Array:
        """J of every signal averaged over each bin, [S, 256]."""
        averaged: jax.Array = bin_average(self.signals)
        return averaged

    def fidelity(self, p_sig: jax.Array) -> jax.Array:
        """F of the set (needs one gamma0 and one delta0)."""
        return analysis.fidelity(p_sig, self.integral(), self.compression, self.gamma0)

    def gain(self, p_sig: jax.Array) -> jax.Array:
        """G of the set (needs one gamma0 and one delta0)."""
        return analysis.gain(p_sig, self.integral(), self.compression, self.gamma0)
