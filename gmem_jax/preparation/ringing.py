"""The ringing period T_1: that of the slowest mode of the box that wall motion excites."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.errors import RunFailedError
from gmem_jax.files.pack_validation import LISTENED, PERIODS, period_bounds
from gmem_jax.physics.pytree import Scalar
from gmem_jax.physics.state import Box
from gmem_jax.physics.step import accelerate, start
from gmem_jax.physics.system import System
from gmem_jax.simulation.loop import Simulation
from gmem_jax.simulation.progress import Progress, silent, work_of
from gmem_jax.simulation.runner import Runner
from gmem_jax.simulation.stage import BINS, Stage
from gmem_jax.simulation.strain import StrainPath, stretched

KICK = 2.0e-5  # strain rate of the kick, 1 / t_c: strains of about 1e-4, below which the response is linear enough
SHIFT = 1.0e-4  # strain of a periodic cell, applied at once: there is no wall from which a wave could start
STEPS_PER_SAMPLE = 4  # steps per sample


def spectrum_peak(series: np.ndarray, spacing: float, shortest: float = 0.0) -> float:
    """Period of the strongest oscillation in `series`, sampled every `spacing` (Hann window, parabolic peak).

    Args:
        series: one number for each sample.
        spacing: time between samples.
        shortest: shortest period that is looked for.

    Raises:
        RunFailedError: if nothing oscillates.
    """
    steps = np.arange(series.size)
    flat = series - np.polyval(np.polyfit(steps, series, 1), steps)
    padded = 16 * series.size
    power = np.abs(np.fft.rfft(flat * np.hanning(series.size), padded)) ** 2
    power[: PERIODS * 16] = 0.0  # fewer periods in the record are drift, not ringing
    if shortest > 0.0:
        power[int(padded * spacing / shortest) + 1 :] = 0.0
    peak = int(np.argmax(power))
    if not power[peak] > 0.0:
        raise RunFailedError("ringing: the x and y walls feel no oscillation: grains do not press on them")
    below, at, above = power[peak - 1 : peak + 2] if 0 < peak < power.size - 1 else (0.0, 1.0, 0.0)
    return padded * spacing / (peak + 0.5 * (below - above) / (below - 2.0 * at + above))


def ringing_period(
    system: System,
    position: jax.Array,
    quaternion: jax.Array,
    box: Box,
    dt: Scalar,
    progress: Progress = silent,
    *,
    backend: str = "auto",
) -> float:
    """T_1 in t_c: kick the resting pack with a uniform shear rate, and take the strongest period of p_x - p_y.

    A periodic cell is sheared by a small strain instead, with its grains; these then ring about their places in it.

    Args:
        system: the system, with the friction law of the experiment.
        position: grain centres at rest, [N, 3, 1].
        quaternion: orientations, [N, 4, 1].
        box: walls, one replica.
        dt: time step, in t_c.
        progress: told about the run.
        backend: the backend that runs the steps.

    Returns:
        A period within `pack_validation.period_bounds`.

    Raises:
        RunFailedError: if the walls feel no oscillation.
    """
    lengths = box.lengths
    duration = LISTENED * float(jnp.max(lengths))
    bins = int(duration / (STEPS_PER_SAMPLE * float(dt)))
    shear = jnp.asarray([-1.0, 1.0, 0.0])[:, None]
    place = position - 0.5 * (box.lower + box.upper)
    if any(box.periodic):
        sheared = jnp.where(box.images, SHIFT * shear, 0.0)
        box, position = stretched(box, sheared), position + sheared * place
    state = start(system, position, quaternion, box)
    velocity = jnp.where(box.images, 0.0, KICK * shear) * place
    state = accelerate(system, replace(state, grains=replace(state.grains, velocity=velocity)), box)
    path = StrainPath(box.lower, box.upper, 0.0, periodic=box.periodic)
    still = Simulation(system, path, dt, steps=STEPS_PER_SAMPLE, backend=backend)
    ringing = Stage("ringing", 0.0, 0.0, bins / BINS, "hold")
    runner = Runner(still, state, progress=progress, total_work=work_of([ringing], 1))
    sample = runner.run_stages(ringing)["ringing"]
    pressure = np.asarray(sample.pressure)[:, :, 0]
    shortest, longest = period_bounds(np.asarray(lengths)[:, 0])
    found = spectrum_peak(pressure[:, 0] - pressure[:, 1], STEPS_PER_SAMPLE * float(dt), shortest)
    return min(max(found, shortest), longest)  # a parabola may lie half a point of the spectrum beyond
