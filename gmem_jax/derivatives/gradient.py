"""Derivatives through the whole memory experiment, chunk by chunk on the host, in both directions.

`jax.grad` and `jax.jvp` of `run_memory` work as they are. The sweeps here do the same in chunks of bins: they
report progress, compile small programs, and need one state per chunk and the replay of one chunk. An experiment is
given by a function `make` from the parameters (a pytree of float arrays) to an `Experiment`.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.experiment import Experiment, Leg, chunks
from gmem_jax.experiment.host import Progress, compiled, refuse, require_x64, silent, worst
from gmem_jax.experiment.protocol import Stage, split
from gmem_jax.physics.state import State

Make = Callable[[Any], Experiment]
"""From parameters to an experiment. It is compiled in: use the same function object again to compile once."""

Loss = Callable[[Experiment, jax.Array], jax.Array]
"""From an experiment and its p_sig [S, 256] to a number."""


def fidelity(experiment: Experiment, p_sig: jax.Array) -> jax.Array:
    """F of the set."""
    return experiment.fidelity(p_sig)


def gain(experiment: Experiment, p_sig: jax.Array) -> jax.Array:
    """G of the set."""
    return experiment.gain(p_sig)


Moving = tuple[Any, Any]  # grains and history: what of a state can be differentiated


def _piece(
    make: Make, theta: Any, moving: Moving, status: jax.Array, leg: Leg, first: jax.Array, *, sheared: bool, bins: int
) -> tuple[tuple[Moving, jax.Array], jax.Array]:
    """A chunk as a function of parameters and state: ((state, pressures), status)."""
    state, pressure = make(theta).part(State(moving[0], moving[1], status), leg, first, sheared=sheared, bins=bins)
    return ((state.grains, state.history), pressure), state.status


@functools.cache
def _program(kind: str) -> Any:
    """The compiled chunk: "run", "push" (forward mode) or "pull" (reverse mode)."""

    def run(make: Make, theta: Any, moving: Moving, *rest: Any, sheared: bool, bins: int) -> Any:
        return _piece(make, theta, moving, *rest, sheared=sheared, bins=bins)

    def push(
        make: Make, theta: Any, moving: Moving, *rest: Any, slopes: tuple[Any, Moving], sheared: bool, bins: int
    ) -> Any:
        def piece(theta: Any, moving: Moving) -> Any:
            return _piece(make, theta, moving, *rest, sheared=sheared, bins=bins)

        return jax.jvp(piece, (theta, moving), slopes, has_aux=True)

    def pull(
        make: Make, theta: Any, moving: Moving, *rest: Any, slopes: tuple[Moving, jax.Array], sheared: bool, bins: int
    ) -> Any:
        def piece(theta: Any, moving: Moving) -> Any:
            return _piece(make, theta, moving, *rest, sheared=sheared, bins=bins)

        return jax.vjp(piece, theta, moving, has_aux=True)[1](slopes)

    programs: dict[str, Callable[..., Any]] = {"run": run, "push": push, "pull": pull}
    chosen = programs[kind]
    return compiled(chosen, static_argnums=0, static_argnames=("sheared", "bins"))


def _fan_out(make: Make, theta: Any, moving: Moving, status: jax.Array) -> Moving:
    state = make(theta).fan_out(State(moving[0], moving[1], status))
    return state.grains, state.history


def _begin(make: Make, theta: Any) -> Moving:
    state = make(theta).begin()
    return state.grains, state.history


def acts_on_prefix(make: Make, theta: Any) -> bool:
    """Whether the parameters change anything of the shear-free prefix (a random direction tells)."""
    rng = np.random.default_rng(0)
    direction = jax.tree.map(lambda leaf: jnp.asarray(rng.standard_normal(np.shape(leaf))), theta)
    _, slopes = jax.jvp(lambda theta: make(theta).prefix_inputs(), (theta,), (direction,))
    floats = [leaf for leaf in jax.tree.leaves(slopes) if leaf.dtype != jax.dtypes.float0]
    return any(bool(np.any(np.asarray(leaf) != 0.0)) for leaf in floats)


@dataclass
class _Chunk:
    """One chunk of the tape: where it begins, and how it is run."""

    stage: Stage
    leg: Leg
    first: int
    bins: int
    moving: Moving
    status: jax.Array

    def call(self, kind: str, make: Make, theta: Any, **extra: Any) -> Any:
        options = {"sheared": self.stage.sheared, "bins": self.bins, **extra}
        return _program(kind)(make, theta, self.moving, self.status, self.leg, jnp.asarray(self.first), **options)


def _plan(experiment: Experiment) -> tuple[list[tuple[Stage, int, int]], int]:
    """The chunks (stage, first bin, bins) of the experiment, and how many of them belong to the prefix."""
    common, sheared = (
        [(stage, *piece) for stage in part for piece in chunks(stage)] for part in split(experiment.timing.stages)
    )
    return common + sheared, len(common)


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


def push(make: Make, theta: Any, direction: Any, *, progress: Progress = silent) -> Pushed:
    """Forward mode: the derivative of a whole experiment along `direction` (a pytree like theta).

    Several derivatives at once are replicas: repeat a signal as often as there are parameters, and let the direction
    change another parameter in each (see `jacobian.exact`). A tangent costs some 2.5 runs on the native backend; the
    shear-free prefix is not differentiated if no parameter acts on it.

    Raises:
        RunFailedError: if the simulation broke down.
    """
    require_x64()
    experiment = make(theta)
    plan, sheared_from = _plan(experiment)
    moving, slope = jax.jvp(lambda theta: _begin(make, theta), (theta,), (direction,))
    status = experiment.begin().status
    differentiate = acts_on_prefix(make, theta)
    pressures: dict[str, list[np.ndarray]] = {}
    slopes: dict[str, list[np.ndarray]] = {}
    for number, (stage, first, bins) in enumerate(plan):
        if number == sheared_from:
            differentiate = True
            moving, slope = jax.jvp(
                lambda moving, status=status: _fan_out(make, theta, moving, status), (moving,), (slope,)
            )
            status = jnp.broadcast_to(status, (experiment.replicas,))
        chunk = _Chunk(stage, experiment.timing.leg(stage), first, bins, moving, status)
        if differentiate:
            (moving, pressure), (slope, change), status = chunk.call("push", make, theta, slopes=(direction, slope))
        else:
            (moving, pressure), status = chunk.call("run", make, theta)
            change = jnp.zeros_like(pressure)
        refuse(worst(State(moving[0], moving[1], status)), stage.name)
        pressures.setdefault(stage.name, []).append(np.asarray(pressure))
        slopes.setdefault(stage.name, []).append(np.asarray(change))
        progress(stage.name, 0.0, (number + 1) / len(plan))
    joined = {name: np.concatenate(parts) for name, parts in pressures.items()}
    changed = {name: np.concatenate(parts) for name, parts in slopes.items()}
    readout = jnp.asarray(joined["readout"]), jnp.asarray(changed["readout"])
    p_sig, p_sig_slope = experiment.recalled(readout[0]), experiment.recalled(readout[1])
    return Pushed(joined, changed, p_sig, p_sig_slope)


@dataclass(frozen=True)
class Gradient:
    """A number and its derivatives.

    Attributes:
        value: the loss.
        slope: its derivative by every parameter, a pytree like theta.
        p_sig: recalled signals, [S, 256].
    """

    value: jax.Array
    slope: Any
    p_sig: jax.Array


def value_and_grad(make: Make, theta: Any, loss: Loss = fidelity, *, progress: Progress = silent) -> Gradient:
    """Reverse mode: a number and its derivatives by all parameters, through the whole experiment.

    The forward sweep keeps the state at the start of each chunk; the backward sweep replays chunk after chunk and,
    within it, bin after bin. On the native backend both happen in the library, for some ten forward runs in all.

    Args:
        make: from parameters to the experiment.
        theta: parameters, a pytree of floats.
        loss: what is differentiated; default the fidelity.
        progress: told about every chunk of both sweeps.

    Raises:
        RunFailedError: if the simulation broke down.
    """
    require_x64()
    theta = jax.tree.map(jnp.asarray, theta)
    experiment = make(theta)
    plan, sheared_from = _plan(experiment)
    moving, pull_begin = jax.vjp(lambda theta: _begin(make, theta), theta)
    status = experiment.begin().status
    tape: list[_Chunk] = []
    readout = []
    pull_fan: Any = None
    for number, (stage, first, bins) in enumerate(plan):
        if number == sheared_from:
            moving, pull_fan = jax.vjp(lambda moving, status=status: _fan_out(make, theta, moving, status), moving)
            status = jnp.broadcast_to(status, (experiment.replicas,))
        tape.append(_Chunk(stage, experiment.timing.leg(stage), first, bins, moving, status))
        (moving, pressure), status = tape[-1].call("run", make, theta)
        refuse(worst(State(moving[0], moving[1], status)), stage.name)
        if stage.name == "readout":
            readout.append(pressure)
        progress(stage.name, 0.0, 0.02 * (number + 1) / len(plan))

    def final(theta: Any, pressure: jax.Array) -> tuple[jax.Array, jax.Array]:
        experiment = make(theta)
        p_sig = experiment.recalled(pressure)
        return loss(experiment, p_sig), p_sig

    last = jax.value_and_grad(final, argnums=(0, 1), has_aux=True)
    (value, p_sig), (slope, from_readout) = last(theta, jnp.concatenate(readout))
    back = jax.tree.map(jnp.zeros_like, moving)
    begins = 0 if acts_on_prefix(make, theta) else sheared_from
    work = sum(chunk.bins * chunk.status.shape[0] for chunk in tape[begins:])
    done = 0
    for number in reversed(range(begins, len(tape))):
        chunk = tape.pop()
        on_pressure = jnp.zeros((chunk.bins, 3, chunk.status.shape[0]))
        if chunk.stage.name == "readout":
            on_pressure = from_readout[chunk.first : chunk.first + chunk.bins]
        more, back = chunk.call("pull", make, theta, slopes=(back, on_pressure))
        slope = jax.tree.map(jnp.add, slope, more)
        if number == sheared_from:
            (back,) = pull_fan(back)
        done += chunk.bins * chunk.status.shape[0]
        progress(f"back through {chunk.stage.name}", 0.0, 0.02 + 0.98 * done / work)
    if begins == 0:
        slope = jax.tree.map(jnp.add, slope, pull_begin(back)[0])
    return Gradient(value, slope, p_sig)


def with_parameters(experiment: Experiment, **changes: Any) -> Experiment:
    """`experiment` with other parameters: fields of `Experiment`, or of its friction law (mu, stiffness, ...)."""
    own = {name: changes.pop(name) for name in list(changes) if not hasattr(experiment, name)}
    law: Any = experiment.friction
    return replace(experiment, friction=replace(law, **own) if own else law, **changes)
