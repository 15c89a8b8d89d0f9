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
        self.spheres = (plain(grains.position)[:, :, None] + arms).reshape(len(arms), -1, 3)
        # At the end of the step that led to a record, and in its middle: what its forces have seen.
        back = 0.5 * dt * plain(grains.acceleration), 0.5 * dt * plain(grains.spin_rate)
        at_end, midway = (self.velocity, self.spin), (self.velocity - back[0], self.spin - back[1])
        self.speeds, self.mid_speeds = (
            (velocity[:, :, None] + np.cross(spin[:, :, None], arms)).reshape(len(arms), -1, 3)
            for velocity, spin in (at_end, midway)
        )
        self.walls, self.boxes = plain(walls), boxes
        self._contacts(system.pairs, plain(states.history), midway[1])

    def _contacts(self, pairs, history, mid_spin):
        real = np.asarray(pairs.valid)
        i, j = np.asarray(pairs.first)[real], np.asarray(pairs.second)[real]
        separation = self.spheres[:, j] - self.spheres[:, i]
        distance = np.linalg.norm(separation, axis=-1, keepdims=True)
        self.normal = separation / distance
        self.overlap = 2.0 - distance
        self.touching = self.overlap > 0.0
        moving = []
        for speeds, spin in ((self.speeds, self.spin), (self.mid_speeds, mid_spin)):
            spins = spin[:, i // 4] + spin[:, j // 4]
            surface = speeds[:, j] - speeds[:, i] - np.cross(spins, 0.5 * distance * self.normal)
            along = (surface * self.normal).sum(-1, keepdims=True)
            moving.append((-along, np.where(self.touching, surface - along * self.normal, 0.0)))
        (self.closing, self.sliding), (self.mid_closing, self.mid_sliding) = moving
        self.spring = history[:, real]
        self.dashpot = self.law.stiffness * self.law.damping_time * self.mid_sliding

    def _hertz(self, stiffness, overlap, closing, mid_closing):
        """Elastic energy, force and viscous power, summed over contacts, of overlaps and closing speeds."""
        p = np.maximum(overlap, 0.0)
        damped = np.maximum(0.0, stiffness * np.sqrt(p) * (p + self.solid.normal_damping * mid_closing))
        return 0.4 * stiffness * p**2.5, damped, (damped - stiffness * p**1.5) * closing

    def _between(self):
        """`_hertz` of the contacts between spheres."""
        return self._hertz(self.solid.normal_stiffness, self.overlap, self.closing, self.mid_closing)

    def _at_walls(self):
        """`_hertz` of the contacts with the lower and with the upper walls."""
        lower, upper = plain(self.boxes.lower)[:, None], plain(self.boxes.upper)[:, None]
        speeds = plain(self.boxes.lower_velocity)[:, None], plain(self.boxes.upper_velocity)[:, None]
        stiffness = self.solid.wall_stiffness
        yield self._hertz(stiffness, 1.0 - (self.spheres - lower), speeds[0] - self.speeds, speeds[0] - self.mid_speeds)
        yield self._hertz(stiffness, 1.0 - (upper - self.spheres), self.speeds - speeds[1], self.mid_speeds - speeds[1])

    @staticmethod
    def total(values):
        return values.reshape(len(values), -1).sum(1)

    def kinetic(self):
        return 0.5 * (self.mass * self.total(self.velocity**2) + self.inertia * self.total(self.spin**2))

    def elastic(self):
        energy = self.total(self._between()[0]) + sum(self.total(wall[0]) for wall in self._at_walls())
        return energy + self.total(self.spring**2) / (2.0 * self.law.stiffness)

    def viscous_power(self):
        power = self.total(self._between()[2]) + sum(self.total(wall[2]) for wall in self._at_walls())
        return power + self.total(self.dashpot * self.sliding)

    def wall_work(self):
        """Of the walls on the grains in each step, [T - 1]: displacements, since speeds jump where a stage ends."""
        force = 0.5 * (self.walls[1:] + self.walls[:-1])
        lower, upper = (np.diff(plain(side), axis=0) for side in (self.boxes.lower, self.boxes.upper))
        return (force[:, 0] * lower - force[:, 1] * upper).sum(1)

    def sliding_loss(self):
        """Energy lost by sliding in each step, [T - 1]: spring force times what Coulomb's limit took off the spring."""
        carried = self.spring[:-1]
        carried = carried - (carried * self.normal[1:]).sum(-1, keepdims=True) * self.normal[1:]
        grown = self.law.stiffness * self.dt * self.mid_sliding[1:]
        trial = np.where(self.touching[1:], carried + grown + self.dashpot[1:], 0.0)
        limit = self.law.mu * self._between()[1][1:]
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
