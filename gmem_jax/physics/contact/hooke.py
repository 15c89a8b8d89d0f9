"""H: a linear tangential spring and dashpot under the Coulomb limit (the paper's default law)."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from gmem_jax.physics.contact.friction import SpringLaw, coulomb
from gmem_jax.physics.contact.kinematics import Kinematics, transport
from gmem_jax.physics.pytree import pytree


@pytree
@dataclass(frozen=True)
class Hooke(SpringLaw):
    """Law H: df_e = k dsigma, f_d = damping_time k dsigma/dt, |f_e + f_d| <= mu f_n (paper, Sec. II).

    sigma is the tangential displacement of a contact, f_e and f_d are its elastic and damping force. All contacts have
    the same stiffness k, whatever the radii of the spheres.

    Attributes:
        mu: friction coefficient; scalar or [B].
        stiffness: k_H in E R; scalar or [B]. The paper gives "a typical inverse transverse compliance" of the
            Mindlin law: k_M <sqrt(p)> is 0.10 to 0.145 over the compression. The default is calibrated within
            these, on packs of 10,240 (docs/decisions/physics.md).
        damping_time: gamma_H / k_H in t_c; scalar or [B].
        spinning: 1 if the history turns with the contact about its normal; 0 if it is only kept in the tangent plane,
            as in LAMMPS; scalar or [B].
    """

    def init(self, contacts: int, replicas: int, dtype: Any) -> jax.Array:
        """The history of contacts that do not touch: elastic force zero, [contacts, 3, replicas]."""
        return jnp.zeros((contacts, 3, replicas), dtype)

    def relaxed(self, history: jax.Array, factor: jax.Array) -> jax.Array:
        """See `gmem_jax.physics.contact.creep.RelaxingLaw`."""
        return history * factor

    def __call__(self, kin: Kinematics, normal_force: jax.Array, history: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Tangential force on sphere i and the new history; see `FrictionLaw`."""
        dashpot = (self.stiffness * self.damping_time) * kin.sliding
        elastic = transport(history, kin, self.spinning) + (self.stiffness * kin.dt) * kin.sliding
        force, _ = coulomb(elastic + dashpot, self.mu * normal_force)
        force = jnp.where(kin.touching, force, 0.0)
        return force, jnp.where(kin.touching, force - dashpot, 0.0)
