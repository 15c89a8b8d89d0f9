"""Inverse design by Jacobians: waveforms whose recalls follow wanted curves, on one or several channels.

The exact Jacobian of the recall at the present waveforms has one tangent for each amplitude, as replicas of one run
(`derivatives.push`). A damped Gauss-Newton step is simulated, whole and in parts, before it is accepted.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmem_jax.derivatives.moving import require_derivatives
from gmem_jax.derivatives.push import push
from gmem_jax.design.kernel import QUADRATURE_POINTS, bumps, nearest, written_sets
from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.changes import replace
from gmem_jax.experiment.experiment import Experiment, require_one_value
from gmem_jax.experiment.run import prefix_of, run
from gmem_jax.experiment.signals import Bumps, Signals, Spline, signals, waveform
from gmem_jax.physics.numbers import require_numbers, require_whole, said
from gmem_jax.physics.pytree import comparable, short_repr
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.checkpoints import ResultCache, no_cache
from gmem_jax.simulation.progress import Progress, ProgressChoice, callback, shows_progress, within
from gmem_jax.simulation.stage import BINS

NODES = 127  # samples of a designed waveform
DAMPING = (0.01, 0.005)
FRACTIONS = (1.0, 0.5, 0.25)  # fractions of a step that are tried
ITERATIONS = 3  # corrections of a design
BUMPS = 17  # basis waveforms of a design
BUMP_WIDTH = 0.2  # full width of the basis waveforms, in u
TANGENT = 2.5  # cost of a tangent in runs; see benchmarks


@comparable
@dataclass(frozen=True)
class Design:
    """Designed waveforms, and how the design went.

    With C > 1 channels arrays have a leading axis [C], in the order of `Recall.channels`; F is [C] and G is [C, C].

    Attributes:
        sets: the designed waveforms by the name of their set, as samples with |I| <= 1.
        target: the integrals J of the original waveforms, which the recalls should follow, averaged over each bin,
            [S, 256].
        p_sig: recalls of the designed waveforms in a fresh run, [S, 256], in E.
        fidelity: F of these recalls with respect to the target.
        gain: G of these recalls with respect to the target.
        untouched: recalls of the original waveforms, [S, 256], in E.
        before: F of these.
        history: F of the original waveforms and after every iteration; the mean over channels if there are several.
    """

    sets: dict[str, Spline]
    target: np.ndarray
    p_sig: np.ndarray
    fidelity: float | np.ndarray
    gain: float | np.ndarray
    untouched: np.ndarray
    before: float | np.ndarray
    history: tuple[float, ...]

    __repr__ = short_repr

    @property
    def signals(self) -> Spline:
        """The designed waveforms, if there is one set.

        Raises:
            ValueError: if there are several sets, which `gm.signals(**design.sets)` puts together.
        """
        if len(self.sets) > 1:
            raise ValueError(f"the design has sets {', '.join(self.sets)}: take gm.signals(**design.sets)")
        return next(iter(self.sets.values()))


def largest(amplitudes: np.ndarray, width: float) -> np.ndarray:
    """Largest |I| of waveforms [S, n], [S]."""
    made = bumps(amplitudes, width)
    kinks = jnp.concatenate([made.centres[0] - 0.5 * width, made.centres[0] + 0.5 * width])
    v = jnp.concatenate([(jnp.arange(QUADRATURE_POINTS) + 0.5) / QUADRATURE_POINTS, kinks])
    found: np.ndarray = np.max(np.abs(np.asarray(made.shear(v))), axis=0)
    return found


def bounded(amplitudes: np.ndarray, width: float) -> np.ndarray:
    """Amplitudes [S, n] with every waveform that exceeds |I| = 1 scaled back to it."""
    result: np.ndarray = amplitudes / np.maximum(1.0, largest(amplitudes, width))[:, None]
    return result


def correction(slope: np.ndarray, miss: np.ndarray, damping: np.ndarray | float) -> np.ndarray:
    """Changes of amplitudes that correct p_sig by `miss`, by damped least squares, [S, n].

    Args:
        slope: dp_sig / da of every waveform, [S, n, 256].
        miss: wanted p_sig less the present p_sig, [S, 256], in E.
        damping: damping in the unit of singular values of the slope, a number or [S, 1].
    """
    left, values, right = np.linalg.svd(slope, full_matrices=False)
    filtered = values / (values**2 + np.square(damping))
    result: np.ndarray = np.einsum("snk,sk,sku,su->sn", left, filtered, right, miss, optimize=True)
    return result


def sampled(signals: Signals) -> Spline:
    """The same waveforms as samples at u = k / (NODES + 1), as `gmem recall --signals` reads them."""
    return waveform(signals.shear(jnp.arange(1, NODES + 1) / (NODES + 1)).T)


def verified(
    experiment: Experiment, sets: dict[str, Spline], p_sig: np.ndarray, untouched: np.ndarray, history: Sequence[float]
) -> Design:
    """The `Design` from the recalls of the designed and of the original waveforms, both [S, 256], in E."""
    match, before = (experiment.compare(jnp.asarray(recall)) for recall in (p_sig, untouched))
    return Design(
        sets=sets,
        target=np.asarray(experiment.integral()),
        p_sig=p_sig,
        fidelity=_told(match.fidelity),
        gain=_told(match.gain),
        untouched=untouched,
        before=_told(before.fidelity),
        history=tuple(history),
    )


def _told(found: jax.Array) -> float | np.ndarray:
    return np.asarray(found) if jnp.ndim(found) else float(found)


class Work:
    """The work of a design, in runs of all its signals, and the part of it that is done."""

    def __init__(self, total: float, progress: Progress) -> None:
        self.total = total
        self._done, self._progress = 0.0, progress

    def next(self, runs: float, name: str = "") -> Progress:
        """The progress callback of the next part of the work, of `runs` runs."""
        begun, self._done = self._done / self.total, self._done + runs
        inner = within(self._progress, begun, self._done / self.total)
        return lambda stage, moment, fraction: inner(f"{name}, {stage}" if name else stage, moment, fraction)


def cost(experiment: Experiment, iterations: int | None = None, n: int = BUMPS) -> float:
    """The cost of a design, in runs of all its signals."""
    corrections = ITERATIONS if iterations is None else iterations
    return 3.0 + 2.0 * _prefix(experiment) + corrections * (TANGENT * n + len(FRACTIONS))


def _prefix(experiment: Experiment) -> float:
    common, own = (sum(stage.bins for stage in some) for some in experiment.phases)
    return common / (own * experiment.replicas)


def require_gain(gain: float | None) -> None:
    """Refuse a wanted gain that no waveform has.

    Raises:
        ValueError: if it is 0, infinite or not a number.
    """
    if gain is not None and not 0.0 < abs(gain) < math.inf:
        raise ValueError(f"gain must be a finite number other than 0, got {gain:g}")


def require_damping(*damping: float) -> None:
    """Refuse no damping at all, and one that no correction can have.

    Raises:
        ValueError: if there is none, or one is negative, infinite or not a number.
    """
    if not damping or not all(0.0 <= one < math.inf for one in damping):
        raise ValueError(f"damping must be finite numbers >= 0, one at least; got {said(damping)}")


@usual_rules()
@shows_progress
def design_waveforms(
    experiment: Experiment,
    *,
    iterations: int = ITERATIONS,
    n: int = BUMPS,
    width: float = BUMP_WIDTH,
    gain: float | None = None,
    damping: float | Sequence[float] = DAMPING,
    cache: ResultCache = no_cache,
    progress: ProgressChoice = None,
) -> Design:
    """Pre-distort waveforms, by Jacobians, so that their recalls follow the integrals J of `experiment.signals`.

    All recalls of a channel follow G E delta0 gamma0 J with one gain G. Cross-talk between channels is corrected, too.

    Args:
        experiment: the pack, the parameters, and the signals whose J are the targets; with one read.
        iterations: number of corrections. Each takes a Jacobian, of n tangents for each signal and channel, and one run
            that tries three lengths of the step.
        n: number of bumps of a designed waveform.
        width: full width of the bumps in u.
        gain: wanted gain G; default half of the gain of the original waveforms on each channel, so that the bound
            |I| <= 1 leaves room.
        damping: damping of each correction, relative to the largest singular value of the Jacobian; the last is used
            for all that follow, and a number for all.
        cache: see `run`; it keeps every simulation and Jacobian.
        progress: see `run`.

    Raises:
        ValueError: if a parameter differs between replicas, there are several reads, a channel has no set of
            waveforms of its own, or the precision is mixed.
        RunFailedError: if a simulation broke down.
    """
    require_kind("design_waveforms", experiment, Experiment)
    require_derivatives(experiment)
    tell = callback(progress)
    require_one_value("waveforms are designed", experiment)
    iterations, n = require_whole("iterations", iterations), require_whole("n", n, 2)
    dampings = (damping,) if isinstance(damping, float | int) else tuple(damping)
    require_numbers(width=width, gain=gain, **{f"damping {number}": one for number, one in enumerate(dampings, 1)})
    require_damping(*dampings)
    require_gain(gain)
    names = written_sets(experiment)
    work, share = Work(cost(experiment, iterations, n * len(names)), tell), _prefix(experiment)
    prefix = prefix_of(experiment, cache=cache, progress=work.next(share))
    target = np.asarray(experiment.integral())
    untouched = run(experiment, prefix=prefix, cache=cache.scoped("untouched"), progress=work.next(1.0)).p_sig
    original = experiment.compare(jnp.asarray(untouched))
    own_gain = np.diag(original.gain) if len(names) > 1 else np.atleast_1d(original.gain)  # of each channel, [C]
    gains = 0.5 * own_gain if gain is None else np.full(len(names), gain)
    basis, count = bumps(np.eye(n), width), experiment.signals.count

    def side_by_side(by_channel: npt.ArrayLike) -> np.ndarray:
        """Curves [C, S, 256], or [S, 256] of one channel, as [S, C 256]."""
        shaped = np.asarray(by_channel).reshape(len(names), -1, BINS)
        return np.concatenate(list(shaped), axis=1)

    def made(rows: np.ndarray) -> dict[str, Bumps]:
        """Waveforms by the name of their set, from amplitudes [S, C n]."""
        own = zip(names, np.split(rows, len(names), axis=1), strict=True)
        return {name: bumps(part, width) for name, part in own}

    def within_bounds(rows: np.ndarray) -> np.ndarray:
        return np.concatenate([bounded(part, width) for part in np.split(rows, len(names), axis=1)], axis=1)

    def recall(name: str, rows: np.ndarray) -> np.ndarray:
        on = work.next(len(rows) / count, name)
        changed = replace(experiment, signals=signals(**made(rows)))
        return side_by_side(run(changed, prefix=prefix, cache=cache.scoped(name), progress=on).p_sig)

    def jacobians(name: str, at: np.ndarray) -> np.ndarray:
        """dp_sig / da of every signal, [S, C n, C 256]."""
        each = at.shape[1]
        rows, directions = np.repeat(at, each, axis=0), np.tile(np.eye(each), (count, 1))
        fields = ["signals"] if names == ("xy",) else [f"signals.{name}" for name in names]
        own = zip(fields, np.split(directions, len(names), axis=1), strict=True)
        direction = {f"{field}.amplitudes": jnp.asarray(part) for field, part in own}
        on = work.next(TANGENT * each, f"F = {history[-1]:.4f}")
        changed = replace(experiment, signals=signals(**made(rows)))
        slope = cache(name, lambda _: push(changed, direction, progress=on).p_sig_slope)
        return side_by_side(slope).reshape(count, each, -1)

    def fidelity(p_sig: np.ndarray) -> float:
        by_channel = np.stack(np.split(p_sig, len(names), axis=1)).reshape(target.shape)
        return float(np.mean(experiment.compare(jnp.asarray(by_channel)).fidelity))

    sets = experiment.sets
    wanted = side_by_side(gains.reshape(-1, 1, 1) * float(experiment.scale) * target.reshape(len(names), -1, BINS))
    first = [nearest(basis, sets[name]) * one / own for name, one, own in zip(names, gains, own_gain, strict=True)]
    amplitudes = within_bounds(np.concatenate(first, axis=1))
    p_sig = recall("projected", amplitudes)
    history = [float(np.mean(original.fidelity))]
    for iteration in range(iterations):
        local = jacobians(f"jacobian-{iteration}", amplitudes)
        damped = dampings[min(iteration, len(dampings) - 1)]
        steps = correction(local, wanted - p_sig, damped * np.linalg.norm(local, 2, axis=(1, 2))[:, None])
        tried = [within_bounds(amplitudes + fraction * steps) for fraction in FRACTIONS]
        candidates = np.stack([amplitudes, *tried])
        recalls = np.stack([p_sig, *recall(f"tried-{iteration}", np.concatenate(tried)).reshape(len(tried), count, -1)])
        chosen = np.linalg.norm(recalls - wanted, axis=2).argmin(axis=0), np.arange(count)
        amplitudes, p_sig = candidates[chosen], recalls[chosen]
        history.append(fidelity(p_sig))
    designed = {name: sampled(one) for name, one in made(amplitudes).items()}
    last = work.next(1.0 + share, "verified")
    fresh = run(replace(experiment, signals=signals(**designed)), cache=cache.scoped("verified"), progress=last).p_sig
    return verified(experiment, designed, np.asarray(fresh), np.asarray(untouched), history)
