"""Many Python threads at once, and the number of threads that a user asks for."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax import native

BUILT, REASON = native.available()
pytestmark = pytest.mark.skipif(not BUILT, reason=REASON)
PACK = gm.load_pack(TETRA_27)
GAMMAS = [1e-3 * (1 + n) for n in range(8)]


def experiment(gamma0: float) -> gm.Experiment:
    return gm.Experiment(PACK, gm.waveform(jnp.array([1.0, -1.0])), gamma0=gamma0, t0=20.0, backend="native")


def on_the_host(gamma0: float) -> np.ndarray:
    return np.asarray(gm.run(experiment(gamma0)).p_sig)


compiled = jax.jit(lambda gamma0: gm.recall(gm.replace(experiment(1e-3), gamma0=gamma0)).p_sig)


def traced(gamma0: float) -> np.ndarray:
    return np.asarray(compiled(jnp.asarray(gamma0)))


@pytest.mark.parametrize(("recalled", "repeats"), [(on_the_host, 2), pytest.param(traced, 20, marks=pytest.mark.slow)])
def test_eight_threads_at_once_give_the_bits_of_one_after_the_other(
    recalled: Callable[[float], np.ndarray], repeats: int
) -> None:
    expected = [recalled(gamma0) for gamma0 in GAMMAS]
    assert len({found.tobytes() for found in expected}) == len(GAMMAS)
    with ThreadPoolExecutor(len(GAMMAS)) as threads:
        for _ in range(repeats):
            for found, one in zip(threads.map(recalled, GAMMAS, timeout=120), expected, strict=True):
                np.testing.assert_array_equal(found, one)


@pytest.mark.parametrize("bad", ["0", "-1", "two", "2 threads"])
def test_a_bad_number_of_threads_is_refused_in_a_sentence(bad: str, monkeypatch: pytest.MonkeyPatch) -> None:
    traced(GAMMAS[0])
    monkeypatch.setenv("GMEM_THREADS", bad)
    with pytest.raises(
        jax.errors.JaxRuntimeError, match=f'GMEM_THREADS should be a number of threads .* it is "{bad}"'
    ):
        traced(GAMMAS[0])
