"""The host loop: lists that go stale are rebuilt and the chunk redone, broken runs stop, progress and warnings."""

import re
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Grains, State, Status, combined_status, still_box
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System
from gmem_jax.simulation import stability
from gmem_jax.simulation.loop import Simulation
from gmem_jax.simulation.observers import Chunk, Observer
from gmem_jax.simulation.progress import work_of
from gmem_jax.simulation.runner import Runner
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.stage import Stage
from gmem_jax.simulation.strain import StrainPath

PACK = gm.load_pack(TETRA_27)
AT, TURNED = PACK.position[..., None], PACK.quaternion[..., None]


COMPRESS = Stage("compress", 0.0, 1.0, 64 / 256)


def compress(skin: float, **settings: object) -> tuple[Runner, np.ndarray]:
    """A frictional compression of the 27-grain pack on lists of this skin; the runner and the wall pressures."""
    box = PACK.box
    still = start(System(PACK.clump, gm.Hooke(), PACK.pairs), AT, TURNED, box)
    finder = PairFinder(PACK.clump, np.asarray(box.lengths)[:, 0], skin)
    system = System(PACK.clump, gm.Hooke(), finder(still.grains, PACK.clump, box))
    simulation = Simulation(system, StrainPath(box.lower, box.upper, 0.05), 0.3, steps=2)
    runner = Runner(simulation, start(system, AT, TURNED, box), finder=finder, skin=skin, **settings)
    return runner, np.asarray(runner.run_stages(COMPRESS)["compress"].pressure)


# 0.12 R beyond the contacts of an uncompressed box does not survive the affine strain of 2.5 %; of 0.01 R nothing is
# left after a bin or two, and a chunk that stood on such a list would miss contacts.
@pytest.mark.parametrize("skin", [0.12, 0.01])
def test_a_list_that_goes_stale_is_rebuilt_and_its_chunk_redone_with_the_same_result(skin: float) -> None:
    wide, expected = compress(0.8)
    narrow, found = compress(skin)
    assert wide.rebuilds == 0
    assert narrow.rebuilds >= 1
    # The same contacts in the same order; only sums over a wider padded table may round differently.
    np.testing.assert_allclose(found, expected, rtol=1e-9)


# Two spheres, 10 R apart, fly by 2 R in a bin: their list needs a skin of 4 R.
@pytest.mark.parametrize(("speed", "whole"), [(0.05, True), (0.2, False)])
def test_grains_that_fly_far_in_a_long_bin_break_a_run_only_if_they_are_fast(speed: float, whole: bool) -> None:
    clump, half = gm.sphere(), jnp.full((3, 1), 20.0)
    at = jnp.asarray([[-5.0, 0.0, 0.0], [5.0, 0.0, 0.0]])[..., None]
    turned = jnp.asarray([[1.0, 0.0, 0.0, 0.0]] * 2)[..., None]
    box, still = still_box(-half, half), jnp.zeros_like(at)
    grains = Grains(at, turned, jnp.full_like(at, speed / np.sqrt(3.0)), still, still, still)
    system = System(clump, gm.Frictionless(), PairFinder(clump, np.full(3, 40.0), 0.3)(grains, clump, box))
    simulation = Simulation(system, StrainPath(-half, half, 0.05), 2.0 / (speed * 200), steps=200)
    runner = Runner(simulation, replace(start(system, at, turned, box), grains=grains))
    rest = Stage("rest", 0.0, 0.0, 1 / 256, "hold")
    if not whole:
        with pytest.raises(gm.RunFailedError, match="rest: grains moved by most of R within one bin"):
            runner.run_stages(rest)
        return
    runner.run_stages(rest)
    np.testing.assert_allclose(runner.state.grains.position, at + 2.0 / np.sqrt(3.0), rtol=1e-9)
    assert runner.skin > 4.0


class Counted(Observer):
    """Counts the chunks that were run and those that stand."""

    def __init__(self) -> None:
        self.done = self.stand = 0

    def step(self, chunk: Chunk) -> None:
        self.done += 1

    def commit(self, chunk: Chunk, state: State, sample: Sample) -> None:
        self.stand += 1


# The affine strain uses up 0.12 R steadily, so that what the last chunk took foretells the next one.
def test_a_runner_that_foresees_throws_no_chunk_away() -> None:
    _, expected = compress(0.8)
    late, early = Counted(), Counted()
    compress(0.12, chunk=2, observers=(late,))
    runner, found = compress(0.12, chunk=2, observers=(early,), foresees=True)
    assert late.done > late.stand == 32
    assert early.done == early.stand == 32
    assert 1 <= runner.rebuilds <= 8
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_result_does_not_depend_on_the_length_of_a_chunk() -> None:
    _, expected = compress(0.8)
    for chunk in (1, 5):
        _, found = compress(0.8, chunk=chunk)
        np.testing.assert_array_equal(found, expected)


