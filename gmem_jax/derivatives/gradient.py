"""Derivatives of a whole memory experiment on the host, chunk by chunk, in both directions.

`jax.grad` and `jax.jvp` of `gm.fidelity` work as they are. The observers here do the same in the chunks of
`simulation.runner`: they report progress, compile small programs, make stale lists anew, and keep the states before all
bins as long as there is room, then those before all chunks. What is differentiated by is named: "gamma0",
"friction.mu", "signals.amplitudes", ...
"""

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gmem_jax.experiment.arguments import require_kind, require_several
from gmem_jax.experiment.experiment import Experiment, acts_on_prefix, value_at
from gmem_jax.experiment.experiment import replace as with_values
from gmem_jax.experiment.recall import apply_waveforms, runner_of
from gmem_jax.physics.pytree import comparable, short_repr
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import State
from gmem_jax.simulation.checkpoints import NO_CHECKPOINT, Checkpoint
from gmem_jax.simulation.compiled import Compiled
from gmem_jax.simulation.loop import Simulation, bin_step, rollout_chunk
from gmem_jax.simulation.observers import CHUNK, Chunk, Move, Observer, told_of
from gmem_jax.simulation.progress import Progress, ProgressChoice, callback, shows_progress, silent, within, work_of
from gmem_jax.simulation.protocol import Bin
from gmem_jax.simulation.runner import Runner
from gmem_jax.simulation.sample import Sample

Loss = Callable[[Experiment, jax.Array], jax.Array]
"""From an experiment and its p_sig [S, 256] to a number."""

STATIC_FIELDS = tuple(entry.name for entry in fields(Experiment) if "static" in entry.metadata)
LENGTHS = ("pack.clump.radii", "pack.clump.sizes")  # of spheres that are not all alike
FORWARDS = 0.2  # of a gradient's time is the way forward
ROOM = 2**30  # bytes that one way may keep of its states; those of later chunks are computed again on the way back

Moving = tuple[Any, ...]  # grains, histories, held walls and periodic cell: what of a state can be differentiated


def fidelity_of(experiment: Experiment, p_sig: jax.Array) -> jax.Array:
    """F of the set: a `Loss`."""
    return experiment.compare(p_sig).fidelity


def _fixed_by(names: Iterable[str]) -> tuple[str, ...]:
    """Parts of a simulation that are not differentiated by: the list, the mark, and lengths that no name has.

    The library has no derivatives by these lengths: where one is wanted, all are those of plain JAX.
    """
    lengths = [length for length in LENGTHS if not any(f"{length}.".startswith(f"{name}.") for name in names)]
    return (".system.pairs", ".mark", *(length.replace("pack", ".system") for length in lengths))


def _is_moving(path: Any, leaf: Any, fixed: tuple[str, ...]) -> bool:
    """Whether a number of a simulation is differentiated by."""
    floats = jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
    return floats and not jax.tree_util.keystr(path).startswith(fixed)


def _numbers(simulation: Simulation, fixed: tuple[str, ...]) -> list[jax.Array]:
    """The numbers of a simulation that are differentiated by."""
    leaves = jax.tree_util.tree_leaves_with_path(simulation)
    return [jnp.asarray(leaf) for path, leaf in leaves if _is_moving(path, leaf, fixed)]


def _with_numbers(simulation: Simulation, numbers: Sequence[jax.Array], fixed: tuple[str, ...]) -> Simulation:
    """The simulation with other numbers in the place of `_numbers`."""
    left = iter(numbers)
    leaves, structure = jax.tree_util.tree_flatten_with_path(simulation)
    filled: Simulation = jax.tree.unflatten(
        structure, [next(left) if _is_moving(path, leaf, fixed) else leaf for path, leaf in leaves]
    )
    return filled


def _moving(state: State) -> Moving:
    return state.grains, state.history, state.servo, state.cell, state.wall_history


def _state(moving: Moving, status: jax.Array) -> State:
    return State(moving[0], moving[1], status, *moving[2:])


def _push(
    simulation: Simulation, state: State, first: Bin, count: Any, slopes: Any, most: int, fixed: tuple[str, ...]
) -> Any:
    """A chunk and its tangent."""

    def chunk(numbers: Any, moving: Moving) -> Any:
        changed = _with_numbers(simulation, numbers, fixed)
        after, sample = rollout_chunk(changed, _state(moving, state.status), first, count, most)
        return (_moving(after), sample.pressure), (after.status, sample)

    at = (_numbers(simulation, fixed), _moving(state))
    (moving, _), slope, (status, sample) = jax.jvp(chunk, at, slopes, has_aux=True)
    return _state(moving, status), sample, slope


