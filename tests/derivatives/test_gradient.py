"""Derivatives through whole, shortened experiments on 27 grains, and at the corners of the contact laws."""

import dataclasses
import functools
import re
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SPREAD_27, TETRA_27, with_skin

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.derivatives import gradient, jacobian
from gmem_jax.derivatives.moving import fixed_by, moving_of
from gmem_jax.derivatives.push import push
from gmem_jax.experiment.changes import value_at
from gmem_jax.experiment.experiment import acts_on_prefix
from gmem_jax.experiment.run import run
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.kinematics import kinematics
from gmem_jax.physics.contact.normal import hertz
from gmem_jax.reading import classify
from gmem_jax.simulation import scan

PACK = TETRA_27
SHORT = {"t0": 75.0, "dt": 0.3, "rest": 0.1, "hold": 0.1, "store": 0.2}  # one step per bin: some 900 steps in all
CENTRES = jnp.asarray([[0.3, 0.7]])


@pytest.fixture(scope="module")
def experiment() -> gm.Experiment:
    bumps = gm.Bumps(jnp.asarray([[1.0, -0.6]]), CENTRES, 0.2)
    return gm.Experiment(gm.load_pack(PACK), bumps, gm.Hooke(mu=0.8), **SHORT)


@pytest.fixture(scope="module")
def exact(experiment: gm.Experiment) -> jacobian.Jacobian:
    return jacobian.exact(experiment)


EVERYTHING = ("signals.amplitudes", "gamma0", "friction.mu", "friction.stiffness", "pack.position")


@pytest.mark.parametrize("length", [20, 48, 53])  # plain, in blocks, in blocks with some left over
def test_nested_checkpoints_change_neither_values_nor_derivatives(length: int) -> None:
    def run(start: jax.Array, scan: Any) -> jax.Array:
        def body(x: jax.Array, k: jax.Array) -> tuple[jax.Array, jax.Array]:
            return jnp.sin(x) + 0.1 * k, x * k

        end, seen = scan(body, start, jnp.arange(length))
        return end + jnp.sum(seen * jnp.arange(length))

    assert scan.inner_length(12) == 3
    assert scan.inner_length(256) == 16
    assert scan.inner_length(668) == 25  # 4 x 167 would keep 171 states
    nested = jax.value_and_grad(lambda x: run(x, scan.scan))(0.3)
    plain = jax.value_and_grad(lambda x: run(x, jax.lax.scan))(0.3)
    np.testing.assert_allclose(nested, plain, rtol=1e-14)


def test_the_reverse_sweep_agrees_with_the_forward_one(experiment: gm.Experiment, exact: jacobian.Jacobian) -> None:
    found = gm.value_and_grad(experiment, EVERYTHING)

    def score(p_sig: jax.Array, amplitudes: jax.Array, gamma0: jax.Array) -> jax.Array:
        changed = gm.replace(experiment, {"signals.amplitudes": amplitudes}, gamma0=gamma0)
        return changed.compare(p_sig).fidelity

    at = (found.p_sig, experiment.signals.amplitudes, jnp.asarray(1e-3))
    through, direct, direct_gamma0 = jax.grad(score, argnums=(0, 1, 2))(*at)
    forward = exact.p_sig @ np.asarray(through)[0]
    forward[:2] += np.asarray(direct)[0]
    forward[2] += float(direct_gamma0)
    reverse = [*found.slope["signals.amplitudes"][0], *(found.slope[name] for name in EVERYTHING[1:4])]
    # Both are exact derivatives of one program; 900 steps of round-off leave about 1e-12.
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
    assert found.slope["pack.position"].shape == (27, 3)
    assert np.all(np.isfinite(found.slope["pack.position"]))
    assert np.any(found.slope["pack.position"] != 0.0)


