"""What becomes of a tangential force while its contact tumbles, spins and rolls."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ELASTIC, SPHERE, coast, column, scene

from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.kinematics import kinematics, transport

OVERLAP = 0.05
VALID = jnp.asarray([True])
HUGE = jnp.full((1, 1, 1), 1e9)  # a normal force under which nothing slides


def rotation(axis, angle) -> jax.Array:
    """Rodrigues' rotation matrix."""
    axis = jnp.asarray(axis) / jnp.linalg.norm(jnp.asarray(axis))
    k = jnp.cross(axis, jnp.eye(3)).T
    return jnp.eye(3) + jnp.sin(angle) * k + (1.0 - jnp.cos(angle)) * k @ k


@functools.partial(jax.jit, static_argnames="steps")
def tumble(force, rate, total, *, steps):
    """Carry `force` on a pair along x through a rigid rotation at angular velocity `rate` [3] for the time `total`.

    Returns the force after every step, [steps, 3], and the sliding velocities, which a rigid motion must not have.
    """
    law, dt = Hooke(), total / steps

    def one(history, index):
        arm = rotation(rate, (index + 1) * dt * jnp.linalg.norm(rate)) @ jnp.asarray([2.0 - OVERLAP, 0.0, 0.0])
        row = lambda vector: vector[None, :, None]  # noqa: E731
        kin = kinematics(row(arm), row(jnp.cross(rate, arm)), row(2.0 * rate), VALID, dt)
        carried, history = law(kin, HUGE, history)
        return history, (carried[0, :, 0], kin.sliding[0, :, 0])

    return jax.lax.scan(one, force[None, :, None], jnp.arange(steps))[1]


RATES = {"about z": [0.0, 0.0, 1.0], "about the normal": [1.0, 0.0, 0.0], "obliquely": [0.5, 0.4, -0.6]}
FORCES = {"along the motion": [0.0, 1.0, 0.0], "along the axis": [0.0, 0.0, 1.0], "between": [0.0, 0.6, 0.8]}


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("force", FORCES)
def test_a_rigidly_rotating_pair_does_not_slide_and_keeps_the_magnitude_of_its_force(rate, force):
    forces, sliding = tumble(jnp.asarray(FORCES[force]), jnp.asarray(RATES[rate]), 3.0, steps=200)
    np.testing.assert_allclose(sliding, 0.0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 1.0, rtol=1e-13)  # round-off of 200 steps


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("force", FORCES)
def test_a_tangential_force_turns_with_its_pair(rate, force):
    """The error of direction is bounded by that of the projection, and falls with dt.

    Projecting on the new tangent plane shortens the component along the motion by cos(w dt), which turns a force at
    angle phi to it by sin(phi) cos(phi) (w dt)^2 / 2 <= (w dt)^2 / 4 a step: first order, w^2 t dt / 4 in all. The
    Cayley turn about n adds (w dt)^2 w t / 12.
    """
    omega, time = jnp.asarray(RATES[rate]), 3.0
    speed = float(jnp.linalg.norm(omega))
    expected = np.asarray(rotation(omega, speed * time) @ jnp.asarray(FORCES[force]))
    errors = []
    for steps in (100, 200, 400):
        forces, _ = tumble(jnp.asarray(FORCES[force]), omega, time, steps=steps)
        dt = time / steps
        errors.append(np.linalg.norm(forces[-1] - expected))
        assert errors[-1] <= speed**2 * time * dt / 4.0 + speed**3 * time * dt**2 / 12.0
    assert errors[2] < max(0.6 * errors[1], 1e-12)


@pytest.mark.parametrize("force", ["along the motion", "along the axis"])
def test_tumbling_is_exact_for_a_force_along_or_across_the_motion(force):
    forces, _ = tumble(jnp.asarray(FORCES[force]), jnp.asarray(RATES["about z"]), 3.0, steps=100)
    expected = rotation(RATES["about z"], 3.0) @ jnp.asarray(FORCES[force])
    np.testing.assert_allclose(forces[-1], expected, atol=1e-13)  # round-off of 100 steps


def test_spinning_turns_the_force_about_the_normal_by_half_the_sum_of_the_spins():
    normal, time, steps = np.array([1.0, 0.0, 0.0]), 2.0, 400
    spins = 0.7 + 0.1  # of the two spheres along n: the contact turns at 0.4
    arm = column((2.0 - OVERLAP) * normal)[None]
    kin = kinematics(arm, jnp.zeros((1, 3, 1)), spins * column(normal)[None], VALID, time / steps)
    end = jax.lax.fori_loop(0, steps, lambda _, f: transport(f, kin), column([0.0, 1.0, 0.0])[None])
    expected = rotation(normal, 0.5 * spins * time) @ jnp.asarray([0.0, 1.0, 0.0])
    # Cayley: (w dt)^3 / 12 a step, 2.7e-7 in all.
    np.testing.assert_allclose(end[0, :, 0], expected, atol=3e-7)
    assert abs(float(end[0, 2, 0])) > 0.7


def test_opposite_spins_about_the_normal_leave_the_force_where_it_is():
    arm = column([2.0 - OVERLAP, 0.0, 0.0])[None]
    kin = kinematics(arm, jnp.zeros((1, 3, 1)), jnp.zeros((1, 3, 1)), VALID, 0.3)
    force = column([0.0, 0.3, -0.4])[None]
    np.testing.assert_array_equal(transport(force, kin), force)


