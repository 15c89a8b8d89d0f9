"""Preparation of a tiny pack: at rest, under its pressure, reproducible."""

import re
from dataclasses import fields
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ELASTIC, SPHERE, column, scene

import gmem_jax as gm
from gmem_jax.files.checkpoints import Checkpoints
from gmem_jax.native.backend import resolve
from gmem_jax.physics.state import still_box
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System
from gmem_jax.preparation.piston import Pressed, Servo, press
from gmem_jax.preparation.preparation import _gas
from gmem_jax.preparation.recipe import SLOWEST_BINS, grain_steps, lattice, pressure_over_wanted, sites_of, stepping
from gmem_jax.preparation.ringing import ringing_period

PRESS = jax.jit(press, static_argnames=("blocks", "backend"))
TINY = gm.Recipe(grains=12, gas_time=500.0, t0=300.0, cycles=1)


@pytest.fixture(scope="module")
def prepared() -> tuple[gm.Pack, dict]:
    log: dict = {}
    return gm.prepare(TINY, gm.sphere(), log=log), log


@pytest.mark.parametrize(
    ("grains", "sites"),
    [
        (325, (5, 5, 13)),
        (1024, (8, 8, 16)),
        (3267, (11, 11, 27)),
        (10240, (16, 16, 40)),
        (31680, (24, 24, 55)),
        (100450, (35, 35, 82)),
    ],
)
def test_lattices_are_those_of_the_paper(grains: int, sites: tuple[int, int, int]) -> None:
    assert lattice(grains) == sites


def test_the_gas_has_the_speeds_and_spins_of_the_recipe_each_at_random() -> None:
    recipe = gm.Recipe(grains=4000, gas_speed=0.03)
    position, quaternion, velocity, spin, lengths = _gas(recipe, gm.sphere())
    for motion in (np.asarray(velocity), np.asarray(spin)):
        # Of 12,000 normal numbers the mean is known to 1 / 110 and the mean square to 1 / 77 of itself: four of these.
        assert np.sqrt(np.mean(np.sum(motion**2, axis=1))) == pytest.approx(0.03, rel=4.0 / 77.0 / 2.0)
        assert np.abs(motion.mean(axis=0)).max() < 4.0 * 0.03 / np.sqrt(3.0 * 4000.0)
        assert np.std(motion, axis=0) == pytest.approx(0.03 / np.sqrt(3.0), rel=4.0 / np.sqrt(2.0 * 4000.0))
    together = np.concatenate([velocity, spin, quaternion], axis=1)
    assert np.abs(np.corrcoef(together.T)[np.triu_indices(10, 1)]).max() < 4.5 / np.sqrt(4000.0)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, rtol=1e-12)
    # A lattice of whole layers, as thin as asked for: nobody touches anybody, or a wall.
    other = _gas(gm.Recipe(grains=4000, gas_speed=0.03, seed=2), gm.sphere())
    assert np.abs(np.asarray(other[2]) - np.asarray(velocity)).max() > 0.01
    assert np.all(position > 1.0)
    assert np.all(position < lengths - 1.0)


def test_the_gas_starts_as_thin_as_the_recipe_says_and_never_thicker_than_grains_that_turn_freely() -> None:
    for grain, filling in ((gm.sphere(), 0.3), (gm.tetra(), 0.2)):
        position, _, _, _, lengths = _gas(gm.Recipe(grains=325, filling=filling), grain)
        sites = np.prod(lattice(325, filling))  # the last layer may have holes
        assert sites * float(grain.mass) / np.prod(lengths) == pytest.approx(filling, rel=1e-12)
        apart = np.linalg.norm(position[:, None] - position, axis=-1)[np.triu_indices(325, 1)]
        assert apart.min() > float(grain.diameter)
    position, _, _, _, _ = _gas(gm.Recipe(grains=325, filling=0.5), gm.tetra())  # too thick for them
    apart = np.linalg.norm(position[:, None] - position, axis=-1)[np.triu_indices(325, 1)]
    assert apart.min() == pytest.approx(1.02 * float(gm.tetra().diameter), rel=1e-12)