def test_states_are_kept_or_computed_again(experiment: gm.Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = gm.value_and_grad(experiment, EVERYTHING)
    monkeypatch.setattr(gradient, "ROOM", 1)  # each way keeps those of its first chunk
    assert gm.value_and_grad(experiment, EVERYTHING) == kept


def test_the_exact_jacobian_agrees_with_central_differences(
    experiment: gm.Experiment, exact: jacobian.Jacobian
) -> None:
    differences = jacobian.differences(experiment, 1e-5)
    miss = jacobian.mismatch(exact, differences)
    # Waveform and gamma0: no contact changes its kind within the step. mu and stiffness act from the first
    # compression on, where 27 grains rearrange: contacts that begin to slide inside the step leave some 1e-4.
    assert miss["amplitudes"] < 1e-5
    assert miss["gamma0"] < 1e-5
    assert miss["all"] < 1e-2


@pytest.mark.parametrize(
    "stages", [(gm.write(z="xy"), gm.read()), (gm.write(), gm.compress(0.0), gm.read(to=0.75, length=0.5))]
)
def test_the_jacobian_is_of_what_the_protocol_reads(experiment: gm.Experiment, stages: tuple[gm.Stage, ...]) -> None:
    """On another channel, and upwards in another time over a part of u."""
    protocol = gm.Protocol(gm.cycle(0.1, 0.1), *stages)
    one = gm.Experiment(experiment.pack, experiment.signals, experiment.friction, protocol=protocol, t0=75.0, dt=0.3)
    found = jacobian.exact(one, progress=False)
    for name in ("mu", "stiffness"):
        path, step = f"friction.{name}", 1e-6
        up, down = (run(gm.replace(one, {path: value_at(one, path) + sign * step})).p_sig for sign in (1.0, -1.0))
        slope = np.asarray(up - down)[0] / (2.0 * step)
        miss = found.p_sig[found.names.index(name)] - slope
        assert np.linalg.norm(miss) < 0.02 * np.linalg.norm(slope), name  # contacts that begin to slide inside the step
    with pytest.raises(ValueError, match="one read and one channel"):
        jacobian.exact(gm.replace(one, protocol=gm.Protocol(gm.write(), gm.read("a"), gm.write(), gm.read("b"))))


@pytest.mark.slow
def test_the_jacobian_by_gamma0_follows_from_that_by_the_amplitudes(exact: jacobian.Jacobian) -> None:
    # Only the product gamma0 a_k enters: gamma0 dp/dgamma0 = sum_k a_k dp/da_k, to round-off.
    euler = exact.values[:2] @ exact.p_sig[:2]
    np.testing.assert_allclose(1e-3 * exact.p_sig[2], euler, atol=1e-9 * np.abs(euler).max())


def test_what_acts_on_the_prefix_is_recognised() -> None:
    assert any(map(acts_on_prefix, EVERYTHING))
    assert not any(map(acts_on_prefix, ["gamma0", "signals.centres"]))


def smooth(experiment: gm.Experiment, p_sig: jax.Array) -> jax.Array:
    """Of everything in a recall, and of nothing that is nearly 0."""
    return 1e6 * jnp.sum(p_sig * jnp.linspace(0.0, 1.0, p_sig.shape[-1])) + experiment.compare(p_sig).gain


def all_names(experiment: gm.Experiment) -> list[str]:
    """The dotted names of all arrays of floats in an experiment."""
    leaves = jax.tree_util.tree_leaves_with_path(experiment)
    floats = [path for path, leaf in leaves if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]
    return [jax.tree_util.keystr(path).removeprefix(".") for path in floats]


@pytest.fixture(scope="module")
def whole(experiment: gm.Experiment) -> gm.Experiment:
    """Every number of it given."""
    given = gm.replace(experiment, t0=60.0, rest=0.02, hold=0.02, store=0.02, delta0=0.05, hold_drag=0.04)
    return gm.replace(given, {"friction.spinning": 0.9, "gravity": 1e-4})


def require_differences(experiment: gm.Experiment, slopes: dict[str, Any]) -> None:
    """Each derivative, along some direction, is that of central differences."""
    experiment = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.result_type(leaf)), experiment)  # one program for all
    for number, (name, slope) in enumerate(slopes.items()):
        value = np.asarray(value_at(experiment, name))
        random = np.random.default_rng(number)  # no component near 0, where round-off would be all there is to see
        toss = random.choice([-1.0, 1.0], value.shape) * random.uniform(0.5, 1.5, value.shape)
        toss *= np.abs(value).mean() + 1e-3
        up, down = (run(gm.replace(experiment, {name: jnp.asarray(value + by * toss)})) for by in (1e-7, -1e-7))
        difference = float(smooth(experiment, up.p_sig) - smooth(experiment, down.p_sig)) / 2e-7
        if name.split(".")[-1] in ("gamma0", "delta0", "width", "amplitudes", "centres"):  # the measure has them too
            changed = [gm.replace(experiment, {name: jnp.asarray(value + by * toss)}) for by in (1e-7, -1e-7)]
            difference = float(smooth(changed[0], up.p_sig) - smooth(changed[1], down.p_sig)) / 2e-7
        # Some contacts of 27 grains begin to slide or touch within the step.
        np.testing.assert_allclose(np.vdot(slope, toss), difference, rtol=2e-2, atol=1e-6, err_msg=name)


