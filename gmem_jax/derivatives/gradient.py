"""Reverse mode: the gradient of a loss with respect to parameters of an experiment, chunk by chunk on the host.

`jax.grad` and `jax.jvp` of `gm.fidelity` work as they are. The observer here does the same in the chunks of
`simulation.runner`: it reports progress, compiles small programs and rebuilds stale neighbour lists. It keeps the state
before each bin as long as there is room, and then the state before each chunk. Parameters are named by dotted names:
"gamma0", "friction.mu", "signals.amplitudes", ...
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gmem_jax.derivatives.moving import (
    Moving,
    fixed_by,
    moving_of,
    numbers_by,
    numbers_of,
    require_derivatives,
    state_of,
    theta_of,
    whole_work,
    with_grain,
    with_numbers,
)
from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.asked import require_host
from gmem_jax.experiment.changes import replace as with_values
from gmem_jax.experiment.experiment import Experiment, acts_on_prefix
from gmem_jax.experiment.run import apply_waveforms, runner_of
from gmem_jax.physics.numbers import said
from gmem_jax.physics.pytree import comparable, short_repr
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import State
from gmem_jax.simulation.checkpoints import NO_CHECKPOINT, Checkpoint
from gmem_jax.simulation.compiled import Compiled
from gmem_jax.simulation.loop import Simulation, bin_step, rollout_chunk
from gmem_jax.simulation.observers import CHUNK, Chunk, Move, Observer, told_of
from gmem_jax.simulation.progress import Progress, ProgressChoice, callback, shows_progress, within
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.stage import Bin

Loss = Callable[[Experiment, jax.Array], jax.Array]
"""A function of an experiment and its p_sig [S, 256] that returns a number."""

FORWARDS = 0.2  # fraction of the time of a gradient that the forward pass takes
ROOM = 2**30  # bytes of states kept in the prefix, and as many after it; the backward pass computes later ones again


def fidelity_of(experiment: Experiment, p_sig: jax.Array) -> jax.Array:
    """The `Loss` that is the fidelity F of the set."""
    return experiment.compare(p_sig).fidelity


def _before(state: State, sample: Sample) -> tuple[Moving, Sample]:
    """The `Keep` of the state before a bin and of its sample."""
    return moving_of(state), sample


def _pull(
    simulation: Simulation,
    before: Moving,
    first: Bin,
    count: Any,
    slopes: tuple[Moving, jax.Array],
    fixed: tuple[str, ...],
) -> Any:
    """Take derivatives back through a chunk.

    Args:
        simulation: the simulation.
        before: states before the bins of the chunk, leaves [most, ..., B].
        first: the first bin.
        count: number of bins; None for as many as there are states.
        slopes: derivatives with respect to the state after the chunk, and to the pressures of its bins, [most, 3, B].
        fixed: parts of the simulation with respect to which it is not differentiated.

    Returns:
        Derivatives with respect to the numbers of the simulation, and to the state before the chunk.
    """
    count = len(slopes[1]) if count is None else count
    numbers, status = numbers_of(simulation, fixed), jnp.zeros(slopes[1].shape[-1], jnp.int32)

    def one(done: jax.Array, carry: Any) -> Any:
        place = count - 1 - done
        by_state, by_numbers = carry

        def step(numbers: Any, moving: Moving) -> tuple[Moving, jax.Array]:
            changed = with_numbers(simulation, numbers, fixed)
            row = first._replace(number=first.number + place)
            after, sample = bin_step(changed, state_of(moving, status), row)
            return moving_of(after), sample.pressure

        at = jax.tree.map(lambda leaf: leaf[place], before)
        more, by_state = jax.vjp(step, numbers, at)[1]((by_state, slopes[1][place]))
        return by_state, jax.tree.map(jnp.add, by_numbers, more)

    by_state, by_numbers = lax.fori_loop(0, count, one, (slopes[0], jax.tree.map(jnp.zeros_like, numbers)))
    return by_numbers, by_state


_pulled = Compiled(_pull, static_argnames="fixed")
_recorded = Compiled(functools.partial(rollout_chunk, keep=_before), static_argnames="most")


class _Piece(NamedTuple):
    """A piece of the backward pass; `back` turns derivatives by the state after it into those by the state before."""

    back: Callable[[Moving], Moving]
    name: str = ""
    work: int = 0


@dataclass
class _Remembering(Observer):
    """Records the forward pass through some stages, for the backward pass."""

    fixed: tuple[str, ...]  # parts of the simulation with respect to which it is not differentiated
    room: int  # bytes that are left for states
    tape: list[_Piece] = field(default_factory=list)
    numbers: Any = None  # derivatives by the simulation's numbers so far
    reads: Mapping[str, np.ndarray] = field(default_factory=dict)  # derivatives by the pressures that are read
    _next: Moving | None = None

    def step(self, chunk: Chunk) -> tuple[State, Sample] | None:
        """Run the chunk, keeping the states before its bins, if there is room for them."""
        if self.room <= 0:
            return None
        state, (self._next, sample) = chunk.run(program=_recorded)
        return state, sample

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        """Record how to go back through the chunk."""
        count, replicas = chunk.count, chunk.state.replicas
        states, self._next = self._next, None
        self.room -= sum(leaf.nbytes for leaf in jax.tree.leaves(states))

        def back(slope: Moving) -> Moving:
            before = chunk.run(program=_recorded)[1][0] if states is None else states
            own = np.zeros((CHUNK, 3, replicas))
            known = self.reads.get(chunk.stage.name)
            if known is not None:
                own[:count] = known[chunk.first : chunk.first + count]
            moving: Moving
            at, slopes = (chunk.simulation, before, chunk.row), (slope, jnp.asarray(own))
            by_numbers, moving = _pulled(*at, told_of(count, CHUNK), slopes, fixed=self.fixed)
            self.numbers = by_numbers if self.numbers is None else jax.tree.map(jnp.add, self.numbers, by_numbers)
            return moving

        self.tape.append(_Piece(back, chunk.stage.name, count * replicas))

    def rebuild(self, history: Any, move: Move, blank: Any) -> None:
        """Record how the history was moved."""
        _, pull = jax.vjp(lambda old: move(old, blank), history)
        self.tape.append(_Piece(lambda slope: (slope[0], pull(slope[1])[0], *slope[2:])))


@comparable
@dataclass(frozen=True)
class Gradient:
    """A loss and its gradient.

    Attributes:
        value: the loss, a scalar.
        slope: derivatives of the loss by dotted name, each a pytree of the same structure as the part of the experiment
            that has this name.
        p_sig: recalled signals from which the loss was computed, [S, 256], in E.
    """

    value: jax.Array
    slope: dict[str, Any]
    p_sig: jax.Array

    __repr__ = short_repr


@usual_rules()
@shows_progress
def value_and_grad(
    experiment: Experiment,
    by: Sequence[str] = ("signals", "gamma0", "friction"),
    *,
    loss: Loss = fidelity_of,
    checkpoint: Checkpoint = NO_CHECKPOINT,
    progress: ProgressChoice = None,
) -> Gradient:
    """The value of a loss and its gradient in reverse mode, through the whole experiment, on the host.

    The forward pass keeps the state before each bin, up to 1 GiB (in the prefix 1 GiB more), and beyond that the state
    before each chunk of 32 bins. The backward pass runs such chunks again, and differentiates bin by bin. On the native
    backend a gradient costs about four forward runs; about five if it goes through the prefix too, as for "friction";
    and one more if chunks are run again.

    Args:
        experiment: the experiment at which the gradient is taken, not traced.
        by: the parameters to differentiate with respect to: dotted names of floats, or of parts of the experiment that
            hold them, like "signals.amplitudes", "friction.mu", "t0", "pack.clump" or "pack.position". No name may be a
            part of another.
        loss: function of (experiment, p_sig) that returns a scalar, with p_sig [S, 256] in E; default the fidelity.
        checkpoint: keeps the progress of the backward pass, so that it can be resumed; default none. A resumed call
            repeats the forward pass, a fifth of the time.
        progress: see `run`.

    Returns:
        The scalar `value`; `slope`, a dictionary by name of pytrees of derivatives, structured as the parts of the
        experiment with these names; and the recalled `p_sig`, [S, 256], in E.

    Raises:
        ValueError: for a name that is no field, a loss that is not a scalar, mixed precision, or a call inside a traced
            function.
        RunFailedError: if the simulation broke down.
    """
    require_kind("value_and_grad", experiment, Experiment)
    require_host("gm.value_and_grad", experiment)
    require_derivatives(experiment)
    tell = callback(progress)
    theta = theta_of(experiment, by)
    experiment = with_grain(experiment, theta)
    along = functools.partial(with_values, experiment)
    common, own = experiment.phases
    on = runner_of(experiment, progress=within(tell, 0.0, FORWARDS))
    on.total_work = whole_work(experiment, on)
    fixed = fixed_by(theta)
    prefix, rest = _Remembering(fixed, ROOM), _Remembering(fixed, ROOM)
    on.observers = (prefix,) if any(map(acts_on_prefix, theta)) else ()
    _, pull_begin = jax.vjp(lambda theta: moving_of(along(theta).begin()), theta)
    on.run_stages(*common)
    fan_out = jax.linear_transpose(_fan_out(experiment), moving_of(on.state))
    on.observers = (rest,)
    apply_waveforms(on, experiment)
    samples = on.run_stages(*own)

    def final(theta: Any, pressures: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        changed = along(theta)
        p_sig = changed.recalled(pressures)
        value = loss(changed, p_sig)
        if not isinstance(value, float) and not jnp.issubdtype(getattr(value, "dtype", np.int64), jnp.floating):
            raise ValueError(f"a loss is one real number, got {said(value)}")
        if jnp.ndim(value):
            raise ValueError(
                f"a loss is one number, got {jnp.shape(value)}: with several reads or channels give one, as "
                "loss=lambda experiment, p_sig: experiment.compare(p_sig).fidelity[0]"
            )
        return value, p_sig

    pressures = {name: jnp.asarray(samples[name].pressure) for name in experiment.protocol.reads}
    # Not compiled: it is a new function in every call, and compiling it would take longer than evaluating it.
    last = jax.value_and_grad(final, argnums=(0, 1), has_aux=True)
    (value, p_sig), (slope, by_pressures) = last(theta, pressures)
    rest.reads = {name: np.asarray(by) for name, by in by_pressures.items()}

    def pull_numbers(sheared: bool, found: Any) -> Any:
        return jax.vjp(numbers_by(experiment, fixed, sheared=sheared), theta)[1](found)[0]

    back = jax.tree.map(jnp.zeros_like, moving_of(on.state))
    way = _Backwards(within(tell, FORWARDS, 1.0), (rest, prefix), checkpoint)
    back = way.through(rest, back)
    slope = jax.tree.map(jnp.add, slope, pull_numbers(True, rest.numbers))
    if any(map(acts_on_prefix, theta)):
        back = way.through(prefix, fan_out(back)[0])
        if prefix.numbers is not None:  # None if the protocol begins with a waveform, without a prefix
            slope = jax.tree.map(jnp.add, slope, pull_numbers(False, prefix.numbers))
        slope = jax.tree.map(jnp.add, slope, pull_begin(back)[0])
    return Gradient(value, slope, p_sig)


def _fan_out(experiment: Experiment) -> Callable[[Moving], Moving]:
    def spread(moving: Moving) -> Moving:
        status = jnp.zeros(moving[0].position.shape[-1], jnp.int32)
        return moving_of(experiment.fan_out(state_of(moving, status)))

    return spread


class _Backwards:
    """The backward pass through recordings, the last first; it drops their tapes, and reports and saves progress."""

    def __init__(self, progress: Progress, ways: Sequence[_Remembering], checkpoint: Checkpoint) -> None:
        self.progress, self.ways, self.checkpoint = progress, ways, checkpoint
        self.total, self.done = sum(piece.work for way in ways for piece in way.tape), 0
        self.saved = checkpoint.restore()
        if self.saved:
            for way, left, numbers in zip(ways, self.saved["left"].tolist(), self.saved["numbers"], strict=True):
                self.done += sum(piece.work for piece in way.tape[left:])
                del way.tape[left:]
                way.numbers = list(numbers) or None

    def through(self, way: _Remembering, slope: Moving) -> Moving:
        """Turn derivatives by the state at the end of a recording into those by the state at its beginning."""
        number = next(place for place, one in enumerate(self.ways) if one is way)
        if self.saved and int(self.saved["way"]) == number:
            slope = self.saved["slope"]

        def standing() -> dict[str, Any]:
            left = np.asarray([len(one.tape) for one in self.ways])
            numbers = tuple(tuple(one.numbers or ()) for one in self.ways)
            return {"way": np.asarray(number), "left": left, "numbers": numbers, "slope": slope}

        while way.tape:
            piece = way.tape.pop()
            slope = piece.back(slope)
            if piece.work:
                self.done += piece.work
                self.progress(f"back through {piece.name}", 0.0, self.done / self.total)
                self.checkpoint.maybe_save(standing)
        return slope
