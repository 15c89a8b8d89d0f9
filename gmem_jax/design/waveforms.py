"""Inverse design: waveforms whose nonlinear recall follows wanted curves, and drives that recall best.

Waveforms are corrected by the exact Jacobian of the recall around the present ones: one tangent per amplitude, as
replicas of one run (`gradient.push`). A damped Gauss-Newton step is handed to an optax optimiser as a preconditioned
gradient, and simulated before it is accepted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import optax

from gmem_jax.derivatives import gradient
from gmem_jax.derivatives.gradient import with_parameters
from gmem_jax.design.kernel import FINE, bumps, nearest
from gmem_jax.experiment import walk as sweep
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.host import Progress, silent
from gmem_jax.experiment.signals import Samples, Signals, waveform

NODES = 127  # samples of a designed waveform
DAMPING = (0.01, 0.005)
FRACTIONS = (1.0, 0.5, 0.25)  # of a step that are tried


@dataclass(frozen=True)
class Design:
    """Waveforms found, and the way there.

    Attributes:
        signals: the waveforms, as samples, |I| <= 1.
        target: J that their recall should follow, averaged over bins, [S, 256].
        p_sig: their recall in a fresh run, [S, 256], in E.
        fidelity: F of that recall with respect to the target.
        gain: G of that recall with respect to the target.
        untouched: recall of the untouched waveforms, [S, 256], in E.
        before: F of that.
        history: F after every iteration, the untouched waveforms first.
    """

    signals: Samples
    target: np.ndarray
    p_sig: np.ndarray
    fidelity: float
    gain: float
    untouched: np.ndarray
    before: float
    history: tuple[float, ...]


def bounded(amplitudes: np.ndarray, width: float) -> np.ndarray:
    """Amplitudes [S, n] with every waveform that exceeds |I| = 1 scaled back to it."""
    v = (jnp.arange(FINE) + 0.5) / FINE
    largest = np.max(np.abs(np.asarray(bumps(amplitudes, width).shear(v))), axis=0)
    result: np.ndarray = amplitudes / np.maximum(1.0, largest)[:, None]
    return result


def _step(jacobian: np.ndarray, miss: np.ndarray, damping: float) -> np.ndarray:
    """The change of amplitudes [n] whose recall comes nearest to `miss` [256] by a Jacobian [n, 256], damped."""
    left, values, right = np.linalg.svd(jacobian, full_matrices=False)
    filtered = values / (values**2 + (damping * values[0]) ** 2)
    result: np.ndarray = ((miss @ right.T) * filtered) @ left.T
    return result


def sampled(signals: Signals, nodes: int = NODES) -> Samples:
    """The same waveforms as samples at u = k / (nodes + 1), as `gmem recall --signals` reads them."""
    values = signals.shear(jnp.arange(1, nodes + 1) / (nodes + 1)).T
    return waveform(values)


def design_waveforms(
    experiment: Experiment,
    *,
    iterations: int = 3,
    n: int = 17,
    width: float = 0.2,
    gain: float | None = None,
    damping: Sequence[float] = DAMPING,
    optimiser: optax.GradientTransformation | None = None,
    progress: Progress = silent,
) -> Design:
    """Pre-distort waveforms so that their recall follows the integrals of `experiment.signals` with one gain.

    Args:
        experiment: the pack, the drive, and the signals whose J are the targets.
        iterations: corrections; each takes a Jacobian of n tangents a signal and up to three simulations.
        n: bumps of a designed waveform.
        width: of the bumps.
        gain: wanted common gain; default half of the untouched waveforms' own, so that the bound leaves room.
        damping: of the steps one after the other, in parts of the Jacobian's largest singular value; the last for all
            that follow.
        optimiser: what makes a step of a preconditioned gradient; default the whole step, shortened if the recall
            gets worse.
        progress: told about every chunk.

    Raises:
        RunFailedError: if a simulation broke down.
    """
    state = sweep.prefix(experiment)
    target = np.asarray(experiment.integral())
    original, _ = sweep.simulate(experiment, state)
    before, own_gain = float(experiment.fidelity(original)), float(experiment.gain(original))
    gain = 0.5 * own_gain if gain is None else gain
    wanted = gain * float(experiment.compression) * float(experiment.gamma0) * target
    basis = bumps(np.eye(n), width)
    amplitudes = bounded(nearest(basis, experiment.signals) * gain / own_gain, width)
    optimiser = optax.sgd(1.0) if optimiser is None else optimiser
    memory = optimiser.init(jnp.asarray(amplitudes))
    count = len(target)

    def make(rows: jax.Array | np.ndarray) -> Experiment:
        return replace(experiment, signals=bumps(rows, width))

    def recall(rows: np.ndarray) -> np.ndarray:
        return np.asarray(sweep.simulate(make(rows), state)[0])

    def jacobians(at: np.ndarray, begun: float, ended: float) -> np.ndarray:
        """dp_sig / da of every signal, [S, n, 256]."""

        def report(_: str, moment: float, fraction: float) -> None:
            progress(f"F = {history[-1]:.4f}", moment, begun + (ended - begun) * fraction)

        rows, directions = np.repeat(at, n, axis=0), np.tile(np.eye(n), (count, 1))
        pushed = gradient.push(make, jnp.asarray(rows), jnp.asarray(directions), progress=report)
        return np.asarray(pushed.p_sig_slope).reshape(count, n, -1)

    p_sig = recall(amplitudes)
    history = [before]
    for iteration in range(iterations):
        local = jacobians(amplitudes, iteration / iterations, (iteration + 1) / iterations)
        damped = damping[min(iteration, len(damping) - 1)]
        steps = np.stack([_step(*pair, damped) for pair in zip(local, wanted - p_sig, strict=True)])
        updates, memory = optimiser.update(jnp.asarray(-steps), memory, jnp.asarray(amplitudes))
        tried = [bounded(amplitudes + fraction * np.asarray(updates), width) for fraction in FRACTIONS]
        candidates = np.stack([amplitudes, *tried])
        recalls = np.stack([p_sig, *recall(np.concatenate(tried)).reshape(len(tried), count, -1)])
        chosen = np.linalg.norm(recalls - wanted, axis=2).argmin(axis=0), np.arange(count)
        amplitudes, p_sig = candidates[chosen], recalls[chosen]
        history.append(float(experiment.fidelity(jnp.asarray(p_sig))))
    signals = sampled(bumps(amplitudes, width))
    fresh, _ = sweep.simulate(replace(experiment, signals=signals))
    progress("verified", 0.0, 1.0)
    return Design(
        signals=signals,
        target=target,
        p_sig=np.asarray(fresh),
        fidelity=float(experiment.fidelity(fresh)),
        gain=float(experiment.gain(fresh)),
        untouched=np.asarray(original),
        before=before,
        history=tuple(history),
    )


@dataclass(frozen=True)
class Drive:
    """Drive parameters found, and the way there.

    Attributes:
        values: of the best drive, by name.
        fidelity: mean F over the packs, there.
        each: F of every pack, there, [packs].
        before: mean F of the drive that was begun with.
        history: (values, mean F) after every iteration, the first drive first.
    """

    values: dict[str, float]
    fidelity: float
    each: np.ndarray
    before: float
    history: tuple[tuple[dict[str, float], float], ...]


def design_drive(
    experiments: Sequence[Experiment],
    bounds: dict[str, tuple[float, float]],
    *,
    iterations: int = 6,
    spread: float = 0.2,
    optimiser: optax.GradientTransformation | None = None,
    progress: Progress = silent,
) -> Drive:
    """Choose gamma0 and parameters of the friction law within bounds so that the mean fidelity of some packs grows.

    F of one pack is rugged in mu and the stiffness: the exact derivative holds for changes of 1e-5 (see
    experiments/gradient_check.py), because grains rearrange. What can be climbed is the slope on a coarser scale, from
    central differences over +- `spread` of each logarithm, averaged over packs. The best drive that was simulated is
    kept; where none is better than the present one, the spread is halved. The maximum of a rugged function is biased:
    check the drive on other packs.

    Args:
        experiments: one for each pack, alike in all else; where they stand is the start.
        bounds: lowest and highest value by name: "gamma0", "mu", "stiffness" (any of them).
        iterations: steps; each costs 2 n + 1 runs a pack for n parameters.
        spread: of the differences at first, in parts of each parameter.
        optimiser: what makes a step of the logarithms of a gradient of length `spread`; default the gradient itself.
        progress: told about every run.

    Raises:
        ValueError: if a bound is not lowest <= start <= highest with lowest positive, or there is no pack.
        RunFailedError: if a simulation broke down.
    """
    if not experiments:
        raise ValueError("a drive is designed for at least one pack")
    names = list(bounds)
    start = [_value(experiments[0], name) for name in names]
    for name, value in zip(names, start, strict=True):
        low, high = bounds[name]
        if not 0.0 < low <= value <= high:
            raise ValueError(
                f"{name}: bounds must be positive and hold the first value {value:g}, got {low:g} to {high:g}"
            )
    lowest, highest = np.log([bounds[name] for name in names]).T
    total, done = (iterations * (2 * len(names) + 1) + 1) * len(experiments), 0

    def each(logs: np.ndarray) -> np.ndarray:
        nonlocal done
        found = []
        for experiment in experiments:
            changed = with_parameters(experiment, **dict(zip(names, np.exp(logs), strict=True)))
            found.append(float(changed.fidelity(sweep.simulate(changed)[0])))
            done += 1
            progress(f"F = {np.mean(found):.4f}", 0.0, done / total)
        return np.asarray(found)

    optimiser = optax.sgd(1.0) if optimiser is None else optimiser
    logs = np.log(start)
    memory = optimiser.init(jnp.asarray(logs))
    found = each(logs)
    history = [(logs, float(found.mean()))]
    for _ in range(iterations):
        seen: list[tuple[np.ndarray, np.ndarray]] = [(logs, found)]
        slope = np.zeros(len(names))
        for place, step in enumerate(spread * np.eye(len(names))):
            sides = [np.clip(logs + sign * step, lowest, highest) for sign in (1.0, -1.0)]
            up, down = (each(side) for side in sides)
            slope[place] = np.mean(up - down) / max(sides[0][place] - sides[1][place], 1e-12)
            seen += zip(sides, (up, down), strict=True)
        # As long as the differences reach: the slope says nothing of what is further away.
        along = -slope * spread / max(float(np.linalg.norm(slope)), 1e-12)
        updates, memory = optimiser.update(jnp.asarray(along), memory, jnp.asarray(logs))
        stepped = np.clip(np.asarray(optax.apply_updates(jnp.asarray(logs), updates)), lowest, highest)
        seen.append((stepped, each(stepped)))
        before, (logs, found) = logs, max(seen, key=lambda pair: float(pair[1].mean()))
        spread = 0.5 * spread if logs is before else spread
        history.append((logs, float(found.mean())))

    def named(logs: np.ndarray) -> dict[str, float]:
        return {name: float(value) for name, value in zip(names, np.exp(logs), strict=True)}

    way = tuple((named(logs), value) for logs, value in history)
    return Drive(named(logs), float(found.mean()), found, history[0][1], way)


def _value(experiment: Experiment, name: str) -> float:
    return float(getattr(experiment if hasattr(experiment, name) else experiment.friction, name))