@pytest.mark.slow
def test_every_name_has_the_derivative_of_differences(whole: gm.Experiment) -> None:
    names = all_names(whole)
    assert {"pack.lower", "pack.quaternion", "pack.clump.inertia", "material.poisson", "t0", "hold_drag"} < set(names)
    assert {"pack.clump.offsets", "gravity"} < set(names)
    found = gm.value_and_grad(whole, names, loss=smooth)
    require_differences(whole, found.slope)
    assert np.all(np.abs(np.asarray(found.slope["pack.clump.offsets"])).max(axis=1) > 0.0)
    moved = {name for name, slope in found.slope.items() if np.any(np.asarray(slope))}
    still = {"pack.delta0", "pack.ringing_period", "pack.clump.diameter", *(n for n in names if "pairs" in n)}
    units = {f"material.{name}" for name in ("radius", "modulus", "density")}
    assert set(names) - moved == still | units  # delta0 was given


@pytest.mark.slow
def test_the_friction_of_walls_has_the_derivative_of_differences_and_of_forward_mode(whole: gm.Experiment) -> None:
    rough = gm.replace(whole, wall_mu=0.5)
    found = gm.value_and_grad(rough, ["wall_mu", "friction.mu"], loss=smooth)
    require_differences(rough, found.slope)
    assert all(abs(float(slope)) > 0.0 for slope in found.slope.values())
    along = push(rough, {"wall_mu": jnp.asarray(1.0)})
    slope = jax.jvp(lambda p_sig: smooth(rough, p_sig), (along.p_sig,), (along.p_sig_slope,))[1]
    np.testing.assert_allclose(slope, found.slope["wall_mu"], rtol=1e-8)  # round-off of 700 steps


def score(experiment: gm.Experiment) -> jax.Array:
    return smooth(experiment, gm.recall(experiment).p_sig)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["auto", "jax"])
def test_every_name_has_the_derivative_of_grad_by_the_whole_experiment(whole: gm.Experiment, backend: Any) -> None:
    names = all_names(whole)
    found = gm.value_and_grad(whole, names, loss=smooth).slope
    moments = {"pack.clump.inertia": whole.pack.clump.inertia}  # the grain has three from now on
    expected = jax.jit(jax.grad(score, allow_int=True))(gm.replace(whole, moments, backend=backend))
    for name in names:
        slope = np.asarray(value_at(expected, name))
        np.testing.assert_allclose(found[name], slope, rtol=1e-6, atol=1e-8 * np.abs(slope).max(), err_msg=name)


@pytest.mark.slow
def test_the_forward_mode_has_the_shape_of_the_grain_too(whole: gm.Experiment) -> None:
    name = "pack.clump.offsets"
    offsets, toss = whole.pack.clump.offsets, jnp.asarray(np.random.default_rng(0).normal(size=(4, 3)))
    along = push(whole, {name: toss}).p_sig_slope
    up, down = (run(gm.replace(whole, {name: offsets + by * toss})).p_sig for by in (1e-7, -1e-7))
    np.testing.assert_allclose(along, (up - down) / 2e-7, atol=2e-2 * np.abs(along).max())


