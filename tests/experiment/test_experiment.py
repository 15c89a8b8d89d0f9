"""The one description of an experiment: its checks, its written form, its changes, and what is compiled for it."""

import json
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.experiment import recall as recalls
from gmem_jax.experiment.changes import value_at
from gmem_jax.experiment.experiment import NUMBERS
from gmem_jax.experiment.record import values_of
from gmem_jax.physics.rotation import unit

PACK = gm.load_pack(TETRA_27)
SHORT = {"t0": 75.0, "rest": 0.02, "hold": 0.02, "store": 0.02}
BUMP = gm.Bumps(jnp.asarray([[1.0, -0.6]]), jnp.asarray([[0.3, 0.7]]), 0.2)


def make(**changes: Any) -> gm.Experiment:
    return gm.Experiment(PACK, BUMP, **{**SHORT, **changes})


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"gamma0": -3.0}, r"gamma0 must be in \[1e-100, 0.5\), got -3"),
        ({"gamma0": float("nan")}, "gamma0 must be in"),
        ({"gamma0": "much"}, "gamma0 must be a number"),
        ({"gamma0": jnp.asarray([1e-3, -1e-3])}, "gamma0 must be in"),
        ({"delta0": 1.0}, r"delta0 must be in \[1e-9, 0.5\), got 1"),
        ({"t0": 0.0}, r"t0 must be in \(0, inf\), got 0"),
        ({"t0": float("inf")}, "t0 must be in"),
        ({"dt": 5.0}, r"dt must be in \(0, 2.0\], got 5"),
        ({"hold_drag": -0.1}, r"hold_drag must be in \[0, inf\)"),
        ({"store": -1.0}, r"store must be in \[0, inf\), got -1"),
        ({"background": "sub9"}, "background must be one of sub0, sub2, sub2-bl; got 'sub9'"),
        ({"backend": "fortran"}, "backend must be one of auto, jax, native; got 'fortran'"),
        ({"steps": 0}, "steps must be a whole number from 1, got 0"),
        ({"t0": 1.8e3, "steps": 2}, "give more steps, or none"),
        ({"gamma0": jnp.full(5, 1e-3)}, r"gamma0 must be one number or one for each replica, .*= \[2\].* shape \(5,\)"),
        (
            {"material": gm.Material(poisson=jnp.full(2, 0.2))},
            r"material.poisson must be one number, .*; got shape \(2,\)",
        ),
    ],
)
def test_impossible_numbers_are_refused_with_what_would_be_right(bad: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(**bad)


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (lambda: gm.Hooke(mu=-1.0), r"mu must be in \[0, inf\), got -1"),
        (lambda: gm.Hooke(mu=float("inf")), "mu must be in"),
        (lambda: gm.MindlinRescaled(stiffness=0.0), r"stiffness must be in \(0, inf\), got 0"),
        (lambda: gm.Mindlin(p_max=-0.1), "p_max must be in"),
        (lambda: gm.Material(poisson=0.6), r"poisson must be in \(-1, 0.5\], got 0.6"),
        (lambda: make(friction=gm.Hooke(mu=jnp.asarray([0.5, 0.6, 0.7]))), r"friction.mu must be one number or one"),
    ],
)
def test_laws_and_materials_refuse_too(law: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        law()


def test_waveforms_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="vanish at u = 0 and u = 1; found"):
        gm.Experiment(PACK, gm.Bumps(jnp.ones((1, 1)), jnp.full((1, 1), 0.95), 0.2))
    with pytest.raises(ValueError, match="every waveform is zero"):
        gm.Experiment(PACK, gm.Bumps(jnp.zeros((2, 1)), jnp.full((2, 1), 0.5), 0.2))
    with pytest.raises(ValueError, match="real samples"):
        gm.waveform(np.asarray([0.1j, 0.2, 0.3]))
    two, nan = (jnp.ones((2, 1)), jnp.full((2, 1), 0.5)), jnp.asarray([[0.5], [jnp.nan]])
    for bad in (gm.Bumps(two[0], nan, 0.2), gm.Bumps(nan, two[1], 0.2), gm.Spline(jnp.pad(nan, ((0, 0), (1, 1))))):
        with pytest.raises(ValueError, match="waveform 2 is not a finite number at every u"):
            gm.Experiment(PACK, bad)
    for width in (0.0, jnp.nan, -0.1):
        with pytest.raises(ValueError, match="the width of bumps must be positive"):
            gm.Bumps(*two, width)
    for nodes in (jnp.zeros(5), jnp.zeros((1, 2))):
        with pytest.raises(ValueError, match=r"nodes must be \[S, n \+ 2\], n samples and two zeros; got"):
            gm.Spline(nodes)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("position", PACK.position.T, r"position must have the shape \(3, 3\), got \(3, 27\)"),
        ("quaternion", PACK.quaternion[:, :3], r"quaternion must have the shape \(27, 4\), got \(27, 3\)"),
        ("lower", PACK.lower[0], r"lower must have the shape \(3,\), got \(\)"),
        ("delta0", 0.7, r"delta0 must be in \[1e-9, 0.5\), got 0.7"),
        ("clump.mass", -1.0, "clump.mass must be positive, got -1.0"),
        ("clump.inertia", PACK.clump.inertia[:2], r"clump.inertia must have the shape \(3,\)"),
        ("clump.offsets", PACK.clump.offsets[:2], r"clump.offsets must have the shape \(4, 3\), got \(2, 3\)"),
    ],
)
def test_packs_of_other_shapes_are_refused_by_name(name: str, value: Any, words: str) -> None:
    with pytest.raises(ValueError, match=f"pack.{words}"):
        gm.replace(make(), {f"pack.{name}": value})


