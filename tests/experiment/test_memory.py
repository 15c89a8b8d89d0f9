"""The memory experiment on a pack of 27 grains with a shortened run: interfaces, transformations, derivatives."""

import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.experiment.cost import COPIES, GRAIN_BYTES, default_batch
from gmem_jax.experiment.run import apply_waveforms, runner_of
from gmem_jax.files.checkpoints import Checkpoints
from gmem_jax.simulation.checkpoints import no_cache
from gmem_jax.simulation.observers import forward
from gmem_jax.simulation.stage import BINS

PACK = TETRA_27
SHORT = {"t0": 75.0, "dt": 0.3, "store": 0.2}  # one step per bin: some 1,200 steps in all


@pytest.fixture(scope="module")
def pack() -> gm.Pack:
    return gm.load_pack(PACK)


@pytest.fixture(scope="module")
def recall(pack: gm.Pack) -> gm.Recall:
    return gm.run(gm.Experiment(pack, gm.six_signals(), **SHORT))


def two_bumps(amplitudes: jax.Array) -> gm.Bumps:
    return gm.Bumps(amplitudes=amplitudes, centres=jnp.asarray([[0.3, 0.7]]), width=0.2)


def test_a_recall_has_one_row_per_signal_and_no_fatal_status(recall: gm.Recall) -> None:
    assert recall.p_sig.shape == recall.J.shape == (6, BINS)
    assert not any(gm.Status(int(bits)).fatal for bits in recall.status)  # a drive this fast is doubtful
    assert np.isfinite(float(recall.gain))
    assert list(recall.stages) == ["rest", "compress", "hold", "decompress", "rest-2", "encode", "store", "readout"]
    assert recall.stages["compress"].pressure.shape == (BINS, 3, 1)
    assert recall.stages["readout"].pressure.shape == (BINS, 3, 7)


def test_the_inertial_number_is_that_of_the_ramp(pack: gm.Pack, recall: gm.Recall) -> None:
    readout = recall.stages["readout"]
    rate = (1.0 - np.sqrt(0.95)) / SHORT["t0"]  # of L0; L is up to 2.5 % smaller
    pressure = np.asarray(readout.pressure)[:, :2].mean(axis=1)
    expected = rate * np.sqrt(float(pack.clump.mass) / (float(pack.clump.diameter) * pressure))
    np.testing.assert_allclose(readout.inertial_number, expected, rtol=0.03)
    assert np.all(np.asarray(recall.stages["store"].inertial_number) == 0.0)


def test_gain_and_fidelity_follow_their_definitions(recall: gm.Recall) -> None:
    signal, template = np.asarray(recall.p_sig), 0.05 * 1e-3 * np.asarray(recall.J)
    gain = (signal * template).sum() / (template**2).sum()
    miss = ((signal - gain * template) ** 2).sum() / (signal**2).sum()
    np.testing.assert_allclose(float(recall.gain), gain, rtol=1e-12)
    np.testing.assert_allclose(float(recall.fidelity), 1.0 - np.sqrt(miss), rtol=1e-12)


def test_traced_and_host_runs_are_the_same_computation(pack: gm.Pack, recall: gm.Recall) -> None:
    experiment = gm.Experiment(pack, gm.six_signals(), **SHORT)
    traced = jax.jit(lambda gamma0: gm.recall(gm.replace(experiment, gamma0=gamma0)))(1e-3)
    # The two are compiled differently; round-off of 1e-16 grows over some 1,200 steps of frictional contacts.
    np.testing.assert_allclose(traced.p_sig, recall.p_sig, atol=1e-6 * np.abs(np.asarray(recall.p_sig)).max())
    # Nor need any of the experiment be an argument of what is traced.
    assert jax.eval_shape(lambda: gm.recall(experiment).p_sig).shape == recall.p_sig.shape