def _before(state: State, sample: Sample) -> tuple[Moving, Sample]:
    """Keep the state before a bin too."""
    return _moving(state), sample


def _pull(
    simulation: Simulation,
    before: Moving,
    first: Bin,
    count: Any,
    slopes: tuple[Moving, jax.Array],
    fixed: tuple[str, ...],
) -> Any:
    """Derivatives by numbers and state before a chunk, from those by the state after it and the pressures of its bins.

    Args:
        simulation: what is run.
        before: states before its bins, leaves [most, ..., B].
        first: the first bin.
        count: of the bins; None for as many as there are states.
        slopes: derivatives; by the pressures [most, 3, B].
        fixed: what is not differentiated by.
    """
    count = len(slopes[1]) if count is None else count
    numbers, status = _numbers(simulation, fixed), jnp.zeros(slopes[1].shape[-1], jnp.int32)

    def one(done: jax.Array, carry: Any) -> Any:
        place = count - 1 - done
        by_state, by_numbers = carry

        def step(numbers: Any, moving: Moving) -> tuple[Moving, jax.Array]:
            changed = _with_numbers(simulation, numbers, fixed)
            row = first._replace(number=first.number + place)
            after, sample = bin_step(changed, _state(moving, status), row)
            return _moving(after), sample.pressure

        at = jax.tree.map(lambda leaf: leaf[place], before)
        more, by_state = jax.vjp(step, numbers, at)[1]((by_state, slopes[1][place]))
        return by_state, jax.tree.map(jnp.add, by_numbers, more)

    by_state, by_numbers = lax.fori_loop(0, count, one, (slopes[0], jax.tree.map(jnp.zeros_like, numbers)))
    return by_numbers, by_state


_pushed = Compiled(_push, static_argnames=("most", "fixed"))
_pulled = Compiled(_pull, static_argnames="fixed")
_recorded = Compiled(functools.partial(rollout_chunk, keep=_before), static_argnames="most")


@dataclass
class _Pushing(Observer):
    """Carries a tangent along.

    Attributes:
        fixed: what is not differentiated by.
        numbers: tangent of the simulation's numbers.
        moving: tangent of the state now; None as long as nothing has one.
        slopes: derivatives of the pressures of every stage, by chunks.
    """

    fixed: tuple[str, ...]
    numbers: Any
    moving: Moving | None
    slopes: dict[str, list[np.ndarray]] = field(default_factory=dict)
    _next: tuple[Moving, jax.Array] | None = None

    def step(self, chunk: Chunk) -> tuple[State, Sample] | None:
        """Run the chunk with its tangent."""
        if self.moving is None:
            return None
        slopes = (self.numbers, self.moving)
        at = chunk.simulation, chunk.state, chunk.row, chunk.count
        after, sample, self._next = _pushed(*at, slopes, most=CHUNK, fixed=self.fixed)
        return after, sample

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        """Keep the derivatives of the pressures."""
        change = jnp.zeros_like(sample.pressure)
        if self._next is not None:
            (self.moving, change), self._next = self._next, None
        self.slopes.setdefault(chunk.stage.name, []).append(np.asarray(change)[: chunk.count])

    def rebuild(self, history: Any, move: Move, blank: Any) -> None:
        """Move the tangent of the history too."""
        if self.moving is not None:
            grains, history, *others = self.moving
            self.moving = grains, move(history, jax.tree.map(jnp.zeros_like, blank)), *others


class _Piece(NamedTuple):
    """A piece of the way: from derivatives by the state after it to those before it."""

    back: Callable[[Moving], Moving]
    name: str = ""
    work: int = 0


@dataclass
class _Remembering(Observer):
    """Remembers the way, to go back on it."""

    fixed: tuple[str, ...]  # what is not differentiated by
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
        """Remember how to go back through the chunk."""
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
        """Remember how the history was moved."""
        _, pull = jax.vjp(lambda old: move(old, blank), history)
        self.tape.append(_Piece(lambda slope: (slope[0], pull(slope[1])[0], *slope[2:])))


