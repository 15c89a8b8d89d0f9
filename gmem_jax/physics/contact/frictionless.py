"""No tangential force at all: the law of the preparation, without any history to carry."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from gmem_jax.physics.contact.kinematics import Kinematics
from gmem_jax.physics.pytree import pytree


@pytree
@dataclass(frozen=True)
class Frictionless:
    """No friction, mu = 0: the law under which packs are prepared (paper, Sec. II)."""

    def init(self, contacts: int, replicas: int, dtype: Any) -> tuple[()]:
        """The empty history."""
        return ()

    def __call__(self, kin: Kinematics, normal_force: jax.Array, history: tuple[()]) -> tuple[jax.Array, tuple[()]]:
        """Zero force; see `FrictionLaw`."""
        return jnp.zeros_like(kin.sliding), ()
