"""Ready observers: each against numpy or a closed form, after both backends, differentiated, and in files."""

import functools
import importlib.util
from dataclasses import dataclass, replace
from typing import Any

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SPHERE, TETRA_27, accelerate, coast, record, scene, still, strain_path

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.experiment.record import describe
from gmem_jax.physics.census import overlaps
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import listed_candidates, sphere_places
from gmem_jax.physics.pytree import pytree
from gmem_jax.physics.rotation import matrix
from gmem_jax.physics.state import Box, State, still_box
from gmem_jax.physics.system import System
from gmem_jax.show.recalls import recall_figure
from gmem_jax.simulation import observables
from gmem_jax.simulation.loop import Mark, Simulation
from gmem_jax.simulation.observables import Observable
from gmem_jax.simulation.sample import end_bin

PACK = gm.load_pack(TETRA_27)
ONE = gm.Bumps(jnp.asarray([[1.0], [-1.0]]), jnp.full((2, 1), 0.5), 0.6)
NAMES = ("stress", "wall_stress", "fabric", "sliding", "mobilisation", "contacts_made", "contacts_lost")
NAMES += ("nonaffine", "rotation", "friction_power", "normal_power", "drag_power")
ALL: tuple[Observable, ...] = tuple(getattr(observables, name)() for name in NAMES)


def mark_of(system: System, state: State, box: Box) -> Mark:
    return Mark(state.grains, box, jnp.sum(jax.jit(overlaps)(system, state) > 0.0, axis=0))


def seen(
    system: System, state: State, box: Box, mark: Mark | None = None, dt: float = 0.0, drag: float = 0.0
) -> Simulation:
    """A simulation as observers see it at the end of a bin, of steps `dt`."""
    simulation = Simulation(system, strain_path(box.lower, box.upper, 0.0), dt, drag)
    _, sample = jax.jit(end_bin)(system, state, box, jnp.zeros((3, 1)), 0.0)
    return replace(simulation, box=box, sample=sample, mark=mark or mark_of(system, state, box))


@functools.partial(jax.jit, static_argnums=2)
def look(simulation: Simulation, state: State, observe: tuple[Observable, ...] = ALL) -> dict[str, jax.Array]:
    """What observers give, by name."""
    return {each.name: each(simulation, state) for each in observe}


def two_spheres(mu: float) -> tuple[System, State, Box]:
    """The second 1.8 to the right of the first, coming nearer at 0.01 and passing by at 0.02 along y."""
    law = Hooke(mu=mu)
    at = ([[0.0, 0.0, 0.0], [1.8, 0.0, 0.0]], None, [[0.0, 0.0, 0.0], [-0.01, 0.02, 0.0]])
    system, state, box = scene(SPHERE, *at, friction=law)
    return system, replace(state, history=state.history.at[0, 1].set(1e-3)), box


MATERIAL = Material()
NORMAL = float(MATERIAL.normal_stiffness) * (0.2**1.5 + 0.23 * 0.2**0.5 * 0.01)
TANGENTIAL = 1e-3 + 0.13 * 0.069 * 0.02  # its history, and the dashpot
AHEAD = TANGENTIAL + 0.13 * 0.1 * 0.02  # after another step


def test_of_two_spheres_pressed_and_sheared_every_number_is_known() -> None:
    system, state, box = two_spheres(0.5)
    simulation, volume = seen(system, state, box, dt=0.1), 30.0**3
    wanted = np.zeros((3, 3))
    wanted[0, 0], wanted[1, 0] = NORMAL * 1.8 / volume, -TANGENTIAL * 1.8 / volume
    pairs = [(0, 1), (1, 0)]
    found = look(simulation, state, (*ALL, observables.normal_forces(pairs), observables.tangential_forces(pairs)))
    np.testing.assert_allclose(found["stress"][..., 0], wanted, rtol=1e-12)
    np.testing.assert_array_equal(found["fabric"][..., 0], np.diag([1.0, 0.0, 0.0]))
    assert found["sliding"] == 0.0
    assert float(found["mobilisation"][0]) == pytest.approx(AHEAD / (0.5 * NORMAL), rel=1e-12)
    assert float(found["friction_power"][0]) == pytest.approx(TANGENTIAL * 0.02, rel=1e-12)
    damping = float(MATERIAL.normal_stiffness) * 0.23 * 0.2**0.5 * 0.01
    assert float(found["normal_power"][0]) == pytest.approx(damping * 0.01, rel=1e-12)
    np.testing.assert_allclose(found["normal_forces"][:, 0], NORMAL, rtol=1e-12)
    on_first = found["tangential_forces"][..., 0]
    np.testing.assert_allclose(on_first, TANGENTIAL * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]), rtol=1e-12)