@pytest.mark.skipif(not native.available()[0], reason=native.available()[1])
def test_a_gradient_by_the_whole_experiment_is_native(whole: gm.Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(dynamics, "march")  # the definition of the steps
    slope = jax.eval_shape(jax.grad(score, allow_int=True), whole)
    assert slope.pack.clump.offsets.shape == (4, 3)


@pytest.mark.skipif(not native.available()[0], reason=native.available()[1])
def test_only_slopes_by_sizes_are_those_of_plain_jax(whole: gm.Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    unequal = gm.replace(whole, pack=gm.load_pack(SPREAD_27), delta0=None)
    simulation, state = unequal.simulation(sheared=False), unequal.begin()
    row, moving = simulation.rows(unequal.phases[0][0], 0), moving_of(state)
    before, slope = jax.tree.map(lambda leaf: leaf[None], moving), (moving, jnp.zeros((1, 3, 1)))
    monkeypatch.delattr(sys.modules["gmem_jax.native.march"], "_plain")  # the definition of the steps

    def pull(*names: str) -> Any:
        fixed = fixed_by(names)
        return jax.eval_shape(functools.partial(gradient._pull, fixed=fixed), simulation, before, row, 1, slope)

    few, _ = pull("friction.mu", "pack.clump.offsets")
    assert len(few) > 0
    for name in ("pack", "pack.clump", "pack.clump.sizes"):
        with pytest.raises(NameError, match="_plain"):
            pull(name)


def test_names_may_come_one_by_one(experiment: gm.Experiment) -> None:
    names = ("friction.mu", "pack.position")
    of_list, of_iterator = (gm.value_and_grad(experiment, by, progress=False).slope for by in (names, iter(names)))
    jax.tree.map(np.testing.assert_array_equal, of_iterator, of_list)


def test_names_that_cannot_be_differentiated_by_are_refused(experiment: gm.Experiment) -> None:
    with pytest.raises(ValueError, match="Hooke has no field 'p_max'"):
        gm.value_and_grad(experiment, ["friction.p_max"])
    with pytest.raises(ValueError, match="pack holds more than floats"):
        gm.value_and_grad(experiment, ["pack"])
    with pytest.raises(ValueError, match=r"friction.mu is part of friction; name one of them"):
        gm.value_and_grad(experiment, ["friction", "friction.mu"])
    with pytest.raises(ValueError, match="background is fixed when a program is compiled and has no derivative"):
        gm.value_and_grad(experiment, ["background"])
    with pytest.raises(ValueError, match="steps is fixed when a program is compiled and has no derivative"):
        gm.value_and_grad(experiment, ["steps"])
    whole = gm.replace(experiment, signals=gm.Bumps(jnp.asarray([[1, -1]]), CENTRES, 0.2))
    with pytest.raises(ValueError, match=r"signals\.amplitudes holds whole numbers, which have no derivative"):
        gm.value_and_grad(whole, ["signals.amplitudes"])
    with pytest.raises(ValueError, match="the experiment has no gravity: give it a number first"):
        gm.value_and_grad(experiment, ["gravity"])
    with pytest.raises(ValueError, match=r"by must hold names, as in \['gamma0', 'friction.mu'\]; got 1"):
        gm.value_and_grad(experiment, [1])


@pytest.mark.parametrize("value", [None, 3, (1.0, 2.0)], ids=repr)
def test_a_loss_that_is_no_real_number_is_refused(experiment: gm.Experiment, value: Any) -> None:
    protocol = gm.Protocol(gm.write(length=0.02), gm.read(length=0.02))
    short = gm.Experiment(experiment.pack, experiment.signals, t0=75.0, protocol=protocol)
    with pytest.raises(ValueError, match="a loss is one real number, got"):
        gm.value_and_grad(short, ["gamma0"], loss=lambda *_: value, progress=False)


def test_each_moment_of_inertia_acts_on_a_grain_that_was_marked_isotropic(experiment: gm.Experiment) -> None:
    name, moments = "pack.clump.inertia", experiment.pack.clump.inertia
    protocol = gm.Protocol(gm.write(length=0.15), gm.hold(0.02), gm.read(length=0.15))
    one = gm.Experiment(experiment.pack, experiment.signals, t0=200.0, dt=0.4, protocol=protocol, gamma0=5e-3)

    def loss(_: Any, p_sig: Any) -> jax.Array:
        return jnp.sum(jnp.sin(1e4 * p_sig))

    found = gm.value_and_grad(one, [name], loss=loss, progress=False).slope[name]
    for axis, moment in enumerate(np.asarray(moments)):
        step = 1e-6 * moment
        ends = [gm.replace(one, {name: moments.at[axis].add(sign * step)}) for sign in (1.0, -1.0)]
        up, down = (float(loss(end, gm.run(end, progress=False).p_sig)) for end in ends)
        assert float(found[axis]) == pytest.approx((up - down) / (2.0 * step), rel=1e-4)
    assert np.ptp(found) > 0.1 * np.abs(found).max()


def test_a_jacobian_of_several_signals_is_refused(experiment: gm.Experiment) -> None:
    several = gm.replace(experiment, signals=gm.six_signals())
    with pytest.raises(ValueError, match="one signal made of bumps"):
        jacobian.exact(several)


@pytest.mark.parametrize("way", [jacobian.exact, lambda experiment: jacobian.differences(experiment, 1e-6)])
def test_a_jacobian_of_another_background_is_refused(experiment: gm.Experiment, way: Any) -> None:
    with pytest.raises(ValueError, match="with the background sub0, got sub2"):
        way(gm.replace(experiment, background="sub2"))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"gamma0": jnp.full(2, 1e-3)}, "at one value of each parameter, not one for each replica"),
        ({"friction.mu": np.full(2, 0.5)}, "at one value of each parameter, not one for each replica"),
        ({"friction": gm.Frictionless()}, "the numbers mu and stiffness; Frictionless has no mu"),
    ],
)
def test_a_jacobian_by_what_there_is_not_is_refused(experiment: gm.Experiment, changes: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        jacobian.exact(gm.replace(experiment, changes))


def test_the_width_of_bumps_may_have_axes(experiment: gm.Experiment, exact: jacobian.Jacobian) -> None:
    bumps: Any = experiment.signals
    wide = gm.replace(experiment, signals=gm.Bumps(bumps.amplitudes, bumps.centres, jnp.asarray([[bumps.width]])))
    np.testing.assert_array_equal(jacobian.exact(wide).p_sig, exact.p_sig)


@pytest.mark.parametrize(
    ("name", "call"), [("run", gm.run), ("value_and_grad", gm.value_and_grad), ("jacobian", gm.jacobian)]
)
def test_what_works_on_the_host_is_refused_inside_a_program(experiment: gm.Experiment, name: str, call: Any) -> None:
    def program(x: Any) -> Any:
        call(experiment, progress=False)  # which is not traced itself
        return x

    with pytest.raises(ValueError, match=f"gm.{name} works on the host; inside jax.jit"):
        jax.jit(program)(1.0)


CORNERS = {
    "no sliding": ([1.9, 0.0, 0.0], [0.0, 0.0, 0.0]),
    "overlap zero": ([2.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
    "first touch": ([2.0 - 1e-15, 0.0, 0.0], [-1e-3, 1e-3, 0.0]),
    "apart": ([2.1, 0.0, 0.0], [1e-3, 0.0, 0.0]),
    "sliding": ([1.9, 0.0, 0.0], [0.0, 10.0, 0.0]),
    "separating so fast that the dashpot would pull": ([1.9, 0.0, 0.0], [10.0, 0.0, 0.0]),
}
# Ten seconds each, nearly all of it compiling: M2 has its own corners, where contacts begin and where they slide.
SLOW_CORNERS = [
    ("M1", "overlap zero"),
    *(("M2", corner) for corner in CORNERS if corner not in ("first touch", "sliding")),
]


@pytest.mark.parametrize(
    ("law", "corner"),
    [
        pytest.param(law, corner, id=f"{corner}-{name}", marks=[pytest.mark.slow] * ((name, corner) in SLOW_CORNERS))
        for name, law in {"H": gm.Hooke(), "M1": gm.MindlinRescaled(), "M2": gm.Mindlin(points=5)}.items()
        for corner in CORNERS
    ],
)
def test_derivatives_are_finite_at_the_corners_of_the_laws(law: Any, corner: str) -> None:
    separation, velocity = (jnp.asarray(v).reshape(1, 3, 1) for v in CORNERS[corner])
    history = law.init(1, 1, jnp.float64)

    def contact(separation: jax.Array, velocity: jax.Array, mu: jax.Array, history: Any) -> Any:
        kin = kinematics(separation, velocity, jnp.zeros((1, 3, 1)), jnp.ones(1, bool), jnp.asarray(0.3))
        normal = hertz(kin.safe_overlap, kin.closing, kin.touching, 0.62, 0.23)
        return dataclasses.replace(law, mu=mu)(kin, normal, history)

    arguments = (separation, velocity, jnp.asarray(0.5), history)
    for jacobian_of in (jax.jacfwd, jax.jacrev):
        slopes = jacobian_of(contact, argnums=(0, 1, 2, 3))(*arguments)
        assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(slopes))


@pytest.mark.parametrize("law", [gm.Hooke(), gm.MindlinRescaled(), gm.Mindlin(points=5)], ids=["H", "M1", "M2"])
def test_at_the_coulomb_limit_the_derivative_is_that_of_one_side(law: Any) -> None:
    def force(mu: jax.Array) -> jax.Array:
        kin = kinematics(
            jnp.asarray([1.9, 0.0, 0.0]).reshape(1, 3, 1),
            jnp.asarray([0.0, 0.05, 0.0]).reshape(1, 3, 1),
            jnp.zeros((1, 3, 1)),
            jnp.ones(1, bool),
            jnp.asarray(0.3),
        )
        normal = jnp.full((1, 1, 1), 0.01)
        return dataclasses.replace(law, mu=mu)(kin, normal, law.init(1, 1, jnp.float64))[0][0, 1, 0]

    limit = force(jnp.asarray(1e6)) / 0.01  # mu at which this contact just sticks
    assert abs(float(jax.grad(force)(limit * (1.0 + 1e-9)))) == 0.0
    np.testing.assert_allclose(float(jax.grad(force)(limit * (1.0 - 1e-9))), 0.01, rtol=1e-6)
    assert float(jax.grad(force)(limit)) in (0.0, 0.01) or np.isclose(float(jax.grad(force)(limit)), 0.01)


def test_the_classifier_is_differentiated_through_the_recall_to_the_waveform(experiment: gm.Experiment) -> None:
    lessons = classify.TrainingConfig(2, hidden=(16,))
    net = classify.initial(lessons, 1)
    words = gm.words(2)

    at_words = gm.replace(experiment, signals=words)

    def loss(_: gm.Experiment, p_sig: jax.Array) -> jax.Array:
        return classify.cross_entropy(net, p_sig)

    slope = gm.value_and_grad(at_words, ["signals.amplitudes"], loss=loss).slope["signals.amplitudes"]
    assert np.all(np.isfinite(slope))
    toss = jnp.asarray(np.random.default_rng(0).normal(size=words.amplitudes.shape))

    def at(step: float) -> float:
        moved = gm.replace(at_words, {"signals.amplitudes": words.amplitudes + step * toss})
        return float(loss(moved, run(moved).p_sig))

    # The net works in single precision: a loss of about 1 has 1e-7 of noise, 2e-4 of a difference over 2 x 3e-4.
    step = 3e-4
    difference = (at(step) - at(-step)) / (2.0 * step)
    assert abs(difference) > 0.01
    np.testing.assert_allclose(jnp.vdot(toss, slope), difference, rtol=0.01, atol=5e-4)


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(gm.Hooke(), id="H"),
        pytest.param(gm.MindlinRescaled(), id="M1", marks=pytest.mark.slow),
        pytest.param(gm.Mindlin(points=6), id="M2", marks=pytest.mark.slow),
    ],
)
def test_every_law_and_the_places_of_bumps_and_delta0_have_derivatives(experiment: gm.Experiment, law: Any) -> None:
    short = gm.replace(experiment, friction=law, delta0=0.05, rest=0.02, hold=0.02, store=0.02)

    def loss(experiment: gm.Experiment, p_sig: jax.Array) -> jax.Array:
        return 1e6 * jnp.sum(p_sig * jnp.linspace(0.0, 1.0, p_sig.shape[-1])) + experiment.compare(p_sig).gain

    theta = {"signals.centres": CENTRES, "friction.stiffness": jnp.asarray(law.stiffness), "delta0": jnp.asarray(0.05)}
    found = gm.value_and_grad(short, tuple(theta), loss=loss)

    def at(name: str, step: jax.Array) -> float:
        changed = gm.replace(short, {name: theta[name] + step})
        return float(loss(changed, run(changed).p_sig))

    for name, tolerance in {"signals.centres": 1e-4, "friction.stiffness": 1e-2, "delta0": 1e-2}.items():
        # The last two act from the first compression on: some contacts begin to slide or touch within the step.
        step = jnp.full(theta[name].shape, 1e-7) * theta[name]
        difference = (at(name, step) - at(name, -step)) / 2.0
        assert difference != 0.0
        np.testing.assert_allclose(jnp.vdot(found.slope[name], step), difference, rtol=tolerance)


