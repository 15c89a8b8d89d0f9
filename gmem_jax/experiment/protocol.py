"""The walls of the experiment: compression u(t), shear gamma(u), and the stages they make up."""

import itertools
import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from gmem_jax.experiment.signals import BINS, Signals
from gmem_jax.physics.state import Box, Scalar


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Motion:
    """Prescribed walls during one stage: u runs linearly, the shear follows a waveform of u (paper, Sec. II).

    L_x = X (1 - gamma/2), L_y = Y (1 + gamma/2) with X, Y = L0 (1 - (1 - sqrt(1 - delta0)) u); z does not move. The
    box stays centred. Half of gamma on each axis is this project's reading of the paper.

    Attributes:
        lower: lower planes at u = 0, [3, 1].
        upper: upper planes at u = 0, [3, 1].
        delta0: areal compression at u = 1, scalar or [B].
        start: u at the beginning of the stage.
        stop: u at its end.
        duration: in t_c.
        gamma0: shear amplitude, scalar or [B].
        signals: the waveforms of the replicas, or None for no shear; replica 0 is always the zero signal.
    """

    lower: jax.Array
    upper: jax.Array
    delta0: Scalar
    start: Scalar
    stop: Scalar
    duration: Scalar
    gamma0: Scalar = 0.0
    signals: Signals | None = None

    def compression(self, time: Scalar) -> Scalar:
        """u at `time` since the start of the stage."""
        return self.start + (self.stop - self.start) * (time / self.duration)

    def _shear(self, u: Scalar) -> jax.Array:
        if self.signals is None:
            return jnp.zeros(1)
        return self.gamma0 * jnp.concatenate([jnp.zeros(1), self.signals.shear(jnp.asarray(u))])

    def box_at(self, time: jax.Array) -> Box:
        """Planes and their velocities at `time` since the start of the stage, [3, B] (or [3, 1] without shear)."""

        def lengths(moment: jax.Array) -> jax.Array:
            u = self.compression(moment)
            squeeze = 1.0 - (1.0 - jnp.sqrt(1.0 - self.delta0)) * u
            half = 0.5 * self._shear(u)
            scale = jnp.stack(jnp.broadcast_arrays(squeeze * (1.0 - half), squeeze * (1.0 + half), jnp.ones(1)))
            return (self.upper - self.lower) * scale

        now, rate = jax.jvp(lengths, (time,), (jnp.ones_like(time),))
        centre = 0.5 * (self.lower + self.upper)
        return Box(centre - 0.5 * now, centre + 0.5 * now, -0.5 * rate, 0.5 * rate)


def clock(t0: Scalar, dt: Scalar, bins: int = BINS) -> tuple[Scalar, int | jax.Array]:
    """The time step and the steps per bin of a ramp of duration t0: dt a little smaller, so that bins are whole.

    Concrete arguments give a Python int of steps, and reverse-mode derivatives; traced ones (t0 or dt under
    `jax.vmap`, say) a traced number, which runs but has forward-mode derivatives only.
    """
    if isinstance(t0, jax.core.Tracer) or isinstance(dt, jax.core.Tracer):
        steps = jnp.ceil(t0 / (bins * dt) * (1.0 - 1e-12)).astype(jnp.int32)
        return t0 / (bins * steps), steps
    whole = max(1, math.ceil(float(t0) / (bins * float(dt)) * (1.0 - 1e-12)))
    return float(t0) / (bins * whole), whole


@dataclass(frozen=True)
class Stage:
    """One stage of a protocol.

    Attributes:
        name: as in the paper: rest, compress, hold, decompress, encode, store, readout.
        start: u at its beginning.
        stop: u at its end.
        length: duration in units of t0.
        sheared: whether the waveform is applied.
    """

    name: str
    start: float
    stop: float
    length: float
    sheared: bool = False

    @property
    def holds(self) -> bool:
        """Whether the walls stand still."""
        return self.start == self.stop

    @property
    def bins(self) -> int:
        """Length in bins of t0 / 256; a hold is rounded up to whole bins."""
        return max(1, math.ceil(self.length * BINS - 1e-9))


def preparation_cycle(rest: float, hold: float) -> tuple[Stage, ...]:
    """One compress/decompress cycle without shear: rest, compress, hold, decompress."""
    return (
        Stage("rest", 0.0, 0.0, rest),
        Stage("compress", 0.0, 1.0, 1.0),
        Stage("hold", 1.0, 1.0, hold),
        Stage("decompress", 1.0, 0.0, 1.0),
    )


def memory_protocol(
    rest: float = 0.2, hold: float = 0.2, store: float = 2.0, second_readout: bool = False
) -> tuple[Stage, ...]:
    """The experiment of Sec. II, lengths in t0: a shear-free cycle, rest, encode, store, readout (6.6 t0 in all).

    With `second_readout`, Sec. III's: another rest, compression, hold and readout (9 t0 in all).
    """
    first = (
        *preparation_cycle(rest, hold),
        Stage("rest-2", 0.0, 0.0, rest),
        Stage("encode", 0.0, 1.0, 1.0, sheared=True),
        Stage("store", 1.0, 1.0, store),
        Stage("readout", 1.0, 0.0, 1.0),
    )
    if not second_readout:
        return first
    *again, last = preparation_cycle(rest, hold)
    repeated = (replace(stage, name=f"{stage.name}-3") for stage in again)
    return (*first, *repeated, replace(last, name="readout-2"))


def split(stages: tuple[Stage, ...]) -> tuple[tuple[Stage, ...], tuple[Stage, ...]]:
    """The stages before the first sheared one, common to all signals and run once; and those from it on."""
    common = tuple(itertools.takewhile(lambda stage: not stage.sheared, stages))
    return common, stages[len(common) :]