def rod(spheres: int, apart: float) -> gm.Clump:
    return gm.clump([[apart * number, 0.0, 0.0] for number in range(spheres)], shape="rod")


@pytest.mark.parametrize("count", [64, 100, 325, 1000])
@pytest.mark.parametrize("grain", [rod(5, 1.6), rod(3, 0.8)], ids=["five", "three"])
def test_long_grains_stand_so_that_their_pressed_pack_will_be_a_cube(grain: gm.Clump, count: int) -> None:
    sites, apart = sites_of(gm.Recipe(grains=count), grain)
    assert np.prod(sites) >= count
    assert apart.min() >= 1.02 * float(grain.diameter) * (1.0 - 1e-12)
    wide, deep, _ = np.asarray(sites) * apart
    assert wide == deep
    assert count * float(grain.mass) / (0.72 * wide**3) == pytest.approx(1.0, rel=1e-12)


def test_grains_that_turn_freely_stand_on_the_cubic_lattice_of_their_number_and_filling() -> None:
    for grain in (gm.sphere(), gm.tetra()):
        for count in (12, 27, 325, 3267):
            sites, apart = sites_of(gm.Recipe(grains=count), grain)
            assert sites == lattice(count, 0.3)
            np.testing.assert_array_equal(apart, (float(grain.mass) / 0.3) ** (1.0 / 3.0))


@pytest.mark.parametrize(
    ("count", "filling", "grain"), [(12, 0.3, rod(5, 1.9)), (12, 0.05, gm.tetra()), (20, 0.3, rod(9, 1.9))]
)
def test_a_pack_that_would_be_flatter_than_its_grains_is_refused_before_it_is_begun(
    count: int, filling: float, grain: gm.Clump
) -> None:
    with pytest.raises(ValueError, match=r"would make a pack of about .* R, flatter than a grain") as refused:
        gm.prepare(grains=count, filling=filling, grain=grain)
    assert "take more grains" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_pack_that_did_not_come_to_rest_goes_on_with_more_patience_to_the_same_bits(
    prepared: tuple[gm.Pack, dict], tmp_path: Path
) -> None:
    def try_with(patience: float) -> gm.Pack:
        return gm.prepare(TINY, gm.sphere(), patience=patience, cache=Checkpoints(tmp_path / "parts", {}))

    with pytest.raises(gm.NotAtRestError, match=r"settle: p_z = .* after 200 t_c; more patience lets it go on"):
        try_with(200.0)
    with pytest.raises(gm.NotAtRestError, match="after 400 t_c"):
        try_with(400.0)
    pack = try_with(TINY.patience)
    for name in ("position", "quaternion", "lower", "upper"):
        np.testing.assert_array_equal(getattr(pack, name), getattr(prepared[0], name))
    assert pack.info["simulated_time"] == prepared[0].info["simulated_time"]


@pytest.mark.filterwarnings("ignore:.*times the wanted")  # the quick way to a last rest
def test_a_last_rest_that_took_too_long_goes_on_with_more_patience(tmp_path: Path) -> None:
    def try_with(patience: float) -> gm.Pack:
        quick = {"settled_speed": 1.0, "pressure_error": 0.5, "quiet": 1e-9}
        return gm.prepare(TINY, gm.sphere(), **quick, patience=patience, cache=Checkpoints(tmp_path / "parts", {}))

    with pytest.raises(gm.NotAtRestError, match=r"rest: largest speed .* more patience lets it go on"):
        try_with(1.0)
    rested = try_with(TINY.patience)
    assert rested.info["at_rest"]["largest_speed"] <= 1e-9


def test_a_pressed_pack_flatter_than_its_grains_is_no_pack() -> None:
    # At 0.3 E spheres are pressed to a filling far above that of a dense pack.
    with pytest.raises(gm.RunFailedError, match=r"flatter than a grain \(2.0 R\); take more grains or less pressure"):
        gm.prepare(TINY, gm.sphere(), pressure=0.3, settled_speed=1.0, pressure_error=0.5)


