"""Spheres and grains of unequal size, against closed forms, scaling, brute force and differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import (
    ELASTIC,
    SPHERE,
    TETRA_27,
    blank_state,
    cached_tetra,
    column,
    make_grains,
    orientations,
    record,
    scene,
    still,
)
from test_collisions import hertz_duration

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.kinematics import Unequal, kinematics
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.contact.path import led_contact
from gmem_jax.physics.grain import Clump, clump, sized
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import listed_candidates, slack, sphere_centres
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import still_box
from gmem_jax.simulation.sample import end_bin

BALL = 4.0 * np.pi / 3.0
K_N, K_W = Material().normal_stiffness, Material().wall_stiffness
LARGE, SMALL = 1.6, 0.7
MASSES = BALL * np.array([LARGE, SMALL]) ** 3
REDUCED = MASSES.prod() / MASSES.sum()
HARMONIC = 2.0 * LARGE * SMALL / (LARGE + SMALL)  # 2 R_eff
TWO = sized(SPHERE, [LARGE, SMALL])
CHAIN = clump([[0.0, 0.0, 0.0], [1.3, 0.2, 0.0], [2.0, -0.3, 0.4]], "chain", radii=[1.0, 0.6, 0.4])


def head_on(speed: float, material=ELASTIC, friction=None, tangential=0.0, spin=((0.0, 0.0, 0.0),) * 2, gap=0.0):
    """A large and a small sphere about to touch on the x axis, in the frame where they have no momentum."""
    share = np.array([MASSES[1], -MASSES[0]]) / MASSES.sum()
    at, velocity = np.zeros((2, 3)), np.stack([speed * share, tangential * share, 0.0 * share], axis=1)
    at[:, 0] = -share * (LARGE + SMALL + gap)
    law = Frictionless() if friction is None else friction
    return scene(TWO, at, velocity=velocity, spin=spin, friction=law, material=material)


def test_two_separate_spheres_have_the_mass_and_the_moments_of_both() -> None:
    made = clump([[1.0, 2.0, 3.0], [1.0, 2.0, 7.0]], radii=[1.5, 0.5])
    masses, own = BALL * np.array([1.5, 0.5]) ** 3, 0.4 * BALL * np.array([1.5, 0.5]) ** 5
    apart = 16.0 * masses.prod() / masses.sum()
    assert float(made.mass) == pytest.approx(masses.sum(), rel=2e-5)
    np.testing.assert_allclose(made.inertia, [own.sum(), own.sum() + apart, own.sum() + apart], rtol=5e-5)
    assert float(made.diameter) == pytest.approx(2.0 * (4.0 * masses[0] / masses.sum() + 0.5), rel=1e-5)
    np.testing.assert_array_equal(made.radii, [1.5, 0.5])


def test_what_is_of_size_one_is_what_it_was_before_there_were_sizes() -> None:
    tetra = cached_tetra()
    assert sized(tetra, np.ones(5)) == tetra
    assert clump(tetra.offsets, "tetra(0.6)", radii=np.ones(4)) == clump(tetra.offsets, "tetra(0.6)")
    assert len(jax.tree.leaves(tetra)) == 4


@pytest.mark.parametrize("law", [Hooke(), MindlinRescaled(), Mindlin()], ids=["H", "M1", "M2"])
def test_what_is_twice_as_large_does_the_same_in_twice_the_time(law) -> None:
    """Lengths and times by s, forces by s^2 at the same velocities: then grains, walls and contacts are all scaled."""
    scale, steps, dt = 2.0, 40, 0.3
    places, turns = np.array([[0.0, 0.0, 0.0], [2.5, 0.3, 0.1], [0.4, 2.4, -0.3]]), orientations(3, 4)
    velocity, spin = np.array([[0.02, 0.01, 0.0], [-0.02, 0.0, 0.01], [0.0, -0.03, 0.0]]), np.full((3, 3), 0.01)
    walls = np.array([-1.4, -1.4, -15.0]), np.array([15.0, 15.0, 15.0])
    found = []
    for s in (1.0, scale):
        own = replace(law, damping_time=s * law.damping_time)
        if isinstance(law, Hooke):
            own = replace(own, stiffness=s * law.stiffness)
        if isinstance(law, Mindlin):
            own = replace(own, p_max=s * law.p_max)
        solid = Material(normal_damping=s * Material().normal_damping)
        box = still_box(*(column(s * plane) for plane in walls))
        grain = replace(CHAIN, sizes=jnp.full(3, s))
        system, state, box = scene(grain, s * places, turns, velocity, spin / s, friction=own, material=solid, box=box)
        states, forces, _ = record(system, state, still(box), s * dt, count=steps)
        grains = states.grains
        found.append((grains.position / s, grains.quaternion, grains.velocity, grains.spin * s, forces / s**2))
    assert float(jnp.max(jnp.abs(found[0][3][-1] - 0.01))) > 1e-3
    assert float(jnp.max(found[0][4])) > 1e-3
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("law", [MindlinRescaled(), Mindlin()], ids=["M1", "M2"])
def test_sizes_and_radii_of_one_change_nothing_but_round_off(law) -> None:
    places, velocity = [[0.0, 0.0, 0.0], [2.2, 0.3, 0.1]], [[0.02, 0.01, 0.0], [-0.02, 0.0, 0.01]]
    found = []
    for made in (cached_tetra(), replace(cached_tetra(), radii=jnp.ones(4), sizes=jnp.ones(2))):
        system, state, box = scene(made, places, orientations(2), velocity, velocity, friction=law)
        states, _, _ = record(system, state, still(box), 0.3, count=30)
        found.append((states.grains.position, states.grains.spin_rate, states.grains.acceleration))
    assert float(jnp.max(jnp.abs(found[0][2]))) > 1e-3
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-14)


def test_an_elastic_collision_of_unequal_spheres_has_hertzs_duration_and_keeps_energy_and_momentum() -> None:
    speed, count, stiffness = 0.02, 2000, K_N * HARMONIC**0.5
    duration = hertz_duration(REDUCED, speed, stiffness)
    dt = 1.2 * duration / count
    system, state, box = head_on(speed)
    states, _, _ = record(system, state, still(box), dt, count=count)
    at, velocity = (np.asarray(leaf)[:, :, 0, 0] for leaf in (states.grains.position, states.grains.velocity))
    overlap = LARGE + SMALL - (at[:, 1] - at[:, 0])
    end = np.flatnonzero(overlap > 0.0)[-1]
    lasted = dt * (1 + end + overlap[end] / (overlap[end] - overlap[end + 1]))
    assert lasted == pytest.approx(duration, rel=1e-5)
    np.testing.assert_allclose(velocity[-1, 1] - velocity[-1, 0], speed, rtol=1e-5)
    np.testing.assert_allclose(velocity @ MASSES, 0.0, atol=1e-15)
    energy = 0.5 * velocity**2 @ MASSES + 0.4 * stiffness * np.maximum(overlap, 0.0) ** 2.5
    np.testing.assert_allclose(energy, 0.5 * REDUCED * speed**2, rtol=3e-6)  # as for equal spheres


@pytest.mark.parametrize("law", [Hooke(), MindlinRescaled(), Mindlin()], ids=["H", "M1", "M2"])
def test_an_oblique_collision_of_unequal_spheres_keeps_momentum_and_angular_momentum(law) -> None:
    system, state, box = head_on(0.05, Material(), law, tangential=0.04, spin=[[0.0, 0.01, 0.02], [0.01, 0.0, -0.03]])
    before = end_bin(system, state, box, jnp.ones((3, 1)), 0.0)[1].kinetic_energy
    states, _, _ = record(system, state, still(box), 0.05, count=800)
    grains = jax.tree.map(lambda leaf: np.asarray(leaf)[..., 0], states.grains)
    inertia = 0.4 * BALL * np.array([LARGE, SMALL]) ** 5
    momentum = MASSES[:, None] * grains.velocity
    turning = np.cross(grains.position, momentum) + inertia[:, None] * grains.spin
    np.testing.assert_allclose(momentum.sum(axis=1), 0.0, atol=1e-15)
    total = turning.sum(axis=1)
    np.testing.assert_allclose(total, np.broadcast_to(total[0], total.shape), atol=1e-13 * np.abs(total).max())
    assert np.abs(np.diff(grains.spin[[0, -1]], axis=0)).min(axis=(0, 2)).max() > 0.0
    last = jax.tree.map(lambda leaf: leaf[-1], states)
    after = end_bin(system, last, box, jnp.ones((3, 1)), 0.0)[1].kinetic_energy
    energy = 0.5 * np.sum(MASSES[:, None] * grains.velocity[-1] ** 2 + inertia[:, None] * grains.spin[-1] ** 2)
    assert float(after[0]) == pytest.approx(energy, rel=1e-13)
    assert 0.2 < float(after[0] / before[0]) < 0.95


def contact_of(separation, velocity, one, other):
    """Kinematics of the large sphere and the small one, of grains with these spins."""
    row = [jnp.asarray(vector, float)[None, :, None] for vector in (separation, velocity, one, other)]
    radii = [jnp.full((1, 1, 1), radius) for radius in (LARGE, SMALL)]
    unequal = Unequal(*radii, row[3] - row[2])
    return kinematics(row[0], row[1], row[2] + row[3], jnp.ones(1, bool), jnp.asarray(0.3), unequal)


def test_the_surfaces_of_unequal_spheres_meet_where_their_arms_end() -> None:
    """Sliding by the velocities of both surfaces at the contact point; none of a pair that turns as one body."""
    separation, velocity = np.array([1.2, 1.4, -0.9]), np.array([0.02, -0.01, 0.03])
    one, other = np.array([0.01, 0.02, -0.03]), np.array([-0.04, 0.05, 0.01])
    kin = contact_of(separation, velocity, one, other)
    distance = np.linalg.norm(separation)
    normal, overlap = separation / distance, LARGE + SMALL - distance
    arms = LARGE - 0.5 * overlap, SMALL - 0.5 * overlap
    moving = velocity + np.cross(other, -arms[1] * normal) - np.cross(one, arms[0] * normal)
    np.testing.assert_allclose(kin.sliding[0, :, 0], moving - (moving @ normal) * normal, atol=1e-16)
    np.testing.assert_allclose([kin.arm[0, 0, 0], kin.other_arm[0, 0, 0]], arms, rtol=1e-14)
    assert float(kin.closing[0, 0, 0]) == pytest.approx(-velocity @ normal, rel=1e-13)
    assert float(kin.root[0, 0, 0]) == pytest.approx((HARMONIC * overlap) ** 0.5, rel=1e-13)
    body = contact_of(separation, np.cross(one, separation), one, one)
    np.testing.assert_allclose(body.sliding, 0.0, atol=1e-17)


def test_forces_on_a_small_sphere_are_hertzs_with_its_own_radii() -> None:
    """On a large sphere k_n (2 R_eff)^0.5 p^1.5, on a wall k_w R^0.5 p^1.5."""
    overlap = 0.07
    _, state, _ = head_on(0.0, gap=-overlap)
    force = K_N * HARMONIC**0.5 * overlap**1.5
    np.testing.assert_allclose(state.grains.acceleration[:, 0, 0], [-force, force] / MASSES, rtol=1e-12)
    _, state, _ = scene(sized(SPHERE, [SMALL, LARGE]), [[14.4, 0, 0], [-13.5, 6.0, 0]])
    by_walls = K_W * np.array([SMALL, LARGE]) ** 0.5 * 0.1**1.5 / (BALL * np.array([SMALL, LARGE]) ** 3)
    np.testing.assert_allclose(state.grains.acceleration[:, 0, 0], [-by_walls[0], by_walls[1]], rtol=1e-12)


@pytest.mark.parametrize("variant", ["averaged", "exact", "paper"])
def test_a_mindlin_contact_of_other_radii_is_one_that_is_stiffer_by_the_root_of_their_mean(variant: str) -> None:
    law = Mindlin(mu=0.4, variant=variant)
    stiffer = replace(law, stiffness=law.stiffness * HARMONIC**0.5)
    histories, rescaled = [law.init(1, 1, float)] * 2, [MindlinRescaled().init(1, 1, float)] * 2
    loose = MindlinRescaled(mu=0.4)
    for overlap, sliding in [(0.05, 0.01), (0.09, 0.02), (0.13, 0.0), (0.06, -0.03), (0.02, -0.01), (0.1, 0.02)]:
        kin = led_contact(jnp.asarray([overlap]), jnp.asarray([sliding]), 0.3)
        wide = replace(kin, radius=jnp.full((1, 1, 1), HARMONIC))
        limit = jnp.full((1, 1, 1), overlap**1.5)
        one, histories[0] = law(wide, limit, histories[0])
        other, histories[1] = stiffer(kin, limit, histories[1])
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-16)
        one, rescaled[0] = loose(wide, limit, rescaled[0])
        other, rescaled[1] = replace(loose, stiffness=stiffer.stiffness)(kin, limit, rescaled[1])
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-16)
        assert abs(float(one[0, 0, 0])) > 1e-5


# ---------------------------------------------------------------- lists


def gas(grain: Clump, count: int, lengths: np.ndarray, seed: int = 0):
    """Grains anywhere in a box, and radii of their spheres."""
    random = np.random.default_rng(seed)
    made = sized(grain, random.uniform(0.5, 1.8, count))
    grains = make_grains(random.uniform(3.0, lengths - 3.0, (count, 3)), orientations(count))
    return made, grains, np.asarray(made.sphere_radii(count * grain.spheres))


@pytest.mark.parametrize("periodic", [(False,) * 3, (True, False, True)], ids=["walls", "x and z"])
@pytest.mark.parametrize("search", [None, native.search()], ids=["jax-md", "native"])
def test_the_list_holds_every_pair_that_is_closer_than_its_radii_and_the_skin(periodic, search) -> None:
    lengths, skin = np.array([20.0, 21.0, 22.0]), 0.5
    made, grains, radii = gas(CHAIN, 70, lengths)
    box = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None], periodic)
    pairs = PairFinder(made, lengths, skin, search=search)(grains, made, box)
    at = np.asarray(sphere_centres(grains, made))[..., 0]
    apart = at - at[:, None]
    apart -= np.where(periodic, lengths * np.rint(apart / lengths), 0.0)
    near = np.linalg.norm(apart, axis=-1) < radii + radii[:, None] + skin
    grain = np.arange(len(at)) // 3
    np.testing.assert_array_equal(listed_candidates(pairs), np.nonzero(near & (grain[:, None] < grain)))
    assert float(pairs.reach) == pytest.approx(2.0 * radii.max() + skin, rel=1e-14)


def test_slack_of_unequal_spheres_is_negative_before_any_unlisted_pair_can_touch() -> None:
    lengths, skin = np.full(3, 16.0), 0.6
    made, grains, radii = gas(SPHERE, 40, lengths, 3)
    box = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None])
    pairs = PairFinder(made, lengths, skin)(grains, made, box)
    listed = np.zeros((40, 40), bool)
    listed[tuple(listed_candidates(pairs))] = True
    at, touched = np.asarray(grains.position)[..., 0], 0
    for seed in range(60):
        random = np.random.default_rng(seed)
        shrink = random.uniform(0.93, 1.0)
        moved = shrink * at + random.normal(size=(40, 3)) * random.uniform(0.0, 0.4)
        narrowed = still_box(jnp.zeros((3, 1)), jnp.asarray(shrink * lengths)[:, None])
        grown = radii * random.uniform(0.9, random.choice([0.9, 1.1]), 40)  # since the list was made
        left = float(slack(pairs, jnp.asarray(moved)[..., None], narrowed, jnp.asarray(grown))[0])
        gap = np.linalg.norm(moved - moved[:, None], axis=-1) - grown - grown[:, None]
        unlisted = np.min(gap[np.triu(~listed, 1)])
        assert left <= unlisted
        touched += unlisted < 0.0
    assert touched > 5
    assert float(slack(pairs, grains.position, box, jnp.asarray(radii))[0]) == pytest.approx(skin, rel=1e-12)


# ---------------------------------------------------------------- packs


def bidisperse():
    """The shipped test pack with its grains a little larger and smaller by turns, which press on each other."""
    pack = gm.load_pack(TETRA_27)
    made = sized(pack.clump, np.where(np.arange(27) % 2, 1.03, 0.97))
    return gm.pack_from(replace(pack, clump=made), position=pack.position, quaternion=pack.quaternion)


march = jax.jit(dynamics.march)


def advanced(pack, steps: int = 40):
    """A pack after some steps with friction, and the sum of the pressures."""
    system = dynamics.System(pack.clump, Hooke(), pack.pairs)
    state = dynamics.start(system, pack.position[..., None], pack.quaternion[..., None], pack.box)
    return march(system, state, jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (steps, 3, 1)), pack.box), 0.3, 0.0)


def test_the_order_of_grains_of_unequal_size_changes_nothing() -> None:
    pack = bidisperse()
    order = np.random.default_rng(1).permutation(27)
    other = replace(pack, clump=replace(pack.clump, sizes=pack.clump.sizes[order]))
    other = gm.pack_from(other, position=pack.position[order], quaternion=pack.quaternion[order])
    (one, pressure), (two, same) = advanced(pack), advanced(other)
    assert float(jnp.max(jnp.abs(one.grains.spin))) > 1e-4
    np.testing.assert_allclose(pressure, same, rtol=1e-12)
    np.testing.assert_allclose(one.grains.position[order], two.grains.position, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(one.grains.spin[order], two.grains.spin, rtol=0.0, atol=1e-13)


def test_derivatives_by_a_size_and_by_a_radius_are_differences_in_both_modes() -> None:
    pack = bidisperse()
    wide = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (20, 3, 1)), pack.box)
    state = blank_state(dynamics.System(pack.clump, Hooke(), pack.pairs), make_grains(pack.position, pack.quaternion))

    def pressure(by: jax.Array) -> jax.Array:
        grain = pack.clump
        grain = replace(grain, sizes=grain.sizes.at[4].add(by[0]), radii=jnp.ones(4).at[2].add(by[1]))
        system = dynamics.System(grain, Hooke(), pack.pairs)
        return dynamics.march(system, state, wide, 0.3, 0.0)[1][0, 0]

    at, step = jnp.zeros(2), 1e-7
    backwards = jax.jit(jax.grad(pressure))(at)
    along = jax.jit(lambda at, one: jax.jvp(pressure, (at,), (one,)))
    units = jnp.eye(2)
    differences = [(along(step * one, one)[0] - along(-step * one, one)[0]) / (2.0 * step) for one in units]
    assert float(jnp.min(jnp.abs(backwards))) > 1e-4
    np.testing.assert_allclose([along(at, one)[1] for one in units], backwards, rtol=1e-9)
    np.testing.assert_allclose(differences, backwards, rtol=1e-5)


def test_samples_of_unequal_grains_count_mass_and_walls_by_size() -> None:
    made = sized(SPHERE, [LARGE, SMALL])
    system, state, box = scene(made, [[-13.5, 0, 0], [14.2, 0, 0]], velocity=[[0.1, 0, 0], [0, 0.2, 0]])
    _, sample = end_bin(system, state, box, jnp.ones((3, 1)), 0.0)
    assert float(sample.kinetic_energy[0]) == pytest.approx(0.5 * MASSES @ [0.01, 0.04], rel=1e-14)
    assert float(sample.filling[0]) == pytest.approx(MASSES.sum() / 30.0**3, rel=1e-14)
    assert float(sample.wall_contacts[0]) == 0.5  # the small one at 14.2 is 0.1 R from its wall


@pytest.mark.parametrize(
    ("radii", "said"),
    [
        ([1.0, 0.0], "clump radii must be 2 positive numbers"),
        ([1.0, -1.0], "clump radii must be 2 positive numbers"),
        ([1.0, np.nan], "clump radii must be 2 positive numbers"),
        ([1.0], "clump radii must be 2 positive numbers"),
        ("large", "clump radii must be 2 positive numbers"),
        ([1.0, np.inf], r"radii of spheres must be in \[0.1, 10\] R, got 1 to inf"),
        ([1.0, 0.09], r"radii of spheres must be in \[0.1, 10\] R, got 0.09 to 1"),
        ([3.0, 0.2], "spheres of radii 0.2 to 3 R cannot be listed together: the largest may be 10 times the smallest"),
    ],
)
def test_impossible_radii_are_refused_in_a_line(radii, said: str) -> None:
    with pytest.raises(ValueError, match=said) as error:
        clump([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], radii=radii)
    assert "\n" not in str(error.value)


def test_a_pack_has_a_size_for_each_grain_or_none() -> None:
    pack = gm.load_pack(TETRA_27)
    few = replace(pack, clump=sized(pack.clump, np.full(26, 1.01)))
    with pytest.raises(ValueError, match="a pack of 27 grains needs a size for each grain, got 26"):
        gm.pack_from(few, position=pack.position, quaternion=pack.quaternion)


def test_impossible_sizes_are_refused_in_a_line_by_the_grain_and_by_the_list() -> None:
    for sizes in ([1.0, 0.0], [1.0, -2.0], [1.0, np.nan], [[1.0]], "all"):
        with pytest.raises(ValueError, match="sizes must be N positive numbers"):
            sized(SPHERE, sizes)
    with pytest.raises(ValueError, match=r"spheres of radii 0.2 to 2.5 R cannot be listed together"):
        sized(CHAIN, [2.5, 0.5])
    heap = replace(SPHERE, sizes=jnp.asarray([0.2, 3.0]))
    with pytest.raises(ValueError, match="cannot be listed together"):
        PairFinder(heap, np.full(3, 30.0), 0.3)
