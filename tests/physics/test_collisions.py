"""Collisions of spheres against closed forms and an independent integration of the same contact law."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ELASTIC, FREE, SPHERE, Motion, column, record, scene, still

from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.material import Material
from gmem_jax.physics.state import still_box

MASS, INERTIA = float(SPHERE.mass), float(SPHERE.inertia[0])
K_N, K_W = Material().normal_stiffness, Material().wall_stiffness
COUNT = 2000  # steps of every recorded run: one compilation serves them all


def hertz_depth(mass: float, speed: float, stiffness: float) -> float:
    """Deepest overlap of an elastic collision: m v^2 / 2 = (2/5) k p^2.5."""
    return (5.0 * mass * speed**2 / (4.0 * stiffness)) ** 0.4


def hertz_duration(mass: float, speed: float, stiffness: float) -> float:
    """Duration of an elastic collision: 2 int_0^1 dx / sqrt(1 - x^2.5) = 2.9433 times depth / speed."""
    return 0.8 * math.sqrt(math.pi) * math.gamma(0.4) / math.gamma(0.9) * hertz_depth(mass, speed, stiffness) / speed


def restitution(mass: float, speed: float, stiffness: float, damping_time: float) -> float:
    """-v_after / v_before of the damped, clipped Hertz law, by Runge-Kutta 4 on its own clock."""

    def rate(p, v):
        force = stiffness * np.sqrt(max(p, 0.0)) * (max(p, 0.0) + damping_time * v)
        return np.array([v, -max(0.0, force) / mass])

    h = hertz_duration(mass, speed, stiffness) / 4000.0
    state = np.array([0.0, speed])
    while state[0] > 0.0 or state[1] > 0.0:
        k1 = rate(*state)
        k2 = rate(*(state + 0.5 * h * k1))
        k3 = rate(*(state + 0.5 * h * k2))
        k4 = rate(*(state + h * k3))
        state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return -state[1] / speed


def head_on(speed: float, material: Material = ELASTIC, friction=None, tangential: float = 0.0, spin: float = 0.0):
    """Two spheres about to touch on the x axis, closing at `speed`, sliding past each other at `tangential`."""
    velocity = 0.5 * np.array([[speed, tangential, 0.0], [-speed, -tangential, 0.0]])
    return scene(
        SPHERE,
        [[-1.0, 0, 0], [1.0, 0, 0]],
        velocity=velocity,
        spin=[[0, 0, spin]] * 2,
        friction=Hooke() if friction is None else friction,
        material=material,
    )


def run(system, state, box, duration: float):
    """The states of `duration`, with the initial one first; numpy arrays [COUNT + 1, N, 3]."""
    states, _, _ = record(system, state, still(box), duration / COUNT, count=COUNT)
    first = jax.tree.map(lambda leaf: leaf[None], state.grains)
    both = jax.tree.map(lambda a, b: np.concatenate([a, b])[..., 0], first, states.grains)
    return both.position, both.velocity, both.spin, both.acceleration


def tangent_frame(position):
    """Overlap [T], and unit normal and tangent (in the plane of motion) of the pair, [T, 3]."""
    separation = position[:, 1] - position[:, 0]
    distance = np.linalg.norm(separation, axis=1, keepdims=True)
    normal = separation / distance
    return 2.0 - distance[:, 0], normal, np.cross([0.0, 0.0, 1.0], normal)


@pytest.mark.parametrize("speed", [1e-3, 0.05])
def test_an_elastic_collision_has_hertzs_peak_force_and_duration(speed):
    duration = hertz_duration(MASS / 2, speed, K_N)
    time = 1.2 * duration
    position, velocity, _, acceleration = run(*head_on(speed), time)
    overlap = 2.0 - (position[:, 1, 0] - position[:, 0, 0])
    peak = K_N * hertz_depth(MASS / 2, speed, K_N) ** 1.5
    # 1700 steps of a smooth force: its square is resolved to 1e-6, its maximum to a curvature of (1/1700)^2.
    assert MASS * acceleration[:, 1, 0].max() == pytest.approx(peak, rel=1e-5)
    assert overlap.max() == pytest.approx(hertz_depth(MASS / 2, speed, K_N), rel=1e-5)
    end = np.flatnonzero(overlap > 0.0)[-1]
    dt = time / COUNT
    lasted = dt * (end + overlap[end] / (overlap[end] - overlap[end + 1]))
    assert lasted == pytest.approx(duration, rel=1e-5)
    np.testing.assert_allclose(velocity[-1, :, 0], [-0.5 * speed, 0.5 * speed], rtol=1e-5)


def test_energy_is_conserved_through_an_elastic_collision():
    speed = 0.05
    position, velocity, _, _ = run(*head_on(speed), 1.2 * hertz_duration(MASS / 2, speed, K_N))
    overlap = np.maximum(0.0, 2.0 - (position[:, 1, 0] - position[:, 0, 0]))
    energy = 0.5 * MASS * (velocity**2).sum((1, 2)) + 0.4 * K_N * overlap**2.5
    # Verlet's energy wobbles by the square of the step, (2 pi / 1700)^2 / 10 of the whole.
    np.testing.assert_allclose(energy, energy[0], rtol=3e-6)


@pytest.fixture(scope="module")
def speeds_and_restitutions():
    """Five collision speeds over four decades, one per replica, each with its own time step."""
    speeds = np.array([1e-5, 1e-4, 1e-3, 1e-2, 1e-1])
    system, state, box = head_on(1.0, material=Material())
    state = jax.tree.map(lambda leaf: jnp.repeat(leaf, 5, axis=-1), state)
    state = replace(state, grains=replace(state.grains, velocity=state.grains.velocity * speeds))
    dt = jnp.asarray([1.5 * hertz_duration(MASS / 2, speed, K_N) / COUNT for speed in speeds])
    states, _, _ = record(system, state, still(box), dt, count=COUNT)
    after = np.asarray(states.grains.velocity)[-1, 1, 0] * 2.0
    return speeds, after / speeds


def test_damped_restitution_agrees_with_an_independent_integration(speeds_and_restitutions):
    for speed, measured in zip(*speeds_and_restitutions, strict=True):
        # The damping force starts as a square root: order 1.5, of 1300 steps.
        assert measured == pytest.approx(restitution(MASS / 2, speed, K_N, 0.23), rel=5e-5)


def test_restitution_falls_with_speed_and_stays_between_zero_and_one(speeds_and_restitutions):
    measured = speeds_and_restitutions[1]
    # 1 - e grows like speed^(1/5) while it is small: by 10^0.2 a decade.
    assert np.all((measured > 0.0) & (measured < 1.0))
    loss = 1.0 - measured
    np.testing.assert_allclose(loss[1:3] / loss[:2], 10.0**0.2, rtol=0.03)
    assert np.all(np.diff(loss) > 0.0)


def test_damped_spheres_never_attract():
    system, state, box = head_on(0.1, material=Material(normal_damping=5.0))
    time = 1.5 * hertz_duration(MASS / 2, 0.1, K_N)
    position, _, _, acceleration = run(system, state, box, time)
    overlap = 2.0 - (position[:, 1, 0] - position[:, 0, 0])
    unclipped = np.sqrt(np.maximum(overlap, 0.0)) * (overlap + 5.0 * np.gradient(overlap, time / COUNT))
    assert unclipped.min() < -0.1 * unclipped.max()  # damping alone would have pulled them back
    assert acceleration[:, 1, 0].min() == 0.0


def test_gross_sliding_gives_mu_times_the_normal_impulse_and_spins_both_alike():
    # Sliding persists while v_t > 3.5 mu (1 + e) v_n; slow, so that the contact hardly turns or sinks in (p ~ 1e-3).
    mu, speed = 0.05, 1e-4
    position, velocity, spin, acceleration = run(
        *head_on(speed, friction=Hooke(mu=mu, damping_time=0.0), tangential=speed),
        1.2 * hertz_duration(MASS / 2, speed, K_N),
    )
    overlap, normal, tangent = tangent_frame(position)
    force = MASS * acceleration[:, 0]
    along, across = -(force * normal).sum(1), (force * tangent).sum(1)
    slid = overlap > 0.0
    # Every step of the contact slides (the first too: p^1.5 is less than the spring's k s), backwards on sphere 0.
    np.testing.assert_allclose(across[slid], -mu * along[slid], rtol=1e-11)
    assert np.all(across[~slid] == 0.0)
    # Elastic normal collision: J_n = m v_n; arms are 1 - p/2 with p < 1.2e-3, and the contact turns by 1.7e-3.
    impulse = mu * MASS * speed
    np.testing.assert_allclose(velocity[-1, 0, 1], 0.5 * speed - impulse / MASS, rtol=2e-3)
    np.testing.assert_allclose(spin[-1, :, 2], -impulse / INERTIA, rtol=2e-3)
    np.testing.assert_allclose(spin[-1, 0], spin[-1, 1], rtol=1e-12)


def test_a_gripping_collision_leaves_five_sevenths_of_the_tangential_velocity():
    """Equal impulses J on both: u' = u - 2 J / m, and the sliding s' = s - (2 J / m)(1 + m R^2 / I) = s - 7 J / m.

    Where the contact grips without springing back s' = 0: u' = u - (2/7) s, 5/7 of u without spin.
    """
    speed = 1e-4
    # All dashpot, no spring, no limit to speak of: sliding decays at 7 c / m = 7 per t_c, over a contact of 33 t_c.
    grip = Hooke(mu=1e9, stiffness=1e-9 * MASS, damping_time=1e9)
    for spin in (0.0, 0.3 * speed):
        system, state, box = head_on(speed, friction=grip, tangential=speed, spin=spin)
        position, velocity, spins, _ = run(system, state, box, 1.2 * hertz_duration(MASS / 2, speed, K_N))
        _, _, tangent = tangent_frame(position)
        relative = ((velocity[:, 1] - velocity[:, 0]) * tangent).sum(1)
        start = -speed - 2.0 * spin  # u - (w_1 + w_2) R, all along +y of the frame
        # Arms 1 - p/2, p < 1.2e-3.
        assert relative[-1] == pytest.approx(-speed - 2.0 / 7.0 * start, rel=2e-3)
        sliding = relative[-1] - spins[-1, :, 2].sum()
        assert abs(sliding) < 1e-3 * abs(start)


def test_an_oblique_collision_conserves_momentum_and_angular_momentum():
    system, state, box = head_on(0.05, material=Material(), friction=Hooke(), tangential=0.04, spin=0.02)
    position, velocity, spin, _ = run(system, state, box, 1.5 * hertz_duration(MASS / 2, 0.05, K_N))
    total = MASS * np.cross(position, velocity).sum(1) + INERTIA * spin.sum(1)
    scale = np.abs(total[0]).max()
    np.testing.assert_allclose(total, np.broadcast_to(total[0], total.shape), atol=1e-13 * scale)  # round-off
    np.testing.assert_allclose(velocity.sum(1), 0.0, atol=1e-15)


def wall_scene(speed: float, material: Material):
    """A sphere about to touch the upper x wall at `speed` towards it; the wall is at x = 15."""
    return scene(SPHERE, [[14.0, 0, 0]], velocity=[[speed, 0, 0]], material=material)


def test_a_sphere_bounces_off_a_wall_with_the_walls_stiffness():
    speed = 0.03
    system, state, box = wall_scene(speed, ELASTIC)
    position, velocity, _, acceleration = run(system, state, box, 1.2 * hertz_duration(MASS, speed, K_W))
    depth = hertz_depth(MASS, speed, K_W)
    assert position[:, 0, 0].max() - 14.0 == pytest.approx(depth, rel=1e-5)
    assert -MASS * acceleration[:, 0, 0].min() == pytest.approx(K_W * depth**1.5, rel=1e-5)
    assert velocity[-1, 0, 0] == pytest.approx(-speed, rel=1e-5)


def moving_wall(speed: float, duration: float) -> Motion:
    """Walls of FREE that come in at `speed` from both sides of x and y, from their places at rest."""
    squeeze = 2.0 * speed * duration / 30.0
    return Motion(FREE.lower, FREE.upper, 1.0 - (1.0 - squeeze) ** 2, 0.0, 1.0, duration)


@pytest.mark.parametrize("material", [ELASTIC, Material()])
def test_a_moving_wall_throws_a_resting_sphere_as_if_the_sphere_had_come_to_it(material):
    speed = 0.02
    time = 1.5 * hertz_duration(MASS, speed, K_W)
    system, state, _ = wall_scene(0.0, material)
    states, walls, _ = record(system, state, moving_wall(speed, time), time / COUNT, count=COUNT)
    thrown = float(states.grains.velocity[-1, 0, 0, 0])
    bounce = restitution(MASS, speed, K_W, material.normal_damping)
    # Damping starts as a square root of the overlap: order 1.5, of 1300 steps.
    assert thrown == pytest.approx(-speed * (1.0 + bounce), rel=1e-5 if material is ELASTIC else 5e-5)
    # The recorded wall force is what gave the momentum (kicks of half a step at either end are zero).
    assert float(walls[:, 1, 0].sum()) * time / COUNT == pytest.approx(-MASS * thrown, rel=1e-12)
    assert float(jnp.abs(walls[:, 0]).max()) == 0.0


def test_walls_give_no_tangential_force():
    system, state, box = scene(
        SPHERE, [[14.0, 0, 0]], velocity=[[0.03, 0.02, -0.01]], spin=[[0.1, 0.2, 0.3]], friction=Hooke(mu=1.0)
    )
    _, velocity, spin, _ = run(system, state, box, 1.2 * hertz_duration(MASS, 0.03, K_W))
    assert velocity[-1, 0, 0] < 0.0
    np.testing.assert_array_equal(velocity[-1, 0, 1:], [0.02, -0.01])
    np.testing.assert_array_equal(spin[-1, 0], [0.1, 0.2, 0.3])


def test_opposite_walls_push_inwards_with_equal_force():
    box = still_box(column([-0.9, -15.0, -15.0]), column([0.9, 15.0, 15.0]))
    _, state, _ = scene(SPHERE, [[0.02, 0, 0]], box=box)
    force = K_W * (0.12**1.5 - 0.08**1.5)
    assert float(state.grains.acceleration[0, 0, 0]) == pytest.approx(-force / MASS, rel=1e-12)
