"""The time step as a primitive: replicas, symmetry, status bits, drag, observables, compilation, derivatives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import (
    ELASTIC,
    FREE,
    SPHERE,
    advance,
    advance_by,
    advance_plain,
    blank_state,
    cached_tetra,
    cluster27,
    coast,
    column,
    make_grains,
    orientations,
    scene,
    squeeze,
    still,
)

from gmem_jax.experiment.signals import Bumps
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.grain import clump
from gmem_jax.physics.pairs import sphere_centres
from gmem_jax.physics.rotation import matrix
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Box, State, Status, explain, replicate, still_box
from gmem_jax.physics.system import System
from gmem_jax.simulation.compiled import Compiled
from gmem_jax.simulation.sample import Sample, end_bin

START, ENDED = jax.jit(dynamics.start), jax.jit(end_bin)
AMPLITUDES = (1e-3, 5e-3, 2e-2, 3e-2)


def checked(system: System, state: State, box: Box) -> State:
    """The state with the status bits that the end of a bin sets."""
    after: State = ENDED(system, state, box, jnp.zeros((3, state.replicas)), 0.0)[0]
    return after


def observed(system: System, state: State, box: Box) -> Sample:
    sample: Sample = ENDED(system, state, box, jnp.zeros((3, state.replicas)), 0.0)[1]
    return sample


def pulse(count: int) -> Bumps:
    """`count` copies of one wide bump."""
    return Bumps(jnp.ones((count, 1)), jnp.full((count, 1), 0.5), 0.9)


def sheared_cluster(amplitudes, run=advance):
    """300 steps of compression, one replica per shear amplitude beside the unsheared one."""
    count = len(amplitudes)
    system, state, box = cluster27(replicas=count + 1)
    shear = {"gamma0": jnp.asarray([0.0, *amplitudes]), "signals": pulse(count)} if count else {}
    return run(system, state, squeeze(box, 400.0, **shear), 0.3, bins=3, steps=100)


@pytest.fixture(scope="module")
def five():
    return sheared_cluster(AMPLITUDES)


def replica(tree, index):
    return jax.tree.map(lambda leaf: leaf[..., index], tree)


def assert_equal_trees(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def assert_same_replicas(one, other):
    """Bit for bit in jax 0.9; later releases vectorise by the number of replicas, which is left in the round-off.

    Measured after 300 steps with jax 0.12: 1e-15 of a position, and 3e-11 of the largest acceleration, which is what is
    left of forces that balance.
    """
    if jax.__version_info__ < (0, 10):
        assert_equal_trees(one, other)
        return
    for leaf, expected in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(leaf, expected, rtol=1e-12, atol=3e-10 * np.abs(expected).max())


@pytest.mark.parametrize("chosen", [(1,), pytest.param((3,), marks=pytest.mark.slow)])
def test_a_replica_does_not_depend_on_its_neighbours_in_the_batch(five, chosen):
    few = sheared_cluster([AMPLITUDES[k] for k in chosen])
    assert_same_replicas(few, replica(five, np.array([0, *(k + 1 for k in chosen)])))
    assert np.ptp(five[1].pressure[-1, 0]) > 1e-4  # the replicas do differ


def test_a_lone_replica_is_the_same_to_round_off(five):
    # With B = 1 XLA lays the arrays out, and fuses multiplications and additions, differently: 1e-15 of a pressure
    # and 1e-12 of the largest history are measured after 300 steps.
    state, sample = sheared_cluster(())
    np.testing.assert_allclose(sample.pressure[..., 0], five[1].pressure[..., 0], rtol=1e-13)
    scale = np.abs(five[0].history[..., 0]).max()
    np.testing.assert_allclose(state.history[..., 0], five[0].history[..., 0], atol=1e-11 * scale)


def test_the_compiler_settings_of_the_host_loop_change_only_round_off(five):
    # They vectorise over replicas, so that results there depend on the batch by round-off.
    state, sample = sheared_cluster(AMPLITUDES, Compiled(advance_plain, static_argnames=("bins", "steps")))
    np.testing.assert_allclose(sample.pressure, five[1].pressure, rtol=1e-13)
    np.testing.assert_allclose(state.grains.position, five[0].grains.position, rtol=1e-14, atol=1e-14)


def test_vmap_over_the_amplitude_equals_the_replica_axis(five):
    system, state, box = cluster27(replicas=2)

    def one(gamma0):
        return advance_plain(
            system, state, squeeze(box, 400.0, gamma0=gamma0, signals=pulse(1)), 0.3, bins=3, steps=100
        )

    _, samples = jax.jit(jax.vmap(one))(jnp.asarray(AMPLITUDES))
    # Same arithmetic in another layout: round-off only.
    np.testing.assert_allclose(samples.pressure[..., 1], np.moveaxis(five[1].pressure[..., 1:], -1, 0), rtol=1e-13)
    np.testing.assert_allclose(samples.pressure[2, ..., 0], five[1].pressure[..., 0], rtol=1e-13)


def test_a_friction_law_can_differ_between_replicas():
    system, state, box = cluster27(Hooke(mu=jnp.asarray([0.0, 0.3]), stiffness=jnp.asarray([0.1, 0.2])), replicas=2)
    both = advance(system, state, squeeze(box, 400.0), 0.3, bins=3, steps=100)
    for index, law in enumerate((Hooke(mu=0.0, stiffness=0.1), Hooke(mu=0.3, stiffness=0.2))):
        system, state, _ = cluster27(law)
        alone = advance(system, state, squeeze(box, 400.0), 0.3, bins=3, steps=100)
        np.testing.assert_allclose(both[1].pressure[..., index], alone[1].pressure[..., 0], rtol=1e-12)
    assert np.ptp(both[1].pressure[-1, 0]) > 1e-5


def mirrored(state):
    """The state with x and y exchanged: spins and the vector parts of quaternions also change sign."""
    grains, swap = state.grains, jnp.asarray([1, 0, 2])
    return {
        "position": grains.position[:, swap, 0],
        "quaternion": jnp.concatenate([grains.quaternion[:, :1], -grains.quaternion[:, 1:][:, swap]], axis=1)[..., 0],
    }


def test_exchanging_x_and_y_exchanges_the_pressures_and_the_sign_of_the_shear():
    system, state, box = cluster27()
    finder = PairFinder(cached_tetra(), np.asarray(box.lengths)[:, 0], 0.5, capacity=system.pairs.capacity)
    image = make_grains(**mirrored(state))
    image_system = replace(system, pairs=finder(image, cached_tetra(), box))

    def run(system, grains, gamma0):
        start = START(system, grains.position, grains.quaternion, box)
        motion = squeeze(box, 400.0, gamma0=gamma0, signals=pulse(1))
        return advance(system, replicate(start, 2), motion, 0.3, bins=3, steps=100)[1]

    plain, image = run(system, state.grains, 0.02), run(image_system, image, -0.02)
    # The image sums other spheres in another order: round-off, growing a little over 300 steps.
    np.testing.assert_allclose(image.pressure[:, [1, 0, 2]], plain.pressure, rtol=1e-11)
    assert np.abs(plain.pressure[-1, 0] / plain.pressure[-1, 1] - 1.0).max() > 0.1  # x and y are not alike


def test_advancing_in_chunks_is_the_same_run_and_compiles_once():
    system, state, box = cluster27()
    motion = squeeze(box, 400.0)
    jitted = jax.jit(advance_by(dynamics.march), static_argnames=("bins", "steps"))
    whole, samples = advance(system, state, motion, 0.3, bins=4, steps=30)
    parts = []
    for first in (0, 2):  # chunks of two bins: the compiler takes a loop of one apart, and rounds otherwise
        state, sample = jitted(system, state, motion, 0.3, first, bins=2, steps=30)
        parts.append(sample)
    assert jitted._cache_size() == 1
    np.testing.assert_array_equal(np.concatenate([part.pressure for part in parts]), samples.pressure)
    assert_equal_trees(state, whole)


def test_a_bin_is_the_average_over_its_steps():
    system, state, box = cluster27()
    motion = squeeze(box, 400.0, delta0=0.3)
    # Two steps to a bin at least: the compiler takes a loop of one apart, and sums in another order.
    middle, early = advance(system, state, motion, 0.3, bins=3, steps=2)
    _, late = advance(system, middle, motion, 0.3, 3, bins=3, steps=2)
    each = jax.tree.map(lambda a, b: np.concatenate([a, b]), early, late)
    _, whole = advance(system, state, motion, 0.3, bins=3, steps=4)
    # The same 12 steps, their sum rounded twice.
    np.testing.assert_allclose(whole.pressure, each.pressure.reshape(3, 2, 3, 1).mean(1), rtol=1e-14)
    np.testing.assert_array_equal(whole.kinetic_energy, each.kinetic_energy[1::2])
    np.testing.assert_array_equal(whole.lengths, each.lengths[1::2])
    assert np.ptp(each.pressure[:2, 0]) > 1e-6  # the average is not the last step's


def test_a_clean_run_has_a_clean_status(five):
    assert np.all(np.asarray(five[0].status) == 0)
    assert explain(0) == "ok"


def test_status_bits_name_what_is_wrong_with_which_replica():
    system, state, box = cluster27(replicas=4)
    grains = state.grains
    position = grains.position.at[3, 0, 1].add(0.3)  # more than half the skin of 0.5
    position = position.at[5, 2, 2].set(-1.0)
    bad = replace(grains, position=position, acceleration=grains.acceleration.at[0, 0, 3].set(jnp.nan))
    status = checked(system, replace(state, grains=bad), box).status
    assert [int(s) for s in status] == [
        0,
        Status.STALE_PAIRS,
        Status.STALE_PAIRS | Status.OUTSIDE_BOX,
        Status.NOT_FINITE,
    ]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_grain_is_outside_when_a_sphere_centre_has_crossed_a_wall(axis):
    grain = cached_tetra()
    box = still_box(column([-4.0, -5.0, -6.0]), column([4.0, 5.0, 6.0]))
    offsets = np.asarray(grain.offsets)
    flagged = []
    for wall, outermost in ((box.lower, offsets[:, axis].min()), (box.upper, offsets[:, axis].max())):
        for beyond in (-1e-9, 1e-9):
            position = np.zeros((1, 3))
            position[0, axis] = float(wall[axis, 0]) - outermost + beyond * np.sign(outermost)
            system, state, _ = scene(grain, position, box=box)
            flagged.append(bool(checked(system, state, box).status[0] & Status.OUTSIDE_BOX))
    assert flagged == [False, True, False, True]


def test_a_list_is_stale_when_a_sphere_has_moved_by_half_its_skin():
    lengths = np.array([9.0, 12.0, 10.0])
    box = still_box(jnp.zeros((3, 1)), column(lengths))
    grains = make_grains(np.random.default_rng(0).uniform(1.0, lengths - 1.0, (30, 3)))
    system = System(SPHERE, Hooke(), PairFinder(SPHERE, lengths, 0.5)(grains, SPHERE, box))
    state = blank_state(system, grains)
    for step, expected in ((0.25 - 1e-9, 0), (0.25 + 1e-9, int(Status.STALE_PAIRS))):
        moved = replace(grains, position=grains.position.at[3, 0, 0].add(step))
        assert int(checked(system, replace(state, grains=moved), box).status[0]) == expected


def test_a_nan_position_is_not_finite_rather_than_stale():
    # A stale list is rebuilt and the chunk repeated; that would not help here.
    system, state, box = cluster27()
    bad = replace(state.grains, position=state.grains.position.at[0, 0].set(jnp.nan))
    assert int(checked(system, replace(state, grains=bad), box).status[0]) == Status.NOT_FINITE


def test_status_bits_are_sticky():
    system, state, box = cluster27()
    flagged = replace(state, status=jnp.asarray([int(Status.OUTSIDE_BOX)], jnp.int32))
    after, _ = advance(system, flagged, still(box), 0.3, bins=3, steps=10)
    assert int(after.status[0]) == Status.OUTSIDE_BOX


def test_a_nan_in_one_replica_leaves_the_others_alone(five):
    system, state, box = cluster27(replicas=5)
    broken = state.grains.velocity.at[4, 1, 2].set(jnp.nan)
    state = replace(state, grains=replace(state.grains, velocity=broken))
    motion = squeeze(box, 400.0, gamma0=jnp.asarray([0.0, *AMPLITUDES]), signals=pulse(4))
    after, sample = advance(system, state, motion, 0.3, bins=3, steps=100)
    others = np.array([0, 1, 3, 4])
    assert_equal_trees(replica((after, sample), others), replica(five, others))
    assert int(after.status[2]) & Status.NOT_FINITE


def test_drag_slows_a_free_grain_at_its_rate():
    rate, dt, steps = 0.05, 0.1, 400
    system, state, box = scene(SPHERE, [[0, 0, 0]], velocity=[[0.1, -0.05, 0.02]], spin=[[0.2, 0.1, -0.3]])
    start = replace(state.grains, acceleration=-rate * state.grains.velocity, spin_rate=-rate * state.grains.spin)
    after = coast(system, replace(state, grains=start), box, dt, steps, rate).grains
    factor = np.exp(-rate * dt * steps)
    # The scheme's factor per step errs by 5/12 (rate dt)^3: 2.1e-5 over 400 steps.
    np.testing.assert_allclose(after.velocity, factor * state.grains.velocity, rtol=2.5e-5)
    np.testing.assert_allclose(after.spin, factor * state.grains.spin, rtol=2.5e-5)
    np.testing.assert_allclose(after.position, (1.0 - factor) / rate * state.grains.velocity, rtol=1e-3)


def test_a_free_grain_moves_in_a_straight_line_and_turns_about_its_spin():
    spin = np.array([[0.03, -0.02, 0.06]])
    system, state, box = scene(SPHERE, [[0, 0, 0]], orientations(1), [[0.01, 0.02, -0.03]], spin)
    after = coast(system, state, box, 0.1, 500).grains
    np.testing.assert_allclose(after.position[0, :, 0], 50.0 * np.array([0.01, 0.02, -0.03]), rtol=1e-12)
    angle, axis = 50.0 * np.linalg.norm(spin), spin[0] / np.linalg.norm(spin)
    k = np.cross(axis, np.eye(3)).T
    turned = (np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k) @ matrix(state.grains.quaternion)[0, ..., 0]
    np.testing.assert_allclose(matrix(after.quaternion)[0, ..., 0], turned, atol=1.5e-5)  # 500 x (0.007)^3 / 12


def test_a_symmetric_top_precesses_at_the_rate_of_its_angular_momentum():
    # Torque-free: the symmetry axis circles the fixed angular momentum L at |L| / I_perpendicular.
    top = clump([[0.7, 0, 0], [-0.7, 0, 0]])
    along, across = float(top.inertia[0]), float(top.inertia[1:].mean())
    spin = np.array([0.08, 0.05, 0.0])  # axis of symmetry along x
    momentum = np.array([along, across, across]) * spin
    grains = make_grains([[0, 0, 0]], spin=[spin])
    angle = np.linalg.norm(momentum) / across * 60.0
    unit = momentum / np.linalg.norm(momentum)
    k = np.cross(unit, np.eye(3)).T
    expected = (np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)[:, 0]
    errors = []
    for steps in (300, 600):
        system, state, box = scene(top, grains.position[..., 0], spin=grains.spin[..., 0])
        after = coast(system, state, box, 60.0 / steps, steps).grains
        body_axis = np.sign(spin @ np.eye(3)[0]) * matrix(after.quaternion)[0, :, 0, 0]
        errors.append(np.linalg.norm(body_axis - expected))
        rotation = np.asarray(matrix(after.quaternion))[0, ..., 0]
        now = rotation @ (np.asarray(top.inertia) * (rotation.T @ np.asarray(after.spin)[0, :, 0]))
        np.testing.assert_allclose(now, momentum, rtol=1e-4, atol=1.5e-5 * np.linalg.norm(momentum))
    # Second order: a quarter at half the step. The two transverse moments agree to 1e-5 only.
    assert errors[0] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_observables_are_those_counted_by_hand():
    # Tetrahedra 0 and 1 touch through several spheres, 2 is alone: Z = 2/3 from one touching pair.
    grain = cached_tetra()
    velocity, spin = np.array([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]]), np.array([[0, 0.1, 0], [0.2, 0, 0], [0, 0, 0]])
    system, state, box = scene(grain, [[0, 0, 0], [1.9, 0, 0], [0, 8, 0]], orientations(3), velocity, spin)
    sample = observed(system, state, box)
    spheres = np.asarray(sphere_centres(state.grains, grain))[..., 0].reshape(3, 4, 3)
    overlaps = 2.0 - np.linalg.norm(spheres[0][:, None] - spheres[1], axis=-1)
    assert (overlaps > 0.0).sum() > 1
    assert float(sample.coordination[0]) == pytest.approx(2.0 / 3.0, rel=1e-15)
    assert float(sample.contacts[0]) == pytest.approx(2.0 * (overlaps > 0.0).sum() / 3.0, rel=1e-15)
    tight = still_box(jnp.full((3, 1), -1.3), jnp.asarray([[3.2], [9.3], [1.3]]))  # cuts off some spheres' caps
    near = spheres.reshape(-1, 3)
    on_walls = int((near < -1.3 + 1.0).sum() + (near > np.array([3.2, 9.3, 1.3]) - 1.0).sum())
    assert on_walls > 3
    once = (int((overlaps > 0.0).sum()) + on_walls) / 3.0
    within = observed(system, state, tight)
    assert float(within.contacts_per_grain[0]) == pytest.approx(once, rel=1e-15)
    assert float(sample.largest_overlap[0]) == pytest.approx(overlaps.max(), rel=1e-12)
    mass, inertia = float(grain.mass), float(grain.inertia[0])
    energy = 0.5 * mass * (velocity**2).sum() + 0.5 * inertia * (spin**2).sum()
    assert float(sample.kinetic_energy[0]) == pytest.approx(energy, rel=1e-12)
    assert float(sample.largest_speed[0]) == pytest.approx(0.3, rel=1e-14)
    assert float(sample.filling[0]) == pytest.approx(3.0 * mass / 30.0**3, rel=1e-12)


def test_the_kinetic_energy_of_a_turned_anisotropic_grain_is_that_of_its_own_tensor():
    grain = clump([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [0.2, 0.6, 0.0]])
    moments = np.asarray(grain.inertia)
    assert np.ptp(moments) > 0.3 * moments.mean()
    assert not grain.isotropic
    velocity, spin = np.random.default_rng(0).normal(size=(2, 5, 3))
    system, state, box = scene(grain, 8.0 * np.eye(5, 3) - 4.0, orientations(5), velocity, spin)
    rotation = np.asarray(matrix(state.grains.quaternion))[..., 0]
    tensor = np.einsum("nij,j,nkj->nik", rotation, moments, rotation)
    energy = 0.5 * float(grain.mass) * (velocity**2).sum() + 0.5 * np.einsum("ni,nij,nj->", spin, tensor, spin)
    sample = observed(system, state, box)
    assert float(sample.kinetic_energy[0]) == pytest.approx(energy, rel=1e-12)


def test_wall_pressure_is_the_mean_force_of_two_walls_over_their_area():
    box = still_box(jnp.zeros((3, 1)), column([2.0, 4.0, 5.0]))
    walls = jnp.asarray([[[1.0], [2.0], [3.0]], [[3.0], [4.0], [5.0]]])
    np.testing.assert_allclose(
        dynamics.wall_pressure(walls, box)[:, 0], [2.0 / 20.0, 3.0 / 10.0, 4.0 / 8.0], rtol=1e-15
    )


def test_start_gives_the_accelerations_of_the_configuration():
    system, state, _ = scene(SPHERE, [[0, 0, 0], [1.9, 0, 0]], material=ELASTIC)
    start = START(system, state.grains.position, state.grains.quaternion, FREE)
    force = ELASTIC.normal_stiffness * 0.1**1.5
    np.testing.assert_allclose(
        start.grains.acceleration[:, 0, 0], [-force / SPHERE.mass, force / SPHERE.mass], rtol=1e-12
    )
    assert np.all(np.asarray(start.grains.velocity) == 0.0)
    assert int(start.status[0]) == 0


def final_pressure(mu, stiffness, gamma0):
    """A scalar of the end of 100 steps of the sheared cluster: the pressure difference of the sheared replica."""
    system, state, box = cluster27(Hooke(mu=mu, stiffness=stiffness), replicas=2)
    motion = squeeze(box, 60.0, delta0=0.1, gamma0=gamma0, signals=pulse(1))
    _, sample = advance_plain(system, state, motion, 0.3, bins=2, steps=50)
    return 1e3 * (sample.pressure[-1, 0, 1] - sample.pressure[-1, 1, 1])


@pytest.mark.slow
def test_reverse_mode_gradients_agree_with_central_differences():
    point = (0.2, 0.145, 0.02)  # mu small enough for many contacts to slide
    cluster27()  # built outside of tracing
    gradient = jax.jit(jax.grad(final_pressure, argnums=(0, 1, 2)))(*point)
    value = jax.jit(final_pressure)
    for k, slope in enumerate(gradient):
        step = 1e-5 * point[k]
        ends = [value(*(p + sign * step * (i == k) for i, p in enumerate(point))) for sign in (1, -1)]
        central = (ends[0] - ends[1]) / (2.0 * step)
        assert np.isfinite(slope)
        assert abs(float(slope)) > 1e-3
        # Round-off of a difference 1e-5 wide: 1e-10; truncation: 1e-10. A contact that starts or stops sliding inside
        # it would cost more, and 1e-5 leaves no room for a missing term.
        assert float(slope) == pytest.approx(float(central), rel=1e-5)
