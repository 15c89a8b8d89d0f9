"""Creep: elastic tangential forces relax, exactly, once in a bin."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.physics.contact.creep import relaxation
from gmem_jax.physics.contact.kinematics import kinematics

PACK = gm.load_pack(TETRA_27)
ONE = gm.Bumps(jnp.asarray([[1.0], [-1.0]]), jnp.full((2, 1), 0.5), 0.6)
SHORT: dict[str, Any] = {"t0": 60.0, "rest": 0.05, "hold": 0.05, "store": 0.3, "gamma0": 0.01}


@pytest.mark.parametrize("law", [gm.Hooke(mu=1e3), gm.MindlinRescaled(mu=1e3), gm.Mindlin(mu=1e3, points=8)])
def test_a_relaxed_contact_pulls_back_with_a_part_of_its_force(law: Any) -> None:
    separation = jnp.asarray([[[1.9], [0.0], [0.0]]])
    still, slides, dt = jnp.zeros((1, 3, 1)), jnp.asarray([[[0.0], [1e-3], [0.0]]]), jnp.asarray(0.3)
    valid, push = jnp.ones(1, bool), jnp.full((1, 1, 1), 1e-2)
    history = law.init(1, 1, float)
    for _ in range(3):  # one more step at rest takes the half of an increment that the history is ahead
        _, history = law(kinematics(separation, slides, still, valid, dt), push, history)
    _, history = law(kinematics(separation, still, still, valid, dt), push, history)
    rests = kinematics(separation, still, still, valid, dt)
    whole, _ = law(rests, push, history)
    part, _ = law(rests, push, law.relaxed(history, jnp.asarray(0.3)))
    assert float(jnp.abs(whole).max()) > 1e-5
    np.testing.assert_allclose(part, 0.3 * whole, rtol=1e-12)


@pytest.mark.parametrize("fades", [None, 20.0])
def test_the_factors_of_bins_make_up_that_of_the_stage(fades: float | None) -> None:
    rate, bins, length = 0.01, 40, 7.0
    begun = length * jnp.arange(bins)
    factors = relaxation(rate, fades, begun, begun + length)
    assert float(jnp.prod(factors)) == pytest.approx(
        float(relaxation(rate, fades, jnp.zeros(()), bins * length)), rel=1e-13
    )
    # The equation itself, by a small step.
    time, step = 100.0, 1e-4
    slope = (float(relaxation(rate, fades, jnp.asarray(time), jnp.asarray(time + step))) - 1.0) / step
    assert slope == pytest.approx(-rate if fades is None else -rate / (1.0 + time / fades), rel=1e-5)


@pytest.mark.parametrize("fades", [1e7, 1e9, 1e13, 1e300, np.inf])
def test_creep_that_hardly_fades_is_that_of_a_maxwell_solid_with_the_slope_of_its_expansion(fades: float) -> None:
    """log of the factor = -rate (d1 - d2 / (2 tau) + d3 / (3 tau^2) ...), with dn = ended^n - begun^n."""
    rate, begun, ended = 0.01, 500.0, 507.0
    d1, d2, d3 = (ended**n - begun**n for n in (1, 2, 3))
    value, slope = jax.value_and_grad(relaxation, argnums=1)(rate, fades, jnp.asarray(begun), jnp.asarray(ended))
    expected = np.exp(-rate * (d1 - d2 / (2.0 * fades) + d3 / (3.0 * fades * fades)))
    assert float(value) == pytest.approx(expected, rel=1e-9)
    expected *= -rate * (d2 / 2.0 - 2.0 * d3 / (3.0 * fades)) / fades / fades
    assert float(slope) == pytest.approx(expected, rel=1e-4)


def friction(simulation: Any, state: Any) -> jax.Array:
    """Root mean square of the elastic tangential forces, [B]."""
    return jnp.sqrt(jnp.mean(state.history**2, axis=(0, 1)))


def test_no_rate_changes_nothing_and_in_storage_friction_relaxes() -> None:
    base = gm.run(gm.Experiment(PACK, ONE, **SHORT), progress=False)
    none = gm.run(gm.Experiment(PACK, ONE, creep=0.0, **SHORT), progress=False)
    np.testing.assert_array_equal(none.p_sig, base.p_sig)
    left = {}
    for rate in (0.0, 0.02):
        slow = gm.Experiment(PACK, ONE, creep=rate, observe={"friction": friction}, **{**SHORT, "t0": 600.0})
        stored = gm.run(slow, progress=False).stages["store"].observed["friction"]
        left[rate] = float(stored[-1, 1] / stored[0, 1])
    assert left[0.0] > 0.9
    # Alone a contact would keep exp(-3.6) = 0.03. In a pack grains give way and load their contacts anew: 0.56.
    assert left[0.02] < 0.7


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"creep": 1.0}, r"creep relaxes 0.23 of a force in a bin of t0 / 256, must be at most 0.05"),
        ({"creep_fades": 1.0}, "give creep, a rate"),
        ({"creep": 1e-3, "friction": gm.Frictionless()}, "Frictionless has no elastic forces"),
        ({"creep": -1.0}, r"creep must be in \[0, inf\)"),
    ],
)
def test_creep_that_cannot_be_is_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        gm.Experiment(PACK, ONE, **{**SHORT, **changes})


@pytest.mark.parametrize("backend", ["auto", pytest.param("jax", marks=pytest.mark.slow)])
def test_both_backends_creep_alike_and_are_differentiated(backend: str) -> None:
    one = gm.Experiment(PACK, ONE, creep=0.02, creep_fades=30.0, backend=backend, **{**SHORT, "t0": 20.0})

    def loss(experiment: gm.Experiment, p_sig: jax.Array) -> jax.Array:
        return 1e6 * jnp.sum(p_sig**2)

    fast = gm.value_and_grad(one, ["creep"], loss=loss, progress=False)
    plain = gm.run(gm.replace(one, backend="jax"), progress=False).p_sig
    np.testing.assert_allclose(fast.p_sig, plain, atol=1e-9 * float(jnp.abs(plain).max()))
    values = [
        float(loss(one, gm.run(gm.replace(one, creep=rate), progress=False).p_sig)) for rate in (0.020005, 0.019995)
    ]
    assert float(fast.slope["creep"]) == pytest.approx((values[0] - values[1]) / 1e-5, rel=1e-4)