def test_moments_that_differ_need_a_grain_that_is_not_marked_isotropic() -> None:
    grain = replace(PACK.clump, inertia=PACK.clump.inertia * jnp.asarray([0.5, 1.0, 2.0]))
    with pytest.raises(ValueError, match=r"is marked isotropic, but its moments are 3\.46573, 6\.93145, 13\.8629"):
        gm.Experiment(replace(PACK, clump=grain), BUMP)
    assert not gm.replace(make(), {"pack.clump.inertia": grain.inertia}).pack.clump.isotropic


def test_a_law_that_jax_does_not_know_is_refused_at_once() -> None:
    class Glue:
        """No pytree."""

    with pytest.raises(ValueError, match="friction must be a pytree: register Glue with"):
        make(friction=Glue())


def test_a_law_made_of_another_may_be_registered_by_jax_itself() -> None:
    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Slippery(gm.Hooke):
        """Half of H's friction."""

        def __call__(self, kin: Any, normal_force: jax.Array, history: jax.Array) -> tuple[jax.Array, jax.Array]:
            return super().__call__(kin, 0.5 * normal_force, history)

    experiment = make(friction=Slippery(mu=1.0), backend="jax")
    half = make(friction=gm.Hooke(mu=0.5), backend="jax")
    quickly = {"xla_backend_optimization_level": 0}
    found, expected = (jax.jit(gm.gain, compiler_options=quickly)(one) for one in (experiment, half))
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # another program: round-off of some 800 steps


@pytest.mark.parametrize("way", ["pack_from", "replace", "traced"])
def test_quaternions_of_any_length_are_brought_to_one(way: str) -> None:
    long = PACK.quaternion * jnp.linspace(0.5, 2.0, 27)[:, None]
    if way == "pack_from":
        made = gm.pack_from(PACK, position=PACK.position, quaternion=long)
        np.testing.assert_allclose(jnp.linalg.norm(made.quaternion, axis=1), 1.0, rtol=1e-15)
        begun = gm.Experiment(made, BUMP, **SHORT).begin()
    elif way == "replace":
        begun = gm.replace(make(), {"pack.quaternion": long}).begin()
    else:
        begun = jax.jit(lambda q: gm.replace(make(), {"pack.quaternion": q}).begin())(long)
    np.testing.assert_allclose(begun.grains.quaternion[..., 0], PACK.quaternion, rtol=1e-15, atol=1e-16)


@pytest.mark.parametrize("name", gm.list_packs())
def test_the_orientations_of_shipped_packs_stay_bit_for_bit(name: str) -> None:
    pack = gm.load_pack(name)
    np.testing.assert_array_equal(unit(pack.quaternion[..., None])[..., 0], pack.quaternion)


def test_the_length_of_a_quaternion_has_no_derivative_and_its_direction_has() -> None:
    def turned(quaternion: jax.Array) -> jax.Array:
        return jnp.sum(unit(quaternion[:, None])[:, 0] * jnp.arange(4.0))

    for quaternion in (PACK.quaternion[3], 1.5 * PACK.quaternion[3]):
        slope = jax.grad(turned)(quaternion)
        assert abs(float(slope @ quaternion)) < 1e-14
        toss = jnp.asarray([0.3, -0.2, 0.5, 0.1])
        difference = (turned(quaternion + 1e-6 * toss) - turned(quaternion - 1e-6 * toss)) / 2e-6
        np.testing.assert_allclose(slope @ toss, difference, rtol=1e-7)