def test_a_contact_at_its_limit_slides() -> None:
    system, state, box = two_spheres(0.01)
    simulation = seen(system, state, box)
    found = look(simulation, state)
    assert found["sliding"] == 1.0
    assert float(found["mobilisation"][0]) == pytest.approx(1.0, rel=1e-12)
    assert float(found["friction_power"][0]) == pytest.approx(0.01 * NORMAL * 0.02, rel=1e-12)
    slippery = replace(simulation, system=replace(system, friction=gm.Frictionless()))
    free = look(slippery, replace(state, history=()))
    assert free["sliding"] == free["mobilisation"] == free["friction_power"] == 0.0


def test_a_sphere_pressed_on_a_moving_wall_counts_from_its_centre_to_the_wall() -> None:
    box = replace(still_box(*(jnp.full((3, 1), at) for at in (-5.0, 5.0))), upper_velocity=jnp.full((3, 1), -0.02))
    system, state, _ = scene(SPHERE, [[0.0, 4.1, 0.0], [0.0, -3.0, 0.0]], None, [[0.0, 0.01, 0.0], [0.0, 0.0, 0.0]])
    simulation, stiffness = seen(system, state, box), float(MATERIAL.wall_stiffness)
    force = stiffness * (0.1**1.5 + 0.23 * 0.1**0.5 * 0.03)
    wanted = np.diag([0.0, force * 0.9 / 10.0**3, 0.0])
    found = look(simulation, state)
    np.testing.assert_allclose(found["stress"][..., 0], wanted, rtol=1e-12)
    power = stiffness * 0.23 * 0.1**0.5 * 0.03**2
    assert float(found["normal_power"][0]) == pytest.approx(power, rel=1e-11)


@functools.cache
def moved_pack() -> tuple[System, State, Box, State]:
    """27 tetra grains at rest; the box that they are in later; and they then: moved, turned, with forces of all kinds.

    Positions, velocities and histories are noise, so that nothing is small for reasons of symmetry.
    """
    experiment = gm.Experiment(PACK, ONE)
    system, rest, random = experiment.simulation(sheared=False).system, experiment.begin(), np.random.default_rng(0)

    def noise(scale: float, *shape: int) -> Any:
        return scale * random.standard_normal(shape)

    box = PACK.box
    later = Box(1.002 * box.lower, 0.996 * box.upper, box.lower_velocity + 0.003, box.upper_velocity - 0.002)
    turned = np.asarray(rest.grains.quaternion) + noise(0.02, 27, 4, 1)
    grains = replace(
        rest.grains,
        position=rest.grains.position + noise(0.02, 27, 3, 1),
        quaternion=jnp.asarray(turned / np.sqrt(np.sum(turned**2, axis=1, keepdims=True))),
        velocity=jnp.asarray(noise(0.01, 27, 3, 1)),
        spin=jnp.asarray(noise(0.01, 27, 3, 1)),
    )
    moved = replace(rest, grains=grains, history=rest.history + noise(5e-3, *rest.history.shape))
    return system, rest, later, accelerate(system, moved, later)