def test_a_preparation_says_when_another_pressure_is_left_than_was_wanted(prepared: tuple[gm.Pack, dict]) -> None:
    with pytest.warns(UserWarning, match=r"p_z is 0.0001 times the wanted 0.0001 E: cycling by delta0"):
        pack = gm.prepare(TINY, gm.sphere(), grains=20, pressure=1e-4, delta0=0.1, seed=2)
    assert pack.info["at_rest"]["pressure"][2] < 1e-6
    assert pressure_over_wanted(pack.info) < 0.01
    assert 0.8 < pressure_over_wanted(prepared[0].info) < 1.25  # which warned of nothing: warnings are errors here
    assert pressure_over_wanted({"imported": {}}) is None


def test_a_preparation_costs_no_more_when_its_cycles_are_faster() -> None:
    calls: list[float] = []
    pack = gm.prepare(TINY, gm.sphere(), t0=1.0, progress=lambda _, time, __: calls.append(time))
    assert pack.info["at_rest"]["largest_speed"] <= TINY.quiet
    assert len(calls) < 1000  # pieces of 0.2 t_c, or steps of t0 / 256, would be tens of thousands
    usual = grain_steps(gm.Recipe(grains=27), gm.tetra())
    for t0 in (100.0, 1.0, 1e-3):
        assert grain_steps(gm.Recipe(grains=27, t0=t0), gm.tetra()) < usual


def test_the_estimate_of_a_preparation_counts_what_its_stages_do() -> None:
    """One thread took 2.6, 7.8 and 7.1 s of CPU time for these: the command allows 0.2 us for a grain-step."""
    for grains, t0, seconds in ((16, 1.0, 2.6), (64, 1800.0, 7.8), (250, 600.0, 7.1)):
        assert 0.2e-6 * grain_steps(gm.Recipe(grains=grains, t0=t0), gm.tetra()) == pytest.approx(seconds, rel=0.5)
    long = 0.2e-6 * grain_steps(gm.Recipe(grains=64), rod(5, 1.6))
    assert long > 30.0  # they fall from a height of 550 R


def pressed(error: float = 0.0, flight: float = 0.0, **servo: float) -> Pressed:
    """One block of a servo on a sphere that is held between floor and piston, and flies along x at `flight`.

    The pressure is the target times 1 + `error`.
    """
    overlap, area = 0.01, 100.0
    force = ELASTIC.wall_stiffness * overlap**1.5
    box = still_box(column([-5.0, -5.0, -1.0 + overlap]), column([5.0, 5.0, 1.0 - overlap]))
    system, state, _ = scene(SPHERE, [[0.0, 0.0, 0.0]], velocity=[[flight, 0.0, 0.0]], material=ELASTIC, box=box)
    no = jnp.asarray(False)
    now = Pressed(state, box, jnp.asarray([force / area]), jnp.asarray(0), no, no)
    numbers = {"target": force / area / (1.0 + error), "speed": 0.0, "gain": 0.005, "error": 0.01, "quiet": 1e-5}
    return PRESS(
        system, now, Servo(**numbers | servo), 0.3, 0.0, blocks=1, backend=resolve("jax", "double", system.friction)
    )


@pytest.mark.parametrize(
    ("error", "speed", "settled"),
    [
        (0.0, 0.0, True),
        (0.0099, 0.0, True),
        (0.0101, 0.0, False),
        (-0.0099, 0.0, True),
        (-0.0101, 0.0, False),
        (0.0, 0.99e-5, True),
        (0.0, 1.01e-5, False),
    ],
)
def test_the_piston_has_settled_when_pressure_and_speed_are_both_within_their_bounds(
    error: float, speed: float, settled: bool
) -> None:
    assert bool(pressed(error, speed).settled) is settled
    assert not bool(pressed(error, speed, quiet=0.0).settled)