def test_packs_that_cannot_be_are_refused_with_the_grain() -> None:
    nowhere, still = PACK.position.at[4, 1].set(jnp.nan), PACK.quaternion.at[2].set(0.0)
    with pytest.raises(ValueError, match="grain 5: a number is not finite"):
        gm.pack_from(PACK, position=nowhere, quaternion=PACK.quaternion)
    with pytest.raises(ValueError, match="grain 3: a number is not finite, or its quaternion is zero"):
        gm.pack_from(PACK, position=PACK.position, quaternion=still)
    with pytest.raises(ValueError, match=r"centres \[N, 3\] and quaternions \[N, 4\], got \(27, 3\), \(26, 4\)"):
        gm.pack_from(PACK, position=PACK.position, quaternion=PACK.quaternion[:-1])
    for name, value in {"pack.position": nowhere, "pack.quaternion": still}.items():
        with pytest.raises(ValueError, match=r"grain [35]: a number is not finite"):
            gm.run(gm.replace(make(), {name: value}))
    with pytest.raises(ValueError, match=r"grain 7 does not lie in the box: its centre is at \[.*\], the box is from"):
        gm.run(gm.replace(make(), {"pack.position": PACK.position.at[6, 2].add(9.0)}))


def test_what_was_made_before_double_precision_is_refused_in_one_line() -> None:
    jax.config.update("jax_enable_x64", False)
    try:
        pack, bumps = gm.load_pack(TETRA_27), gm.six_signals()
        early = gm.Experiment(pack, bumps, **SHORT)
    finally:
        jax.config.update("jax_enable_x64", True)
    words = r"{0} is float32, and float64 is needed: make or load the {1} after jax.config.update"
    with pytest.raises(ValueError, match=words.format("pack.clump.offsets", "pack")):
        gm.Experiment(pack, BUMP)
    with pytest.raises(ValueError, match=words.format("signals.amplitudes", "signals")):
        gm.Experiment(PACK, bumps)
    for start in (gm.run, gm.recall):
        with pytest.raises(ValueError, match=words.format("pack.clump.offsets", "pack")):
            start(early)


def test_equal_is_true_or_false() -> None:
    again = gm.load_pack(TETRA_27)
    assert again == PACK
    assert make() == gm.Experiment(again, gm.Bumps(BUMP.amplitudes + 0.0, BUMP.centres, 0.2), **SHORT)
    assert make() != make(gamma0=2e-3)
    assert make() != make(friction=gm.Hooke(mu=0.5))
    assert make() != make(friction=gm.MindlinRescaled())
    assert make() != make(gamma0=jnp.asarray([1e-3, 2e-3]))
    assert gm.pack_from(PACK, position=PACK.position, quaternion=PACK.quaternion, name="other") != PACK
    assert gm.stack([PACK, PACK]) != PACK
    assert (PACK == "pack") is False
    assert gm.words(2) == gm.words(2)
    assert gm.words(2) != gm.words(3)
    assert gm.tetra() == gm.tetra(0.6)
    assert gm.tetra() != gm.sphere()
    assert hash(gm.Hooke(mu=0.5)) == hash(gm.Hooke(mu=0.5))
    assert gm.Hooke(mu=0.5) in {gm.Hooke(mu=0.5): 1}
    with pytest.raises(TypeError, match="unhashable"):
        hash(PACK)


def test_recalls_and_what_holds_arrays_are_comparable(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    experiment, recall = recalled
    assert experiment == gm.replace(experiment)
    assert recall == jax.tree.map(jnp.asarray, recall)
    assert recall != jax.tree.map(lambda leaf: leaf + 1, recall)
    kernel = gm.MemoryKernel(np.zeros(3), np.zeros((3, 2)), 0.1, np.zeros((2, 3)), np.zeros((2, 3)), 1e-3, 0.05)
    assert kernel == replace(kernel, even=np.zeros((2, 3)))
    assert kernel != replace(kernel, even=np.ones((2, 3)))


def test_a_stack_of_packs_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match=r"one pack: positions \[N, 3\], got \(2, 27, 3\)"):
        gm.Experiment(gm.stack([PACK, PACK]), BUMP)


