"""Sizes of the grains of a pack: a lognormal distribution, or a mixture of a few sizes.

The sizes follow the distribution exactly; chance decides only which grain has which size. So a small pack has the
spread that was asked for, too.
"""

import math
from collections.abc import Sequence
from statistics import NormalDist

import jax
import numpy as np

from gmem_jax.physics import chance
from gmem_jax.physics.numbers import is_real, require_numbers, require_whole, said
from gmem_jax.physics.rules import usual_rules

CUT = 3.0  # standard deviations of ln(size) beyond which the lognormal has no grains
LARGEST_SPREAD = 0.35  # with this cut the largest grain is then 7.7 times the smallest, and lists allow a ratio of 10
_STREAM = 4  # number of the stream of random numbers of a seed; the gas uses the first three


@usual_rules()
def lognormal(grains: int, spread: float, *, seed: int = 0) -> np.ndarray:
    """Sizes of grains with a lognormal distribution whose mean is 1, cut at 3 standard deviations of ln(size).

    Args:
        grains: number of grains N.
        spread: standard deviation of the sizes over their mean, before the cut, which lowers it by some 2 %.
        seed: random seed of the order of the sizes.

    Returns:
        Quantiles of the distribution in random order, [N].

    Raises:
        ValueError: if the spread is not in [0, 0.35], or there are no grains.
    """
    require_numbers(spread=spread)
    if not 0.0 <= spread <= LARGEST_SPREAD:
        raise ValueError(f"size_spread must be in [0, {LARGEST_SPREAD:g}], got {spread:g}")
    normal, count = NormalDist(), require_whole("grains", grains, 1)
    beyond = normal.cdf(-CUT)
    parts = beyond + (1.0 - 2.0 * beyond) * (np.arange(count) + 0.5) / count
    found = np.exp(math.sqrt(math.log1p(spread**2)) * np.array([normal.inv_cdf(part) for part in parts]))
    return _shuffled(found / found.mean(), seed)


@usual_rules()
def mixture(grains: int, sizes: Sequence[float], shares: Sequence[float] | None = None, *, seed: int = 0) -> np.ndarray:
    """Sizes of grains that are a mixture of a few sizes, as in a bidisperse pack.

    Args:
        grains: number of grains N.
        sizes: the sizes of the mixture.
        shares: fraction of all grains that has each of these sizes; default equal fractions.
        seed: random seed of the order of the sizes.

    Returns:
        The sizes in random order, [N].

    Raises:
        ValueError: if sizes or shares are no positive numbers, the shares do not sum to 1 or are not as many as the
            sizes, or one of the sizes would have no grain.
    """
    found = _positive("sizes", sizes)
    parts = np.full(len(found), 1.0 / len(found)) if shares is None else _positive("shares", shares)
    if len(parts) != len(found) or not math.isclose(parts.sum(), 1.0, rel_tol=1e-6):
        raise ValueError(f"shares must be one for each of {len(found)} sizes and sum to 1, got {said(shares)}")
    ends = np.rint(np.cumsum(parts) * require_whole("grains", grains, 1)).astype(int)
    counts = np.diff(ends, prepend=0)
    if not counts.all():
        raise ValueError(f"of {grains} grains none would have size {found[np.argmin(counts)]:g}: take a larger share")
    return _shuffled(np.repeat(found, counts), seed)


def _positive(name: str, values: Sequence[float]) -> np.ndarray:
    found = np.asarray(values, float) if is_real(values) else np.zeros(0)
    if found.ndim != 1 or not found.size or not np.all((found > 0.0) & np.isfinite(found)):
        raise ValueError(f"{name} must be positive numbers, got {said(values)}")
    return found


def _shuffled(sizes: np.ndarray, seed: int) -> np.ndarray:
    own = jax.random.fold_in(chance.key(require_whole("seed", seed)), _STREAM)
    return np.asarray(sizes[np.asarray(jax.random.permutation(own, len(sizes)))])
