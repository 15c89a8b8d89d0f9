"""Runs that are killed at any of their checkpoints go on to the same bits."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import PERIODIC_27, TETRA_27, with_skin

import gmem_jax as gm
from gmem_jax.derivatives.gradient import value_and_grad
from gmem_jax.errors import RunFailedError
from gmem_jax.files import checkpoints
from gmem_jax.files.checkpoints import Checkpoints
from gmem_jax.simulation.checkpoints import Checkpoint, ResultCache, no_cache

PACK = TETRA_27
SHORT = {"t0": 75.0, "rest": 0.05, "hold": 0.05, "store": 0.1}
ONE = gm.Bumps(jnp.asarray([[1.0, -0.6]]), jnp.asarray([[0.3, 0.7]]), 0.3)


class KilledError(Exception):
    """In place of a signal that cannot be caught."""


class Deadly(Checkpoints):
    """Checkpoints of a run that dies at one of its checkpoints, once that is written."""

    def __init__(self, folder: Path, after: int) -> None:
        super().__init__(folder, {})
        self.left = after

    def __call__(self, name: str, run: Callable[[Checkpoint], Any]) -> Any:
        def deadly(checkpoint: Checkpoint) -> Any:
            maybe_save = checkpoint.maybe_save

            def die(state: Callable[[], Any], *, milestone: bool = False) -> None:
                maybe_save(state, milestone=milestone)
                self.left -= 1
                if self.left == 0:
                    raise KilledError

            checkpoint.maybe_save = die  # type: ignore[method-assign]
            return run(checkpoint)

        return super().__call__(name, deadly)


@pytest.fixture(autouse=True)
def _at_every_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoints, "CHECKPOINT_INTERVAL", 0.0)
    monkeypatch.setattr(checkpoints, "AT_MILESTONES", 0.0)


def _same(run: Callable[[ResultCache], Any], folder: Path, deaths: list[int]) -> None:
    """Dying several times in one run, each time so many checkpoints after it went on, changes no bit."""
    for after in deaths:
        with pytest.raises(KilledError):
            run(Deadly(folder, after))
    assert Checkpoints(folder, {}).begun() == 1
    resumed = jax.tree.leaves(run(Checkpoints(folder, {})))
    for one, other in zip(resumed, jax.tree.leaves(run(no_cache)), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "law",
    [pytest.param(gm.Hooke(), id="H"), pytest.param(gm.Mindlin(points=20), id="M2", marks=pytest.mark.slow)],
)
def test_a_run_goes_on_with_the_lists_it_had(law: Any, tmp_path: Path) -> None:
    pack = with_skin(gm.load_pack(PACK), 0.02)  # its lists are made anew on the way
    experiment = gm.Experiment(pack, ONE, law, **SHORT)
    _same(lambda cache: gm.run(experiment, cache=cache, frames=8), tmp_path / "parts", [3, 9, 11])


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param({"grains": 12}, id="walls"),
        # Some seeds of so few spheres lose their pressure in the cycles, which is warned of; on either backend.
        pytest.param({"grains": 56, "boundary": "periodic", "seed": 6}, id="periodic", marks=pytest.mark.slow),
    ],
)
def test_a_preparation_goes_on(changes: dict[str, Any], tmp_path: Path) -> None:
    recipe = gm.Recipe(**{"gas_time": 500.0, "t0": 300.0, "cycles": 1, **changes})

    def run(cache: ResultCache) -> Any:
        log: dict = {}
        film: list = []
        pack = gm.prepare(recipe, gm.sphere(), cache=cache, log=log, frames=9, film=film)
        record = {name: value for name, value in pack.info.items() if name in ("rebuilds", "simulated_time")}
        return dataclasses.replace(pack, record="{}"), log, record, film

    _same(run, tmp_path / "parts", [2, 5, 40, 60])  # in the gas, twice, the cycles, the last rest


@pytest.mark.slow
def test_the_way_back_goes_on(tmp_path: Path) -> None:
    experiment = gm.Experiment(with_skin(gm.load_pack(PACK), 0.02), ONE, **SHORT)

    def run(cache: ResultCache) -> Any:
        def both(checkpoint: Checkpoint) -> Any:
            found = value_and_grad(experiment, ["friction.mu", "gamma0"], checkpoint=checkpoint)
            return found.value, found.slope["friction.mu"], found.slope["gamma0"]

        return cache("gradient", both)

    _same(run, tmp_path / "parts", [4, 6, 17])


@pytest.mark.slow
def test_a_design_goes_on(tmp_path: Path) -> None:
    experiment = gm.Experiment(gm.load_pack(PACK), ONE, **SHORT)

    def run(cache: ResultCache) -> Any:
        found = gm.design_waveforms(experiment, iterations=1, n=3, width=0.3, cache=cache)
        return found.signals, found.p_sig, jnp.asarray(found.history)

    _same(run, tmp_path / "parts", [20, 30])


def test_a_damaged_checkpoint_gives_way_to_the_one_before(tmp_path: Path) -> None:
    folder = tmp_path / "parts"
    experiment = gm.Experiment(gm.load_pack(PACK), ONE, **SHORT)
    with pytest.raises(KilledError):
        gm.run(experiment, cache=Deadly(folder, 6))
    (newest,) = folder.glob("*.now")
    newest.write_bytes(newest.read_bytes()[:-100])
    one, other = gm.run(experiment, cache=Checkpoints(folder, {})), gm.run(experiment)
    np.testing.assert_array_equal(one.p_sig, other.p_sig)


def test_a_run_that_failed_leaves_nothing_to_go_on_from(tmp_path: Path) -> None:
    kept = Checkpoints(tmp_path / "parts", {})

    def fail(checkpoint: Checkpoint) -> None:
        checkpoint.maybe_save(lambda: np.zeros(3), milestone=True)
        assert kept.begun() == 1
        raise RunFailedError

    with pytest.raises(RunFailedError):
        kept("part", fail)
    assert kept.begun() == kept.finished() == 0
    Checkpoints(tmp_path / "parts", {"with": "another key"})


@pytest.mark.parametrize("source", [TETRA_27, PERIODIC_27], ids=["walls", "periodic"])
def test_a_protocol_of_ones_own_goes_on_to_the_same_bits(source: Path, tmp_path: Path) -> None:
    """Held walls, two channels, shaking, a mark and an observer: all of it is in a checkpoint."""
    pack = with_skin(gm.load_pack(source), 0.05) if source == PERIODIC_27 else gm.load_pack(source)
    sets = gm.signals(xy=ONE, z=gm.Bumps(-ONE.amplitudes, ONE.centres + 0.1, ONE.width))
    protocol = gm.Protocol(
        gm.compress(0.5, 0.2),
        gm.compress(0.0, 0.2),
        gm.write(length=0.3),
        gm.shake(0.5, 2, length=0.1, channel="z"),
        gm.hold(0.2, pressure=(None, None, 3e-3), mark=True),
        gm.read("half", to=0.5, length=0.2),
        gm.read("whole", length=0.2),
    )
    watched = {"nonaffine": gm.observables.nonaffine(), "made": gm.observables.contacts_made()}
    experiment = gm.Experiment(pack, sets, protocol=protocol, observe=watched, t0=100.0)
    _same(lambda cache: gm.run(experiment, cache=cache), tmp_path / "parts", [2, 4, 6])