@pytest.mark.parametrize(
    "broken",
    [
        lambda e, bad: gm.replace(e, gamma0=bad),
        lambda e, bad: gm.replace(e, {"friction.mu": bad}),
        lambda e, bad: gm.replace(e, delta0=bad),
        lambda e, bad: gm.replace(e, {"material.poisson": bad - 2.0}),
        lambda e, bad: gm.replace(e, {"signals.centres": jnp.asarray([[0.3, 0.97]]) + 0.0 * bad}),
        lambda e, bad: gm.replace(e, {"signals.centres": jnp.asarray([[0.3, 0.7]]) + jnp.nan * bad}),
    ],
    ids=["gamma0", "mu", "delta0", "poisson", "open waveform", "a bump that is nowhere"],
)
def test_what_is_traced_sets_a_fatal_bit_and_turns_all_into_nan(broken: Any) -> None:
    experiment = make()
    found = jax.jit(lambda bad: gm.recall(broken(experiment, bad)))(-0.5)
    assert np.all(np.asarray(found.status) & int(gm.Status.IMPOSSIBLE))
    assert gm.Status(int(found.status[0])).fatal
    assert np.isnan(float(found.fidelity))
    assert np.all(np.isnan(np.asarray(found.p_sig)))


def test_a_broken_run_has_no_gradient_either() -> None:
    experiment = make()

    def fidelity(mu: jax.Array, gamma0: jax.Array) -> jax.Array:
        return gm.fidelity(gm.replace(experiment, {"friction.mu": mu}, gamma0=gamma0))

    # mu acts through the walk alone, gamma0 also on what the recalled signals are compared with.
    assert np.all(np.isnan(jax.grad(fidelity, argnums=(0, 1))(-0.5, 1e-3)))


@pytest.mark.parametrize(
    "experiment",
    [
        make(),
        make(gamma0=2e-3, delta0=0.04, hold_drag=0.0, background="SUB2-BL", backend="jax", steps=2),
        make(friction=gm.Mindlin(mu=0.3, points=7, variant="paper"), material=gm.Material(poisson=0.3)),
        make(friction=gm.MindlinRescaled(stiffness=0.5)),
        make(friction=gm.Hooke(mu=jnp.asarray([1.0, 0.3])), gamma0=jnp.asarray([1e-3, 2e-3])),
        gm.Experiment(PACK, gm.six_signals()),
        gm.Experiment(PACK, gm.words(3), background="sub2"),
        gm.Experiment(PACK, gm.waveform(np.sin(np.linspace(0.3, 3.0, 7)))),
        gm.Experiment(gm.load_pack("tetra-325-a"), gm.six_signals()),
    ],
    ids=["bumps", "all fields", "m2", "m1", "replicas", "six", "words", "samples", "shipped"],
)
def test_the_written_form_reads_back_to_the_same_experiment(experiment: gm.Experiment) -> None:
    again = gm.from_dict(json.loads(json.dumps(gm.to_dict(experiment))))
    assert jax.tree.structure(again) == jax.tree.structure(experiment)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(experiment), strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.pack.name == experiment.pack.name


def test_a_written_form_of_another_pack_is_refused() -> None:
    form = gm.to_dict(make())
    moved = gm.pack_from(PACK, position=PACK.position * 0.999, quaternion=PACK.quaternion)
    with pytest.raises(gm.FileFormatError, match="its content has changed"):
        gm.from_dict(form, moved)
    with pytest.raises(gm.FileFormatError, match="no field 'gama0'"):
        gm.from_dict({**form, "gama0": 1.0}, PACK)
    with pytest.raises(gm.FileFormatError, match="'t0' is missing"):
        gm.from_dict({name: value for name, value in form.items() if name != "t0"}, PACK)


def test_a_configuration_says_twice_only_what_came_to_something_else() -> None:
    experiment = make(gamma0=2e-3, creep=1e-6)
    found = json.loads(json.dumps(gm.describe(experiment)))
    again = {"pack", "signals", "friction", "delta0", "hold_drag", "dt", "steps", "backend"}
    assert set(found) & set(found["experiment"]) == again
    values = values_of(found)
    assert {name: values[name] for name in {*NUMBERS} - again} == {
        name: value_at(experiment, name) for name in {*NUMBERS} - again
    }
    assert (values["delta0"], values["hold_drag"]) == (float(PACK.delta0), 0.05)
    assert (values["dt"], values["steps"]) == experiment.timing


