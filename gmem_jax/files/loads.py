"""What the walls do in a configuration, and the pressure tensor of all its contacts."""

import numpy as np

from gmem_jax.physics.material import Material
from gmem_jax.simulation.frames import Frames, images_met


def frame_wall_forces(frames: Frames, number: int, material: Material) -> np.ndarray:
    """The elastic forces of the walls on every sphere of a frame, [N K, 3], in E R^2.

    What damping adds depends on speeds, which frames do not keep: it is left out.
    """
    centres, radii = frames.centres(number), frames.sphere_radii[:, None]
    overlaps = (radii - (centres - frames.lower[number]), radii - (frames.upper[number] - centres))
    lower, upper = (np.sqrt(radii) * np.maximum(overlap, 0.0) ** 1.5 for overlap in overlaps)
    return np.asarray(np.where(frames.periodic, 0.0, float(material.wall_stiffness) * (lower - upper)))


def pressure_tensor(frames: Frames, number: int, walls: np.ndarray) -> np.ndarray:
    """The mean stress in a frame, [3, 3], in E, compression positive: the sum of f_a l_b over the box's volume.

    A contact counts with the force on its second grain and the line from the first grain's centre to the second's, a
    wall with its force and the line from where it is touched to the grain's centre (Love and Weber). So at rest the
    diagonal is what the walls measure.

    Args:
        frames: the configurations.
        number: of the frame.
        walls: its `frame_wall_forces`.
    """
    own, each = slice(*frames.start[number : number + 2]), len(frames.offsets)
    centres, position = frames.centres(number), frames.position[number]
    one, other = frames.spheres[own].T
    image = images_met(frames, number)
    normal = centres[other] - centres[one] + image
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    force = frames.normal_force[own, None] * normal - frames.friction_force[own]
    total = force.T @ (position[other // each] - position[one // each] + image)
    planes = np.where(walls > 0.0, frames.lower[number], frames.upper[number])
    total += walls.T @ (np.repeat(position, each, axis=0) - centres)
    total += np.diag(np.sum(walls * (centres - planes), axis=0))
    return np.asarray(total / np.prod(frames.upper[number] - frames.lower[number]))