def test_the_piston_moves_with_the_error_of_the_pressure_at_most_at_its_speed() -> None:
    for error in (-0.5, -0.1, 0.2, 3.0):
        after = pressed(error, speed=0.002)
        moved = float(after.box.upper[2, 0] - 0.99)
        assert moved == pytest.approx(8 * 0.3 * np.clip(0.005 * error, -0.002, 0.002), rel=1e-9)
        np.testing.assert_array_equal(after.box.lower[:, 0], [-5.0, -5.0, -0.99])


def test_a_pack_ends_at_rest_under_its_pressure(prepared: tuple[gm.Pack, dict]) -> None:
    pack, log = prepared
    rest = pack.info["at_rest"]
    assert rest["largest_speed"] <= TINY.quiet
    # p_z was met to 1 % before the cycles; they move it, but not by an order of magnitude.
    assert 0.2e-3 < rest["pressure"][2] < 2e-2
    assert list(log) == ["cycle 1: rest", "cycle 1: compress", "cycle 1: hold", "cycle 1: decompress", "rest"]
    first = log["cycle 1: rest"]
    # The piston was fixed at 1 % and hardly a grain moving; at the end of the first bin, four steps later, its own last
    # speed, 1 % of its gain, may have gone into a grain.
    np.testing.assert_allclose(first.pressure[0, 2, 0], TINY.pressure, rtol=1.2 * TINY.pressure_error)
    assert first.largest_speed[0, 0] < TINY.settled_speed + TINY.piston_gain * TINY.pressure_error


@pytest.mark.slow
def test_a_pack_that_was_prepared_under_gravity_is_at_rest_under_it() -> None:
    g = 1e-4
    pack = gm.prepare(TINY, gm.sphere(), gravity=g)

    def fastest(gravity: float | None) -> float:
        system = System(pack.clump, gm.Hooke(), pack.pairs, gm.Material(), gravity)
        state = start(system, pack.position[..., None], pack.quaternion[..., None], pack.box)
        return float(jnp.abs(state.grains.acceleration).max())

    # What is left of forces at rest is what moves grains by 1e-6 R / t_c (`Recipe.quiet`) within some 10 t_c.
    assert fastest(g) < 1e-2 * g
    assert fastest(None) > 0.9 * g
    assert pack.info["recipe"]["gravity"] == g
    system = System(pack.clump, gm.Hooke(), pack.pairs, gm.Material(), g)
    at_rest = pack.position[..., None], pack.quaternion[..., None], pack.box
    steps = stepping(max(TINY.t0, SLOWEST_BINS), TINY.dt)[1]
    np.testing.assert_allclose(pack.ringing_period, ringing_period(system, *at_rest, steps), rtol=1e-3)


def test_a_pack_is_centred_with_all_spheres_inside(prepared: tuple[gm.Pack, dict]) -> None:
    pack, _ = prepared
    np.testing.assert_allclose(pack.lower, -pack.upper, atol=1e-12)
    assert np.all(np.abs(np.asarray(pack.position)) < np.asarray(pack.upper))
    filling = 12 * float(pack.clump.mass) / float(np.prod(np.asarray(pack.upper - pack.lower)))
    np.testing.assert_allclose(filling, pack.info["at_rest"]["filling"], rtol=1e-12)


def test_the_ringing_period_is_that_of_a_box_of_this_size(prepared: tuple[gm.Pack, dict]) -> None:
    pack, _ = prepared
    longest = float(np.max(np.asarray(pack.upper - pack.lower)))
    # Waves travel at 0.2 to 0.8 R/t_c at these pressures, and the mode is one box long.
    assert longest < float(pack.ringing_period) < 6.0 * longest


