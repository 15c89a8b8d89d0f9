"""One contact under a friction law, led along a prescribed path of overlap and tangential displacement."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.kinematics import Kinematics
from gmem_jax.physics.contact.normal import hertz
from gmem_jax.physics.material import Material
from gmem_jax.physics.pytree import Scalar


def led_contact(overlap: jax.Array, sliding: jax.Array, dt: Scalar) -> Kinematics:
    """Kinematics of one contact that neither tumbles nor spins: n = z, sliding along x.

    Args:
        overlap: p, scalar or [B], in R.
        sliding: tangential velocity, in the shape of `overlap`, in R / t_c.
        dt: time step, in t_c.
    """
    p = jnp.reshape(overlap, (1, 1, -1))
    zero = jnp.zeros_like(p)
    touching = p > 0.0
    return Kinematics(
        normal=jnp.concatenate([zero, zero, zero + 1.0], axis=1),
        overlap=p,
        safe_overlap=jnp.where(touching, p, 1.0),
        touching=touching,
        closing=zero,
        sliding=jnp.concatenate([jnp.reshape(sliding, (1, 1, -1)), zero, zero], axis=1),
        twist=zero,
        arm=1.0 - 0.5 * p,
        dt=jnp.asarray(dt),
    )


def lead_contact(law: FrictionLaw, overlap: jax.Array, sliding: jax.Array, dt: Scalar) -> jax.Array:
    """Tangential force of a contact sampled every dt, as the simulator would call the law.

    Args:
        law: the friction law.
        overlap: p at each step, [T], in R.
        sliding: tangential velocity of each step, [T], in R / t_c.
        dt: time step, in t_c.

    Returns:
        The force along the sliding direction, dashpot included, [T], in E R^2.
    """
    material = Material()  # sets the normal force, that of a static overlap

    def step(history: Any, sample: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
        kin = led_contact(*sample, dt)
        normal_force = hertz(
            kin.safe_overlap, kin.closing, kin.touching, material.normal_stiffness, material.normal_damping
        )
        force, history = law(kin, normal_force, history)
        return history, force[0, 0, 0]

    overlap, sliding = jnp.asarray(overlap), jnp.asarray(sliding)
    _, forces = lax.scan(step, law.init(1, 1, overlap.dtype), (overlap, sliding))
    return forces


def contact_path(
    law: FrictionLaw,
    overlap: jax.Array,
    displacement: jax.Array,
    *,
    dt: Scalar = 1e6,
) -> jax.Array:
    """Quasi-static tangential force of one contact along a path (p, sigma) of T points; it may have sharp corners.

    The displacement between two points happens at their mean overlap, and the force is read at rest at each point. The
    error falls with the square of the spacing of the points.

    Args:
        law: the friction law.
        overlap: p, [T], in R; the contact begins at the first positive one.
        displacement: sigma, [T], in R.
        dt: time between two points, in t_c; the default is so slow that dashpots do not matter.

    Returns:
        The force along the displacement, [T], in E R^2.
    """
    overlap, displacement = jnp.asarray(overlap), jnp.asarray(displacement)
    # The law is called at rest at each point, and in motion between two points.
    halfway = 0.5 * (overlap[1:] + overlap[:-1])
    pulses = jnp.diff(displacement) / dt
    calls = 2 * overlap.shape[0] - 1
    p = jnp.zeros(calls, overlap.dtype).at[::2].set(overlap).at[1::2].set(halfway)
    v = jnp.zeros(calls, overlap.dtype).at[1::2].set(pulses)
    return lead_contact(law, p, v, dt)[::2]


def polyline(corners: jax.Array, points: int) -> jax.Array:
    """Points along straight segments between `corners` [C, D], `points` to a segment: [(C - 1) points + 1, D]."""
    corners = jnp.asarray(corners)
    fraction = (jnp.arange(points) / points)[None, :, None]
    segments = corners[:-1, None] + fraction * (corners[1:, None] - corners[:-1, None])
    return jnp.concatenate([segments.reshape(-1, corners.shape[-1]), corners[-1:]])
