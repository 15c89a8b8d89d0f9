"""Inverse design: waveforms whose nonlinear recall follows wanted curves, and drives that recall best.

The recall is simulated anew in every iteration; only the direction of a step comes from a linear model, the memory
kernel of the pack or central differences around the present waveforms. A step is handed to an optax optimiser as a
preconditioned gradient. By unit costs the exact gradient of `gradient.value_and_grad` takes some hundred native runs;
differences with replicas take two runs a parameter.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import optax

from gmem_jax import analysis, sweep
from gmem_jax.experiment import Experiment
from gmem_jax.response import FINE, MemoryKernel, bumps, memory_kernel
from gmem_jax.run import Progress, silent
from gmem_jax.signals import Samples, Signals, bin_average, waveform
from gmem_jax.state import State

NODES = 127  # samples of a designed waveform


@dataclass(frozen=True)
class Design:
    """Waveforms found, and the way there.

    Attributes:
        signals: the best waveforms, as samples, |I| <= 1.
        target: J that their recall should follow, averaged over bins, [S, 256].
        p_sig: their recall in a fresh run, [S, 256], in E.
        fidelity: F of that recall with respect to the target.
        gain: G of that recall with respect to the target.
        before: F of the untouched waveforms.
        history: F after every iteration, the untouched waveforms first.
    """

    signals: Samples
    target: np.ndarray
    p_sig: np.ndarray
    fidelity: float
    gain: float
    before: float
    history: tuple[float, ...]


def bounded(amplitudes: np.ndarray, width: float) -> np.ndarray:
    """Amplitudes [S, n] with every waveform that exceeds |I| = 1 scaled back to it."""
    v = (jnp.arange(FINE) + 0.5) / FINE
    largest = np.max(np.abs(np.asarray(bumps(amplitudes, width).shear(v))), axis=0)
    result: np.ndarray = amplitudes / np.maximum(1.0, largest)[:, None]
    return result


def _inverse(jacobian: np.ndarray, damping: float) -> np.ndarray:
    """Tikhonov's inverse of p = a @ jacobian: [256, n]; `damping` in parts of the largest singular value."""
    left, values, right = np.linalg.svd(jacobian, full_matrices=False)
    filtered = values / (values**2 + (damping * values[0]) ** 2)
    result: np.ndarray = right.T @ np.diag(filtered) @ left.T
    return result


def sampled(signals: Signals, nodes: int = NODES) -> Samples:
    """The same waveforms as samples at u = k / (nodes + 1), as `gmem recall --signals` reads them."""
    values = signals.shear(jnp.arange(1, nodes + 1) / (nodes + 1)).T
    return waveform(values)


def local_jacobians(
    experiment: Experiment, amplitudes: np.ndarray, width: float, state: State, step: float = 1e-3
) -> np.ndarray:
    """dp_sig / da of every signal by central differences, [S, n, 256]: 2 S n replicas."""
    count, n = amplitudes.shape
    shifts = step * np.concatenate([np.eye(n), -np.eye(n)])
    rows = (amplitudes[:, None] + shifts).reshape(-1, n)
    p_sig = np.asarray(sweep.simulate(replace(experiment, signals=bumps(rows, width)), state)[0])
    both = p_sig.reshape(count, 2, n, -1)
    result: np.ndarray = (both[:, 0] - both[:, 1]) / (2.0 * step)
    return result


def design_waveforms(
    experiment: Experiment,
    *,
    iterations: int = 12,
    n: int = 17,
    width: float = 0.2,
    gain: float | None = None,
    damping: float = 0.015,
    optimiser: optax.GradientTransformation | None = None,
    kernel: MemoryKernel | None = None,
    state: State | None = None,
    refresh: int = 0,
    progress: Progress = silent,
) -> Design:
    """Pre-distort waveforms so that their recall follows the integrals of `experiment.signals` with one gain.

    Args:
        experiment: the pack, the drive, and the signals whose J are the targets.
        iterations: simulated corrections.
        n: bumps of a designed waveform.
        width: of the bumps.
        gain: wanted common gain; default 0.55 of the untouched waveforms' own, so that the bound leaves room.
        damping: of the inverse, in parts of the largest singular value.
        optimiser: what makes a step of a preconditioned gradient; default plain descent with steps of 0.7.
        kernel: measured kernel on the same bumps; measured if not given.
        state: what `sweep.prefix` gave.
        refresh: differentiate anew around the present waveforms every so many iterations; 0 for never.
        progress: told about every iteration.

    Raises:
        RunFailedError: if a simulation broke down.
    """
    state = sweep.prefix(experiment) if state is None else state
    target = np.asarray(bin_average(experiment.signals))
    unit = float(experiment.compression) * float(experiment.gamma0)
    original, _ = sweep.simulate(experiment, state)
    before = float(experiment.fidelity(original))
    wanted = (0.55 * float(experiment.gain(original)) if gain is None else gain) * unit * target
    kernel = memory_kernel(experiment.pack, n, width, state=state, experiment=experiment) if kernel is None else kernel
    progress("kernel measured", 0.0, 1.0 / (iterations + 2))
    inverses = np.repeat(_inverse(kernel.odd, damping)[None], len(target), axis=0)
    amplitudes = bounded(wanted @ inverses[0], width)
    optimiser = optax.sgd(0.7) if optimiser is None else optimiser
    memory = optimiser.init(jnp.asarray(amplitudes))
    best, best_fidelity, history = amplitudes, -np.inf, [before]

    def score(p_sig: jax.Array) -> float:
        return float(analysis.fidelity(p_sig, jnp.asarray(target), experiment.compression, experiment.gamma0))

    for iteration in range(iterations):
        if refresh and iteration % refresh == 0:
            local = local_jacobians(experiment, amplitudes, width, state)
            inverses = np.stack([_inverse(each, damping) for each in local])
        p_sig, _ = sweep.simulate(replace(experiment, signals=bumps(amplitudes, width)), state)
        history.append(score(p_sig))
        if history[-1] > best_fidelity:
            best, best_fidelity = amplitudes, history[-1]
        progress(f"iteration {iteration + 1}: F = {history[-1]:.4f}", 0.0, (iteration + 2) / (iterations + 2))
        miss = np.asarray(p_sig) - wanted
        slope = jnp.asarray(np.einsum("sp,spn->sn", miss, inverses))
        updates, memory = optimiser.update(slope, memory, jnp.asarray(amplitudes))
        amplitudes = bounded(np.asarray(optax.apply_updates(jnp.asarray(amplitudes), updates)), width)
    signals = sampled(bumps(best, width))
    fresh, _ = sweep.simulate(replace(experiment, signals=signals))
    found = analysis.gain(fresh, jnp.asarray(target), experiment.compression, experiment.gamma0)
    progress("verified", 0.0, 1.0)
    return Design(signals, target, np.asarray(fresh), score(fresh), float(found), before, tuple(history))
