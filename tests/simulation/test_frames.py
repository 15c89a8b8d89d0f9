"""Configurations along a run: which they are, what is in them, and that taking them changes nothing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.experiment.run import frame_schedule
from gmem_jax.files.frames import load_frames, write_frames
from gmem_jax.files.hdf5 import writing
from gmem_jax.files.schemas import RECALL
from gmem_jax.physics.forces import contact_forces, sphere_table
from gmem_jax.physics.state import Grains, State
from gmem_jax.physics.system import System
from gmem_jax.preparation.preparation import preparation_frames as preparation_schedule
from gmem_jax.simulation.frames import Frames, concatenate, configuration, places

PACK = gm.load_pack(TETRA_27)
TWO = gm.Bumps(jnp.asarray([[1.0, -0.6], [0.3, 1.0]]), jnp.asarray([[0.3, 0.7]] * 2), 0.3)
EXPERIMENT = gm.Experiment(PACK, TWO, gm.Hooke(mu=0.3), t0=75.0, rest=0.05, hold=0.05, store=0.1)
COUNT = 8


@pytest.fixture(scope="module")
def filmed() -> gm.Recall:
    return gm.run(EXPERIMENT, frames=COUNT, frames_of=2)


def frames_of(recall: gm.Recall) -> Frames:
    assert recall.frames is not None
    return recall.frames


def same(one: Any, other: Any) -> None:
    for leaf, its in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(leaf, its)


def test_the_longest_stretch_without_a_frame_is_halved_first() -> None:
    stages = gm.Experiment(PACK, TWO).protocol.stages
    five = places(stages, 5, 32)
    assert five == {"rest": [0], "hold": [52], "encode": [256], "store": [512], "readout": [256]}
    before = {(name, bins) for name in five for bins in five[name]}
    for count in (6, 9, 30, 300):
        found = places(stages, count, 32)
        these = {(name, bins) for name in found for bins in found[name]}
        assert len(these) == count
        assert before <= these
        before = these


@pytest.mark.parametrize("count", [1, 10_000])
def test_too_few_frames_and_more_than_bins_are_refused(count: int) -> None:
    with pytest.raises(ValueError, match=f"for this run; got {count}"):
        frame_schedule(EXPERIMENT, count, 1)
    with pytest.raises(ValueError, match=f"for this recipe; got {count}"):
        preparation_schedule(gm.Recipe(), count)


def test_frames_are_kept_wherever_the_run_passes_a_chosen_compression() -> None:
    frames = frames_of(gm.run(EXPERIMENT, frames_of=2, frames_at=(0.25, 1.0)))
    moments = list(zip(frames.stages, frames.u.round(12).tolist(), strict=True))
    way = {"compress": [0.25, 1.0], "hold": [1.0], "decompress": [0.25]}
    back = {"encode": [0.25, 1.0], "store": [1.0], "readout": [0.25]}
    assert moments == [(stage, u) for stage, all_of_it in (way | back).items() for u in all_of_it]
    assert frames.signal == 2


def test_chosen_compressions_come_beside_a_number_of_frames() -> None:
    both = frame_schedule(EXPERIMENT, 5, 1, (0.0, 0.5)).wanted
    alone = frame_schedule(EXPERIMENT, 5, 1).wanted
    assert all(set(bins) <= set(both[name]) for name, bins in alone.items())
    assert both["encode"] == [128, 256]
    assert both["readout"] == [128, 256]


@pytest.mark.parametrize("u", [-0.1, 1.5, float("nan")])
def test_compressions_that_there_are_not_are_refused(u: float) -> None:
    with pytest.raises(ValueError, match="u goes from 0, not compressed, to 1"):
        frame_schedule(EXPERIMENT, 0, 1, (u,))


def test_frames_of_a_signal_that_there_is_not_are_refused() -> None:
    with pytest.raises(ValueError, match="signals 1 to 2"):
        frame_schedule(EXPERIMENT, 5, 3)


def test_taking_frames_changes_no_other_bit(filmed: gm.Recall) -> None:
    same(replace(filmed, frames=None), gm.run(EXPERIMENT))


def test_the_batch_does_not_matter(filmed: gm.Recall) -> None:
    same(filmed.frames, gm.run(EXPERIMENT, frames=COUNT, frames_of=2, batch=1).frames)


def test_frames_are_what_the_stages_say(filmed: gm.Recall) -> None:
    frames = frames_of(filmed)
    wanted = places(EXPERIMENT.protocol.stages, COUNT, 32)
    assert frames.stages == tuple(name for name in wanted for _ in wanted[name])
    np.testing.assert_array_equal(frames.position[0], PACK.position)
    step = float(filmed.dt) * EXPERIMENT.steps_per_bin
    passed, number = 0, 0
    for stage in EXPERIMENT.protocol:
        sample = filmed.stages[stage.name]
        replica = 2 if sample.pressure.shape[-1] > 1 else 0
        for bins in wanted.get(stage.name, []):
            np.testing.assert_allclose(frames.time[number], (passed + bins) * step, rtol=1e-12)
            u = stage.start + (stage.stop - stage.start) * bins / stage.bins
            np.testing.assert_allclose(frames.u[number], u, atol=1e-15)
            if bins:  # the sample is of the same moment
                lengths = frames.upper[number] - frames.lower[number]
                np.testing.assert_allclose(lengths, sample.lengths[bins - 1][:, replica], rtol=1e-14)
                touching = 0.5 * sample.contacts[bins - 1, replica] * PACK.grains
                assert frames.start[number + 1] - frames.start[number] == round(float(touching))
            number += 1
        passed += stage.bins
    assert number == COUNT


def test_forces_repel_and_keep_to_the_coulomb_limit(filmed: gm.Recall) -> None:
    frames = frames_of(filmed)
    assert np.all(frames.normal_force >= 0.0)
    tangential = np.linalg.norm(frames.friction_force, axis=1)
    assert np.all(tangential <= 0.3 * frames.normal_force * (1.0 + 1e-12))
    assert np.sum(tangential > 0.29 * frames.normal_force) > 10  # and some slide
    for frame in range(1, COUNT):
        spheres, centres = frames.spheres[frames.start[frame] : frames.start[frame + 1]], frames.centres(frame)
        separation = centres[spheres[:, 1]] - centres[spheres[:, 0]]
        own = frames.friction_force[frames.start[frame] : frames.start[frame + 1]]
        distance = np.linalg.norm(separation, axis=1)
        assert np.all(distance < 2.0)
        np.testing.assert_allclose(np.sum(separation * own, axis=1), 0.0, atol=1e-14)


def test_the_forces_of_a_frame_are_those_on_the_spheres() -> None:
    system = System(PACK.clump, gm.Hooke(), PACK.pairs)
    keys = jax.random.split(jax.random.key(0), 3)
    motion = [0.01 * jax.random.normal(key, (PACK.grains, 3, 1)) for key in keys[:2]]
    grains = Grains(PACK.position[..., None], PACK.quaternion[..., None], *motion, *motion)
    history = 1e-3 * jax.random.normal(keys[2], (PACK.pairs.capacity, 3, 1))
    state = State(grains, history, jnp.zeros(1, jnp.int32))
    table, _ = sphere_table(PACK.clump, grains)
    on_spheres, *_ = jax.jit(contact_forces)(system, table, history, jnp.zeros(()), jnp.asarray(True))
    lower, upper = np.asarray(PACK.lower), np.asarray(PACK.upper)
    frames = concatenate({"rest": (configuration(system, state, lower, upper, 0.0, 0.0),)}, PACK.clump)
    centres, (first, second) = frames.centres(0), frames.spheres.T
    normal = centres[second] - centres[first]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    force = frames.friction_force - frames.normal_force[:, None] * normal
    total = np.zeros_like(centres)
    np.add.at(total, first, force)
    np.add.at(total, second, -force)
    np.testing.assert_allclose(total, on_spheres[:, :3, 0], atol=1e-15)


def test_a_file_gives_frames_back(filmed: gm.Recall, tmp_path: Path) -> None:
    gm.save_recall(tmp_path / "recall.h5", filmed)
    for found in (gm.load_recall(tmp_path / "recall.h5").frames, load_frames(tmp_path / "recall.h5")):
        assert found is not None
        same(found, filmed.frames)
        assert (found.stages, found.signal) == (frames_of(filmed).stages, 2)
    gm.save_recall(tmp_path / "none.h5", replace(filmed, frames=None))
    assert load_frames(tmp_path / "none.h5") is None


@pytest.mark.parametrize(
    ("change", "refusal"),
    [
        ({"spheres": lambda a: a + 200}, "must be between spheres of two of its grains"),
        ({"start": lambda a: a[::-1]}, "must follow each other"),
        ({"time": lambda a: a[:-1]}, "has shape"),
        ({"quaternion": lambda a: 2.0 * a}, "not of length 1"),
        ({"normal_force": lambda a: a * np.nan}, "not finite"),
        ({"upper": lambda a: -a}, "lower wall"),
    ],
)
def test_frames_that_cannot_be_are_refused(
    filmed: gm.Recall, tmp_path: Path, change: dict[str, Any], refusal: str
) -> None:
    frames = frames_of(filmed)
    changed = replace(frames, **{name: how(getattr(frames, name)) for name, how in change.items()})

    def keep_and_look() -> None:  # some are seen when they are written
        with writing(tmp_path / "recall.h5", RECALL.name) as file:
            write_frames(file, changed)
        load_frames(tmp_path / "recall.h5")

    with pytest.raises(gm.FileFormatError, match=refusal):
        keep_and_look()
