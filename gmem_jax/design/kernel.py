"""The memory kernel of a pack: how the recall depends on the waveform when the waveform is weak.

p_sig(u) = int M(u, v) gamma(v) dv. The kernel is measured on n basis waveforms (half-cosine bumps of one width), each
stored with both signs as replicas of one run. Half the difference of the two recalls is the odd part, M; half the sum
is the even part, which a linear memory would not have. In measurements both grow in proportion to a weak waveform: a
pack answers a shear and its opposite differently, however small they are.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment import analysis
from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.changes import replace
from gmem_jax.experiment.experiment import Experiment, require_one_value
from gmem_jax.experiment.run import Prefix, run
from gmem_jax.experiment.signals import Bumps, Signals, bin_average, signals
from gmem_jax.physics.numbers import plural, require_numbers, require_whole
from gmem_jax.physics.pytree import comparable, short_repr
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.checkpoints import ResultCache, no_cache
from gmem_jax.simulation.compiled import require_x64
from gmem_jax.simulation.progress import ProgressChoice, callback, shows_progress, within
from gmem_jax.simulation.stage import BINS, bin_centres

QUADRATURE_POINTS = 2048  # points of v for inner products of basis functions


@comparable
@dataclass(frozen=True)
class MemoryKernel:
    """The recalls of n basis waveforms: half-cosine bumps of height 1.

    Attributes:
        u: centres of the bins, [256].
        centres: centres of the bumps in u, [n].
        width: full width of the bumps in u.
        odd: half the difference of the recalls of each bump and its negative, [n, 256], in E; 0 in bins that the read
            does not go through.
        even: half the sum of the same two recalls, [n, 256], in E.
        gamma0: shear amplitude at which they were measured: that of the experiment times that of the drive.
        delta0: areal compression at which they were measured.
    """

    u: np.ndarray
    centres: np.ndarray
    width: float
    odd: np.ndarray
    even: np.ndarray
    gamma0: float
    delta0: float

    __repr__ = short_repr

    @property
    def basis(self) -> Bumps:
        """The n basis waveforms."""
        return bumps(np.eye(self.centres.size), self.width)

    def kernel(self) -> np.ndarray:
        """M(u, v) at the bins u and the centres v, [256, n], in E: `odd` over gamma0 and the integral of the bump."""
        area = np.asarray(self.basis.integral(jnp.asarray(1.0)))
        result: np.ndarray = (self.odd / (self.gamma0 * area[:, None])).T
        return result

    def _orthonormal(self) -> tuple[np.ndarray, np.ndarray]:
        """Recalls [n, 256] and values [n, QUADRATURE_POINTS] of an orthonormal basis of the space of the bumps."""
        v = (np.arange(QUADRATURE_POINTS) + 0.5) / QUADRATURE_POINTS
        shapes = np.asarray(self.basis.shear(jnp.asarray(v))).T
        values, vectors = np.linalg.eigh(shapes @ shapes.T / QUADRATURE_POINTS)
        whiten = vectors @ np.diag(values**-0.5) @ vectors.T
        return whiten @ self.odd, whiten @ shapes

    def singular_values(self) -> np.ndarray:
        """Singular values, [n], falling, in E: RMS of p_sig for the best, second best, ... waveform of RMS 1."""
        recalled, _ = self._orthonormal()
        values: np.ndarray = np.linalg.svd(recalled, compute_uv=False) / np.sqrt(BINS)
        return values

    def _match(self) -> analysis.Match:
        seen = np.any(self.odd, axis=0)
        integral = jnp.where(seen | ~seen.any(), bin_average(self.basis), 0.0)
        match: analysis.Match = analysis.compare(jnp.asarray(self.odd), integral, self.delta0 * self.gamma0)
        return match

    @usual_rules()
    def gain(self) -> float:
        """G of the perfect integral (M = G E delta0 for v < u, else 0) that is nearest to this kernel on its basis."""
        return float(self._match().gain)

    def distance(self) -> float:
        """Distance from that perfect integral, |odd - ideal| / |odd|: 0 for a perfect memory, 1 for none (1 - F)."""
        return 1.0 - float(self._match().fidelity)

    def asymmetry(self) -> float:
        """|even| / |odd|, with norms over the basis: 0 for a linear memory."""
        return float(np.linalg.norm(self.even) / np.linalg.norm(self.odd))

    def capacity(self, noise: float) -> int:
        """Number of singular values above `noise`, the RMS in E of noise in p_sig."""
        return int(np.sum(self.singular_values() > noise))

    def resolution(self, noise: float) -> float:
        """Resolution in v of waveforms that are read back with noise of RMS `noise` in p_sig, in E.

        It is the full width at half maximum of the point-spread function of the inverse, truncated to singular values
        above the noise; the mean over 0.2 < v < 0.8. 1 if no value is above the noise.
        """
        recalled, shapes = self._orthonormal()
        left, values, _ = np.linalg.svd(recalled, full_matrices=False)
        kept = values / np.sqrt(BINS) > noise
        if not kept.any():
            return 1.0
        modes = left[:, kept].T @ shapes
        widths = []
        for at in range(QUADRATURE_POINTS // 5, 4 * QUADRATURE_POINTS // 5, QUADRATURE_POINTS // 32):
            spread = modes[:, at] @ modes
            half = spread < 0.5 * spread[at]
            right = np.argmax(half[at:]) if half[at:].any() else QUADRATURE_POINTS - at
            back = np.argmax(half[at::-1]) if half[at::-1].any() else at
            widths.append((right + back) / QUADRATURE_POINTS)
        return float(np.mean(widths))

    @usual_rules()
    def coefficients(self, signals: Signals) -> np.ndarray:
        """Amplitudes of the bumps whose sums are nearest to given waveforms (least squares), [S, n]."""
        return nearest(self.basis, signals)

    @usual_rules()
    def predict(self, signals: Signals, *, even: bool = True) -> np.ndarray:
        """p_sig of waveforms by superposition, without a simulation, [S, 256], in E, at the gamma0 of the kernel.

        Args:
            signals: the waveforms.
            even: whether to add the even parts, in proportion to the absolute amplitudes.
        """
        return self.recalled(self.coefficients(signals), even=even)

    @usual_rules()
    def recalled(self, amplitudes: np.ndarray, *, even: bool = True) -> np.ndarray:
        """The same as `predict`, [S, 256], for amplitudes of the bumps, [S, n]."""
        linear: np.ndarray = amplitudes @ self.odd
        return linear + np.abs(amplitudes) @ self.even if even else linear


def bumps(amplitudes: np.ndarray | jax.Array, width: float) -> Bumps:
    """Waveforms of amplitudes [S, n] on n evenly spaced bumps that fill [0, 1]."""
    centres = np.linspace(0.5 * width, 1.0 - 0.5 * width, amplitudes.shape[1])
    return Bumps(jnp.asarray(amplitudes), jnp.broadcast_to(jnp.asarray(centres), amplitudes.shape), width)


def nearest(basis: Signals, signals: Signals) -> np.ndarray:
    """Amplitudes of n basis functions that come nearest to waveforms (least squares), [S, n]."""
    v = (jnp.arange(QUADRATURE_POINTS) + 0.5) / QUADRATURE_POINTS
    shapes, wanted = np.asarray(basis.shear(v)), np.asarray(signals.shear(v))
    result: np.ndarray = np.linalg.lstsq(shapes, wanted, rcond=None)[0].T
    return result


@usual_rules()
@shows_progress
def memory_kernel(
    experiment: Experiment,
    n: int = 17,
    width: float = 0.2,
    *,
    prefix: Prefix | None = None,
    cache: ResultCache = no_cache,
    progress: ProgressChoice = None,
) -> MemoryKernel:
    """Measure the memory kernel M of a pack, p_sig(u) = int M(u, v) gamma(v) dv, by one run of 2 n + 1 replicas.

    Args:
        experiment: the pack and all parameters, with one read and one channel; its signals do not matter.
        n: number of basis waveforms, half-cosine bumps.
        width: full width of the bumps in u; narrow bumps move the walls faster.
        prefix: what `gm.prefix_of` returned for the same pack, law and protocol; default none.
        cache: see `run`.
        progress: see `run`.

    Raises:
        ValueError: if n < 2, a parameter differs between replicas, the background is not sub0, or there are
            several reads or channels.
        RunFailedError: if the simulation broke down.
    """
    require_kind("memory_kernel", experiment, Experiment)
    require_x64()
    tell, both = callback(progress), _basis(experiment, n, width)
    if len(experiment.readings.reads) * len(experiment.readings.channels) > 1:
        raise ValueError("a kernel is of one read and one channel; gm.kernel_matrix measures those of several channels")
    wanted = _writing_alone(experiment, written_sets(experiment)[0], both)
    p_sig = np.asarray(run(wanted, prefix=prefix, cache=cache.scoped("basis"), progress=tell).p_sig)
    return _kernel_of(wanted, both, p_sig, wanted.readings.channels[0])


def _basis(experiment: Experiment, n: int, width: float) -> Bumps:
    """n bumps and their negatives, after a check that a kernel can be measured with them."""
    n = require_whole("n", n)
    require_numbers(width=width)
    if n < 2:
        raise ValueError(f"a kernel needs at least 2 basis waveforms, got {n}")
    if experiment.background != "sub0":
        raise ValueError(
            f"a kernel is measured with background 'sub0', since with {experiment.background!r} silence has a recall"
        )
    require_one_value("a kernel is measured", experiment)
    return bumps(np.concatenate([np.eye(n), -np.eye(n)]), width)


@comparable
@dataclass(frozen=True)
class KernelMatrix:
    """The memory kernels of C channels of one pack, for every pair of a channel that writes and one that reads.

    Attributes:
        channels: names of the C channels.
        blocks: `blocks[c][d]` is the kernel of the recall on channel c of waveforms written on channel d; those with
            c != d are the cross-talk.
    """

    channels: tuple[str, ...]
    blocks: tuple[tuple[MemoryKernel, ...], ...]

    __repr__ = short_repr

    def singular_values(self) -> np.ndarray:
        """Singular values, [C n], falling, in E.

        They are the root of the mean squares of p_sig, summed over channels, for the best, second best, ... set of
        waveforms whose mean squares sum to 1. With one channel they are those of its `MemoryKernel`.
        """
        recalled = np.block(
            [[block._orthonormal()[0] for block in column] for column in zip(*self.blocks, strict=True)]
        )
        values: np.ndarray = np.linalg.svd(recalled, compute_uv=False) / np.sqrt(BINS)
        return values


@usual_rules()
@shows_progress
def kernel_matrix(
    experiment: Experiment,
    n: int = 17,
    width: float = 0.2,
    *,
    cache: ResultCache = no_cache,
    progress: ProgressChoice = None,
) -> KernelMatrix:
    """Measure the memory kernels of all channels that an experiment writes on, by one run of 2 n + 1 replicas for each.

    Args:
        experiment: the pack, all parameters and a protocol with one read. The names of its sets of waveforms matter,
            the waveforms do not: in each run the bumps replace one set, and the others are zero.
        n: number of basis waveforms, half-cosine bumps.
        width: full width of the bumps in u.
        cache: see `run`.
        progress: see `run`.

    Raises:
        ValueError: if n < 2, a parameter differs between replicas, the background is not sub0, there are several
            reads, or not a set of waveforms for each channel.
        RunFailedError: if the simulation broke down.
    """
    require_kind("kernel_matrix", experiment, Experiment)
    require_x64()
    channels, written = experiment.readings.channels, written_sets(experiment)
    loud = _basis(experiment, n, width)
    tell, columns = callback(progress), []
    for number, channel in enumerate(channels):
        one = _writing_alone(experiment, written[number], loud)
        share = within(tell, number / len(channels), (number + 1) / len(channels))
        recall = run(one, cache=cache.scoped(f"basis-{channel}"), progress=share)
        columns.append([_kernel_of(one, loud, np.asarray(recall.at(channel=name).p_sig), channel) for name in channels])
    return KernelMatrix(channels, tuple(zip(*columns, strict=True)))


def _writing_alone(experiment: Experiment, name: str, loud: Bumps) -> Experiment:
    """The experiment with the waveforms `loud` as its set `name`, and zero waveforms as its other sets."""
    silent = bumps(jnp.zeros_like(loud.amplitudes), float(loud.width))
    return replace(experiment, signals=signals(**{one: loud if one == name else silent for one in experiment.sets}))


def written_sets(experiment: Experiment) -> tuple[str, ...]:
    """Names of the sets of waveforms that are written on the channels, [C].

    Raises:
        ValueError: if there are several reads, or not a set of waveforms for each channel.
    """
    reads, channels = experiment.readings.reads, experiment.readings.channels
    written = experiment.protocol.written(reads[0])
    names = {str(drive.waveform): None for drive in written.values() if not drive.fixed}
    if len(reads) > 1 or len(names) < len(channels):
        raise ValueError(
            f"kernels need one read, and a set of waveforms for each channel; the protocol has "
            f"{plural(len(reads), 'read')}, and writes {' and '.join(names) or 'nothing'} on {' and '.join(channels)}"
        )
    return tuple(str(written[channel].waveform) for channel in channels)


def amplitude_on(experiment: Experiment, channel: str) -> float:
    """gamma0 times the amplitude of the drive that writes on a channel; the experiment has one read."""
    (read,) = experiment.readings.reads
    return float(experiment.gamma0) * experiment.protocol.written(read)[channel].amplitude


def _kernel_of(experiment: Experiment, both: Bumps, p_sig: np.ndarray, channel: str) -> MemoryKernel:
    """The kernel from the recalls [2 n, 256] of n bumps and their negatives that were written on a channel."""
    n = len(p_sig) // 2
    plus, minus = p_sig[:n], p_sig[n:]
    return MemoryKernel(
        u=bin_centres(),
        centres=np.asarray(both.centres[0]),
        width=float(both.width),
        odd=0.5 * (plus - minus),
        even=0.5 * (plus + minus),
        gamma0=amplitude_on(experiment, channel),
        delta0=float(experiment.compression),
    )


def relative_error(predicted: np.ndarray, simulated: jax.Array | np.ndarray) -> np.ndarray:
    """|predicted - simulated| / |simulated| of every signal, [S]."""
    simulated = np.asarray(simulated)
    result: np.ndarray = np.linalg.norm(predicted - simulated, axis=1) / np.linalg.norm(simulated, axis=1)
    return result
