"""The constants of a run: grain, friction law, candidate contacts, material."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import Pairs
from gmem_jax.physics.pytree import Scalar, pytree


@pytree
@dataclass(frozen=True)
class System:
    """The constants of a run.

    Attributes:
        clump: the grain.
        friction: the friction law.
        pairs: candidate contacts.
        material: the elastic solid.
        gravity: acceleration of every grain along -z, in R / t_c^2; scalar or [B], None for none.
        wall_mu: friction coefficient of the walls; scalar or [B], None for smooth walls.
    """

    clump: Clump
    friction: FrictionLaw
    pairs: Pairs
    material: Material = Material()
    gravity: Scalar | None = None
    wall_mu: Scalar | None = None

    def weighed(self, acceleration: jax.Array) -> jax.Array:
        """Accelerations [N, 3, B] plus the acceleration of gravity."""
        if self.gravity is None:
            return acceleration
        return acceleration.at[:, 2].add(-jnp.asarray(self.gravity, acceleration.dtype))
