"""Wall forces and the pressure tensor of the contacts in a configuration, for export."""

import numpy as np

from gmem_jax.physics.contact.wall import PLANES
from gmem_jax.physics.material import Material
from gmem_jax.simulation.frames import Frames, images_met


def frame_wall_forces(frames: Frames, number: int, material: Material) -> np.ndarray:
    """The forces of the planes on every sphere of a frame, [N K, 6, 3], in E R^2: elastic forces and friction.

    The planes are the lower ones of x, y and z, then the upper ones. Damping forces are left out: they depend on
    speeds, which frames do not keep.
    """
    centres, radii = frames.centres(number), frames.sphere_radii[:, None]
    forces = np.zeros((len(centres), PLANES, 3))
    for first, overlap, sign in (
        (0, radii - (centres - frames.lower[number]), 1.0),
        (3, radii - (frames.upper[number] - centres), -1.0),
    ):
        elastic = float(material.wall_stiffness) * np.sqrt(radii) * np.maximum(overlap, 0.0) ** 1.5
        forces[:, range(first, first + 3), range(3)] = sign * np.where(frames.periodic, 0.0, elastic)
    return forces if frames.wall_friction is None else forces + frames.wall_friction[number]


def pressure_tensor(frames: Frames, number: int, walls: np.ndarray) -> np.ndarray:
    """The mean stress in a frame, [3, 3], in E, compression positive: the sum of f_a l_b over the box's volume.

    In a contact, f is the force on the second grain and l the line from the first grain's centre to the second's. At a
    wall, f is its force and l the line from the point of contact to the grain's centre (Love and Weber). At rest
    between smooth walls the diagonal is the pressures on the walls.

    Args:
        frames: the configurations.
        number: number of the frame.
        walls: `frame_wall_forces` of this frame.
    """
    own, each = slice(*frames.start[number : number + 2]), len(frames.offsets)
    centres, position = frames.centres(number), frames.position[number]
    one, other = frames.spheres[own].T
    image = images_met(frames, number)
    normal = centres[other] - centres[one] + image
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    force = frames.normal_force[own, None] * normal - frames.friction_force[own]
    total = force.T @ (position[other // each] - position[one // each] + image)
    touched = np.repeat(centres[:, None], PLANES, axis=1)
    touched[:, range(PLANES), [0, 1, 2] * 2] = np.concatenate([frames.lower[number], frames.upper[number]])
    total += np.einsum("nwa,nwb->ab", walls, np.repeat(position, each, axis=0)[:, None] - touched)
    return np.asarray(total / np.prod(frames.upper[number] - frames.lower[number]))
