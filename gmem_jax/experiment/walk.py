"""An `Experiment` run forward on the host, the shear-free prefix apart: for many waveforms on one pack."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.experiment import Experiment, chunks
from gmem_jax.experiment.host import Progress, compiled, refuse, require_x64, silent, worst
from gmem_jax.experiment.protocol import Stage, split
from gmem_jax.physics.state import State


@functools.cache
def _part() -> Any:
    return compiled(Experiment.part, static_argnames=("sheared", "bins"))


def _advance(
    experiment: Experiment, state: State, stages: Sequence[Stage], progress: Progress, whole: tuple[float, float]
) -> tuple[State, dict[str, np.ndarray]]:
    """Run stages; `whole` is the part of all work that they are, as (from, to)."""
    pressures: dict[str, np.ndarray] = {}
    total, done = sum(stage.bins for stage in stages), 0
    for stage in stages:
        leg, parts = experiment.timing.leg(stage), []
        for first, bins in chunks(stage):
            state, pressure = _part()(experiment, state, leg, jnp.asarray(first), sheared=stage.sheared, bins=bins)
            refuse(worst(state), stage.name)
            parts.append(np.asarray(pressure))
            done += bins
            moment = done * experiment.timing.steps * experiment.timing.step
            progress(stage.name, moment, whole[0] + (whole[1] - whole[0]) * done / total)
        pressures[stage.name] = np.concatenate(parts)
    return state, pressures


def prefix(experiment: Experiment, *, progress: Progress = silent) -> State:
    """The state when encoding begins: the same for all waveforms.

    Raises:
        RunFailedError: if the simulation broke down.
    """
    require_x64()
    return _advance(experiment, experiment.begin(), split(experiment.timing.stages)[0], progress, (0.0, 0.1))[0]


def simulate(
    experiment: Experiment, state: State | None = None, *, progress: Progress = silent
) -> tuple[jax.Array, dict[str, np.ndarray]]:
    """Recall all signals of an experiment.

    Args:
        experiment: the experiment.
        state: what `prefix` gave for the same pack and friction; computed if not given.
        progress: told about every chunk.

    Returns:
        p_sig, [S, 256], and the pressures of the stages from the encoding on, [bins, 3, S + 1], in E.

    Raises:
        RunFailedError: if the simulation broke down.
    """
    state = prefix(experiment, progress=progress) if state is None else state
    _, pressures = _advance(
        experiment, experiment.fan_out(state), split(experiment.timing.stages)[1], progress, (0.1, 1.0)
    )
    return experiment.recalled(jnp.asarray(pressures["readout"])), pressures
