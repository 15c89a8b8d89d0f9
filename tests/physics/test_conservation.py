"""Momentum, angular momentum and energy of many grains, each balance computed here from the recorded motion alone."""

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from budget import Budget, plain
from scenes import ELASTIC, cached_tetra, cluster27, coast, orientations, record, scene, squeeze

from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.material import Material

TETRA = cached_tetra()
MASS, INERTIA = float(TETRA.mass), float(TETRA.inertia[0])
SOLID = Material()


@pytest.fixture(scope="module")
def collapse():
    """20 spinning tetrahedra falling into each other, and what they are after the first and after most collisions."""
    lattice = 2.7 * (np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3)[:20] - 1.0)
    random = np.random.default_rng(4)
    velocity = -0.03 * lattice + 0.02 * random.normal(size=(20, 3)) + [0.01, -0.02, 0.03]
    spin = 0.05 * random.normal(size=(20, 3))
    system, state, box = scene(TETRA, lattice, orientations(20, 5), velocity, spin, friction=Hooke(mu=0.5))
    return state, [coast(system, state, box, 0.1, steps) for steps in (150, 400)]


def momenta(state):
    position, velocity, spin = (plain(getattr(state.grains, n)) for n in ("position", "velocity", "spin"))
    orbital = MASS * np.cross(position, velocity)
    return MASS * velocity, orbital + INERTIA * spin


def test_a_collapsing_cluster_does_collide_with_friction_and_loss(collapse):
    first, later = collapse
    energies = [np.sum(momenta(state)[0] ** 2) for state in (first, *later)]
    assert energies[2] < 0.8 * energies[0]  # the drift of the whole remains
    assert max(np.abs(state.history).max() for state in later) > 1e-3


def test_collisions_conserve_momentum(collapse):
    first, later = collapse
    start, _ = momenta(first)
    for state in later:
        now, _ = momenta(state)
        # Round-off of 400 steps, against the sum of magnitudes.
        np.testing.assert_allclose(now.sum(0), start.sum(0), atol=1e-13 * np.abs(start).sum())


def test_collisions_conserve_orbital_and_spin_angular_momentum_together(collapse):
    first, later = collapse
    _, start = momenta(first)
    spin_alone = INERTIA * plain(first.grains.spin).sum(0)
    for state in later:
        _, now = momenta(state)
        # Verlet kicks at the positions where the forces were computed: exact, to round-off.
        np.testing.assert_allclose(now.sum(0), start.sum(0), atol=1e-13 * np.abs(start).sum())
        assert np.abs(INERTIA * plain(state.grains.spin).sum(0) - spin_alone).max() > 1e-2 * np.abs(start).sum()


LAW = Hooke(mu=0.3)
TIME = 48.0


def shaken(dt: float, material: Material = SOLID, law: Hooke = LAW):
    """The 27-grain cluster with random velocities while its walls close in; returns everything recorded."""
    system, state, box = cluster27(law, material=material)
    random = np.random.default_rng(7)
    velocity, spin = 0.005 * jnp.asarray(random.normal(size=(2, 27, 3, 1)))
    state = replace(state, grains=replace(state.grains, velocity=velocity, spin=spin))
    motion = squeeze(box, 2.0 * TIME, delta0=0.1)
    return system, state, *record(system, state, motion, dt, count=round(TIME / dt))


def test_the_walls_account_for_the_change_of_momentum():
    dt = 0.3
    _, first, states, walls, _ = shaken(dt)
    force = plain(walls[:, 0] - walls[:, 1])  # [T, 3]
    before = MASS * plain(first.grains.acceleration).sum(0)  # of the start: inner forces cancel
    kicks = 0.5 * dt * (before + 2.0 * force[:-1].sum(0) + force[-1])
    change = MASS * (plain(states.grains.velocity)[-1] - plain(first.grains.velocity)).sum(0)
    # The half kicks of velocity Verlet, to round-off.
    np.testing.assert_allclose(change, kicks, atol=1e-13 * np.abs(MASS * plain(first.grains.velocity)).sum())
    assert np.abs(change).max() > 1e-3


@functools.cache
def budget(dt, material=SOLID, damping_time=0.069):
    system, _, states, walls, boxes = shaken(dt, material, Hooke(mu=0.3, damping_time=damping_time))
    return Budget(system, states, walls, boxes, dt)


def test_every_term_of_the_energy_budget_takes_part():
    terms = budget(0.15).terms()
    assert terms["viscous"] > 0.03 * terms["work"] > 0.0
    assert terms["slid"] > 0.05 * terms["work"]
    spring = budget(0.15).total(budget(0.15).spring ** 2) / (2.0 * LAW.stiffness)
    assert spring.max() > 2e-3 * terms["work"]


def test_work_of_the_walls_is_what_was_stored_damped_and_slid_away():
    # Forces of half-step velocities do in every step the work that is counted here; contacts that begin and end within
    # a step are what is left. Measured: 9e-7 at 0.3, 2.7e-6 at 0.15, 1.6e-6 at 0.075.
    assert budget(0.3).residual() < 5e-6
    assert budget(0.15).residual() < 5e-6


def test_the_energy_budget_closes_without_damping():
    # Measured: 1.1e-6 at 0.3 and 7e-7 at 0.15.
    undamped = budget(0.15, ELASTIC, 0.0)
    assert undamped.residual() < 2e-6
    assert undamped.terms()["viscous"] < 1e-15
    assert undamped.terms()["slid"] > 0.05 * undamped.terms()["work"]