def spheres_of(system: System, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres of spheres, their velocities and their spins, [S, 3], by numpy."""
    grains = {name: np.asarray(getattr(state.grains, name))[..., 0] for name in vars(state.grains)}
    each = system.clump.spheres
    centres = sphere_places(grains["position"], grains["quaternion"], np.asarray(system.clump.offsets))
    arms, spin = centres - np.repeat(grains["position"], each, axis=0), np.repeat(grains["spin"], each, axis=0)
    return centres, np.repeat(grains["velocity"], each, axis=0) + np.cross(spin, arms), spin


def touching(centres: np.ndarray) -> set[tuple[int, int]]:
    """All pairs of spheres of different tetra grains that touch."""
    distance = np.linalg.norm(centres[:, None] - centres, axis=-1)
    return {(i, j) for i, j in np.argwhere(distance < 2.0).tolist() if i // 4 < j // 4}


def test_contacts_are_those_of_a_search_through_all_pairs_and_forces_those_of_the_law() -> None:
    system, rest, box, state = moved_pack()
    centres, velocity, spin = spheres_of(system, state)
    now, then = touching(centres), touching(spheres_of(system, rest)[0])
    rows = {
        pair: row for row, pair in enumerate(zip(*map(np.ndarray.tolist, listed_candidates(system.pairs)), strict=True))
    }
    tensor, at_limit, shares, powers, forces = np.zeros((3, 3)), 0, [], np.zeros(2), {}
    for i, j in now:
        gap = centres[j] - centres[i]
        distance = np.linalg.norm(gap)
        n, overlap = gap / distance, 2.0 - distance
        relative = velocity[j] - velocity[i] - np.cross(spin[i] + spin[j], (1.0 - 0.5 * overlap) * n)
        closing, slide = -relative @ n, relative - (relative @ n) * n
        spring = float(MATERIAL.normal_stiffness) * overlap**1.5
        normal = max(0.0, spring + float(MATERIAL.normal_stiffness) * 0.23 * overlap**0.5 * closing)
        kept = np.asarray(state.history)[rows[i, j], :, 0]
        flat = kept - (kept @ n) * n
        carried = np.linalg.norm(kept) * flat / np.linalg.norm(flat)
        angle = 2.0 * np.arctan(0.25 * (spin[i] + spin[j]) @ n * 0.1)
        turned = np.cos(angle) * carried + np.sin(angle) * np.cross(n, carried)
        trials = carried + 0.13 * 0.069 * slide, turned + 0.13 * (0.069 + 0.1) * slide  # now, and after another step
        friction, ahead = (each * min(1.0, normal / np.linalg.norm(each)) for each in trials)  # mu = 1
        tensor += np.outer(n, n)
        powers += friction @ slide, (normal - spring) * closing
        if normal > 0.0:
            shares.append(np.linalg.norm(ahead) / normal)
            at_limit += np.linalg.norm(trials[1]) > normal
        forces[i, j] = normal, friction
    for axis in range(3):
        for plane, side, own in ((box.lower, -1.0, box.lower_velocity), (box.upper, 1.0, box.upper_velocity)):
            for place, moving in zip(centres[:, axis], velocity[:, axis], strict=True):
                overlap, closing = 1.0 - abs(float(plane[axis, 0]) - place), side * (moving - float(own[axis, 0]))
                if overlap > 0.0:
                    spring = float(MATERIAL.wall_stiffness) * overlap**1.5
                    damped = float(MATERIAL.wall_stiffness) * 0.23 * overlap**0.5 * closing
                    powers[1] += (max(0.0, spring + damped) - spring) * closing
    simulation = seen(system, state, box, mark_of(system, rest, PACK.box), dt=0.1)
    apart = next(pair for pair in rows if pair not in now)
    pairs = [*list(now)[:3], apart, (0, 107)]
    chosen = observables.normal_forces(pairs), observables.tangential_forces(pairs)
    found = {name: np.asarray(values)[..., 0] for name, values in look(simulation, state, (*ALL, *chosen)).items()}
    assert 0 < at_limit < len(now)
    assert now - then
    assert then - now
    assert (found["contacts_made"], found["contacts_lost"]) == (len(now - then), len(then - now))
    np.testing.assert_allclose(found["fabric"], tensor / len(now), rtol=1e-12)
    assert found["sliding"] == pytest.approx(at_limit / len(shares), rel=1e-12)
    assert found["mobilisation"] == pytest.approx(np.mean(shares), rel=1e-12)
    np.testing.assert_allclose([found["friction_power"], found["normal_power"]], powers, rtol=1e-10)
    known = [forces.get(pair, (0.0, np.zeros(3))) for pair in pairs]
    np.testing.assert_allclose(found["normal_forces"], [one[0] for one in known], rtol=1e-11)
    np.testing.assert_allclose(found["tangential_forces"], [one[1] for one in known], rtol=1e-10)


def test_the_stress_of_contacts_is_that_of_the_walls_and_of_accelerations() -> None:
    """The virial: V sigma = sum of m a x over grains, and of the forces on walls times where they act."""
    system, _, box, state = moved_pack()
    centres, velocity, _ = spheres_of(system, state)
    acceleration, position = (np.asarray(getattr(state.grains, name))[..., 0] for name in ("acceleration", "position"))
    total = float(system.clump.mass) * acceleration.T @ position
    for axis in range(3):
        for plane, side, own in ((box.lower, -1.0, box.lower_velocity), (box.upper, 1.0, box.upper_velocity)):
            for place, moving in zip(centres, velocity, strict=True):
                overlap = 1.0 - abs(float(plane[axis, 0]) - place[axis])
                if overlap > 0.0:
                    damped = overlap**1.5 + 0.23 * overlap**0.5 * side * (moving[axis] - float(own[axis, 0]))
                    point = np.where(np.arange(3) == axis, float(plane[axis, 0]), place)
                    total[axis] += side * max(0.0, float(MATERIAL.wall_stiffness) * damped) * point
    found = np.asarray(look(seen(system, state, box), state)["stress"])[..., 0]
    np.testing.assert_allclose(found, total / np.prod(np.asarray(box.lengths)), atol=1e-13)
    assert np.abs(found - found.T).max() > 1e-6  # spins are accelerated, too


def test_motion_since_the_mark_is_that_beyond_the_box_and_the_angle_of_turns() -> None:
    system, rest, box, state = moved_pack()
    simulation = seen(system, state, box, mark_of(system, rest, PACK.box))
    lower, upper, was_lower, was_upper = (np.asarray(x)[:, 0] for x in (box.lower, box.upper, PACK.lower[:, None],
                                                                        PACK.upper[:, None]))  # fmt: skip
    was, now = (np.asarray(one.grains.position)[..., 0] for one in (rest, state))
    beyond = now - np.stack(
        [np.interp(was[:, k], [was_lower[k], was_upper[k]], [lower[k], upper[k]]) for k in range(3)], 1
    )
    wanted = np.sqrt(np.mean(np.sum(beyond**2, axis=1)))
    found = look(simulation, state)
    assert float(found["nonaffine"][0]) == pytest.approx(wanted, rel=1e-12)
    before, after = (np.asarray(matrix(one.grains.quaternion))[..., 0] for one in (rest, state))
    cosine = 0.5 * (np.einsum("gij,gij->g", before, after) - 1.0)
    wanted = np.sqrt(np.mean(np.arccos(cosine) ** 2))
    assert float(found["rotation"][0]) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_known_rotation_is_found_whatever_the_sign_of_its_quaternions(sign: float) -> None:
    system, state, box = scene(SPHERE, [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    half = 0.5 * np.array([0.3, 2.5])
    turned = sign * np.stack([np.cos(half), 0.6 * np.sin(half), 0.0 * half, 0.8 * np.sin(half)], axis=1)[..., None]
    later = replace(state, grains=replace(state.grains, quaternion=jnp.asarray(turned)))
    simulation = seen(system, later, box, mark_of(system, state, box))
    assert float(look(simulation, later)["rotation"][0]) == pytest.approx(np.sqrt(np.mean([0.3**2, 2.5**2])), rel=1e-12)
    for each in (observables.rotation(), observables.nonaffine()):  # where nothing moved the slope is 0, not NaN
        value, slope = jax.value_and_grad(lambda grains, f=each: f(simulation, replace(state, grains=grains))[0])(
            state.grains
        )
        assert value == 0.0
        assert not any(np.any(leaf) for leaf in jax.tree.leaves(slope))


@pytest.mark.parametrize("law", [gm.Hooke(mu=0.3), gm.MindlinRescaled(mu=0.3), gm.Mindlin(mu=0.3)])
def test_powers_add_up_to_the_energy_that_a_collision_takes(law: Any) -> None:
    """Two rough spheres meet off-centre: when they are apart again, springs have given back what they took up."""
    spins = [[0.0, 0.01, 0.04], [0.02, 0.0, 0.02]]
    at = ([[0.0, 0.0, 0.0], [1.99, 0.3, 0.0]], None, [[0.05, 0.0, 0.0], [-0.05, 0.0, 0.02]], spins)
    system, state, box = scene(SPHERE, *at, friction=law)
    dt = 0.02
    states, _, _ = record(system, state, still(box), dt, count=1250)

    def power(state: State) -> tuple[jax.Array, jax.Array]:
        simulation = Simulation(system, strain_path(box.lower, box.upper, 0.0), dt, box=box)
        return observables.friction_power()(simulation, state), observables.normal_power()(simulation, state)

    friction, normal = (np.asarray(one)[:, 0] for one in jax.jit(jax.vmap(power))(states))
    assert np.all(normal >= 0.0)
    assert friction[-1] == normal[-1] == 0.0 < friction.max()
    lost = kinetic(system, state) - kinetic(system, jax.tree.map(lambda leaf: leaf[-1], states))
    # Dashpots are seen at the velocities of the ends of steps: measured 2.5e-4, in proportion to dt.
    assert dt * (friction.sum() + normal.sum()) == pytest.approx(lost, rel=4e-4)
    assert 0.05 * lost < dt * friction.sum() < 0.8 * lost


def kinetic(system: System, state: State) -> float:
    """Of isotropic grains."""
    speed, spin = (np.sum(np.asarray(part) ** 2) for part in (state.grains.velocity, state.grains.spin))
    return float(0.5 * float(system.clump.mass) * speed + 0.5 * float(system.clump.inertia[0]) * spin)


def test_the_drag_takes_its_power_from_free_grains() -> None:
    moving = ([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], None, [[0.01, 0.02, 0.0], [0.0, 0.0, 0.01]], [[0.0, 0.1, 0.0]] * 2)
    system, state, box = scene(SPHERE, *moving)
    first, middle, last = (coast(system, state, box, 0.01, steps, 0.05) for steps in (10, 20, 30))
    found = float(look(seen(system, middle, box, drag=0.05), middle)["drag_power"][0])
    assert found == pytest.approx((kinetic(system, first) - kinetic(system, last)) / 0.2, rel=1e-4)


@functools.cache
def contacts() -> tuple[tuple[int, int], ...]:
    """Two pairs that touch at rest, and after the moves."""
    system, rest, _, state = moved_pack()
    both = (touching(spheres_of(system, one)[0]) for one in (rest, state))
    return tuple(sorted(set.intersection(*both))[:2])


SMOOTH = ("stress", "fabric", "mobilisation", "nonaffine", "rotation", "friction_power", "normal_power")


def test_slopes_of_observers_by_the_state_are_those_of_differences() -> None:
    system, rest, box, state = moved_pack()
    random = np.random.default_rng(1)
    along = jax.tree.map(
        lambda leaf: jnp.asarray(0.01 * random.standard_normal(leaf.shape)), (state.grains, state.history)
    )
    chosen = (*(getattr(observables, name)() for name in SMOOTH), observables.tangential_forces(contacts()))
    simulation = seen(system, state, box, mark_of(system, rest, PACK.box), dt=0.1)

    @jax.jit
    def values(step: float) -> dict[str, jax.Array]:
        grains, history = jax.tree.map(lambda leaf, slope: leaf + step * slope, (state.grains, state.history), along)
        moved = replace(state, grains=grains, history=history)
        return look(simulation, moved, chosen)

    step = 1e-6
    _, slopes = jax.jvp(values, (0.0,), (1.0,))
    up, down = values(step), values(-step)
    for name, slope in slopes.items():
        scale = float(jnp.max(jnp.abs(slope)))
        assert scale > 0.0, name
        np.testing.assert_allclose(slope, (up[name] - down[name]) / (2.0 * step), atol=1e-5 * scale, err_msg=name)


FREELY = gm.hold(0.1, friction=False, drag=0.1)
BACKEND = "native" if native.available()[0] else "jax"
STAGES = gm.Protocol(gm.write(length=0.1), FREELY, gm.hold(8.0), gm.read(length=0.1))


@functools.cache
def run_on(backend: str) -> gm.Recall:
    """Half a bin of a wave, grains without friction, rest, and a readout, seen by all."""
    observe = [*ALL, observables.normal_forces(contacts()), observables.tangential_forces(contacts())]
    experiment = gm.Experiment(PACK, ONE, protocol=STAGES, t0=60.0, gamma0=0.01, observe=observe, backend=backend)
    return gm.run(experiment, progress=False)


@pytest.mark.skipif(not native.available()[0], reason=native.available()[1])
@pytest.mark.slow
def test_both_backends_see_the_same() -> None:
    one, other = run_on("native"), run_on("jax")
    for stage, sample in one.stages.items():
        for name, values in sample.observed.items():
            wanted = other.stages[stage].observed[name]
            scale = max(np.abs(wanted).max(), 1e-12)
            np.testing.assert_allclose(values, wanted, rtol=0.0, atol=1e-7 * scale, err_msg=f"{stage} {name}")


def test_at_rest_the_stresses_of_contacts_and_walls_agree() -> None:
    """To the accelerations that are left: 480 t_c under a drag of 0.05 / t_c take off seven digits and more."""
    sample = run_on(BACKEND).stages["hold-2"]
    within, walls = (np.asarray(sample.observed[name])[-1] for name in ("stress", "wall_stress"))
    np.testing.assert_allclose(np.diagonal(within), np.diagonal(walls), rtol=1e-7)
    np.testing.assert_allclose(within, np.swapaxes(within, 0, 1), atol=1e-7 * within.max())
    np.testing.assert_array_equal(np.diagonal(walls).T, sample.pressure[-1])


def test_observers_know_the_drag_and_the_friction_of_a_stage() -> None:
    stages = run_on(BACKEND).stages
    free, held, write = stages["hold"], stages["hold-2"], stages["write"]
    for name in ("mobilisation", "sliding", "friction_power"):
        assert not np.any(free.observed[name]), name
        assert np.any(held.observed[name]), name
    assert not np.any(write.observed["drag_power"])
    np.testing.assert_allclose(free.observed["drag_power"], 2.0 * 0.1 * free.kinetic_energy, rtol=1e-12)
    np.testing.assert_allclose(held.observed["drag_power"], 2.0 * 0.05 * held.kinetic_energy, rtol=1e-12)


def test_units_and_words_go_into_files_and_pictures(tmp_path: Any) -> None:
    recall = run_on(BACKEND)
    told = recall.configuration["observed"]
    assert told["stress"] == {"units": "E", "words": observables.stress().words}
    assert set(told) == set(recall.stages["read"].observed)
    gm.save_recall(tmp_path / "a.h5", recall)
    with h5py.File(tmp_path / "a.h5") as file:
        array = file["stages/hold/observed_stress"]
        assert (array.attrs["units"], array.attrs["description"]) == ("E", observables.stress().words)
    again = gm.load_recall(tmp_path / "a.h5")
    np.testing.assert_array_equal(again.stages["read"].observed["fabric"], recall.stages["read"].observed["fabric"])
    assert again.configuration["observed"] == told
    if importlib.util.find_spec("xarray"):
        about = gm.to_xarray(again).observed_stress.attrs
        assert about == {"units": "E", "description": observables.stress().words}
    (panel,) = recall_figure(again, "observed:Sliding").panels
    np.testing.assert_array_equal(panel.marks[0].y, recall.stages["write"].observed["sliding"][:, 0])
    assert panel.y == "share of contacts at the Coulomb limit"
    (panel,) = recall_figure(again, "observed:stress", signals=[1]).panels
    assert len(panel.marks) == 9 * len(recall.stages)
    assert panel.y.endswith("(E)")
    with pytest.raises(ValueError, match="observed:sliding"):
        recall_figure(again, "observed:nothing")


def counted(simulation: Simulation, state: State) -> jax.Array:
    return jnp.sum(state.grains.position[:, 0] > 0.0, axis=0)


def test_observers_are_named_by_themselves_or_by_a_mapping() -> None:
    ready = observables.sliding()
    listed = gm.Experiment(PACK, ONE, observe=[ready, ("count", counted)])
    assert listed.observe == (("count", counted), ("sliding", ready))  # as files have them
    assert listed == gm.Experiment(PACK, ONE, observe={"sliding": observables.sliding(), "count": counted})
    assert describe(listed, 0.0)["observed"] == {"sliding": {"units": "1", "words": ready.words}}
    own = observables.Observable("count", "1", "grains on the right", counted)
    assert gm.Experiment(PACK, ONE, observe=[own]).observe == (("count", own),)
    assert len({observables.normal_forces([(0, 5)]), observables.normal_forces([(0, 5)])}) == 1


REFUSED = {
    "two observers are called 'stress'": [observables.stress(), observables.stress()],
    "or a list of gm.observables": observables.stress(),
    "called 'a/b'": {"a/b": counted},
    "got 1.0 called 'x'": {"x": 1.0},
}


@pytest.mark.parametrize(("reason", "observe"), REFUSED.items())
def test_what_cannot_observe_is_refused(reason: str, observe: Any) -> None:
    with pytest.raises(ValueError, match=reason):
        gm.Experiment(PACK, ONE, observe=observe)


@pytest.mark.parametrize("pairs", [[], [(0, 0)], [(-1, 5)], [(0, 5, 7)], [(0.5, 5)], 3])
def test_what_are_no_pairs_of_spheres_is_refused(pairs: Any) -> None:
    with pytest.raises(ValueError, match="numbers of two spheres each"):
        observables.normal_forces(pairs)


@pytree
@dataclass(frozen=True)
class NoMu:
    """A law that is no Coulomb law: a dashpot."""

    damping: float = 1e-3

    def init(self, contacts: int, replicas: int, dtype: Any) -> tuple[()]:
        return ()

    def __call__(self, kin: Any, normal_force: jax.Array, history: tuple[()]) -> tuple[jax.Array, tuple[()]]:
        return jnp.where(kin.touching, self.damping * kin.sliding, 0.0), ()


def test_what_cannot_be_seen_is_refused() -> None:
    system, state, box = two_spheres(0.5)
    simulation = seen(system, state, box)
    with pytest.raises(ValueError, match="spheres 0 and 2: must be of two grains, and below 2"):
        observables.normal_forces([(0, 2)])(simulation, state)
    with pytest.raises(ValueError, match="NoMu has no mu"):
        observables.sliding()(replace(simulation, system=replace(system, friction=NoMu())), state)
    with pytest.raises(ValueError, match="at the end of a bin"):
        observables.nonaffine()(replace(simulation, mark=None), state)
    with pytest.raises(ValueError, match="one line of at most 200 letters"):
        observables.Observable("a\nb", "1", "", counted)


def test_a_gradient_through_a_recall_is_that_of_differences() -> None:
    """By the amplitude and by mu, of how far friction is mobilised in the last bins."""
    short = gm.Protocol(gm.write(length=0.1), gm.hold(0.02), gm.read(length=0.05))
    one = gm.Experiment(PACK, ONE, protocol=short, t0=20.0, gamma0=0.01, observe=[observables.mobilisation()])

    @jax.jit
    def loss(numbers: dict[str, float]) -> jax.Array:
        recall = gm.recall(gm.replace(one, numbers))
        return jnp.sum(recall.stages["read"].observed["mobilisation"][-4:])

    at = {"gamma0": 0.01, "friction.mu": 1.0}
    found = jax.grad(loss)(at)
    for name, value in at.items():
        up, down = (loss({**at, name: value * (1.0 + step)}) for step in (1e-5, -1e-5))
        assert float(found[name]) == pytest.approx(float(up - down) / (2e-5 * value), rel=1e-4), name


@pytest.mark.parametrize("given", [1.0, jnp.zeros(5), jnp.zeros(3) * 1j])
def test_what_no_file_could_hold_is_refused_before_the_run(given: Any) -> None:
    experiment = gm.Experiment(PACK, ONE, t0=60.0, observe={"odd": lambda simulation, state: given})
    with pytest.raises(ValueError, match=r"observer 'odd' must give real numbers \[\.\.\., B\], B = .; it gave "):
        gm.run(experiment, progress=False)
