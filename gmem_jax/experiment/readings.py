"""Recalled signals by read and channel, from the wall pressures of the stages of a protocol.

A run has R reads, C channels and S signals. Its arrays have these axes in this order, [R, C, S, 256], gains
[R, C, C]; an axis of length one is left out, so that the paper's experiment has p_sig [S, 256] and one G and F.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment import analysis
from gmem_jax.experiment.signals import Signals, bin_average
from gmem_jax.physics.pytree import Scalar
from gmem_jax.simulation.channels import CHANNELS
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stage import BINS, Stage, bin_centres


class Readings(NamedTuple):
    """The reads of a protocol, and how p_sig is made of them.

    Attributes:
        protocol: the protocol.
        background: one of `analysis.BACKGROUNDS`.
    """

    protocol: Protocol
    background: str

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the R stages that are read; only the first if the second readout serves as background."""
        return self.protocol.reads if self.background == "sub0" else self.protocol.reads[:1]

    @property
    def channels(self) -> tuple[str, ...]:
        """The C channels."""
        return self.protocol.channels

    @property
    def rates(self) -> np.ndarray:
        """Rates of the reads, [R]; see `rates_of`."""
        return rates_of(self.protocol, self.reads)

    def squeezed(self, rows: list[list[jax.Array]]) -> jax.Array:
        """Arrays by read and channel, stacked into one; axes of length one are left out."""
        by_read = [row[0] if len(row) == 1 else jnp.stack(row) for row in rows]
        return by_read[0] if len(by_read) == 1 else jnp.stack(by_read)

    def recalled(self, pressures: Mapping[str, jax.Array]) -> jax.Array:
        """p_sig in ascending u, [R, C, S, 256], in E, from the pressures [bins, 3, S + 1] by stage."""

        def stress(read: str, channel: str) -> jax.Array:
            return placed(self.protocol.stage(read), CHANNELS[channel].stress(pressures[read]))

        if self.background == "sub0":
            found = [[analysis.subtract("sub0", stress(read, c)) for c in self.channels] for read in self.reads]
        else:
            first, second = self.protocol.reads
            found = [[analysis.subtract(self.background, stress(first, c), stress(second, c)) for c in self.channels]]
        return self.squeezed(found)

    def _by_drive(self, sets: Mapping[str, Signals], of: Any) -> jax.Array:
        """`of` applied to the set with which each read and channel is compared; zero where nothing was written."""
        known = {name: of(one) for name, one in sets.items()}
        nothing = jnp.zeros_like(next(iter(known.values())))

        def one(read: str, channel: str) -> jax.Array:
            stage, drive = self.protocol.stage(read), self.protocol.written(read).get(channel)
            if drive is None or not stage.moves:
                return nothing
            own: jax.Array = known[str(drive.waveform)]
            own = own if drive.amplitude == 1.0 else drive.amplitude * own
            return jnp.where(_seen(stage), own, 0.0) if _partial(stage) else own

        return self.squeezed([[one(read, channel) for channel in self.channels] for read in self.reads])

    def integrals(self, sets: Mapping[str, Signals]) -> jax.Array:
        """J averaged over each bin, [R, C, S, 256]; 0 where nothing was written and in bins that are not read."""
        return self._by_drive(sets, bin_average)

    def shears(self, sets: Mapping[str, Signals]) -> jax.Array:
        """I at the centres of the bins, [R, C, S, 256]; 0 where nothing was written and in bins that are not read."""
        return self._by_drive(sets, lambda one: one.shear(jnp.asarray(bin_centres())).T)

    def compare(
        self, signal: jax.Array, integral: jax.Array, scale: Scalar, window: Scalar | None = None
    ) -> analysis.Match:
        """Gain [R, C, C] and fidelity [R, C]; see `analysis.compare` and `analysis.compare_channels`.

        `window` is a time in units of t0. Each read is averaged over the part of u that it goes through in this time.
        """
        channels = len(self.channels)
        windows: Any = None if window is None else window * self.rates

        def of_read(signal: jax.Array, integral: jax.Array, window: Scalar | None) -> analysis.Match:
            compare = analysis.compare if channels == 1 else analysis.compare_channels
            match: analysis.Match = compare(signal, integral, scale, window)
            return match

        if len(self.reads) == 1:
            return of_read(signal, integral, None if windows is None else windows[0])
        return jax.vmap(of_read)(signal, integral, windows)


def rates_of(protocol: Protocol, reads: Sequence[str]) -> np.ndarray:
    """The part of u that each read goes through per t0, or the part of its own duration if u stands still, [R]."""
    stages = [protocol.stage(name) for name in reads]
    return np.array([(abs(np.subtract(*one.ends)) if one.moves else 1.0) / one.length for one in stages])


def _partial(stage: Stage) -> bool:
    return set(stage.ends) != {0.0, 1.0}


def _seen(stage: Stage) -> np.ndarray:
    """Whether a stage goes through the centre of each of the 256 bins of u, [256]."""
    low, high = sorted(stage.ends)
    inside: np.ndarray = (low < bin_centres()) & (high > bin_centres())
    return inside


def placed(stage: Stage, stress: jax.Array) -> jax.Array:
    """Stresses of a stage [bins, B] on the 256 bins of ascending u, or of time if u stands still, [B, 256].

    If the stage has another number of bins, stresses are averaged over the 256; bins that it does not pass are 0.
    """
    if stage.bins == BINS and not _partial(stage):
        return (jnp.flip(stress, axis=0) if stage.start == 1.0 else stress).T
    start, stop = stage.ends if stage.moves else (0.0, 1.0)
    edges = start + (stop - start) * np.arange(stage.bins + 1) / stage.bins
    if stop < start:
        edges, stress = edges[::-1], jnp.flip(stress, axis=0)
    bins = np.arange(BINS + 1) / BINS
    overlap = np.minimum(edges[1:], bins[1:, None]) - np.maximum(edges[:-1], bins[:-1, None])  # [256, stage bins]
    weight = np.maximum(overlap, 0.0)
    total = weight.sum(axis=1, keepdims=True)
    weight = np.where(total > 0.5 / BINS, weight / np.where(total > 0.0, total, 1.0), 0.0)
    return (jnp.asarray(weight) @ stress).T
