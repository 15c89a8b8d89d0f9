"""Walls with friction: a sphere that sticks, slides and rolls on a floor, and packs between such walls."""

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import (
    ELASTIC,
    PERIODIC_27,
    PERIODIC_XY_27,
    SPHERE,
    TETRA_27,
    all_pairs,
    cached_tetra,
    make_grains,
    squeeze,
    standing,
)

import gmem_jax as gm
from gmem_jax.physics import forces
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.wall import wall_forces
from gmem_jax.physics.grain import sized
from gmem_jax.physics.state import Box, State, Status, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System
from gmem_jax.simulation import loop
from gmem_jax.simulation.stable_step import largest_stable_step
from gmem_jax.simulation.stage import Bin

quickly = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
MARCH = quickly(dynamics.march)
REST = Bin(0.0, 0.0, 1, 0, timed=True, still=True)
FLOOR = Box(jnp.asarray([[-90.0], [-90.0], [-3.0]]), jnp.full((3, 1), 90.0), jnp.zeros((3, 1)), jnp.zeros((3, 1)))
LAWS = {
    "H": gm.Hooke(damping_time=0.0),
    "M1": gm.MindlinRescaled(damping_time=0.0),
    "M2": gm.Mindlin(damping_time=0.0, points=20),
}


@quickly
def dragging(system: System, grains: Any, history: Any) -> Any:
    """Force, torque, new history and normal force of a sphere on the floor after a step of 1 t_c."""
    table, _ = forces.sphere_table(system.clump, grains)
    material, radii = system.material, system.clump.sphere_radii(1)
    lower, upper = wall_forces(table, FLOOR, material, material.normal_damping, radii)
    loads = forces.wall_loads(system, grains, FLOOR, lower, upper, history, jnp.asarray(1.0))
    return (*(jnp.sum(load, axis=0)[:, 0] for load in loads[1:3]), loads[3], jnp.sum(lower))


def dragged(law: Any, to: float, radius: float = 1.0, rigidity: float = 1.0) -> tuple[Any, Any, float]:
    """Force and torque on a sphere on the floor, 0.02 deep, after it was dragged along x; and the normal force."""
    grain = SPHERE if radius == 1.0 else sized(SPHERE, np.asarray([radius]))
    system = System(grain, law, all_pairs(grain, 1), gm.Material(wall_rigidity=rigidity), wall_mu=0.5)
    grains = make_grains([[0.0, 0.0, -3.0 + radius - 0.02]], velocity=[[to / 10.0, 0.0, 0.0]])
    history = dynamics.wall_histories(system, 1, 1)
    for _ in range(10):
        force, torque, history, pushed = dragging(system, grains, history)
    return force, torque, float(pushed)