@pytest.mark.slow
def test_grad_of_the_traced_recall_agrees_with_the_walk_on_the_host(experiment: gm.Experiment) -> None:
    short = gm.replace(experiment, rest=0.02, hold=0.02, store=0.02)

    def score(amplitudes: jax.Array) -> jax.Array:
        return gm.fidelity(gm.replace(short, {"signals.amplitudes": amplitudes}))

    amplitudes = jnp.asarray([[1.0, -0.6]])
    several = jax.vmap(jax.grad(score))(jnp.stack([amplitudes, 0.5 * amplitudes]))
    found = gm.value_and_grad(short, ["signals.amplitudes"])
    np.testing.assert_allclose(several[0], found.slope["signals.amplitudes"], rtol=1e-8)
    assert np.all(np.isfinite(several[1]))


def test_a_second_readout_as_background_is_differentiated_too(experiment: gm.Experiment) -> None:
    short = gm.replace(experiment, rest=0.02, hold=0.02, store=0.02, background="sub2-bl")
    found = gm.value_and_grad(short, ["gamma0"], loss=lambda of, p_sig: of.compare(p_sig).gain)
    step = 1e-8
    up, down = (float(run(gm.replace(short, gamma0=1e-3 + sign * step)).gain) for sign in (1.0, -1.0))
    np.testing.assert_allclose(found.slope["gamma0"], (up - down) / (2.0 * step), rtol=1e-3)
    along = push(short, {"gamma0": jnp.asarray(1.0)})
    np.testing.assert_allclose(along.p_sig, found.p_sig, rtol=1e-10, atol=1e-18)


