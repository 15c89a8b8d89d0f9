"""Experiments side by side give the numbers that they give one by one."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.experiment.several import match, run_several

PACK = TETRA_27
SHORT = {"t0": 150.0, "rest": 0.05, "hold": 0.05, "store": 0.1}


@pytest.fixture(scope="module")
def base() -> gm.Experiment:
    return gm.Experiment(gm.load_pack(PACK), gm.six_signals(), **SHORT)


@pytest.mark.parametrize("backend", ["native", pytest.param("jax", marks=pytest.mark.slow)])
def test_points_side_by_side_are_the_points_alone(base: gm.Experiment, backend: str) -> None:
    if backend == "native" and not native.available()[0]:
        pytest.skip("no native library")
    one = gm.Bumps(jnp.asarray([[1.0]]), jnp.asarray([[0.5]]), 0.3)
    changes = [
        {"friction.mu": 1.0},
        {"friction.mu": 1.0, "gamma0": 2e-3},  # the same prefix
        {"friction.mu": 0.3},
        {"friction.stiffness": 0.1, "signals": one},  # another number of signals
        {"hold_drag": 0.03, "delta0": 0.04},
        {"t0": 140.0},  # as many steps, of another length
    ]
    experiments = [gm.replace(base, {**change, "backend": backend}) for change in changes]
    with pytest.warns(UserWarning, match="was cycled with delta0"):
        together = run_several(experiments)
    with pytest.warns(UserWarning, match="was cycled with delta0"):
        alone = [gm.run(experiment) for experiment in experiments]
    assert [recall.p_sig.shape[0] for recall in together] == [6, 6, 6, 1, 6, 6]
    for found, wanted in zip(together, alone, strict=True):
        assert jax.tree.structure(found) == jax.tree.structure(wanted)
        for leaf, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            assert np.shape(leaf) == np.shape(other)
        # Lists made anew for all together may be others than for one alone, and XLA's vector code differs with the
        # number of replicas: round-off, grown over some 900 steps.
        scale = float(jnp.abs(wanted.p_sig).max())
        np.testing.assert_allclose(found.p_sig, wanted.p_sig, atol=1e-6 * scale)
        np.testing.assert_allclose(found.fidelity, wanted.fidelity, rtol=1e-5)
    assert len({float(recall.fidelity) for recall in together}) == len(changes)


def test_a_protocol_that_begins_with_a_waveform_runs_side_by_side() -> None:
    two = gm.Protocol(gm.write(), gm.read("half", to=0.5, length=0.5), gm.read("whole", length=0.5))
    first = gm.Experiment(gm.load_pack(PACK), gm.words(1), protocol=two, t0=20.0, gamma0=0.01)
    experiments = [first, gm.replace(first, {"friction.mu": 0.3})]
    for found, experiment in zip(run_several(experiments), experiments, strict=True):
        wanted = gm.run(experiment, progress=False)
        np.testing.assert_allclose(found.p_sig, wanted.p_sig, atol=1e-9 * float(jnp.abs(wanted.p_sig).max()))
        np.testing.assert_allclose(found.gain, wanted.gain, rtol=1e-8)
        assert found.reads == ("half", "whole")


def test_what_cannot_run_side_by_side_does_not_match(base: gm.Experiment) -> None:
    assert match(base, gm.replace(base, gamma0=5e-3, friction=gm.Hooke(mu=0.1)))
    others = [
        gm.replace(base, friction=gm.MindlinRescaled()),
        gm.replace(base, store=0.2),
        gm.replace(base, background="sub2"),
        gm.replace(base, dt=0.1),
        gm.replace(base, pack=gm.load_pack(PACK)),
        gm.replace(base, backend="jax"),
        gm.replace(base, gamma0=jnp.full(7, 1e-3)),
        gm.replace(base, {"material.poisson": 0.3}),
        gm.replace(base, {"friction.mu": 0.0}),
    ]
    for other in others:
        assert not match(base, other)
        with pytest.raises(ValueError, match="must differ only in"):
            run_several([base, other])
    with pytest.raises(ValueError, match="must differ only in"):
        run_several([])


def test_a_sweep_in_the_library_keeps_its_results_and_grows(base: gm.Experiment, tmp_path: Path) -> None:
    told: list[float] = []
    swept = gm.sweep(base, {"friction.mu": [0.3, 1.0]}, tmp_path / "mu", progress=lambda *now: told.append(now[2]))
    assert [result.values for result in swept] == [{"friction.mu": 0.3}, {"friction.mu": 1.0}]
    assert told[-1] == pytest.approx(1.0)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "mu" / "points").iterdir()}
    assert len(before) == 2
    grown = gm.sweep(base, {"friction.mu": [0.3, 0.6, 1.0], "gamma0": [1e-3]}, tmp_path / "mu")
    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "mu" / "points").iterdir()}
    assert len(after) == 3
    assert before.items() < after.items()
    np.testing.assert_array_equal(grown[2].recall.p_sig, swept[1].recall.p_sig)
    # Without a folder nothing is kept, and the numbers are the same.
    (other,) = gm.sweep(base, {"pack": [str(PACK)]})
    np.testing.assert_array_equal(other.recall.p_sig, gm.run(base).p_sig)


def test_a_part_of_a_set_may_be_silent(base: gm.Experiment) -> None:
    signals = gm.waveform(np.array([[0.0] * 4, [0.0, 1.0, 1.0, 0.0]]))
    experiment = gm.replace(base, signals=signals)
    whole, split = gm.run(experiment), gm.run(experiment, batch=1)
    scale = float(jnp.abs(whole.p_sig).max())
    np.testing.assert_allclose(split.p_sig, whole.p_sig, atol=1e-6 * scale)  # see above
    together = run_several([experiment, gm.replace(experiment, {"friction.mu": 0.5})])
    np.testing.assert_allclose(together[0].p_sig, whole.p_sig, atol=1e-6 * scale)


def test_every_replica_may_have_its_share_of_the_shear(base: gm.Experiment) -> None:
    shares = jnp.linspace(0.4, 0.6, 7)
    found = gm.run(gm.replace(base, shear_share=shares))
    alone = gm.run(gm.replace(base, shear_share=float(shares[3])))
    scale = float(jnp.abs(alone.p_sig).max())
    np.testing.assert_allclose(found.p_sig[2], alone.p_sig[2], atol=1e-6 * scale)  # see above
    with pytest.raises(ValueError, match="need all signals in one batch"):
        gm.run(gm.replace(base, shear_share=shares), batch=3)
