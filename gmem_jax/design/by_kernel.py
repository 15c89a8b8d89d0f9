"""Inverse design by the memory kernel, for many waveforms at once, such as all words of a length.

A Jacobian for every waveform (`waveforms`) costs some tens of runs of each. Here one kernel of the pack (2 n + 1
replicas) serves as the Jacobian of all. Since it is only approximate, corrections are simulated and repeated, and each
simulation updates the derivatives of each waveform (Broyden's method). These derivatives can also be measured, with
most runs for the waveforms that miss their target most; the remaining error lies along directions in which the kernel
is small. A step that makes a recall worse is undone, and the next is damped more (Levenberg and Marquardt).
"""

import jax.numpy as jnp
import numpy as np

from gmem_jax.design.kernel import MemoryKernel, amplitude_on, bumps, memory_kernel, nearest, written_sets
from gmem_jax.design.waveforms import (
    Design,
    Work,
    bounded,
    correction,
    largest,
    require_damping,
    require_gain,
    sampled,
    verified,
)
from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.changes import with_signals
from gmem_jax.experiment.experiment import Experiment, require_one_value
from gmem_jax.experiment.run import PREFIX, prefix_of, run
from gmem_jax.experiment.signals import Signals, Spline
from gmem_jax.physics.numbers import plural, require_numbers, require_whole
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.checkpoints import ResultCache, no_cache
from gmem_jax.simulation.progress import ProgressChoice, callback, shows_progress

KERNEL_BUMPS = 31  # basis waveforms; narrower ones drive the walls faster than the box rings
KERNEL_BUMP_WIDTH = 0.08  # full width of the basis waveforms, in u
KERNEL_DAMPING = 0.05  # damping of the first correction, over the kernel's largest singular value
EASED, FIRMED = 0.6, 1.8  # factors on the damping after a step to a better recall, and after one to a worse recall
KERNEL_ITERATIONS = 6  # simulations of all waveforms
SLOPES_AT = (1 / 3, 2 / 3)  # fractions of the iterations after which slopes are measured
PROBE = (0.01, 0.05)  # shortest and longest step along a direction that is measured
FIRST_GUESS_BOUND = 0.6  # largest |I| of the first guess if no gain is asked for; the bound is 1
SHORTEST = 1e-6  # smallest length of a step that learned slopes are divided by: a zero waveform takes no step
PREDICTED = 6  # corrections of the first guess, by the kernel alone


def slopes(kernel: MemoryKernel, amplitudes: np.ndarray) -> np.ndarray:
    """dp_sig / da of waveforms by the kernel, at the sign of each amplitude, [S, n, 256]."""
    slope: np.ndarray = kernel.odd + np.sign(amplitudes)[:, :, None] * kernel.even
    return slope


def kernel_design_cost(
    experiment: Experiment, iterations: int | None = None, n: int = KERNEL_BUMPS, measured: int = 0
) -> float:
    """The cost of a design, in runs of all its signals."""
    runs = KERNEL_ITERATIONS if iterations is None else max(1, iterations)
    return runs + 2.0 + 2.0 * n / experiment.signals.count + len(SLOPES_AT) * measured


def shares(runs: int, needs: np.ndarray, most: int) -> np.ndarray:
    """Numbers of runs, [S], that share out `runs` in proportion to `needs` [S]; each is at most `most`."""
    share, order = np.zeros(len(needs), int), np.argsort(-needs)
    for place, neediest in enumerate(order):
        fair = (runs - share.sum()) * needs[neediest] / max(needs[order[place:]].sum(), np.finfo(float).tiny)
        share[neediest] = min(most, round(fair))
    return share


def refuse_another_drive(kernel: MemoryKernel, experiment: Experiment) -> None:
    """Refuse a kernel that was measured at another gamma0 or delta0.

    Raises:
        ValueError: saying what differs.
    """
    written = amplitude_on(experiment, experiment.readings.channels[0])
    for name, own in (("gamma0", written), ("delta0", experiment.compression)):
        if getattr(kernel, name) != float(own):
            raise ValueError(
                f"the kernel was measured at {name} = {getattr(kernel, name):g}, but the experiment has {float(own):g}"
            )