def test_vmap_over_parameters_equals_one_run_at_a_time(pack: gm.Pack) -> None:
    signals = two_bumps(jnp.asarray([[1.0, -1.0]]))

    def run(mu: jax.Array, stiffness: jax.Array, gamma0: jax.Array) -> jax.Array:
        friction = gm.Hooke(mu=mu, stiffness=stiffness)
        return gm.fidelity(gm.Experiment(pack, signals, friction, gamma0=gamma0, **SHORT))

    mu, stiffness, gamma0 = jnp.asarray([1.0, 0.4]), jnp.asarray([0.145, 0.1]), jnp.asarray([1e-3, 2e-3])
    together = jax.jit(jax.vmap(run))(mu, stiffness, gamma0)
    single = jax.jit(run)
    apart = [single(*each) for each in zip(mu, stiffness, gamma0, strict=True)]
    np.testing.assert_allclose(together, jnp.stack(apart), rtol=1e-6)
    assert abs(float(together[0] - together[1])) > 1e-4


def test_vmap_over_stacked_packs_equals_one_run_at_a_time(pack: gm.Pack) -> None:
    mirrored = jnp.asarray([-1.0, -1.0, 1.0])  # the same pack turned half about z: another pack, the same physics
    quaternion = pack.quaternion[:, jnp.asarray([3, 2, 1, 0])] * jnp.asarray([-1.0, -1.0, 1.0, 1.0])
    turned = gm.pack_from(pack, position=pack.position * mirrored, quaternion=quaternion)
    signals = two_bumps(jnp.asarray([[1.0, 1.0]]))
    run = jax.jit(lambda one: gm.fidelity(gm.Experiment(one, signals, **SHORT)))
    together = jax.jit(jax.vmap(run))(gm.stack([pack, turned]))
    np.testing.assert_allclose(together, jnp.stack([run(pack), run(turned)]), rtol=1e-6)
    np.testing.assert_allclose(together[0], together[1], rtol=1e-5)


def test_stacking_packs_of_different_sizes_is_refused(pack: gm.Pack) -> None:
    other = gm.pack_from(pack, position=pack.position[:-1], quaternion=pack.quaternion[:-1])
    with pytest.raises(ValueError, match="one size"):
        gm.stack([pack, other])
    pair, triple = (gm.clump(np.eye(3)[:count]) for count in (2, 3))
    two, three = (
        gm.pack_from(dataclasses.replace(pack, clump=grain), position=pack.position, quaternion=pack.quaternion)
        for grain in (pair, triple)
    )
    with pytest.raises(ValueError, match=r"has 27 clump of 2 spheres, .* has 27 clump of 3 spheres"):
        gm.stack([two, three])


def test_what_cannot_be_stacked_is_named(pack: gm.Pack) -> None:
    with pytest.raises(ValueError, match="stack takes several packs, in a list: got None"):
        gm.stack(None)  # type: ignore[arg-type]
    rough = dataclasses.replace(pack, position=pack.position.astype(jnp.float32))
    with pytest.raises(ValueError, match=r"pack\.position is float32, and float64 is needed"):
        gm.stack([pack, rough])


def test_a_stack_is_isotropic_only_if_all_its_grains_are(pack: gm.Pack) -> None:
    other = dataclasses.replace(pack, clump=dataclasses.replace(pack.clump, isotropic=False))
    assert gm.stack([pack, pack]).clump.isotropic
    assert not gm.stack([pack, other]).clump.isotropic


def test_33_replicas_of_all_stages_run_in_one_compiled_program(pack: gm.Pack) -> None:
    signals = gm.Bumps(jnp.linspace(-1.0, 1.0, 32)[:, None], jnp.full((32, 1), 0.5), 0.2)
    experiment = gm.Experiment(pack, signals, t0=75.0, store=0.3, rest=0.01, hold=0.01)
    common, own = experiment.phases
    on = runner_of(experiment)
    on.run_stages(*common)
    apply_waveforms(on, experiment)
    before = forward.program._cache_size()
    on.run_stages(*own)  # stages of 256 and 77 bins, in chunks of 32 and fewer
    assert forward.program._cache_size() == before + 1
    assert on.state.replicas == 33


