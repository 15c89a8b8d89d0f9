"""The stages of an experiment: each hold has its own length, bins are whole, and the walls never jump."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.experiment.protocols import memory_protocol
from gmem_jax.experiment.stages import cycle
from gmem_jax.physics.state import replicate, still_box
from gmem_jax.physics.step import start
from gmem_jax.simulation.loop import bin_step, walls
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stage import Stage, table

PACK = gm.load_pack(TETRA_27)
REST, HOLD, STORE = 0.1, 0.3, 0.7
CYCLE = [("rest", 0, 0, REST), ("compress", 0, 1, 1.0), ("hold", 1, 1, HOLD), ("decompress", 1, 0, 1.0)]
FIRST = [*CYCLE, ("rest-2", 0, 0, REST), ("encode", 0, 1, 1.0), ("store", 1, 1, STORE), ("readout", 1, 0, 1.0)]
AGAIN = [("rest-3", 0, 0, REST), ("compress-3", 0, 1, 1.0), ("hold-3", 1, 1, HOLD), ("readout-2", 1, 0, 1.0)]


def written(stages: tuple[Stage, ...]) -> list[tuple[str, float, float, float]]:
    return [(stage.name, stage.start, stage.stop, stage.length) for stage in stages]


def test_rests_holds_and_storage_have_lengths_of_their_own() -> None:
    assert written(cycle(REST, HOLD)) == CYCLE
    assert written(memory_protocol(REST, HOLD, STORE, second_readout=False)) == FIRST
    assert written(memory_protocol(REST, HOLD, STORE, second_readout=True)) == FIRST + AGAIN


def test_only_the_encoding_is_sheared_and_all_before_it_is_common() -> None:
    stages = memory_protocol(REST, HOLD, STORE, second_readout=True)
    assert [stage.name for stage in stages if stage.drives] == ["encode"]
    common, own = stages.phases
    assert written(common + own) == FIRST + AGAIN
    assert own[0].name == "encode"


def test_a_pulse_before_the_compression_takes_the_shear_from_it() -> None:
    protocol = memory_protocol(REST, HOLD, STORE, second_readout=False, shear="before")
    stages = protocol.stages
    assert [stage.name for stage in stages if stage.drives] == ["pulse"]
    assert [stage.name for stage in stages][4:7] == ["rest-2", "pulse", "encode"]
    assert (stages[5].start, stages[5].stop, stages[5].bins) == (0.0, 0.0, 256)
    _, own = protocol.phases
    assert own[0].name == "pulse"


WHOLE_BINS = [(0.0, 1), (1e-6, 1), (0.001, 1), (1 / 256, 1), (0.05, 13), (0.1, 26), (0.2, 52), (0.25, 64)]
WHOLE_BINS += [(0.3, 77), (0.5, 128), (1.0, 256), (2.0, 512)]


@pytest.mark.parametrize(("length", "bins"), WHOLE_BINS)
def test_a_hold_that_is_not_whole_bins_is_rounded_up_to_them(length: float, bins: int) -> None:
    assert Stage("hold", 1.0, 1.0, length).bins == bins


def experiment() -> gm.Experiment:
    """Two steps to a bin; holds of 25.6, 76.8 and 179.2 bins."""
    bumps = gm.Bumps(jnp.asarray([[1.0]]), jnp.asarray([[0.5]]), 0.9)
    return gm.Experiment(
        PACK, bumps, t0=153.6, dt=0.3, rest=REST, hold=HOLD, store=STORE, gamma0=0.02, background="sub2"
    )


def test_the_table_counts_the_bins_of_every_stage_from_zero() -> None:
    stages = experiment().protocol.stages
    rows = table(stages)
    place = 0
    for stage in stages:
        here = slice(place, place + stage.bins)
        np.testing.assert_array_equal(rows.number[here], np.arange(stage.bins))
        assert {*np.asarray(rows.bins)[here]} == {stage.bins}
        assert {*np.asarray(rows.start)[here], *np.asarray(rows.stop)[here]} == {stage.start, stage.stop}
        assert {*np.asarray(rows.amplitudes[0])[here]} == {float(bool(stage.drives))}
        place += stage.bins
    assert place == len(rows.number) == 26 + 256 + 77 + 256 + 26 + 256 + 180 + 256 + 26 + 256 + 77 + 256


def test_the_walls_never_jump_whatever_the_lengths_of_the_holds() -> None:
    one = experiment()
    simulation, rows = one.simulation(sheared=True), table(one.protocol.stages)
    state = replicate(one.begin(), one.replicas)
    boxes = jax.jit(jax.vmap(lambda row: walls(simulation, row, state)[0]))(jax.tree.map(jnp.asarray, rows))
    upper, speed = (np.asarray(leaf).reshape(-1, 3, 2) for leaf in (boxes.upper, boxes.upper_velocity))
    dt = 153.6 / 512
    full = 0.5 * np.asarray(PACK.upper - PACK.lower)
    shrink = 1.0 - np.sqrt(1.0 - float(PACK.delta0))
    # The zero signal: u in every step by hand, from the lengths of the stages alone.
    u = np.concatenate([np.linspace(s.start, s.stop, 2 * s.bins + 1)[1:] for s in one.protocol])
    np.testing.assert_allclose(upper[:, 0, 0], full[0] * (1.0 - shrink * u), rtol=1e-13)
    np.testing.assert_allclose(upper[:, 1, 0], full[1] * (1.0 - shrink * u), rtol=1e-13)
    np.testing.assert_array_equal(upper[:, 2, 0], np.full(len(u), full[2]))
    np.testing.assert_array_equal(speed[np.repeat(rows.start == rows.stop, 2)], 0.0)
    # The sheared one: no step is larger than the fastest wall's, and shear is gone outside the encoding.
    assert np.abs(np.diff(upper[:, :, 1], axis=0)).max() <= 1.01 * dt * np.abs(speed[:, :, 1]).max()
    sheared = np.repeat(np.asarray(rows.amplitudes[0]) != 0.0, 2)
    np.testing.assert_allclose(upper[~sheared, :, 1], upper[~sheared, :, 0], rtol=1e-13)
    assert np.abs(upper[sheared, 0, 1] / upper[sheared, 0, 0] - 1.0).max() == pytest.approx(0.01, rel=1e-3)


def test_drag_acts_in_holds_only() -> None:
    """Grains that touch nothing keep their spins while the walls move, and lose them while the walls stand still."""
    one = replace(experiment(), hold_drag=0.05)
    simulation = one.simulation(sheared=True)
    path = replace(simulation.path, lower=100.0 * simulation.path.lower, upper=100.0 * simulation.path.upper)
    simulation = replace(simulation, path=path)
    state = jax.jit(start)(
        simulation.system,
        10.0 * PACK.position[..., None],
        PACK.quaternion[..., None],
        still_box(path.lower, path.upper),
    )
    state = replicate(replace(state, grains=replace(state.grains, spin=jnp.full_like(state.grains.spin, 0.01))), 2)
    step = jax.jit(bin_step)
    spins = {
        stage.name: float(step(simulation, state, simulation.rows(stage, 0))[0].grains.spin.max())
        for stage in one.protocol
    }
    slowed = {name for name, spin in spins.items() if spin < 0.01 * (1.0 - 1e-3)}
    assert slowed == {stage.name for stage in one.protocol if stage.start == stage.stop}
    assert {spins[name] for name in spins if name not in slowed} == {0.01}


def test_what_is_asked_of_a_protocol_follows_from_roles_and_not_from_names() -> None:
    stages = memory_protocol(REST, HOLD, STORE, second_readout=True).stages
    renamed = Protocol(tuple(replace(stage, name=f"part {number}") for number, stage in enumerate(stages)))
    assert renamed.reads == ("part 7", "part 11")
    assert renamed.before_read == "part 6"
    assert renamed.first_memory == ("part 5", "part 6", "part 7")
    assert [len(phase) for phase in renamed.phases] == [5, 7]
    assert Protocol.from_list(json.loads(json.dumps(renamed.to_list()))) == renamed


def test_a_stage_has_a_role_and_a_length() -> None:
    with pytest.raises(ValueError, match="must be one of condition, write, hold, read"):
        Stage("a", 0.0, 1.0, 1.0, "readout")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"stage 'a': its length must be in \[0, inf\)"):
        Stage("a", 0.0, 1.0, -1.0)
