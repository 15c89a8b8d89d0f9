"""Momentum, angular momentum and energy of many grains, each balance computed here from the recorded motion alone."""

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ELASTIC, cached_tetra, cluster27, coast, orientations, record, scene, squeeze

from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.material import Material

TETRA = cached_tetra()
MASS, INERTIA = float(TETRA.mass), float(TETRA.inertia[0])
SOLID = Material()


def plain(leaf) -> np.ndarray:
    """A leaf of one replica as a numpy array without its replica axis."""
    return np.asarray(leaf)[..., 0]


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


def rotated(quaternion, vectors):
    """Body vectors [K, 3] turned by quaternions [T, N, 4], [T, N, K, 3]."""
    w, q = (
        quaternion[..., None, :1],
        np.broadcast_to(quaternion[..., None, 1:], (*quaternion.shape[:2], len(vectors), 3)),
    )
    cross = np.cross(q, vectors)
    return vectors + 2.0 * (w * cross + np.cross(q, cross))


class Budget:
    """Energies [T] and powers [T] of a recorded run, from positions, velocities and stored tangential forces."""

    def __init__(self, system, states, walls, boxes, dt):
        self.dt, self.solid, self.law = dt, system.material, system.friction
        grains = states.grains
        self.velocity, self.spin = plain(grains.velocity), plain(grains.spin)
        arms = rotated(plain(grains.quaternion), np.asarray(TETRA.offsets))
        count = len(arms)
        self.spheres = (plain(grains.position)[:, :, None] + arms).reshape(count, -1, 3)
        self.speeds = (self.velocity[:, :, None] + np.cross(self.spin[:, :, None], arms)).reshape(count, -1, 3)
        self.walls, self.boxes = plain(walls), boxes
        self._contacts(system.pairs, plain(states.history))

    def _contacts(self, pairs, history):
        real = np.asarray(pairs.valid)
        i, j = np.asarray(pairs.first)[real], np.asarray(pairs.second)[real]
        separation = self.spheres[:, j] - self.spheres[:, i]
        distance = np.linalg.norm(separation, axis=-1, keepdims=True)
        self.normal = separation / distance
        self.overlap = 2.0 - distance
        self.touching = self.overlap > 0.0
        spins = self.spin[:, i // 4] + self.spin[:, j // 4]
        surface = self.speeds[:, j] - self.speeds[:, i] - np.cross(spins, 0.5 * distance * self.normal)
        along = (surface * self.normal).sum(-1, keepdims=True)
        self.closing = -along
        self.sliding = np.where(self.touching, surface - along * self.normal, 0.0)
        self.stored = history[:, real]
        self.half_step = 0.5 * self.law.stiffness * self.dt * self.sliding
        self.spring = np.where(self.touching, self.stored - self.half_step, 0.0)
        self.dashpot = self.law.stiffness * self.law.damping_time * self.sliding

    def _hertz(self, stiffness, overlap, closing):
        """Elastic energy, force and viscous power, summed over contacts, of overlaps and closing speeds."""
        p = np.maximum(overlap, 0.0)
        damped = np.maximum(0.0, stiffness * np.sqrt(p) * (p + self.solid.normal_damping * closing))
        return 0.4 * stiffness * p**2.5, damped, (damped - stiffness * p**1.5) * closing

    @staticmethod
    def total(values):
        return values.reshape(len(values), -1).sum(1)

    def kinetic(self):
        return 0.5 * (MASS * self.total(self.velocity**2) + INERTIA * self.total(self.spin**2))

    def _wall_overlaps(self):
        lower, upper = plain(self.boxes.lower)[:, None], plain(self.boxes.upper)[:, None]
        speeds = plain(self.boxes.lower_velocity)[:, None], plain(self.boxes.upper_velocity)[:, None]
        yield 1.0 - (self.spheres - lower), speeds[0] - self.speeds
        yield 1.0 - (upper - self.spheres), self.speeds - speeds[1]

    def elastic(self):
        energy = self.total(self._hertz(self.solid.normal_stiffness, self.overlap, self.closing)[0])
        for overlap, closing in self._wall_overlaps():
            energy = energy + self.total(self._hertz(self.solid.wall_stiffness, overlap, closing)[0])
        return energy + self.total(self.spring**2) / (2.0 * self.law.stiffness)

    def viscous_power(self):
        power = self.total(self._hertz(self.solid.normal_stiffness, self.overlap, self.closing)[2])
        for overlap, closing in self._wall_overlaps():
            power = power + self.total(self._hertz(self.solid.wall_stiffness, overlap, closing)[2])
        return power + self.total(self.dashpot * self.sliding)

    def wall_power(self):
        lower, upper = self.walls[:, 0], self.walls[:, 1]
        return (lower * plain(self.boxes.lower_velocity) - upper * plain(self.boxes.upper_velocity)).sum(1)

    def sliding_loss(self):
        """Energy lost by sliding in each step, [T - 1]: spring force times what Coulomb's limit took off the spring."""
        carried = self.stored[:-1]
        carried = carried - (carried * self.normal[1:]).sum(-1, keepdims=True) * self.normal[1:]
        trial = np.where(self.touching[1:], carried + self.half_step[1:] + self.dashpot[1:], 0.0)
        limit = self.law.mu * self._hertz(self.solid.normal_stiffness, self.overlap[1:], self.closing[1:])[1]
        size = np.linalg.norm(trial, axis=-1, keepdims=True)
        slid = trial * np.maximum(0.0, 1.0 - limit / np.where(size > 0.0, size, 1.0)) / self.law.stiffness
        # Springs of contacts that opened in this step were let go with what they held.
        opened = self.touching[:-1] & ~self.touching[1:]
        released = np.where(opened, self.spring[:-1] ** 2, 0.0) / (2.0 * self.law.stiffness)
        return self.total(0.5 * (self.spring[1:] + self.spring[:-1]) * slid) + self.total(released)

    def integral(self, power):
        return self.dt * (power.sum() - 0.5 * (power[0] + power[-1]))

    def terms(self):
        """Work of the walls, and where it went, between the first and the last record."""
        change = self.kinetic() + self.elastic()
        return {
            "work": self.integral(self.wall_power()),
            "stored": change[-1] - change[0],
            "viscous": self.integral(self.viscous_power()),
            "slid": self.sliding_loss().sum(),
        }

    def residual(self):
        """What does not add up, relative to all the energy that was turned over."""
        terms = self.terms()
        return abs(terms["work"] - terms["stored"] - terms["viscous"] - terms["slid"]) / sum(map(abs, terms.values()))


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
    # Measured: 1.3e-4 at 0.3, 5.4e-5 at 0.15, 1.8e-5 at 0.075: order 1.5, as damped contacts that make and break allow.
    coarse, fine = budget(0.3).residual(), budget(0.15).residual()
    assert coarse < 2e-4
    assert fine < 8e-5
    assert fine < 0.6 * coarse


def test_the_energy_budget_closes_better_without_damping():
    # Measured: 1.4e-4 at 0.3 and 1.4e-5 at 0.15, the shortest period being ten steps of 0.3.
    undamped = budget(0.15, ELASTIC, 0.0)
    assert undamped.residual() < 3e-5
    assert undamped.terms()["viscous"] < 1e-15
    assert undamped.terms()["slid"] > 0.05 * undamped.terms()["work"]