@pytest.mark.parametrize("background", ["sub2", "sub2-bl"])
def test_a_second_readout_serves_as_background(pack: gm.Pack, background: str) -> None:
    recall = gm.run(gm.Experiment(pack, two_bumps(jnp.asarray([[1.0, 1.0]])), background=background, **SHORT))
    assert list(recall.stages)[-1] == "readout-2"
    if background == "sub2-bl":
        np.testing.assert_allclose(np.asarray(recall.p_sig)[:, [0, -1]], 0.0, atol=1e-18)


def test_fidelity_is_differentiable_by_amplitudes_and_friction(pack: gm.Pack) -> None:
    def run(parameters: jax.Array) -> jax.Array:
        friction = gm.Hooke(mu=parameters[2])
        return gm.fidelity(gm.Experiment(pack, two_bumps(parameters[None, :2]), friction, **SHORT))

    at = jnp.asarray([1.0, -0.6, 0.8])
    gradient = jax.jit(jax.grad(run))(at)
    value = jax.jit(run)
    for index in range(3):
        step = 1e-5
        up, down = (float(value(at.at[index].add(sign * step))) for sign in (1.0, -1.0))
        # 1e-3: contacts that begin or end sliding between the two evaluations bend F by about this much.
        np.testing.assert_allclose(float(gradient[index]), (up - down) / (2.0 * step), rtol=1e-3)


def test_forward_and_reverse_derivatives_agree(pack: gm.Pack) -> None:
    def run(amplitudes: jax.Array) -> jax.Array:
        return gm.gain(gm.Experiment(pack, two_bumps(amplitudes[None]), **SHORT))

    at = jnp.asarray([1.0, -0.6])
    np.testing.assert_allclose(jax.jit(jax.jacfwd(run))(at), jax.jit(jax.grad(run))(at), rtol=1e-8)


def test_a_step_too_large_for_a_traced_run_gives_nan_and_says_so(pack: gm.Pack) -> None:
    experiment = gm.Experiment(pack, gm.six_signals(), t0=75.0, store=0.1)  # one step in a bin
    recall = jax.jit(lambda t0: gm.recall(gm.replace(experiment, t0=t0)))(600.0)
    assert np.all(np.asarray(recall.status) & int(gm.Status.STEP_TOO_LARGE))
    assert np.isnan(float(recall.fidelity))
    assert "2 t_c" in gm.explain(int(recall.status[0]))


def test_another_delta0_than_the_packs_own_warns(pack: gm.Pack) -> None:
    with pytest.warns(UserWarning, match="was cycled with delta0") as heard:
        gm.run(gm.Experiment(pack, two_bumps(jnp.ones((1, 2))), delta0=0.04, **SHORT))
    assert {one.filename for one in heard} == {__file__}


def test_another_material_than_the_packs_own_warns(pack: gm.Pack) -> None:
    soft = gm.Experiment(pack, two_bumps(jnp.ones((1, 2))), material=gm.Material(wall_rigidity=0.5), **SHORT)
    with pytest.warns(
        UserWarning, match=r"tetra-27 was prepared with wall_rigidity = 1, not 0\.5: it is not at rest with the new"
    ):
        gm.run(soft)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # units move nothing
        gm.run(gm.replace(soft, material=gm.Material(modulus=1e9)))


def test_a_weight_that_is_taken_off_a_pack_warns(pack: gm.Pack) -> None:
    record = {**pack.info, "recipe": {**pack.info["recipe"], "gravity": 1e-5}}
    heavy = dataclasses.replace(pack, record=json.dumps(record))
    light = gm.Experiment(heavy, two_bumps(jnp.ones((1, 2))), **SHORT)
    with pytest.warns(UserWarning, match=r"tetra-27 was prepared under gravity = 1e-05, not 0\.0"):
        gm.run(light)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gm.run(gm.replace(light, gravity=1e-5))
        gm.run(gm.Experiment(pack, light.signals, gravity=1e-5, **SHORT))  # which sags


