"""M2: the Mindlin contact with its whole history, resolved by the overlap at which each part was attached."""

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp

from gmem_jax.physics.contact.friction import SpringLaw, coulomb
from gmem_jax.physics.contact.kinematics import Kinematics, transport
from gmem_jax.physics.material import Material
from gmem_jax.physics.numbers import require_whole
from gmem_jax.physics.pytree import Scalar, parameter, pytree, static
from gmem_jax.physics.rotation import cross, dot

Variant = Literal["averaged", "exact", "paper"]
MOST_POINTS = 10_000  # of a history; the paper has 100


@pytree
@dataclass(frozen=True)
class LayeredHistory:
    """The history of a contact under M2; zero for an untouched contact.

    Attributes:
        layers: f_j, along the frame and across it, [P, Q, 2, B], in E R^1.5.
        frame: a unit vector of the tangent plane that is carried along like a force, [P, 3, B]; the second axis is
            n x frame.
        overlap: overlap of the last step, [P, 1, B], in R.
    """

    layers: jax.Array
    frame: jax.Array
    overlap: jax.Array


def any_tangent(normal: jax.Array) -> jax.Array:
    """Unit vectors that are not along the unit vectors `normal`, both [P, 3, B]. Projected, they start a frame."""
    near_x = jnp.abs(normal[:, :1]) > 0.6
    return jnp.concatenate([jnp.where(near_x, 0.0, 1.0), jnp.where(near_x, 1.0, 0.0), jnp.zeros_like(normal[:, :1])], 1)