def test_a_blank_history_stays_blank_and_its_derivative_is_finite():
    arm = column([2.0 - OVERLAP, 0.0, 0.0])[None]

    def length(force):
        kin = kinematics(arm, jnp.zeros((1, 3, 1)), column([0.2, 0.1, 0.0])[None], VALID, 0.3)
        return jnp.sum(transport(force, kin))

    assert float(length(jnp.zeros((1, 3, 1)))) == 0.0
    assert np.all(np.isfinite(jax.grad(length)(jnp.zeros((1, 3, 1)))))


def test_a_history_is_forgotten_when_the_contact_opens():
    arm = column([2.0 + 1e-9, 0.0, 0.0])[None]
    kin = kinematics(arm, column([0.0, 0.1, 0.0])[None], jnp.zeros((1, 3, 1)), VALID, 0.3)
    force, history = Hooke()(kin, jnp.zeros((1, 1, 1)), jnp.ones((1, 3, 1)))
    assert np.all(np.asarray(force) == 0.0)
    assert np.all(np.asarray(history) == 0.0)


def test_rolling_without_sliding_raises_no_friction():
    # Like gear wheels: with resting centres, opposite spins roll and equal ones slide.
    arm = column([2.0 - OVERLAP, 0.0, 0.0])[None]
    rolling = kinematics(arm, jnp.zeros((1, 3, 1)), jnp.zeros((1, 3, 1)), VALID, 0.3)  # the spins cancel in their sum
    grinding = kinematics(arm, jnp.zeros((1, 3, 1)), column([0.0, 0.0, 0.2])[None], VALID, 0.3)
    assert np.all(np.asarray(Hooke()(rolling, HUGE, jnp.zeros((1, 3, 1)))[0]) == 0.0)
    # Two surfaces passing each other at (w_i + w_j) times the arm.
    np.testing.assert_allclose(grinding.sliding[0, :, 0], [0.0, -0.2 * (1.0 - 0.5 * OVERLAP), 0.0], rtol=1e-14)


def test_the_stored_force_is_the_integral_of_the_sliding_velocity():
    """A contact dragged at v(t) = sin(t), known in the middle of steps: the spring's force is second order in dt."""
    law = Hooke(stiffness=0.145, damping_time=0.0)

    @functools.partial(jax.jit, static_argnames="steps")
    def dragged(*, steps):
        dt = 2.0 / steps

        def one(index, carry):
            velocity = jnp.sin((index + 0.5) * dt) * column([0.0, 1.0, 0.0])[None]
            kin = kinematics(column([2.0 - OVERLAP, 0.0, 0.0])[None], velocity, jnp.zeros((1, 3, 1)), VALID, dt)
            return law(kin, HUGE, carry[1])

        start = jnp.zeros((1, 3, 1))
        return jax.lax.fori_loop(0, steps, one, (start, start))[0][0, 1, 0]

    exact = 0.145 * (1.0 - np.cos(2.0))
    errors = [abs(float(dragged(steps=steps)) - exact) for steps in (20, 40)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.01)


def test_a_spinning_pair_held_together_transfers_spin_until_it_turns_as_one():
    """Two pressed spheres, one spinning about an axis across n, with a heavy dashpot: angular momentum is conserved.

    The surfaces stop sliding when u = (w_1 + w_2)(1 - p/2), whatever friction did on the way; here the pair flies
    apart slowly under its own compression, long after that.
    """
    grip = Hooke(mu=1e9, stiffness=1e-9, damping_time=4e9)
    system, state, box = scene(
        SPHERE, [[-0.98, 0, 0], [0.98, 0, 0]], spin=[[0, 0, 0.01], [0, 0, 0]], friction=grip, material=ELASTIC
    )
    after = coast(system, state, box, 0.01, 300).grains
    position, velocity, spin = (np.asarray(x)[..., 0] for x in (after.position, after.velocity, after.spin))
    mass, inertia = float(SPHERE.mass), float(SPHERE.inertia[0])
    momentum = (mass * np.cross(position, velocity) + inertia * spin).sum(0)
    np.testing.assert_allclose(momentum, [0.0, 0.0, 0.01 * inertia], atol=1e-15)
    separation = position[1] - position[0]
    distance = np.linalg.norm(separation)
    assert distance < 2.0
    tangent = np.cross([0.0, 0.0, 1.0], separation / distance)
    sliding = (velocity[1] - velocity[0]) @ tangent - spin[:, 2].sum() * 0.5 * distance
    # The dashpot's rate is 7 c / m = 6.7; the arm still grows (by 1e-3 per t_c), which leaves a thousandth of it.
    assert abs(sliding) < 1e-3 * 0.01
    # Impulse J at the contact: (2 J / m)(1 + m a^2 / I) = 0.01 a with the arm a = 0.98 where it happened.
    impulse = 0.01 * 0.98 * mass / 2.0 / (1.0 + mass * 0.98**2 / inertia)
    np.testing.assert_allclose(spin[:, 2], [0.01 - impulse * 0.98 / inertia, -impulse * 0.98 / inertia], rtol=1e-2)