@dataclass(frozen=True)
class Pushed:
    """A run and its tangent.

    Attributes:
        pressure: p of every stage by name, [bins, 3, B], in E.
        slope: their derivatives along the direction, likewise.
        p_sig: recalled signals, [S, 256].
        p_sig_slope: their derivatives.
    """

    pressure: dict[str, np.ndarray]
    slope: dict[str, np.ndarray]
    p_sig: jax.Array
    p_sig_slope: jax.Array


@usual_rules()
def push(experiment: Experiment, direction: Mapping[str, Any], *, progress: Progress = silent) -> Pushed:
    """Forward mode: the derivative of a whole experiment along a direction.

    Several derivatives at once are replicas: repeat a signal as often as there are parameters, and let the direction
    change another parameter in each (see `jacobian.exact`). A tangent costs some 2.5 runs on the native backend; the
    shear-free prefix is not differentiated if no parameter acts on it.

    Args:
        experiment: where.
        direction: tangents by the name of what changes, each a pytree like what stands there.
        progress: told about every chunk.

    Raises:
        ValueError: for a name that is no field.
        RunFailedError: if the simulation broke down.
    """
    theta, tangent = _theta(experiment, direction), jax.tree.map(jnp.asarray, dict(direction))
    along = _along(experiment)
    common, own = experiment.phases
    on = runner_of(experiment, progress=progress)
    on.total_work = _work(experiment, on)
    wide = on.state.replicas > 1
    slope: Moving | None = None
    if any(map(acts_on_prefix, theta)):
        slope = jax.jvp(lambda theta: _moving(along(theta).begin()), (theta,), (tangent,))[1]
    fixed = _fixed_by(theta)
    pushing = _Pushing(fixed, _number_slope(experiment, theta, tangent, fixed, sheared=False), slope)
    on.observers = (pushing,)
    samples = on.run_stages(*common)
    if pushing.moving is None:
        pushing.moving = jax.tree.map(jnp.zeros_like, _moving(on.state))
    if not wide:
        pushing.moving = jax.tree.map(lambda leaf: jnp.repeat(leaf, experiment.replicas, axis=-1), pushing.moving)
    pushing.numbers = _number_slope(experiment, theta, tangent, fixed, sheared=True)
    apply_waveforms(on, experiment)
    samples |= on.run_stages(*own)
    pressure = {name: np.asarray(sample.pressure) for name, sample in samples.items()}
    slopes = {name: np.concatenate(parts) for name, parts in pushing.slopes.items()}
    read, change = ({name: jnp.asarray(of[name]) for name in experiment.protocol.reads} for of in (pressure, slopes))
    return Pushed(pressure, slopes, experiment.recalled(read), experiment.recalled(change))


def _theta(experiment: Experiment, names: Any) -> dict[str, Any]:
    """What stands at names, as arrays.

    Raises:
        ValueError: if there is no such name, it holds what has no derivative, or it is within another.
    """
    require_several(names, "by")
    found = {name: value_at(experiment, name) for name in names}
    for name, tree in found.items():
        if inside := next((other for other in found if name.startswith(f"{other}.")), ""):
            raise ValueError(f"{name} is part of {inside}; name one of them")
        if name in STATIC_FIELDS or tree is None or not all(map(_is_number, jax.tree.leaves(tree))):
            raise ValueError(
                f"{name} is fixed when a program is compiled and has no derivative; "
                "numbers like gamma0, friction.mu, signals.amplitudes and pack.position have"
            )
    theta = {name: jax.tree.map(jnp.asarray, tree) for name, tree in found.items()}
    for name, tree in theta.items():
        if not all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(tree)):
            raise ValueError(f"{name} holds more than floats; name what to differentiate by, like pack.position")
    return theta


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, float | int | np.ndarray | jax.Array)


def _along(experiment: Experiment) -> Callable[[dict[str, Any]], Experiment]:
    return lambda theta: with_values(experiment, theta)


def _number_slope(experiment: Experiment, theta: Any, tangent: Any, fixed: tuple[str, ...], *, sheared: bool) -> Any:
    def numbers(theta: Any) -> list[jax.Array]:
        return _numbers(with_values(experiment, theta).simulation(sheared=sheared), fixed)

    return jax.jvp(numbers, (theta,), (tangent,))[1]


def _work(experiment: Experiment, on: Runner) -> float:
    common, own = experiment.phases
    return work_of(common, on.state.replicas) + work_of(own, experiment.replicas)