def test_replace_knows_every_field_by_keyword_and_by_name() -> None:
    experiment = gm.replace(make(), {"friction.mu": 0.5, "signals.width": 0.1}, gamma0=2e-3)
    assert value_at(experiment, "friction.mu") == 0.5
    assert (experiment.signals.width, experiment.gamma0) == (0.1, 2e-3)
    with pytest.raises(ValueError, match="Experiment has no field 'gama0'"):
        gm.replace(experiment, gama0=1e-3)
    with pytest.raises(ValueError, match=r"Experiment has no field 'mu' \(meant is friction.mu\?\); it has pack, "):
        gm.replace(experiment, {"mu": 0.5})
    with pytest.raises(ValueError, match="Hooke has no field 'viscosity'"):
        gm.replace(experiment, {"friction.viscosity": 1.0})


def test_a_concrete_t0_chooses_its_steps_and_a_traced_one_keeps_them() -> None:
    experiment = make(t0=1.8e3)
    assert experiment.timing.steps == 12
    assert gm.replace(experiment, t0=1.8e4).timing.steps == 118
    seen = []
    jax.eval_shape(lambda t0: seen.append(gm.replace(experiment, t0=t0).timing.steps) or t0, 1e3)
    assert seen == [12]
    with pytest.raises(ValueError, match="t0 is traced"):
        jax.eval_shape(lambda t0: gm.Experiment(PACK, BUMP, t0=t0).t0, 1e3)


def test_the_same_structure_is_compiled_once() -> None:
    program = recalls._recall
    gm.recall(make())
    before = program._cache_size()
    other = gm.pack_from(PACK, position=PACK.position * 0.9999, quaternion=PACK.quaternion, name="another")
    for experiment in (
        make(friction=gm.Hooke(mu=1)),
        make(friction=gm.Hooke(mu=np.float32(0.5)), gamma0=np.float64(2e-3)),
        gm.replace(make(), pack=other),
        make(t0=70.0),
    ):
        assert np.isfinite(float(gm.fidelity(experiment)))
    assert program._cache_size() == before
    for gamma0 in (1e-3, 2e-3):  # a number that is an array has a type of its own, and so a program
        assert np.isfinite(float(gm.fidelity(make(gamma0=jnp.asarray(gamma0)))))
    assert program._cache_size() == before + 1


def test_packs_of_one_size_share_a_structure() -> None:
    shapes = {
        str(jax.tree.map(jnp.shape, gm.load_pack(name).pairs))
        for name in gm.list_packs()
        if name.startswith("tetra-325")
    }
    assert len(shapes) == 1


@pytest.mark.slow
def test_grad_and_vmap_work_outside_jit() -> None:
    experiment = make()

    def by_mu(mu: jax.Array) -> jax.Array:
        return gm.fidelity(gm.replace(experiment, {"friction.mu": mu}))

    def by_position(position: jax.Array) -> jax.Array:
        return gm.fidelity(gm.replace(experiment, {"pack.position": position}))

    def by_t0(t0: jax.Array) -> jax.Array:
        return gm.gain(gm.replace(experiment, t0=t0))

    assert np.isfinite(float(jax.grad(by_mu)(0.8)))
    assert jax.vmap(by_mu)(jnp.asarray([0.8, 0.4])).shape == (2,)
    assert np.all(np.isfinite(jax.grad(by_position)(PACK.position)))
    slope, step = float(jax.grad(by_t0)(75.0)), 1e-4
    difference = float(by_t0(75.0 + step) - by_t0(75.0 - step)) / (2.0 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-3)  # contacts that turn within the step bend G


def test_a_concrete_waveform_inside_jit_is_a_waveform_like_any_other() -> None:
    wave = jnp.asarray([[0.0, 0.5, 1.0, 0.5, 0.0]])
    found = jax.jit(lambda mu: gm.fidelity(gm.Experiment(PACK, gm.waveform(wave), gm.Hooke(mu=mu), **SHORT)))(0.8)
    assert np.isfinite(float(found))


@pytest.mark.parametrize("make", [gm.rest, gm.tetra, lambda x: gm.words(2, width=x)], ids=["rest", "tetra", "words"])
def test_what_a_program_is_compiled_for_may_not_be_traced(make: Any) -> None:
    with pytest.raises(ValueError, match="is fixed when a program is compiled: it must be a number, not traced"):
        jax.jit(lambda x: jnp.asarray(0.0 * (make(x) is None)))(0.5)


def test_the_host_refuses_what_is_traced_and_says_what_to_use() -> None:
    experiment = make()
    with pytest.raises(ValueError, match=r"use gm.recall"):
        jax.jit(lambda mu: gm.run(gm.replace(experiment, {"friction.mu": mu})).gain)(0.5)