@pytest.mark.parametrize(("radius", "rigidity"), [(1.0, 1.0), (1.2, 0.5)])
@pytest.mark.parametrize("name", LAWS)
def test_a_sphere_on_the_floor_sticks_by_its_spring_and_slides_at_the_limit(
    name: str, radius: float, rigidity: float
) -> None:
    law, moved = LAWS[name], 1e-3
    # Mindlin's springs are to those between two spheres of radius 1 as Hertz's are (docs/physics.md).
    stiffer = 1.0 if name == "H" else 2.0**1.5 * rigidity * np.sqrt(radius * 0.02)
    assert np.isclose(gm.Material().wall_stiffness / gm.Material().normal_stiffness, 2.0**1.5)
    force, torque, pushed = dragged(law, moved, radius, rigidity)
    np.testing.assert_allclose(pushed, rigidity * gm.Material().plane_stiffness * np.sqrt(radius) * 0.02**1.5)
    np.testing.assert_allclose(force, [-law.stiffness * stiffer * moved, 0.0, 0.0], rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(torque, np.cross([0.0, 0.0, -radius], force), rtol=1e-12, atol=1e-18)
    force, *_, pushed = dragged(law, 1.0, radius, rigidity)
    np.testing.assert_allclose(force, [-0.5 * pushed, 0.0, 0.0], rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize(
    "law",
    [gm.Hooke(), *(pytest.param(law, marks=pytest.mark.slow) for law in (gm.MindlinRescaled(), gm.Mindlin(points=20)))],
)
def test_a_sphere_that_slides_on_the_floor_rolls_with_five_sevenths_of_its_speed(law: Any) -> None:
    weight, speed = 1e-4, 1e-2
    depth = (weight * float(SPHERE.mass) / float(gm.Material().wall_stiffness)) ** (2.0 / 3.0)
    system = System(SPHERE, law, all_pairs(SPHERE, 1), gravity=weight, wall_mu=0.5)
    grains = make_grains([[0.0, 0.0, -2.0 - depth]], velocity=[[speed, 0.0, 0.0]])
    state = start(system, grains.position, grains.quaternion, FLOOR)
    state = dynamics.accelerate(system, replace(state, grains=grains), FLOOR)
    after, _ = MARCH(system, state, standing(FLOOR, 4000), 0.5, 0.0)
    moving, turning = float(after.grains.velocity[0, 0, 0]), float(after.grains.spin[0, 1, 0])
    # About the point of contact, an arm of R away, friction leaves the angular momentum as it is. What is left of the
    # spring's oscillation, which the dashpot damps, is 1e-5; overlaps do not matter.
    np.testing.assert_allclose(moving + 0.4 * turning, speed, rtol=1e-9)
    np.testing.assert_allclose(moving, 5.0 / 7.0 * speed, rtol=1e-4)


def squeezed(wall_mu: Any, law: Any = gm.Hooke(), replicas: int = 1, steps: int = 40) -> tuple[System, State, Box]:  # noqa: B008
    """27 grains that fly and spin between walls that close in."""
    pack = gm.load_pack(TETRA_27)
    system = System(pack.clump, law, pack.pairs, wall_mu=wall_mu)
    places = replicate((pack.position[..., None], pack.quaternion[..., None]), replicas)
    state = start(system, *places, pack.box)
    draws = 5e-3 * np.random.default_rng(0).normal(size=(2, pack.grains, 3, replicas))
    state = replace(state, grains=replace(state.grains, velocity=jnp.asarray(draws[0]), spin=jnp.asarray(draws[1])))
    boxes = jax.vmap(squeeze(pack.box, 300.0).box_at)(0.3 * jnp.arange(1.0, steps + 1.0))
    return system, state, boxes


@functools.cache
def rough(*wall_mu: float) -> State:
    """`squeezed` in two replicas, with friction of the walls of each."""
    state: State = MARCH(*squeezed(jnp.asarray(wall_mu), replicas=2), 0.3, 0.0)[0]
    return state


def test_walls_whose_friction_is_zero_are_smooth() -> None:
    smooth, _ = MARCH(*squeezed(None, replicas=2), 0.3, 0.0)
    assert smooth.wall_history is None
    of_none, of_one = (np.asarray(rough(0.0, 0.5).grains.velocity - smooth.grains.velocity)[..., n] for n in (0, 1))
    assert np.abs(of_none).max() < 1e-14  # of speeds up to 2e-2: sums have more terms, zeros, and round-off may differ
    assert np.abs(of_one).max() > 1e-3


def test_each_replica_has_walls_of_its_own() -> None:
    np.testing.assert_array_equal(rough(0.0, 0.5).grains.position[..., 1], rough(0.5, 0.5).grains.position[..., 1])


@pytest.mark.slow
@pytest.mark.parametrize("law", [gm.Hooke(mu=0.6), gm.MindlinRescaled(mu=0.6)])
def test_derivatives_by_the_friction_of_walls_are_differences(law: Any) -> None:
    weights = np.random.default_rng(1).normal(size=(27, 3, 1))

    def score(wall_mu: jax.Array) -> jax.Array:
        system, state, boxes = squeezed(wall_mu, law, steps=20)
        after, pressure = dynamics.march(system, state, boxes, 0.3, 0.0)
        return jnp.sum(weights * after.grains.velocity) + jnp.sum(pressure)

    both, by = quickly(jax.value_and_grad(score)), 1e-6
    (_, backwards), (up, _), (down, _) = (both(jnp.asarray(0.3 + step)) for step in (0.0, by, -by))
    assert abs(float(backwards)) > 1e-3
    np.testing.assert_allclose(backwards, (up - down) / (2.0 * by), rtol=1e-6)  # round-off over the step
    _, forwards = quickly(lambda at: jax.jvp(score, (at,), (jnp.ones(()),)))(jnp.asarray(0.3))
    np.testing.assert_allclose(backwards, forwards, rtol=1e-10)


def test_friction_of_walls_takes_the_energy_that_its_forces_do() -> None:
    """A tetrahedron that tumbles on an elastic floor: what it loses is the integral of force times sliding velocity."""
    law, dt = gm.Hooke(mu=0.4, damping_time=0.0), 0.02
    system = System(cached_tetra(), law, all_pairs(cached_tetra(), 1), ELASTIC, wall_mu=0.4)
    grains = make_grains([[0.0, 0.0, -1.55]], [[0.8, 0.4, 0.4, 0.2]], [[2e-2, 0.0, -2e-2]], [[3e-3, 5e-3, -4e-3]])
    state = start(system, grains.position, grains.quaternion, FLOOR)
    state = dynamics.accelerate(system, replace(state, grains=grains), FLOOR)

    def stiffness(grains: Any) -> Any:
        table, _ = forces.sphere_table(system.clump, grains)
        return table, wall_forces(table, FLOOR, ELASTIC, 0.0)

    def one(state: State, _: Any) -> Any:
        state, _ = dynamics.step(system, state, FLOOR, jnp.asarray(dt), 0.0, state.status[0] >= 0)
        table, normal = stiffness(state.grains)
        kin, force, _, _ = forces.wall_loads(system, state.grains, FLOOR, *normal, state.wall_history, jnp.zeros(()))
        grains, deep = state.grains, jnp.maximum(1.0 - (table[:, 2] - FLOOR.lower[2]), 0.0)
        energy = 0.5 * system.clump.mass * jnp.sum(grains.velocity**2)
        energy += 0.5 * system.clump.inertia[0] * jnp.sum(grains.spin**2)
        return state, (energy + 0.4 * ELASTIC.wall_stiffness * jnp.sum(deep**2.5), jnp.sum(force * kin.sliding))

    _, (energy, power) = jax.jit(lambda state: jax.lax.scan(one, state, None, 4000))(state)
    energy, power = np.asarray(energy), np.asarray(power)
    lost = -dt * (power.sum() - 0.5 * (power[0] + power[-1]))
    assert energy[0] - energy[-1] > 0.02 * energy[0]
    # Measured 2e-5: the trapezoidal rule over forces that jump where contacts open.
    np.testing.assert_allclose(-lost, energy[0] - energy[-1], rtol=1e-3)


def test_walls_of_a_box_that_is_periodic_along_others_are_carried_along_with_it() -> None:
    pack = gm.load_pack(PERIODIC_XY_27)
    system = System(pack.clump, gm.Hooke(), pack.pairs, wall_mu=0.7)
    growth = jnp.asarray([[1e-3], [-2e-3], [0.0]])
    box = replace(pack.box, lower_velocity=-growth, upper_velocity=growth)
    state = start(system, pack.position[..., None], pack.quaternion[..., None], box)
    step = quickly(dynamics.step)
    rest, _ = step(system, state, box, jnp.asarray(1e-9), 0.0, state.status[0] >= 0)
    touched = np.any(np.asarray(rest.grains.position)[:, 2] < float(pack.lower[2]) + 1.4)
    assert touched  # and yet: grains that move with the cell do not rub
    np.testing.assert_allclose(rest.wall_history, 0.0, atol=1e-15)
    moving = replace(state.grains, velocity=state.grains.velocity.at[:, 0].add(1e-3))
    slid, _ = step(system, replace(state, grains=moving), box, jnp.asarray(0.1), 0.0, state.status[0] >= 0)
    history = np.asarray(slid.wall_history).reshape(-1, 6, 3)
    assert np.abs(history[:, [2, 5], 0]).max() > 1e-6
    np.testing.assert_array_equal(history[:, [0, 1, 3, 4]], 0.0)


def test_what_walls_remember_creeps_as_contacts_do() -> None:
    state = rough(0.5, 0.5)
    simulation = loop.Simulation(squeezed(0.5)[0], None, 0.3, steps=10, creep=1e-3)  # type: ignore[arg-type]
    crept = loop._crept(simulation, state, REST)
    assert np.abs(np.asarray(state.wall_history)).max() > 1e-6
    np.testing.assert_allclose(crept.wall_history, np.exp(-3e-3) * np.asarray(state.wall_history), rtol=1e-12)


def test_the_stable_step_knows_the_springs_of_walls() -> None:
    stiff = gm.Hooke(stiffness=5.0, damping_time=0.0)
    place, upright = jnp.asarray([[[0.0], [0.0], [-2.01]]]), jnp.asarray([[[1.0], [0.0], [0.0], [0.0]]])
    system = System(SPHERE, stiff, all_pairs(SPHERE, 1), ELASTIC, wall_mu=10.0)
    found = largest_stable_step(loop.Simulation(system, None, 1.0), place, upright, FLOOR)  # type: ignore[arg-type]
    frequency = np.sqrt(5.0 * (1.0 / float(SPHERE.mass) + 1.0 / float(SPHERE.inertia[0])))
    np.testing.assert_allclose(found, 2.0 / frequency, rtol=0.03)  # it is looked for to 2 %; without friction it is 2


SHORT = {"t0": 60.0, "rest": 0.1, "hold": 0.02, "store": 0.02}
SIGNAL = gm.Bumps(jnp.asarray([[1.0]]), jnp.asarray([[0.5]]), 0.3)


@pytest.mark.slow
def test_friction_of_walls_is_a_number_of_an_experiment() -> None:
    pack = gm.load_pack(TETRA_27)
    rough, smooth = (gm.Experiment(pack, SIGNAL, wall_mu=wall_mu, **SHORT) for wall_mu in (0.5, None))
    found = gm.recall(rough)
    assert not np.allclose(found.p_sig, gm.recall(smooth).p_sig, rtol=1e-3)
    warned = gm.recall(gm.replace(rough, wall_mu=11.0))
    assert Status(int(np.bitwise_or.reduce(np.asarray(warned.status)))) & Status.LARGE_FRICTION


def test_observers_see_the_friction_of_walls() -> None:
    system = System(SPHERE, LAWS["H"], all_pairs(SPHERE, 1), wall_mu=0.5)
    grains = make_grains([[0.0, 0.0, -2.02]], velocity=[[2e-3, 0.0, 0.0]])
    remembered = dynamics.wall_histories(system, 1, 1).at[2, 0].set(-1e-4)  # of the floor, less than the limit
    state = State(
        grains, system.friction.init(system.pairs.capacity, 1, float), jnp.zeros(1, int), None, None, remembered
    )
    simulation = loop.Simulation(system, None, 0.3, box=FLOOR)  # type: ignore[arg-type]
    power, stress = (one()(simulation, state) for one in (gm.observables.friction_power, gm.observables.stress))
    np.testing.assert_allclose(power, 1e-4 * 2e-3, rtol=1e-12)
    # The floor is pushed by 1e-4 along x, 0.98 below the centre; what lies there is pushed away along z.
    np.testing.assert_allclose(stress[0, 2] * 180.0 * 180.0 * 93.0, -1e-4 * 0.98, rtol=1e-12)
    assert float(stress[2, 2, 0]) > 0.0


def test_a_stage_without_friction_has_none_at_walls() -> None:
    system = System(SPHERE, gm.Hooke(), all_pairs(SPHERE, 1), wall_mu=0.5)
    assert loop._rubbing(system, REST._replace(friction=0.5)).wall_mu == 0.25


def test_impossible_friction_of_walls_is_refused() -> None:
    pack = gm.load_pack(TETRA_27)
    with pytest.raises(ValueError, match="wall_mu must be in"):
        gm.Experiment(pack, SIGNAL, wall_mu=-0.1)
    with pytest.raises(ValueError, match="Frictionless has no mu"):
        gm.Experiment(pack, SIGNAL, gm.Frictionless(), wall_mu=0.1)
    with pytest.raises(ValueError, match="no walls"):
        gm.Experiment(gm.load_pack(PERIODIC_27), SIGNAL, wall_mu=0.1)
    with pytest.raises(ValueError, match="walls with friction"):
        gm.Experiment(pack, SIGNAL, wall_mu=0.1, precision="mixed")
    system, state, boxes = squeezed(0.5)
    with pytest.raises(ValueError, match="belong together"):
        dynamics.march(system, replace(state, wall_history=None), boxes, 0.3, 0.0)