@comparable
@dataclass(frozen=True)
class Gradient:
    """A number and its derivatives.

    Attributes:
        value: the loss.
        slope: its derivatives by name, each a pytree like what stands there in the experiment.
        p_sig: recalled signals, [S, 256].
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
    """Reverse mode: a number and its derivatives by all parameters, through the whole experiment.

    The way forward keeps the state before each bin, in up to a GB, and beyond it the state before each chunk of 32. The
    way back replays such a chunk, and every bin. On the native backend bins are differentiated in the library; a
    gradient costs some four forward runs, and one more where chunks are replayed.

    Args:
        experiment: where.
        by: what to differentiate by: dotted names of floats or of parts that hold them, like "signals.amplitudes",
            "friction.mu", "t0", "pack.clump" or "pack.position". None within another.
        loss: what is differentiated; default the fidelity.
        checkpoint: where to go on and to keep how far it is on the way back; the way forward, a fifth, is done again.
        progress: told about every chunk of both ways; default a bar in a terminal or a notebook, False for none.

    Raises:
        ValueError: for a name that is no field, or a loss that is not one number.
        RunFailedError: if the simulation broke down.
    """
    require_kind("value_and_grad", experiment, Experiment)
    tell = callback(progress)
    theta, along = _theta(experiment, by), _along(experiment)
    common, own = experiment.phases
    on = runner_of(experiment, progress=within(tell, 0.0, FORWARDS))
    on.total_work = _work(experiment, on)
    fixed = _fixed_by(by)
    prefix, rest = _Remembering(fixed, ROOM), _Remembering(fixed, ROOM)
    on.observers = (prefix,) if any(map(acts_on_prefix, by)) else ()
    _, pull_begin = jax.vjp(lambda theta: _moving(along(theta).begin()), theta)
    on.run_stages(*common)
    fan_out = jax.linear_transpose(_fan_out(experiment), _moving(on.state))
    on.observers = (rest,)
    apply_waveforms(on, experiment)
    samples = on.run_stages(*own)

    def final(theta: Any, pressures: dict[str, jax.Array]) -> tuple[jax.Array, jax.Array]:
        changed = along(theta)
        p_sig = changed.recalled(pressures)
        value = loss(changed, p_sig)
        if jnp.ndim(value):
            raise ValueError(
                f"a loss is one number, got {jnp.shape(value)}: with several reads or channels give one, as "
                "loss=lambda experiment, p_sig: experiment.compare(p_sig).fidelity[0]"
            )
        return value, p_sig

    pressures = {name: jnp.asarray(samples[name].pressure) for name in experiment.protocol.reads}
    # Not compiled: it is another function in every call, and compiling it takes longer than doing it.
    last = jax.value_and_grad(final, argnums=(0, 1), has_aux=True)
    (value, p_sig), (slope, by_pressures) = last(theta, pressures)
    rest.reads = {name: np.asarray(by) for name, by in by_pressures.items()}

    def pull_numbers(sheared: bool, found: Any) -> Any:
        def numbers(theta: Any) -> list[jax.Array]:
            return _numbers(along(theta).simulation(sheared=sheared), fixed)

        return jax.vjp(numbers, theta)[1](found)[0]

    back = jax.tree.map(jnp.zeros_like, _moving(on.state))
    way = _Backwards(within(tell, FORWARDS, 1.0), (rest, prefix), checkpoint)
    back = way.through(rest, back)
    slope = jax.tree.map(jnp.add, slope, pull_numbers(True, rest.numbers))
    if any(map(acts_on_prefix, by)):
        back = way.through(prefix, fan_out(back)[0])
        if prefix.numbers is not None:  # a protocol may begin with a waveform
            slope = jax.tree.map(jnp.add, slope, pull_numbers(False, prefix.numbers))
        slope = jax.tree.map(jnp.add, slope, pull_begin(back)[0])
    return Gradient(value, slope, p_sig)


def _fan_out(experiment: Experiment) -> Callable[[Moving], Moving]:
    def spread(moving: Moving) -> Moving:
        status = jnp.zeros(moving[0].position.shape[-1], jnp.int32)
        return _moving(experiment.fan_out(_state(moving, status)))

    return spread


class _Backwards:
    """Goes back through some ways, the last first, forgetting their tapes; tells and keeps how far it is."""

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
        """From derivatives by the state at the end of a way to those at its beginning."""
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
