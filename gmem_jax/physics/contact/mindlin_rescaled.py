"""M1: the Mindlin contact whose elastic force is rescaled on unloading, so that it cannot create energy."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp

from gmem_jax.physics.contact.friction import SpringLaw, coulomb
from gmem_jax.physics.contact.kinematics import Kinematics, transport
from gmem_jax.physics.material import Material
from gmem_jax.physics.pytree import Scalar, parameter, pytree


@pytree
@dataclass(frozen=True)
class RescaledHistory:
    """The history of a contact under M1; zero for an untouched contact.

    Attributes:
        force: elastic force, [P, 3, B], in E R^2.
        overlap: overlap of the last step, [P, 1, B], in R.
    """

    force: jax.Array
    overlap: jax.Array


@pytree
@dataclass(frozen=True)
class MindlinRescaled(SpringLaw):
    """Law M1: df_e = k p^0.5 dsigma, f_d = damping_time k p^0.5 dsigma/dt, |f_e + f_d| <= mu f_n (paper, Sec. II).

    p is the overlap and sigma the tangential displacement. When the overlap decreases from p_old to p, f_e is first
    multiplied by sqrt(p / p_old). Between spheres of radii other than 1, k is multiplied by the square root of their
    harmonic mean.

    Attributes:
        mu: friction coefficient; scalar or [B].
        stiffness: k_M in E R^0.5, by default that of the default material; scalar or [B].
        damping_time: gamma_M / k_M in t_c; scalar or [B].
        spinning: see `gmem_jax.physics.contact.hooke.Hooke`.
    """

    stiffness: Scalar = parameter(Material().mindlin_stiffness, "(0, inf)", "k_M", "E R^0.5")

    def init(self, contacts: int, replicas: int, dtype: Any) -> RescaledHistory:
        """The history of contacts that do not touch: elastic force and overlap zero."""
        return RescaledHistory(jnp.zeros((contacts, 3, replicas), dtype), jnp.zeros((contacts, 1, replicas), dtype))

    def relaxed(self, history: RescaledHistory, factor: jax.Array) -> RescaledHistory:
        """See `gmem_jax.physics.contact.creep.RelaxingLaw`."""
        return replace(history, force=history.force * factor)

    def __call__(
        self, kin: Kinematics, normal_force: jax.Array, history: RescaledHistory
    ) -> tuple[jax.Array, RescaledHistory]:
        """Tangential force on sphere i and the new history; see `FrictionLaw`."""
        unloads = kin.touching & (kin.overlap < history.overlap)
        ratio = jnp.where(unloads, kin.safe_overlap, 1.0) / jnp.where(unloads, history.overlap, 1.0)
        spring = self.stiffness * kin.root
        dashpot = self.damping_time * spring * kin.sliding
        elastic = jnp.sqrt(ratio) * transport(history.force, kin, self.spinning) + kin.dt * spring * kin.sliding
        force, _ = coulomb(elastic + dashpot, self.mu * normal_force)
        force = jnp.where(kin.touching, force, 0.0)
        return force, RescaledHistory(
            jnp.where(kin.touching, force - dashpot, 0.0), jnp.where(kin.touching, kin.overlap, 0.0)
        )