def test_derivatives_do_not_mind_lists_that_are_made_anew(experiment: gm.Experiment) -> None:
    short = gm.replace(experiment, rest=0.02, hold=0.02, store=0.02)
    tight = gm.replace(short, pack=with_skin(short.pack, 0.02))
    names = ["friction.mu", "gamma0"]
    wide, narrow = (gm.value_and_grad(one, names) for one in (short, tight))
    # The same contacts in the same order, but sums over other tables: round-off of some 900 steps.
    for by in names:
        np.testing.assert_allclose(narrow.slope[by], wide.slope[by], rtol=1e-6)
        direction = {name: jnp.asarray(float(name == by)) for name in names}
        one, other = (push(e, direction) for e in (short, tight))
        scale = np.abs(one.p_sig_slope).max()
        np.testing.assert_allclose(other.p_sig_slope, one.p_sig_slope, atol=1e-6 * scale)


def test_the_table_of_derivatives_has_every_name(whole: gm.Experiment) -> None:
    page = (Path(__file__).parents[2] / "docs" / "derivatives.md").read_text()
    rows = dict(re.findall(r"^\| `([\w.]+)` \|.*\| (.*?) \|.*\|.*\|$", page, re.MULTILINE))
    assert set(all_names(whole)) <= set(rows)
    assert {"friction.p_max", "creep", "creep_fades", "gravity", "wall_mu", "pack.clump.sizes", "signals.nodes"} <= set(
        rows
    )
    assert all(found.startswith("0: ") or float(found) < 2e-2 for found in rows.values())