def test_single_precision_is_refused(pack: gm.Pack) -> None:
    experiment = gm.Experiment(pack, gm.six_signals())
    for run in (gm.run, gm.recall):
        with jax.enable_x64(False), pytest.raises(ValueError, match="float64 is needed"):
            run(experiment)


@pytest.mark.parametrize("measure", [gm.memory_kernel, gm.kernel_matrix])
def test_single_precision_is_refused_before_a_bump_is_made(pack: gm.Pack, measure: Any) -> None:
    experiment = gm.Experiment(pack, gm.six_signals())
    with jax.enable_x64(False), pytest.raises(ValueError, match="float64 is needed"):
        measure(experiment, n=3, width=0.3)


def test_batches_are_one_run_and_can_be_resumed(pack: gm.Pack, recall: gm.Recall, tmp_path: Path) -> None:
    def some(batch: int, parts: Checkpoints | None = None) -> gm.Recall:
        return gm.run(gm.Experiment(pack, gm.six_signals(), **SHORT), batch=batch, cache=parts or no_cache)

    undisturbed = some(4)
    # A batch's replicas see the same forces in the same order; XLA's vector code differs with their number.
    np.testing.assert_allclose(undisturbed.p_sig, recall.p_sig, atol=1e-6 * float(jnp.abs(recall.p_sig).max()))
    assert undisturbed.status.shape == recall.status.shape == (7,)
    assert undisturbed.stages["readout"].pressure.shape == recall.stages["readout"].pressure.shape

    class KilledError(Exception):
        """In place of a signal that cannot be caught."""

    class Dying(Checkpoints):
        def __call__(self, name: str, run: object) -> object:
            if name == "batch-0001":
                raise KilledError
            return super().__call__(name, run)

    with pytest.raises(KilledError):
        some(4, Dying(tmp_path / "parts", {"batch": 4}))
    left = Checkpoints(tmp_path / "parts", {"batch": 4})
    assert left.finished() == 2
    for one, other in zip(jax.tree.leaves(some(4, left)), jax.tree.leaves(undisturbed), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(gm.FileFormatError, match=r"another batch \(4, now 5\)"):
        Checkpoints(tmp_path / "parts", {"batch": 5})
    left.discard()
    assert not (tmp_path / "parts").exists()


def test_friction_may_differ_between_replicas(pack: gm.Pack) -> None:
    mus = jnp.asarray([1.0, 0.3, 1.0])
    signals = two_bumps(jnp.asarray([[1.0, -0.5], [1.0, -0.5]]))
    mixed = gm.run(gm.Experiment(pack, signals, gm.Hooke(mu=mus), **SHORT))
    alone = gm.run(gm.Experiment(pack, two_bumps(jnp.asarray([[1.0, -0.5]])), gm.Hooke(mu=1.0), **SHORT))
    # The second signal has the zero signal's mu, and so a recall of its own as in a run without the others.
    np.testing.assert_allclose(mixed.p_sig[1], alone.p_sig[0], atol=1e-6 * float(jnp.abs(alone.p_sig).max()))
    assert float(jnp.abs(mixed.p_sig[0] - mixed.p_sig[1]).max()) > 0.1 * float(jnp.abs(alone.p_sig).max())


def test_the_default_batch_fits_the_memory(pack: gm.Pack) -> None:
    def batch(law: object, available: int) -> int:
        return default_batch(gm.Experiment(pack, gm.six_signals(), law), available)

    replica = COPIES * (pack.pairs.capacity * 3 * 8 + GRAIN_BYTES * pack.grains)
    assert batch(gm.Hooke(), 0) == 1
    assert batch(gm.Hooke(), 22 * replica) == 10  # half of it holds 11 replicas, one of them the zero signal
    assert batch(gm.Hooke(), 10**12) == 63
    assert batch(gm.Mindlin(points=100), 220 * replica) < 10 < batch(gm.Hooke(), 220 * replica)