@usual_rules()
@shows_progress
def design_by_kernel(
    experiment: Experiment,
    *,
    iterations: int = KERNEL_ITERATIONS,
    n: int = KERNEL_BUMPS,
    width: float = KERNEL_BUMP_WIDTH,
    kernel: MemoryKernel | None = None,
    gain: float | None = None,
    start: Signals | None = None,
    damping: float = KERNEL_DAMPING,
    measured: int = 0,
    batch: int | None = None,
    cache: ResultCache = no_cache,
    progress: ProgressChoice = None,
) -> Design:
    """Pre-distort many waveforms, by the memory kernel, so that their recalls follow the J of `experiment.signals`.

    All recalls follow G E delta0 gamma0 J with one gain G. `design_waveforms` does the same by exact Jacobians, for few
    waveforms.

    Args:
        experiment: the pack, the parameters, and the signals whose J are the targets; with one read and one channel.
        iterations: number of simulations of all waveforms, each but the first after a correction.
        n: number of bumps of a designed waveform.
        width: full width of the bumps in u.
        kernel: the memory kernel of this pack at these parameters, whose n and width are then used; default: it is
            measured.
        gain: wanted gain G; default that of `start`; without it half of the gain of the original waveforms, or less if
            the designed waveforms would exceed the bound |I| <= 1.
        start: waveforms designed earlier for the same J, one for each signal, that are improved; default a first guess
            by the kernel.
        damping: damping of the first correction, relative to the largest singular value of the kernel.
        measured: mean number of directions along which the derivatives of a waveform are measured, at two times in the
            design. Waveforms that miss most get most of them, up to n, the kernel's strongest first.
        batch: number of signals that run together; default all of them.
        cache: see `run`; it keeps every part of every simulation.
        progress: see `run`.

    Raises:
        ValueError: if the kernel was measured at another gamma0 or delta0, a parameter differs between replicas,
            `start` has another number of waveforms than there are signals, or there are several reads or channels.
        RunFailedError: if a simulation broke down.
    """
    require_kind("design_by_kernel", experiment, Experiment)
    tell = callback(progress)
    require_one_value("waveforms are designed", experiment)
    if len(written_sets(experiment)) > 1:
        raise ValueError(
            "a design by a kernel needs an experiment with one channel; gm.design_waveforms designs several together"
        )
    count = experiment.waveforms.count
    iterations, n = require_whole("iterations", iterations), require_whole("n", n, 2)
    measured = require_whole("measured", measured)
    require_numbers(width=width, gain=gain, damping=damping)
    require_damping(damping)
    require_gain(gain)
    if start is not None and start.count != count:
        raise ValueError(
            f"{plural(start.count, 'waveform')} to start from, for {plural(count, 'signal')}; give one for each"
        )
    if kernel is not None:
        refuse_another_drive(kernel, experiment)
        n, width = len(kernel.centres), kernel.width
    work = Work(kernel_design_cost(experiment, iterations, 0 if kernel else n, measured), tell)

    once = cache.memoised()

    def recall(name: str, changed: Experiment, runs: float = 1.0) -> np.ndarray:
        kept = cache.scoped(name).shared(PREFIX, once)
        return np.asarray(run(changed, batch=batch, cache=kept, progress=work.next(runs, name)).p_sig)

    target = np.asarray(experiment.integral())
    untouched = recall("untouched", experiment)
    if kernel is None:
        told = work.next(2.0 * n / len(target), "kernel")
        prefix = prefix_of(experiment, cache=once)
        kernel = memory_kernel(experiment, n, width, prefix=prefix, cache=cache.scoped("kernel"), progress=told)
    original = experiment.compare(jnp.asarray(untouched))
    firm = np.full((len(target), 1), damping * np.linalg.norm(kernel.odd, 2))

    def guess(gain: float) -> np.ndarray:
        """The amplitudes that the kernel alone predicts for a gain."""
        # The kernel recalls J with its own gain, so that each waveform is needed times this ratio.
        amplitudes = nearest(kernel.basis, experiment.waveforms) * gain / kernel.gain()
        for _ in range(PREDICTED):
            missed = gain * float(experiment.scale) * target - kernel.recalled(amplitudes)
            amplitudes = bounded(amplitudes + correction(slopes(kernel, amplitudes), missed, firm), width)
        return amplitudes

    if start is not None:
        amplitudes = bounded(nearest(sampled(kernel.basis), start), width)  # in the basis in which they were written
    elif gain is not None:
        amplitudes = guess(gain)
    else:
        gain = 0.5 * float(original.gain)
        amplitudes = guess(gain)
        for _ in range(PREDICTED):  # a guess that is cut off at the bound does not say how much too large it is
            if (peak := float(np.max(largest(amplitudes, width)))) <= FIRST_GUESS_BOUND:
                break
            gain *= FIRST_GUESS_BOUND / peak
            amplitudes = guess(gain)

    def made(rows: np.ndarray) -> Spline:
        """The waveforms as they are written in the end: at slow rates F shows even the cubics between samples."""
        return sampled(bumps(rows, width))

    best, p_sig = amplitudes, recall("trial-0", with_signals(experiment, made(amplitudes)))
    first = experiment.compare(jnp.asarray(p_sig))
    history = [float(original.fidelity), float(first.fidelity)]
    wanted = (float(first.gain) if gain is None else gain) * float(experiment.scale) * target
    learned = np.zeros((len(best), *kernel.odd.shape))  # slopes of each waveform, beyond the kernel's
    strongest = np.linalg.svd(kernel.odd)[0].T  # [n, n]
    damped = firm
    passed = 0.0 if start is None else SLOPES_AT[0]  # the part that an earlier design has done
    moments = [max(1, int((part - passed) * iterations)) for part in SLOPES_AT]
    for iteration in range(1, iterations):
        if measured and iteration in moments:
            missed = wanted - p_sig
            # Probes go where the next step would go, and about as far.
            ahead = correction(slopes(kernel, best) + learned, missed, damped) @ strongest.T
            far = np.where(ahead < 0.0, -1.0, 1.0) * np.clip(np.abs(ahead), *PROBE)
            share = shares(measured * len(best), np.sum(missed**2, axis=1), n)
            whose = np.repeat(np.arange(len(best)), share)
            steps = np.concatenate([far[one, :count, None] * strongest[:count] for one, count in enumerate(share)])
            probes = bounded(best[whose] + steps, width)
            changes = recall(f"slopes-{iteration}", with_signals(experiment, made(probes)), measured) - p_sig[whose]
            steps = probes - best[whose]
            for one in np.unique(whose):
                mine, foreseen = whose == one, slopes(kernel, best)[one]
                learned[one] = np.linalg.pinv(steps[mine]) @ (changes[mine] - steps[mine] @ foreseen)
            damped = np.minimum(damped, firm)
        slope = slopes(kernel, best) + learned
        tried = bounded(best + correction(slope, wanted - p_sig, damped), width)
        found = recall(f"trial-{iteration}", with_signals(experiment, made(tried)))
        step = tried - best
        unforeseen = found - p_sig - np.einsum("sn,snu->su", step, slope)
        length = np.maximum(np.sum(step**2, axis=1), SHORTEST**2)
        learned += (step / length[:, None])[:, :, None] * unforeseen[:, None, :]
        better = np.linalg.norm(found - wanted, axis=1) < np.linalg.norm(p_sig - wanted, axis=1)
        best, p_sig = (np.where(better[:, None], *pair) for pair in ((tried, best), (found, p_sig)))
        damped = damped * np.where(better, EASED, FIRMED)[:, None]
        history.append(float(experiment.compare(jnp.asarray(p_sig)).fidelity))
    signals = made(best)
    fresh = recall("verified", with_signals(experiment, signals))
    return verified(experiment, {name: signals for name in experiment.sets}, fresh, untouched, history)