@pytree
@dataclass(frozen=True)
class Mindlin(SpringLaw):
    """Law M2: f_e is the integral of f(q) over 0 < q < sqrt(p), where df = k dsigma (paper, App. D.2).

    p is the overlap and sigma the tangential displacement. f(q) is the elastic force per unit of q in the ring of the
    contact area that was attached when sqrt(p) passed q; rings beyond sqrt(p) are detached, and their f is lost. f is
    kept at Q points, dq = sqrt(p_max) / (Q - 1) apart: with x = sqrt(p) / dq and the outermost ring jp = floor(x),
    f_e = dq sum_j w_j f_j over j <= jp. The dashpot is f_d = damping_time k p^0.5 dsigma/dt, and |f_e + f_d| <= mu f_n.
    A sliding contact loses the same amount of f in all its rings. All rings turn with the contact: f_j is kept as its
    components in a frame that turns.

    Between spheres of radii other than 1, q runs to sqrt(r p), where r is their harmonic mean; q is then, in every
    contact, the radius of the contact area times sqrt(2). The points are sqrt(r) dq apart, so that they reach to the
    overlap p_max in every contact, and x is as above.

    The variants differ in the outermost ring, which the contact fills only in part:

    - "averaged": w_j = 1 and w_jp = x - jp, so that the stiffness dq sum w_j is exactly sqrt(p). While the ring fills,
      f_jp is diluted so that its force w_jp f_jp is constant. So no path can extract energy, and f_e is in error by the
      force in one ring, or by dq^2.
    - "exact": the same weights without the dilution. Filling the ring then adds a spurious force: f_e is in error by
      dq, and a cycle of p within one ring can create energy.
    - "paper": as "exact", but w_0 less by 1/2, the weights of App. D.2. The stiffness sqrt(p) - dq/2 would be
      negative below x = 1/2; there this variant has no spring at all.

    Attributes:
        mu: friction coefficient; scalar or [B].
        stiffness: k_M in E R^0.5, by default that of the default material; scalar or [B].
        damping_time: gamma_M / k_M in t_c; scalar or [B].
        spinning: see `gmem_jax.physics.contact.hooke.Hooke`.
        p_max: largest overlap that the points cover, in R. The paper's packs reach 0.16 at u = 1. A larger overlap
            makes the run fail (`Status.OVERLAP_RANGE`).
        points: number Q of points, 2 to 10,000.
        variant: "averaged", "exact" or "paper".

    Raises:
        ValueError: if `points` or `variant` is none of these.
    """

    stiffness: Scalar = parameter(Material().mindlin_stiffness, "(0, inf)", "k_M", "E R^0.5")
    p_max: Scalar = parameter(0.2, "(0, inf)", "m2: largest overlap that its history covers", "R")
    points: int = static(100, "m2: number of points of its history")
    variant: Variant = static("averaged", "m2: its outermost ring is averaged, exact or paper")

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "points", require_whole("Mindlin.points", self.points))
        if not 2 <= self.points <= MOST_POINTS:
            raise ValueError(f"Mindlin.points must be 2 to {MOST_POINTS}, got {self.points}")
        if self.variant not in get_args(Variant):
            raise ValueError(f"Mindlin.variant must be one of {', '.join(get_args(Variant))}; got {self.variant!r}")

    @property
    def largest_overlap(self) -> Scalar:
        """p_max: see `gmem_jax.physics.contact.friction.RangedLaw`."""
        return self.p_max

    @property
    def spacing(self) -> jax.Array:
        """dq, in R^0.5; scalar or [B]."""
        return jnp.sqrt(jnp.asarray(self.p_max)) / (self.points - 1)

    def init(self, contacts: int, replicas: int, dtype: Any) -> LayeredHistory:
        """The history of contacts that do not touch: no ring is attached."""
        return LayeredHistory(
            jnp.zeros((contacts, self.points, 2, replicas), dtype),
            jnp.zeros((contacts, 3, replicas), dtype),
            jnp.zeros((contacts, 1, replicas), dtype),
        )

    def relaxed(self, history: LayeredHistory, factor: jax.Array) -> LayeredHistory:
        """See `gmem_jax.physics.contact.creep.RelaxingLaw`."""
        return replace(history, layers=history.layers * factor)

    def outermost(self, x: jax.Array) -> jax.Array:
        """The ring jp that a contact reaching to x = sqrt(p) / dq fills in part; a whole number, in the shape of x."""
        return jnp.minimum(jnp.floor(x), self.points - 2)

    def weights(self, x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The weights w_j of the points in the force of a contact with x = sqrt(p) / dq > 0.

        Args:
            x: [P, 1, B].

        Returns:
            Whether a point carries force, [P, Q, 1, B]; its weight; and the sum of the weights, [P, 1, B].
        """
        points = jnp.arange(self.points)[:, None, None]
        outermost = self.outermost(x)[:, None]
        inside = points <= outermost
        weight = jnp.where(points == outermost, x[:, None] - outermost, 1.0)
        if self.variant != "paper":
            return inside, jnp.where(inside, weight, 0.0), x
        inside &= x[:, None] > 0.5
        return inside, jnp.where(inside, weight - 0.5 * (points == 0), 0.0), jnp.where(x > 0.5, x - 0.5, 1.0)

    def _diluted(self, history: LayeredHistory, x: jax.Array) -> jax.Array:
        """The layers after the contact grew to x: the force w f of the ring that was partly filled does not change."""
        known = history.overlap > 0.0
        reached = jnp.where(known, jnp.sqrt(jnp.where(known, history.overlap, 1.0)) / self.spacing, 0.0)
        ring = self.outermost(reached)
        filled, weight = reached - ring, jnp.where(self.outermost(x) > ring, 1.0, x - ring)
        grows = filled < weight
        dilution = jnp.where(grows, filled / jnp.where(grows, weight, 1.0), 1.0)
        points = jnp.arange(self.points)[:, None, None]
        return history.layers * jnp.where(points == ring[:, None], dilution[:, None], 1.0)

    def __call__(
        self, kin: Kinematics, normal_force: jax.Array, history: LayeredHistory
    ) -> tuple[jax.Array, LayeredHistory]:
        """Tangential force on sphere i and the new history; see `FrictionLaw`."""
        x = jnp.sqrt(kin.safe_overlap) / self.spacing
        spacing = self.spacing if kin.radius is None else self.spacing * jnp.sqrt(kin.radius)
        inside, weight, total = self.weights(x)
        inside &= kin.touching[:, None]

        before = jnp.where(history.overlap > 0.0, history.frame, any_tangent(kin.normal).astype(history.frame.dtype))
        frame = transport(before, kin, self.spinning)
        across = cross(kin.normal, frame)
        sliding = jnp.concatenate([dot(kin.sliding, frame), dot(kin.sliding, across)], axis=1)
        growth = (self.stiffness * kin.dt) * sliding
        dashpot = (self.stiffness * self.damping_time) * kin.root * sliding

        layers = self._diluted(history, x) if self.variant == "averaged" else history.layers
        layers = jnp.where(inside, layers + growth[:, None], 0.0)
        trial = spacing * jnp.sum(weight * layers, axis=1) + dashpot
        force, _ = coulomb(trial, self.mu * normal_force)
        correction = (force - trial) / (spacing * total)
        layers = jnp.where(inside, layers + correction[:, None], 0.0)
        force = jnp.where(kin.touching, force[:, :1] * frame + force[:, 1:] * across, 0.0)
        return force, LayeredHistory(
            layers, jnp.where(kin.touching, frame, 0.0), jnp.where(kin.touching, kin.overlap, 0.0)
        )
