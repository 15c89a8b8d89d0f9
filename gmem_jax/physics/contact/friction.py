"""Friction laws: tangential force from the sliding history of a contact, limited by Coulomb friction.

A law is a frozen pytree of parameters with two methods, `init` and `__call__`, and nothing else; a user's law is
one such class. `coulomb` and `kinematics.transport` are the shared pieces.

A law is called once in a step, with positions at its end and velocities of its middle: the sliding of the step is
`kin.sliding` times `kin.dt`.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from gmem_jax.physics.contact.kinematics import Kinematics
from gmem_jax.physics.pytree import Scalar, parameter, validate
from gmem_jax.physics.rotation import dot

TANGENTIAL_DAMPING = 0.069  # gamma / k of a tangential spring, in t_c; the paper's, of every law


@dataclass(frozen=True)
class SpringLaw:
    """The numbers of a law with a tangential spring and dashpot, which each law describes; the stiffness is H's."""

    mu: Scalar = parameter(1.0, "[0, inf)", "Friction coefficient")
    stiffness: Scalar = parameter(0.13, "(0, inf)", "k_H in E R, or k_M in E R^0.5; default the law's")
    damping_time: Scalar = parameter(
        TANGENTIAL_DAMPING, "[0, inf)", "Tangential damping over stiffness; default the law's", "t_c"
    )
    spinning: Scalar = parameter(1.0, "[0, 1]", "1: the history turns with a contact about its normal; 0: not")

    def __post_init__(self) -> None:
        validate(self)


@runtime_checkable
class FrictionLaw(Protocol):
    """What the simulator asks of a friction law."""

    def init(self, contacts: int, replicas: int, dtype: Any) -> Any:
        """The history of `contacts` untouched contacts: a pytree with leaves [contacts, ..., replicas]."""
        ...

    def __call__(self, kin: Kinematics, normal_force: jax.Array, history: Any) -> tuple[jax.Array, Any]:
        """Tangential force on sphere i, [P, 3, B] (on j its opposite), and the new history.

        Both must be exactly zero (the history as `init` gives it) where `kin.touching` is False.
        """
        ...


@runtime_checkable
class CoulombLaw(Protocol):
    """A law with a friction coefficient."""

    @property
    def mu(self) -> Scalar:
        """Friction coefficient; scalar or [B]."""
        ...


@runtime_checkable
class RangedLaw(Protocol):
    """A law that is valid up to some overlap only, and says so."""

    @property
    def largest_overlap(self) -> Scalar:
        """Largest overlap the law can represent; scalar or [B], in R."""
        ...


def largest_overlap(law: FrictionLaw) -> Scalar:
    """Overlap beyond which a run with `law` has failed (`Status.OVERLAP_RANGE`); infinite for most laws."""
    return law.largest_overlap if isinstance(law, RangedLaw) else float("inf")


def coulomb(trial: jax.Array, limit: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Scale tangential forces [P, 3, B] back to the friction limit [P, 1, B] where they exceed it.

    Returns:
        The limited force, and whether the contact slides, [P, 1, B].
    """
    square = dot(trial, trial)
    slides = square > limit * limit
    scale = jnp.where(slides, limit / jnp.sqrt(jnp.where(slides, square, 1.0)), 1.0)
    return trial * scale, slides
