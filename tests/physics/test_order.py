"""Order of convergence in dt, by regression of log error on log dt against a much smaller step."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import ELASTIC, cached_tetra, coast, orientations, scene

from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.grain import sphere
from gmem_jax.physics.material import Material

STEPS = (128, 192, 256, 384, 512, 768, 1024)
REFERENCE = 16 * STEPS[-1]
GAPS = 1.0 + 0.003 * np.arange(8)  # eight collisions, whose contacts begin at different moments of a step
TETRA = cached_tetra()
TOUCHING = [[0, 0, 0], [2.45, 0.2, 0], [1.0, 2.4, 0.3]]
APART = [[0, 0, 0], [2.75, 0.2, 0], [1.1, 2.7, 0.3]]
CLOSING = 0.02 * np.array([[1, 0.7, 0], [-1, 0, 0.3], [0.1, -1, -0.2]])


def final(setup, duration: float, steps: int) -> np.ndarray:
    """Positions, velocities and spins at the end of `duration`, in one vector."""
    grains = coast(*setup, duration / steps, steps).grains
    return np.concatenate([np.ravel(x) for x in (grains.position, grains.velocity, grains.spin)])


def order(setup, duration: float) -> float:
    """Slope of log error on log dt."""
    reference = final(setup, duration, REFERENCE)
    errors = [np.linalg.norm(final(setup, duration, n) - reference) for n in STEPS]
    return -np.polyfit(np.log(STEPS), np.log(errors), 1)[0]


def pressed(mu: float, material: Material = ELASTIC, damping_time: float = 0.0):
    """Three grains at rest, pressed into each other, let go: many contacts, none of which opens for a while."""
    law = Hooke(mu=mu, damping_time=damping_time)
    return scene(TETRA, TOUCHING, orientations(3, 1), friction=law, material=material)


def approaching(clump, position, quaternion, velocity, spin, law, material):
    """Grains about to collide, in eight replicas that start at slightly different distances."""
    system, state, box = scene(
        clump, position, quaternion, velocity, spin, friction=law, material=material, replicas=len(GAPS)
    )
    return system, replace(state, grains=replace(state.grains, position=state.grains.position * GAPS)), box


def colliding(mu: float, material: Material = ELASTIC, damping_time: float = 0.0):
    """Three grains about to collide obliquely, with spin."""
    spin = 0.01 * np.random.default_rng(0).normal(size=(3, 3))
    law = Hooke(mu=mu, damping_time=damping_time)
    return approaching(TETRA, APART, orientations(3, 1), CLOSING, spin, law, material)


def oblique_spheres(mu: float, material: Material = ELASTIC, damping_time: float = 0.0):
    """Two spheres about to collide in a plane: their sliding keeps its direction."""
    velocity = [[0.02, 0.012, 0], [-0.02, -0.012, 0]]
    spin = [[0, 0, 0.02], [0, 0, 0.013]]
    law = Hooke(mu=mu, damping_time=damping_time)
    return approaching(sphere(), [[0, 0, 0], [2.02, 0, 0]], None, velocity, spin, law, material)


def test_a_collision_without_friction_or_damping_is_second_order():
    assert order(colliding(mu=0.0), 40.0) > 1.9  # measured 1.98


def test_sticking_contacts_are_of_order_three_halves():
    # The sliding of a step is projected on the tangent plane at its end: measured 1.46.
    assert order(pressed(mu=100.0), 4.0) > 1.4


def test_sticking_contacts_with_damping_are_first_order():
    # Dashpots see velocities that are half a step old: measured 1.03.
    assert order(pressed(100.0, Material(), 0.069), 4.0) > 0.98


def test_sliding_in_a_fixed_direction_is_second_order():
    assert order(oblique_spheres(mu=0.1), 30.0) > 1.9  # measured 2.04


def test_sliding_contacts_lose_a_little_where_the_sliding_direction_turns():
    """Scaling the trial force back is first order in the *direction* of a sliding force.

    The direction turns by k dt v_across / (f + k dt v_along) a step where half of v_along would be right. Measured
    1.43 here, falling towards 1 at small dt.
    """
    assert order(pressed(mu=0.05), 4.0) > 1.35


@pytest.mark.parametrize("mu", [0.3, 1.0])
def test_oblique_collisions_with_friction_are_first_order(mu):
    # The same term, large where contacts begin and end with hardly any force: measured 0.99 and 1.03.
    assert order(colliding(mu), 40.0) > 0.9


def test_damped_contacts_that_make_and_break_are_first_order():
    assert order(colliding(0.0, Material()), 40.0) > 1.05  # measured 1.14


def test_damped_sliding_collisions_are_first_order():
    assert order(oblique_spheres(0.1, Material(), 0.069), 30.0) > 1.1  # measured 1.20
