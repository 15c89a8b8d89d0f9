"""Forward mode: a run and its tangent, chunk by chunk."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

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
from gmem_jax.experiment.changes import replace as with_values
from gmem_jax.experiment.experiment import Experiment, acts_on_prefix
from gmem_jax.experiment.run import apply_waveforms, runner_of
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import State
from gmem_jax.simulation.compiled import Compiled
from gmem_jax.simulation.loop import Simulation, rollout_chunk
from gmem_jax.simulation.observers import CHUNK, Chunk, Move, Observer
from gmem_jax.simulation.progress import Progress, silent
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.stage import Bin


def _push(
    simulation: Simulation, state: State, first: Bin, count: Any, slopes: Any, most: int, fixed: tuple[str, ...]
) -> Any:
    """Run a chunk with its tangent."""

    def chunk(numbers: Any, moving: Moving) -> Any:
        changed = with_numbers(simulation, numbers, fixed)
        after, sample = rollout_chunk(changed, state_of(moving, state.status), first, count, most)
        return (moving_of(after), sample.pressure), (after.status, sample)

    at = (numbers_of(simulation, fixed), moving_of(state))
    (moving, _), slope, (status, sample) = jax.jvp(chunk, at, slopes, has_aux=True)
    return state_of(moving, status), sample, slope


_pushed = Compiled(_push, static_argnames=("most", "fixed"))


@dataclass
class _Pushing(Observer):
    """Carries the tangent of a run along.

    Attributes:
        fixed: parts of the simulation with respect to which it is not differentiated.
        numbers: tangent of the simulation's numbers.
        moving: tangent of the present state; None while it is zero.
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


@dataclass(frozen=True)
class Pushed:
    """A run and its tangent.

    Attributes:
        pressure: pressure in every stage by name, [bins, 3, B], in E.
        slope: derivatives of the pressures along the direction, likewise.
        p_sig: recalled signals, [S, 256], in E.
        p_sig_slope: derivatives of the recalled signals along the direction.
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
        experiment: the experiment at which the derivative is taken.
        direction: tangents by dotted name, each a pytree like the part of the experiment with that name.
        progress: told about every chunk.

    Raises:
        ValueError: for a name that is no field.
        RunFailedError: if the simulation broke down.
    """
    require_derivatives(experiment)
    theta, tangent = theta_of(experiment, direction), jax.tree.map(jnp.asarray, dict(direction))
    experiment = with_grain(experiment, theta)
    common, own = experiment.phases
    on = runner_of(experiment, progress=progress)
    on.total_work = whole_work(experiment, on)
    wide = on.state.replicas > 1
    slope: Moving | None = None
    if any(map(acts_on_prefix, theta)):
        slope = jax.jvp(lambda theta: moving_of(with_values(experiment, theta).begin()), (theta,), (tangent,))[1]
    fixed = fixed_by(theta)

    def number_slope(sheared: bool) -> Any:
        return jax.jvp(numbers_by(experiment, fixed, sheared=sheared), (theta,), (tangent,))[1]

    pushing = _Pushing(fixed, number_slope(False), slope)
    on.observers = (pushing,)
    samples = on.run_stages(*common)
    if pushing.moving is None:
        pushing.moving = jax.tree.map(jnp.zeros_like, moving_of(on.state))
    if not wide:
        pushing.moving = jax.tree.map(lambda leaf: jnp.repeat(leaf, experiment.replicas, axis=-1), pushing.moving)
    pushing.numbers = number_slope(True)
    apply_waveforms(on, experiment)
    samples |= on.run_stages(*own)
    pressure = {name: np.asarray(sample.pressure) for name, sample in samples.items()}
    slopes = {name: np.concatenate(parts) for name, parts in pushing.slopes.items()}
    read, change = ({name: jnp.asarray(of[name]) for name in experiment.protocol.reads} for of in (pressure, slopes))
    return Pushed(pressure, slopes, experiment.recalled(read), experiment.recalled(change))
