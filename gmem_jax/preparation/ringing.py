"""The slowest mode of the box that wall motion excites: its period T_1, over which a recall is averaged."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.pytree import Scalar
from gmem_jax.physics.state import Box
from gmem_jax.physics.step import System, accelerate, start
from gmem_jax.simulation.loop import Simulation
from gmem_jax.simulation.progress import Progress, silent, work_of
from gmem_jax.simulation.protocol import BINS, Stage
from gmem_jax.simulation.runner import Runner
from gmem_jax.simulation.strain import StrainPath

KICK = 2.0e-5  # strain rate of the kick, 1 / t_c: strains of about 1e-4, below which the response is linear enough
STEPS = 4  # steps per sample


def spectrum_peak(series: np.ndarray, spacing: float) -> float:
    """Period of the strongest oscillation in `series`, sampled every `spacing` (Hann window, parabolic peak).

    Raises:
        ValueError: if there is none.
    """
    steps = np.arange(series.size)
    flat = series - np.polyval(np.polyfit(steps, series, 1), steps)
    padded = 16 * series.size
    power = np.abs(np.fft.rfft(flat * np.hanning(series.size), padded)) ** 2
    power[: 3 * 16] = 0.0  # fewer than three periods in the record are drift, not ringing
    peak = int(np.argmax(power))
    if not power[peak] > 0.0:
        raise ValueError("a kick does not make the pressure on the walls ring: grains do not press on them")
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
    """T_1 in t_c: kick the resting pack with a uniform shear rate, and take the strongest period of p_xy.

    Args:
        system: with the friction law of the experiment.
        position: grain centres at rest, [N, 3, 1].
        quaternion: orientations, [N, 4, 1].
        box: walls, one replica.
        dt: time step, in t_c.
        progress: told about the run.
        backend: who does the steps.

    Raises:
        ValueError: if the walls feel nothing of the kick.
    """
    lengths = box.lengths
    duration = 40.0 * float(jnp.max(lengths))  # some 15 periods: the mode's speed is about 0.4 R / t_c
    bins = int(duration / (STEPS * float(dt)))
    state = start(system, position, quaternion, box)
    rate = KICK * jnp.asarray([-1.0, 1.0, 0.0])[:, None]
    velocity = rate * (position - 0.5 * (box.lower + box.upper))
    state = accelerate(system, replace(state, grains=replace(state.grains, velocity=velocity)), box)
    still = Simulation(system, StrainPath(box.lower, box.upper, 0.0), dt, steps=STEPS, backend=backend)
    ringing = Stage("ringing", 0.0, 0.0, bins / BINS, "hold")
    runner = Runner(still, state, progress=progress, total_work=work_of([ringing], 1))
    sample = runner.run_stages(ringing)["ringing"]
    pressure = np.asarray(sample.pressure)[:, :, 0]
    return spectrum_peak(pressure[:, 0] - pressure[:, 1], STEPS * float(dt))
