"""Tuning gamma0 and parameters of the friction law for the largest mean fidelity of several packs."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from gmem_jax.derivatives.moving import theta_of
from gmem_jax.experiment.arguments import require_kind, require_several
from gmem_jax.experiment.changes import replace
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.run import run
from gmem_jax.experiment.stepping import require_stable
from gmem_jax.physics.numbers import require_numbers, require_whole
from gmem_jax.physics.pytree import comparable
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.checkpoints import Checkpoint, ResultCache, no_cache
from gmem_jax.simulation.progress import ProgressChoice, callback, shows_progress

PARAMETERS = {"gamma0": "gamma0", "mu": "friction.mu", "stiffness": "friction.stiffness"}


@comparable
@dataclass(frozen=True)
class TunedDrive:
    """Tuned parameters, and how the search went.

    Attributes:
        values: the best values that were found, by name.
        fidelity: mean F over the packs at these values.
        each: F of every pack at these values, [packs].
        before: mean F at the first values.
        history: (values, mean F) at the first values and after every iteration.
    """

    values: dict[str, float]
    fidelity: float
    each: np.ndarray
    before: float
    history: tuple[tuple[dict[str, float], float], ...]


def start_within(experiments: Sequence[Experiment], bounds: dict[str, tuple[float, float]]) -> list[float]:
    """The values with which a search begins.

    Raises:
        ValueError: if a bound is not lowest <= start <= highest with lowest positive, there is no pack, a parameter
            is no number that can be tuned or differs between experiments, or the time step is not stable with the
            highest values.
    """
    require_several(experiments, "experiments")
    if not experiments:
        raise ValueError("a drive is designed for at least one pack")
    for experiment in experiments:
        require_kind("design_drive", experiment, Experiment)
    if not bounds:
        raise ValueError("bounds must name what is tuned, as in {'gamma0': (3e-4, 3e-3)}")
    if len(experiments[0].readings.reads) * len(experiments[0].readings.channels) > 1:
        raise ValueError("a drive is designed for one read and one channel")
    found, paths = [], [PARAMETERS.get(name, name) for name in bounds]
    if len(set(paths)) < len(paths):
        raise ValueError(f"one parameter is named twice: {', '.join(bounds)}")
    for path, (name, (low, high)) in zip(paths, bounds.items(), strict=True):
        require_numbers(**{f"{name} (lowest)": low, f"{name} (highest)": high})
        values = [theta_of(one, [path])[path] for one in experiments]
        if any(np.ndim(value) for value in values) or len(set(map(float, values))) > 1:
            raise ValueError(f"{name} must be one number, the same in all experiments: the search begins there")
        value = float(values[0])
        if not 0.0 < low <= value <= high:
            raise ValueError(
                f"{name}: bounds must be positive and hold the first value {value:g}, got {low:g} to {high:g}"
            )
        found.append(value)
    highest = {PARAMETERS.get(name, name): high for name, (_, high) in bounds.items()}
    for experiment in experiments:
        try:
            require_stable(replace(experiment, highest))
        except ValueError as error:
            raise ValueError(f"with the highest values of the bounds: {error}") from error
    return found


@usual_rules()
@shows_progress
def design_drive(
    experiments: Sequence[Experiment],
    bounds: dict[str, tuple[float, float]],
    *,
    iterations: int = 6,
    spread: float = 0.2,
    cache: ResultCache = no_cache,
    progress: ProgressChoice = None,
) -> TunedDrive:
    """Choose gamma0 and parameters of the friction law, within bounds, so that the mean fidelity of some packs grows.

    F of one pack is rugged in mu and the stiffness, because grains rearrange: the exact derivative holds only for
    relative changes of some 1e-5 (experiments/gradient_check.py). So the search climbs a coarser slope: central
    differences of the mean F over steps of +-`spread` in the logarithm of each parameter. The best values that were
    simulated are kept; if none are better than the present ones, the spread is halved. The maximum of a rugged function
    is biased: check the result on other packs.

    Args:
        experiments: one for each pack, alike in all else; their parameters are the start of the search.
        bounds: lowest and highest value of each tuned parameter, by name: "gamma0", "mu", "stiffness" or any dotted
            name, as in {"mu": (0.5, 2.0)}.
        iterations: number of steps; each takes 2 n + 1 runs of each pack for n parameters.
        spread: first step of the differences in the logarithms, in (0, 1).
        cache: see `run`; it keeps the fidelity of every run.
        progress: see `run`; called after every run.

    Raises:
        ValueError: if a parameter does not begin within its bounds, is no positive number or differs between
            experiments; if there is no pack, there are several reads or channels, or the time step is not stable with
            the highest values.
        RunFailedError: if a simulation broke down.
    """
    tell, iterations = callback(progress), require_whole("iterations", iterations)
    require_numbers(spread=spread)
    if not 0.0 < spread < 1.0:
        raise ValueError(f"spread must be in (0, 1), got {spread:g}")
    names = list(bounds)
    paths = [PARAMETERS.get(name, name) for name in names]
    start = start_within(experiments, bounds)
    lowest, highest = np.log([bounds[name] for name in names]).T
    total, done = (iterations * (2 * len(names) + 1) + 1) * len(experiments), 0

    def each(logs: np.ndarray) -> np.ndarray:
        nonlocal done
        found = []
        for experiment in experiments:
            changed = replace(experiment, dict(zip(paths, np.exp(logs), strict=True)))

            def recall(_: Checkpoint, changed: Experiment = changed) -> jax.Array:
                return run(changed).fidelity

            found.append(float(cache(f"run-{done:05d}", recall)))
            done += 1
            tell(f"F = {np.mean(found):.4f}", 0.0, done / total)
        return np.asarray(found)

    logs = np.log(start)
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
        # The step is as long as the differences: the slope says nothing about points further away.
        along = -slope * spread / max(float(np.linalg.norm(slope)), 1e-12)
        stepped = np.clip(logs - along, lowest, highest)
        seen.append((stepped, each(stepped)))
        before, (logs, found) = logs, max(seen, key=lambda pair: float(pair[1].mean()))
        spread = 0.5 * spread if logs is before else spread
        history.append((logs, float(found.mean())))

    def named(logs: np.ndarray) -> dict[str, float]:
        return {name: float(value) for name, value in zip(names, np.exp(logs), strict=True)}

    way = tuple((named(logs), value) for logs, value in history)
    return TunedDrive(named(logs), float(found.mean()), found, history[0][1], way)
