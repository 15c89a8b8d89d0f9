"""The package under every flag that makes JAX strict, or lets it show what it does: the numbers stay as they are."""

import contextlib
import itertools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.physics.rules import usual_rules

PACK = TETRA_27
FLAGS: dict[str, Callable[[], contextlib.AbstractContextManager]] = {
    "rank promotion raises": lambda: jax.numpy_rank_promotion("raise"),
    "strict dtype promotion": lambda: jax.numpy_dtype_promotion("strict"),
    "nothing is NaN": lambda: jax.debug_nans(True),
    "no tracer leaks": jax.checking_leaks,
    "checks": lambda: jax.enable_checks(True),
    "no transfers": lambda: jax.transfer_guard("disallow"),
}
COMPILED_ANEW = ("nothing is NaN", "no tracer leaks", "checks")  # the others share the programs of no flag


def cases(*fast: str) -> list[Any]:
    """Every flag on both backends; slow are those that compile for ten seconds and more."""
    found = []
    for flag, backend in itertools.product(FLAGS, ("native", "jax")):
        slow = flag in COMPILED_ANEW or backend not in fast
        found.append(pytest.param(flag, backend, marks=[pytest.mark.slow] * slow, id=f"{flag}-{backend}"))
    return found


def made(backend: str) -> gm.Experiment:
    """The shortest experiment there is, all of it made anew."""
    pack = gm.load_pack(PACK)
    law = gm.Hooke(mu=0.7)
    return gm.Experiment(pack, gm.words(1), law, t0=60.0, rest=0.1, hold=0.1, store=0.1, backend=backend)


def slope_of(experiment: gm.Experiment) -> jax.Array:
    """dF / dgamma0 by JAX's own transformations."""

    def fidelity(gamma0: jax.Array) -> jax.Array:
        return gm.fidelity(gm.replace(experiment, gamma0=gamma0))

    return jax.jit(jax.grad(fidelity))(jax.device_put(1e-3))


@pytest.mark.parametrize(("flag", "backend"), cases("native", "jax"))
def test_an_experiment_has_the_same_numbers_under(flag: str, backend: str) -> None:
    expected = gm.run(made(backend))
    with FLAGS[flag]():
        experiment = made(backend)
        assert gm.run(experiment).fidelity == expected.fidelity
        traced = gm.recall(gm.replace(experiment, {"friction.mu": 0.7}))
    np.testing.assert_allclose(traced.p_sig, expected.p_sig, rtol=1e-6)


@pytest.mark.parametrize(("flag", "backend"), cases("native"))
def test_a_gradient_has_the_same_numbers_under(flag: str, backend: str) -> None:
    names = ["gamma0", "friction.mu", "signals.amplitudes"]
    expected = gm.value_and_grad(made(backend), names)
    with FLAGS[flag]():
        experiment = made(backend)
        found, traced = gm.value_and_grad(experiment, names), slope_of(experiment)
    assert found.value == expected.value
    jax.tree.map(np.testing.assert_array_equal, found.slope, expected.slope)
    np.testing.assert_allclose(traced, expected.slope["gamma0"], rtol=1e-6)


def test_a_flag_holds_again_for_the_programs_own_code_once_the_package_is_done() -> None:
    with jax.numpy_rank_promotion("raise"):
        gm.six_signals()
        with pytest.raises(ValueError, match="rank_promotion"):
            jax.numpy.ones((2, 3)) + jax.numpy.ones(3)
        with usual_rules():
            assert (jax.numpy.ones((2, 3)) + jax.numpy.ones(3)).shape == (2, 3)
