"""Periodic boxes: images, the motion of the cell, and the pressure without walls, against what is known of them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ELASTIC, SPHERE, cached_tetra, make_grains, orientations

from gmem_jax.physics import step as dynamics
from gmem_jax.physics.boundary import WALLS, boundary_of, periodic_axes
from gmem_jax.physics.census import overlaps
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.pairs import listed_candidates, sphere_centres
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Box, State, still_box
from gmem_jax.simulation import observables
from gmem_jax.simulation.loop import Simulation
from gmem_jax.simulation.sample import end_bin
from gmem_jax.simulation.stage import Bin
from gmem_jax.simulation.strain import StrainPath

PERIODIC = (True, True, True)
EDGES = np.array([7.4, 7.6, 7.8])
GRAINS = 27
GAUSS = np.random.default_rng(3)
PLACES = ((np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) / 3.0) * EDGES
VELOCITY, SPIN = (0.01 * GAUSS.normal(size=(GRAINS, 3)) for _ in range(2))
RATE = np.array([-2e-4, 3e-4, -1e-4])  # strain rates of the cell, 1 / t_c


def cell(edges=EDGES, periodic=PERIODIC, origin=0.0) -> Box:
    """A box at rest."""
    lower = jnp.full((3, 1), origin)
    return still_box(lower, lower + jnp.asarray(edges)[:, None], periodic)


def packed(shift=0.0, *, friction=None, material=None, box=None, skin=1.0) -> tuple[dynamics.System, State, Box]:
    """27 tetrahedra that move and press on each other in a periodic box, all shifted by a vector."""
    box = cell() if box is None else box
    grains = make_grains(PLACES + shift, orientations(GRAINS), VELOCITY - VELOCITY.mean(axis=0), SPIN)
    pairs = PairFinder(cached_tetra(), EDGES, skin)(grains, cached_tetra(), box)
    given = {} if material is None else {"material": material}
    system = dynamics.System(cached_tetra(), Hooke() if friction is None else friction, pairs, **given)
    state = dynamics.start(system, grains.position, grains.quaternion, box)
    return system, dynamics.accelerate(system, replace(state, grains=grains), box), box


def strained(box: Box, steps: int, dt: float, rate=RATE) -> Box:
    """A box whose edges grow steadily about its centre, at the end of each step."""
    times = dt * (1.0 + np.arange(steps))[:, None, None]
    centre, half = 0.5 * (box.lower + box.upper), 0.5 * box.lengths
    grown, speed = half * (1.0 + rate[:, None] * times), half * rate[:, None]
    wide = jnp.broadcast_to(speed, (steps, 3, 1))
    return Box(centre - grown, centre + grown, -wide, wide, box.periodic)


march = jax.jit(dynamics.march)
STEPS, DT = 200, 0.3


def simulation_of(system: dynamics.System, box: Box) -> Simulation:
    """What observers look at, in a box."""
    path = StrainPath(box.lower, box.upper, 0.0, periodic=box.periodic)
    return Simulation(system, path, DT, backend="jax", box=box)


@pytest.mark.parametrize("periodic", [PERIODIC, (True, False, True)], ids=["all axes", "x and z"])
@pytest.mark.parametrize("lengths", [(9.0, 8.0, 7.5), (14.0, 13.0, 15.0)], ids=["few cells", "cells"])
def test_the_list_holds_every_pair_of_nearest_images_in_reach_and_says_which(periodic, lengths) -> None:
    lengths, clump = np.array(lengths), cached_tetra()
    place = np.random.default_rng(0).uniform(-20.0, 20.0, (60, 3))
    place = np.where(periodic, place, place % (lengths - 2.0) + 1.0)
    grains, box = make_grains(place, orientations(60)), cell(lengths, periodic)
    finder, grain = PairFinder(clump, 1.2 * lengths, 0.5), np.arange(240) // 4
    for shrink in (1.0, 0.95, 0.8):
        pairs = finder(grains, clump, box, shrink * lengths)
        at = np.asarray(sphere_centres(grains, clump))[..., 0] / lengths
        apart = at - at[:, None]
        apart -= np.where(periodic, np.rint(apart), 0.0)
        near = np.linalg.norm(shrink * lengths * apart, axis=-1) < 2.5
        found = listed_candidates(pairs)
        np.testing.assert_array_equal(found, np.nonzero(near & (grain[:, None] < grain)))
        image = np.asarray(pairs.image)[np.asarray(pairs.valid)]
        np.testing.assert_allclose(at[found[1]] - at[found[0]] + image, apart[found[0], found[1]], atol=1e-12)
        assert np.ptp(image) > 0


def test_a_box_that_has_no_room_for_two_images_is_refused_in_a_line() -> None:
    grains = make_grains(PLACES, orientations(GRAINS))
    with pytest.raises(
        ValueError, match=r"a periodic box of 7.4 x 7.6 x 7.8 R is too small: .* 8.0 R at least"
    ) as error:
        PairFinder(cached_tetra(), EDGES, 2.0)(grains, cached_tetra(), cell())
    assert "\n" not in str(error.value)
    assert len(listed_candidates(PairFinder(cached_tetra(), EDGES, 2.0)(grains, cached_tetra(), cell(periodic=WALLS))))


def test_a_boundary_is_said_in_words_for_all_axes_or_for_each() -> None:
    for words, axes in {"walls": WALLS, "periodic": PERIODIC, "periodic,walls,periodic": (True, False, True)}.items():
        assert periodic_axes(words) == periodic_axes(words.split(",") if "," in words else [words] * 3) == axes
        assert boundary_of(axes) == words
    for wrong in ("open", "periodic,walls", 3, None, ("walls", True, "walls")):
        with pytest.raises(ValueError, match="boundary must be walls or periodic"):
            periodic_axes(wrong)


def test_a_box_with_walls_along_one_axis_has_them_there_and_images_elsewhere() -> None:
    """A sphere that leaves through a face, pressed on a wall: the wall measures it, and no bit is set."""
    box = cell(np.array([8.0, 9.0, 10.0]), (True, True, False))
    grains = make_grains([[7.9, 0.5, 0.8]], None, [[0.3, 0.0, 0.0]])
    pairs = PairFinder(SPHERE, np.full(3, 10.0), 1.0)(grains, SPHERE, box)
    system = dynamics.System(SPHERE, Hooke(), pairs, ELASTIC)
    state = dynamics.start(system, grains.position, grains.quaternion, box)
    state = replace(state, grains=replace(grains, acceleration=state.grains.acceleration))
    after, pressure = march(system, state, jax.tree.map(lambda leaf: leaf[None], box), 0.0, 0.0)
    sphere = float(SPHERE.mass)
    assert float(pressure[2, 0]) == pytest.approx(float(ELASTIC.wall_stiffness) * 0.2**1.5 / 2.0 / 72.0, rel=1e-12)
    assert float(pressure[0, 0]) == pytest.approx(sphere * 0.3**2 / 720.0, rel=1e-12)
    assert float(pressure[1, 0]) == 0.0
    later, _ = march(system, after, jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), box), 0.5, 0.0)
    assert float(later.grains.position[0, 0, 0]) == pytest.approx(8.2, rel=1e-12)
    assert int(end_bin(system, later, box, pressure, 0.0)[0].status[0]) == 0
    assert float(end_bin(system, after, box, pressure, 0.0)[1].wall_contacts[0]) == 1.0


def test_two_grains_that_meet_through_an_image_feel_what_the_same_two_feel_unwrapped() -> None:
    first, apart, edge = np.array([0.5, 6.0, 11.0]), np.array([1.9, 0.7, -0.4]), 12.0
    velocity, spin = [[0.02, 0.0, 0.01], [-0.03, 0.0, 0.0]], [[0.01, 0.02, 0.0]] * 2
    found = []
    for image, box in ((0.0, cell(np.full(3, 40.0), WALLS, -20.0)), ([edge, 0.0, -edge], cell(np.full(3, edge)))):
        grains = make_grains([first, first + apart + image], orientations(2, 5), velocity, spin)
        pairs = PairFinder(cached_tetra(), np.full(3, 40.0), 1.0)(grains, cached_tetra(), box)
        system = dynamics.System(cached_tetra(), Hooke(), pairs)
        state = dynamics.start(system, grains.position, grains.quaternion, box)
        state = dynamics.accelerate(system, replace(state, grains=grains), box)
        still = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (8, 3, 1)), box)
        state, _ = march(system, state, still, 0.3, 0.0)
        found.append((state.grains.velocity, state.grains.spin, state.grains.spin_rate))
    assert float(jnp.max(jnp.abs(found[0][2]))) > 1e-3
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-14)


def test_a_free_grain_goes_straight_on_while_its_cell_grows_steadily() -> None:
    """Newton: dx/dt is constant, and v = dx/dt - x dL/dt / L is what changes; to second order in the step."""
    rate, box = np.array([-2e-3, 3e-3, -1e-3]), cell(np.array([20.0, 24.0, 22.0]), origin=-10.0)
    at, own = np.array([3.0, -4.0, 5.0]), np.array([0.02, -0.01, 0.03])
    centre = np.asarray(0.5 * (box.lower + box.upper))[:, 0]
    straight = at + 100.0 * (own + rate * (at - centre))
    errors = []
    for dt in (2.0, 1.0):
        grains = make_grains([at], None, [own])
        system = dynamics.System(SPHERE, Hooke(), PairFinder(SPHERE, EDGES, 1.0)(grains, SPHERE, box))
        state = dynamics.start(system, grains.position, grains.quaternion, box)
        moving = strained(box, 1, 0.0, rate)  # at its beginning, but growing
        state = replace(state, grains=grains, cell=jax.tree.map(lambda leaf: leaf[0], moving))
        state = dynamics.accelerate(system, state, state.cell)
        state, _ = march(system, state, strained(box, round(100.0 / dt), dt, rate), dt, 0.0)
        errors.append(np.abs(np.asarray(state.grains.position)[0, :, 0] - straight).max())
    assert errors[1] < 1e-4
    assert errors[1] < 0.3 * errors[0]


def test_momentum_stays_zero_to_round_off_while_the_cell_is_strained() -> None:
    system, state, box = packed()
    state, total = march(system, state, strained(box, STEPS, DT), DT, 0.0)
    assert float(jnp.max(jnp.abs(state.grains.velocity))) > 1e-3
    assert float(total[0, 0]) > 1e-4 * STEPS
    np.testing.assert_allclose(jnp.sum(state.grains.velocity, axis=0), 0.0, atol=1e-14)


@pytest.mark.parametrize(
    "shift", [np.array([2.3, -5.1, 31.7]), EDGES * [1.0, -2.0, 0.0] * (np.arange(GRAINS) % 2)[:, None]]
)
def test_where_the_cell_is_cut_changes_nothing(shift: np.ndarray) -> None:
    """All grains shifted by a vector, or some put at the place of one of their images."""
    moving, final = [], []
    for by in (0.0, shift):
        system, state, box = packed(by)
        state, total = march(system, state, strained(box, STEPS, DT), DT, 0.0)
        final.append((state.grains.velocity, state.grains.spin, total))
        moving.append(observables.stress()(simulation_of(system, state.cell), state))
    np.testing.assert_allclose(*moving, rtol=0.0, atol=1e-12)
    for one, other in zip(*final, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-11)


def test_the_pressure_of_a_step_is_the_stress_of_its_contacts_and_the_flux_of_momentum() -> None:
    system, state, box = packed()
    box = jax.tree.map(lambda leaf: leaf[0], strained(box, 1, DT))
    moved = jax.tree.map(lambda leaf: leaf[None], box)
    slow = replace(state, grains=replace(state.grains, acceleration=0.0 * state.grains.velocity))
    after, pressure = march(system, slow, moved, DT, 0.0)
    # Forces are those at velocities of the middle of the step, which without accelerations are those of its beginning.
    seen = replace(
        after,
        grains=replace(
            after.grains, velocity=slow.grains.velocity, spin=slow.grains.spin + 0.5 * DT * slow.grains.spin_rate
        ),
    )
    contacts = observables.stress()(simulation_of(system, box), replace(seen, history=after.history))
    flux = jnp.sum(cached_tetra().mass * slow.grains.velocity**2, axis=0) / jnp.prod(box.lengths, axis=0)
    assert float(jnp.min(flux)) > 1e-5
    np.testing.assert_allclose(pressure, jnp.einsum("iib->ib", contacts) + flux, rtol=1e-4)


def test_what_the_strain_of_the_cell_does_is_kept_by_grains_without_damping() -> None:
    """d(energy) = - sum_i V p_i d(ln L_i), to the order of the step."""
    system, state, box = packed(friction=Hooke(mu=0.0), material=ELASTIC)
    begun = energy(system, state)

    @jax.jit
    def run(state: State, boxes: Box, dt: jax.Array) -> tuple[State, jax.Array]:
        def one(state: State, box: Box) -> tuple[State, jax.Array]:
            wall = jax.tree.map(lambda leaf: leaf[None], box)
            state, pressure = dynamics.march(system, state, wall, dt, 0.0)
            return state, jnp.sum(pressure * jnp.prod(box.lengths, axis=0) * box.growth / box.lengths)

        return jax.lax.scan(one, state, boxes)

    errors = []
    for dt in (0.1, 0.05):
        after, power = run(state, strained(box, round(20.0 / dt), dt, 20.0 * RATE), jnp.asarray(dt))
        done = -float(jnp.sum(power) - 0.5 * power[-1]) * dt
        errors.append(abs(energy(system, after) - begun - done) / abs(done))
    assert errors[1] < 2e-3
    assert errors[1] < 0.6 * errors[0]


def energy(system: dynamics.System, state: State) -> float:
    """Kinetic, beside the motion of the cell, and elastic."""
    overlap = jnp.maximum(overlaps(system, state), 0.0)
    elastic = 0.4 * system.material.normal_stiffness * jnp.sum(overlap**2.5)
    zero = jnp.ones((3, 1))
    return float(elastic + end_bin(system, state, state.cell, zero, 0.0)[1].kinetic_energy[0])


def test_a_state_between_walls_cannot_go_on_in_a_periodic_box() -> None:
    system, state, box = packed()
    with pytest.raises(ValueError, match="the boxes are walls, and the state is one of periodic"):
        dynamics.march(system, state, replace(strained(box, 2, DT), periodic=WALLS), DT, 0.0)


def test_both_modes_of_derivatives_of_a_strained_periodic_pack_are_its_differences() -> None:
    system, state, box = packed()
    path, row = StrainPath(box.lower, box.upper, 0.05, periodic=PERIODIC), Bin(0.0, 1.0, 1, 0, timed=False, still=False)

    def pressures(delta0: jax.Array) -> jax.Array:
        moving, duration = replace(path, delta0=delta0), 100.0 * DT
        boxes = jax.vmap(lambda time: moving.box_at(row, time, duration))(DT * jnp.arange(1.0, 101.0))
        return dynamics.march(system, state, boxes, DT, 0.0)[1][:, 0] / 100.0

    at, one = jnp.asarray(0.05), jnp.ones(())
    value, forwards = jax.jit(lambda x: jax.jvp(pressures, (x,), (one,)))(at)
    backwards = jax.jit(jax.jacrev(pressures))(at)
    run = jax.jit(pressures)
    differences = (run(at + 1e-7) - run(at - 1e-7)) / 2e-7
    assert float(jnp.min(forwards / value)) > 1.0
    np.testing.assert_allclose(backwards, forwards, rtol=1e-10)
    np.testing.assert_allclose(differences, forwards, rtol=2e-6)