def test_a_broken_run_stops_and_names_the_stage() -> None:
    runner, _ = compress(0.8)
    position = runner.state.grains.position.at[0, 0, 0].set(jnp.nan)
    runner.state = replace(runner.state, grains=replace(runner.state.grains, position=position))
    with pytest.raises(gm.RunFailedError, match=r"doomed: .*not a finite number"):
        runner.run_stages(Stage("doomed", 0.0, 0.0, 1 / 256))


def test_progress_rises_to_one_and_names_the_stage() -> None:
    calls: list[tuple[str, float, float]] = []
    compress(0.8, progress=lambda *told: calls.append(told), total_work=work_of([COMPRESS], 1), chunk=16)
    assert [name for name, _, _ in calls] == ["compress"] * 4
    np.testing.assert_allclose([fraction for _, _, fraction in calls], [0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(calls[-1][1], 64 * 2 * 0.3)


def test_every_status_bit_has_a_sentence() -> None:
    assert gm.explain(0) == gm.explain(np.zeros(3, int)) == "ok"
    one, other = Status.RINGING, Status.RESTLESS  # of two replicas of a run
    assert gm.explain(jnp.asarray([int(one), 0, int(other)])) == gm.explain(one | other)
    for bit in Status:
        assert ";" in gm.explain(int(bit))
        assert "use" in gm.explain(int(bit)) or "allocate" in gm.explain(int(bit))
    assert not Status.NOT_AT_REST.fatal
    assert (Status.NOT_AT_REST | Status.STALE_PAIRS).fatal


NAMED = re.compile(r"\b(gm\.\w+|[a-z]+_[a-z_]+|[a-z]+0|dt|steps|store|mu|stiffness|precision|friction)\b")


def test_the_sentences_name_options_that_there_are() -> None:
    experiment = gm.Experiment(PACK, gm.six_signals(), gm.Mindlin())
    seen = set()
    for bit in Status:
        text = gm.explain(int(bit))
        assert "skin" not in text
        remedy = text.partition("; ")[2]
        for name in NAMED.findall(remedy):
            seen.add(name)
            owners = (experiment, experiment.friction, experiment.material, gm)
            assert any(hasattr(owner, name.removeprefix("gm.")) for owner in owners), f"{bit.name}: {name}"
    assert {"gm.run", "dt", "steps", "t0", "store", "hold_drag", "p_max", "gamma0", "delta0", "mu"} <= seen


UNSTABLE = {
    "material.wall_rigidity": {"material": gm.Material(wall_rigidity=1e9)},
    "material.normal_damping": {"material": gm.Material(normal_damping=1e9)},
}
FAST = {"t0": 60.0, "rest": 0.02, "hold": 0.02, "store": 0.02}


@pytest.mark.filterwarnings("ignore:tetra-27 was prepared with")
@pytest.mark.parametrize("name", UNSTABLE)
def test_a_run_that_broke_names_the_number_that_made_its_steps_unstable(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = gm.Experiment(PACK, gm.words(1), **FAST, **UNSTABLE[name])
    with pytest.raises(ValueError, match=rf"below 0\.1 t_c; {name} = 1e\+09 makes steps beyond .* unstable"):
        gm.run(experiment)
    monkeypatch.setattr("gmem_jax.experiment.run.require_stable", lambda _: None)
    words = rf"rest: grains moved by most of R within one bin: {name} = 1e\+09 makes steps beyond .* unstable"
    with pytest.raises(gm.RunFailedError, match=words):
        gm.run(experiment)


SOFTER = {  # other numbers, other laws, and one replica alone
    "material.wall_rigidity": {"material": gm.Material(wall_rigidity=400.0)},
    "material.normal_damping": {"material": gm.Material(normal_damping=200.0), "friction": gm.Frictionless()},
    "friction.stiffness": {"friction": gm.Mindlin(stiffness=jnp.asarray([0.6, 400.0, 0.6]))},
    "friction.damping_time": {"friction": gm.MindlinRescaled(damping_time=jnp.asarray([0.069, 190.0, 0.069]))},
}


@pytest.mark.parametrize("name", SOFTER)
def test_the_number_that_makes_steps_unstable_is_found_by_any_law_and_in_any_replica(name: str) -> None:
    sound = gm.Experiment(PACK, gm.words(1), dt=0.5)
    assert stability.cause(sound.simulation(sheared=True)) == ""
    told = stability.cause(gm.replace(sound, **SOFTER[name]).simulation(sheared=True))
    assert re.match(rf"{name} = [\d.]+ makes steps beyond 0\.\d+ t_c unstable, and dt is 0\.\d+; use a smaller", told)


@pytest.mark.filterwarnings("ignore:tetra-27 was prepared with")
def test_a_run_that_broke_for_no_number_that_is_known_says_what_to_try(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gmem_jax.experiment.run.require_stable", lambda _: None)
    stiff = gm.Experiment(PACK, gm.words(1), material=gm.Material(poisson=-0.9999), **FAST)
    with pytest.raises(gm.RunFailedError, match="one bin: the steps are unstable; use a smaller dt, or check pack"):
        gm.run(stiff)


def test_a_step_that_is_too_large_for_one_of_several_traced_rates_is_told_of_that_alone() -> None:
    experiment = gm.Experiment(PACK, gm.words(1), t0=100.0, steps=1, rest=0.01, hold=0.01, store=0.01)
    bits = jax.vmap(lambda t0: gm.replace(experiment, t0=t0).begin().status)(jnp.asarray([511.9, 512.1]))
    assert (np.asarray(bits) & int(Status.STEP_TOO_LARGE) > 0).all(axis=1).tolist() == [False, True]
    assert (np.asarray(bits) & int(Status.STEP_TOO_LARGE) > 0).any(axis=1).tolist() == [False, True]


def test_a_run_in_sound_steps_has_no_cause() -> None:
    for law in (gm.Hooke(), gm.Mindlin(), gm.Frictionless()):
        assert stability.cause(gm.Experiment(PACK, gm.words(1), law, dt=0.5).simulation(sheared=True)) == ""
    for by, numbers in {"stiffness": {"stiffness": 1e9}, "damping_time": {"damping_time": 1e9}}.items():
        course = gm.Experiment(PACK, gm.words(1), gm.Hooke(**numbers)).simulation(sheared=True)
        assert stability.cause(course).startswith(f"friction.{by} = 1e+09 makes steps")


@pytest.mark.parametrize("ways", ["p_max", "own"])
def test_an_overlap_beyond_the_law_is_told_as_that(ways: str) -> None:
    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Shallow(gm.Hooke):
        largest_overlap = 0.01

    law = gm.Mindlin(p_max=0.01, points=5) if ways == "p_max" else Shallow()
    with pytest.raises(gm.RunFailedError, match="an overlap exceeded what the friction law covers; use a larger p_max"):
        gm.run(gm.Experiment(PACK, gm.words(1), law, **FAST))


def test_a_traced_recall_tells_a_stale_list_from_a_grain_outside_and_a_step_too_long() -> None:
    experiment = gm.Experiment(PACK, gm.words(1), **FAST)
    recall = jax.jit(lambda position, t0: gm.recall(gm.replace(experiment, {"pack.position": position, "t0": t0})))

    def said(position: jax.Array, t0: float = 60.0) -> str:
        return gm.explain(combined_status(recall(position, t0).status))

    assert "gm.run renews the list" in said(PACK.position.at[0].add(0.2))
    assert "a grain left the box" in said(PACK.position.at[0, 2].add(20.0))
    assert "is not a finite number" in said(PACK.position.at[0, 2].set(jnp.nan))
    assert "the time step, t0 / (256 steps), exceeds 2 t_c; use more steps" in said(PACK.position, 600.0)


def test_only_while_the_walls_stand_still_is_there_a_drag() -> None:
    """Bit for bit: a drag of zero is none."""

    def pressures(drag: float) -> dict[str, np.ndarray]:
        simulation = Simulation(
            System(PACK.clump, gm.Hooke(), PACK.pairs), StrainPath(PACK.box.lower, PACK.box.upper, 0.05), 0.3, drag
        )
        runner = Runner(simulation, start(simulation.system, AT, TURNED, PACK.box))
        played = runner.run_stages(Stage("compress", 0.0, 1.0, 16 / 256), Stage("hold", 1.0, 1.0, 16 / 256))
        return {name: np.asarray(sample.pressure) for name, sample in played.items()}

    free, damped = pressures(0.0), pressures(0.01)
    np.testing.assert_array_equal(damped["compress"], free["compress"])
    assert np.abs(damped["hold"] - free["hold"]).max() > 1e-3 * np.abs(free["hold"]).max()
