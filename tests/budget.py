"""Energies and powers of a recorded run, each computed from the recorded motion alone (law H)."""

import numpy as np


def plain(leaf) -> np.ndarray:
    """A leaf of one replica as a numpy array without its replica axis."""
    return np.asarray(leaf)[..., 0]


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
        self.mass, self.inertia = float(system.clump.mass), float(system.clump.inertia[0])
        offsets = np.asarray(system.clump.offsets)
        grains = states.grains
        self.velocity, self.spin = plain(grains.velocity), plain(grains.spin)
        arms = rotated(plain(grains.quaternion), offsets)
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
        return 0.5 * (self.mass * self.total(self.velocity**2) + self.inertia * self.total(self.spin**2))

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

    def wall_work(self):
        """Of the walls on the grains in each step, [T - 1]: displacements, since speeds jump where a stage ends."""
        force = 0.5 * (self.walls[1:] + self.walls[:-1])
        lower, upper = (np.diff(plain(side), axis=0) for side in (self.boxes.lower, self.boxes.upper))
        return (force[:, 0] * lower - force[:, 1] * upper).sum(1)

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
            "work": self.wall_work().sum(),
            "stored": change[-1] - change[0],
            "viscous": self.integral(self.viscous_power()),
            "slid": self.sliding_loss().sum(),
        }

    def residual(self):
        """What does not add up, relative to all the energy that was turned over."""
        terms = self.terms()
        return abs(terms["work"] - terms["stored"] - terms["viscous"] - terms["slid"]) / sum(map(abs, terms.values()))