def test_the_same_seed_gives_the_same_pack_bit_for_bit_and_another_another(prepared: tuple[gm.Pack, dict]) -> None:
    pack, _ = prepared
    again, other = gm.prepare(TINY, gm.sphere()), gm.prepare(TINY, gm.sphere(), seed=2)
    np.testing.assert_array_equal(pack.position, again.position)
    assert np.max(np.abs(np.asarray(pack.position - other.position))) > 0.1


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"grains": 0}, "grains must be at least 12"),
        ({"dt": 0.6}, "dt must be in"),
        ({"delta0": 0.0}, "delta0 must be in"),
        ({"filling": 0.9}, "filling must be in (0, 0.6), got 0.9"),
        ({"t0": -1.0}, "t0 must be in (0, inf) t_c, got -1"),
        ({"cycles": -1}, "cycles must be in [0, 1000], got -1"),
        ({"rest": -1.0}, "rest must be in [0, inf) t0, got -1"),
        ({"hold": float("nan")}, "hold must be in [0, inf) t0, got nan"),
        ({"pressure_error": 0.0}, "pressure_error must be in (0, inf), got 0"),
        ({"patience": -1.0}, "patience must be in (0, inf) t_c, got -1"),
        ({"seed": -1}, "seed must be in [0, 9007199254740991], got -1"),
        ({"seed": 2**63}, "seed must be in [0, 9007199254740991], got 9223372036854775808"),
        ({"grains": 64.5}, "grains must be a whole number in [12, inf), got 64.5"),
        ({"cycles": True}, "cycles must be a whole number in [0, 1000], got True"),
        ({"pressure": "2 kPa"}, "pressure must be a number in (0, inf), got '2 kPa'"),
        ({"gravity": 1e-5, "boundary": "periodic"}, "gravity acts along z, and a box that is periodic there has no"),
        ({"pressure": float("inf")}, "pressure must be in (0, inf) E, got inf"),
    ],
)
def test_impossible_recipes_are_refused(bad: dict, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        gm.Recipe(**bad)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"friction": gm.Hooke}, "friction must be a friction law, got the class Hooke"),
        ({"grain": "tetra"}, "grain must be a grain, as gm.tetra(0.6); got 'tetra'"),
        ({"material": 1e7}, "material must be a gm.Material; got 10000000.0"),
        ({"log": []}, "log must be a dictionary to fill, got []"),
        ({"frames": 6}, "frames go into film: give a list for them"),
    ],
)
def test_what_a_preparation_cannot_use_is_refused_before_it_is_begun(wrong: dict, words: str) -> None:
    def told(*_: object) -> None:
        pytest.fail("it was begun")

    with pytest.raises(ValueError, match=re.escape(words)):
        gm.prepare(grains=27, t0=60.0, progress=told, **wrong)


def test_a_pack_that_takes_long_to_settle_is_not_said_to_be_finished() -> None:
    told: list[tuple[str, float]] = []
    slow = gm.Recipe(grains=27, t0=60.0, seed=3, settled_speed=1e-9, drag=5e-4)
    gm.prepare(slow, progress=lambda stage, _, fraction: told.append((stage, fraction)))
    settling = [fraction for stage, fraction in told if stage == "settle"]
    assert len(settling) > 20
    assert max(settling) < 0.95  # the cycles come after it
    assert sorted(told, key=lambda at: at[1]) == told


@pytest.mark.parametrize("wrong", ["open", "periodic,walls", 3, None])
def test_a_boundary_is_walls_or_periodic(wrong: object) -> None:
    assert gm.Recipe(boundary=("periodic", "walls", "walls")).boundary == "periodic,walls,walls"
    with pytest.raises(ValueError, match="boundary must be walls or periodic"):
        gm.Recipe(boundary=wrong)


def test_every_number_of_a_recipe_says_what_it_means_and_where_it_must_lie() -> None:
    for entry in fields(gm.Recipe):
        assert entry.name in ("sizes", "shares", "boundary") or entry.metadata["interval"].holds(entry.default)
        assert entry.metadata["words"]
        assert f"        {entry.name}: " in str(gm.Recipe.__doc__)


def test_single_precision_is_refused() -> None:
    with jax.enable_x64(False), pytest.raises(ValueError, match="float64 is needed"):
        gm.prepare(TINY)
