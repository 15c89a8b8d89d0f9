"""The interface of friction laws, and the Coulomb limit that they share.

A law is a frozen pytree of parameters with two methods, `init` and `__call__`. It computes the tangential force of a
contact from its sliding history; a user's own law is one such class. `coulomb` and `kinematics.transport` are shared.

A law is called once in a step, with the positions at its end and the velocities of its middle: the tangential
displacement in the step is `kin.sliding` times `kin.dt`.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from gmem_jax.physics.contact.kinematics import Kinematics
from gmem_jax.physics.pytree import Scalar, parameter, validate
from gmem_jax.physics.rotation import dot

TANGENTIAL_DAMPING = 0.069  # gamma / k of a tangential spring, in t_c; the paper's value for every law


@dataclass(frozen=True)
class SpringLaw:
    """The parameters of a law with a tangential spring and dashpot; the default stiffness is that of law H.

    The subclasses describe what the parameters mean in each law.
    """

    mu: Scalar = parameter(1.0, "[0, inf)", "Friction coefficient")
    stiffness: Scalar = parameter(0.13, "(0, inf)", "k_H in E R, or k_M in E R^0.5; default the law's")
    damping_time: Scalar = parameter(
        TANGENTIAL_DAMPING, "[0, inf)", "Tangential damping over tangential stiffness; default the law's", "t_c"
    )
    spinning: Scalar = parameter(1.0, "[0, 1]", "1: the history turns with a contact about its normal; 0: not")

    def __post_init__(self) -> None:
        validate(self)


@runtime_checkable
class FrictionLaw(Protocol):
    """The interface of a friction law: a frozen pytree of parameters with these two methods."""

    def init(self, contacts: int, replicas: int, dtype: Any) -> Any:
        """The history of contacts that have not touched: a pytree with leaves [contacts, ..., replicas].

        Args:
            contacts: number of candidate contacts P.
            replicas: number of replicas B.
            dtype: floating-point type of the history.
        """
        ...

    def __call__(self, kin: Kinematics, normal_force: jax.Array, history: Any) -> tuple[jax.Array, Any]:
        """One step of the law. Where `kin.touching` is False, the force must be 0 and the history that of `init`.

        Args:
            kin: geometry and motion of the P candidate contacts.
            normal_force: f_n, [P, 1, B], in E R^2.
            history: the history after the previous step.

        Returns:
            The tangential force on sphere i, [P, 3, B], in E R^2 (that on j is its opposite), and the new history.
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
    """A friction law that is valid only up to some overlap; a run that exceeds it has failed."""

    @property
    def largest_overlap(self) -> Scalar:
        """The largest valid overlap, in R; scalar or [B]."""
        ...


def largest_overlap(law: FrictionLaw) -> Scalar:
    """Overlap beyond which a run with `law` has failed (`Status.OVERLAP_RANGE`); infinite for most laws."""
    return law.largest_overlap if isinstance(law, RangedLaw) else float("inf")


def coulomb(trial: jax.Array, limit: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Limit tangential forces by Coulomb friction.

    Args:
        trial: forces without the limit, [P, 3, B].
        limit: mu f_n, [P, 1, B], in the unit of the forces.

    Returns:
        The forces, scaled back to the limit where they exceed it, [P, 3, B]; and whether the contact slides, [P, 1, B].
    """
    square = dot(trial, trial)
    slides = square > limit * limit
    scale = jnp.where(slides, limit / jnp.sqrt(jnp.where(slides, square, 1.0)), 1.0)
    return trial * scale, slides
