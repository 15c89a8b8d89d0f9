"""Measures of each signal by itself, which files hold; they follow from a recall and its configuration."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment import analysis
from gmem_jax.experiment.readings import placed
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.record import values_of
from gmem_jax.simulation.channels import CHANNELS

EACH = ("signal_gain", "signal_fidelity", "signal_windowed_fidelity", "signal_correlation")


def relative_scale(configuration: Mapping[str, Any]) -> jax.Array:
    """delta0 gamma0, the unit of gains; scalar, or [S, 1] if it differs between signals; NaN if unknown."""
    numbers = np.multiply(*(values_of(configuration).get(name, np.nan) for name in ("delta0", "gamma0")))
    return jnp.asarray(numbers if np.ndim(numbers) == 0 else numbers[1:, None])


def read_stress(recall: Recall, read: str) -> jax.Array:
    """The stress of the first channel in a stage that reads, in ascending u, of every replica, [S + 1, 256], in E."""
    stress = CHANNELS[recall.channels[0]].stress(jnp.asarray(recall.stages[read].pressure))
    return placed(recall.protocol.stage(read), stress)


def of_each(recall: Recall) -> dict[str, np.ndarray]:
    """The measures `EACH` of every signal: G and F with its own gain, F averaged over T_1, and correlation with J.

    They are arrays [S], or [R, C, S] as in the recall; NaN for a signal that is zero.
    """
    known, shape = values_of(recall.configuration), np.shape(recall.J)[:-1]
    scale, windows = relative_scale(known), recall.windows(known.get("t0", np.nan))
    curves = [jnp.asarray(each).reshape(-1, *np.shape(each)[-2:]) for each in (recall.p_sig, recall.J)]
    found: dict[str, list[Any]] = {name: [] for name in EACH}
    for p_sig, integral, window in zip(*curves, np.repeat(windows, len(recall.channels)), strict=True):
        own, smooth = (analysis.each(p_sig, integral, scale, over) for over in (None, window))
        values = (own.gain, own.fidelity, smooth.fidelity, analysis.correlation(p_sig, integral))
        for name, value in zip(EACH, values, strict=True):
            found[name].append(np.asarray(value))
    return {name: np.stack(values).reshape(shape) for name, values in found.items()}
