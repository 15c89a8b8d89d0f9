"""The state of a run: grains, walls and contact histories; and the status bits that say what went wrong.

Replicas (B runs of one pack that differ in waveform or parameters) are always the last axis of an array.
"""

import enum
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from gmem_jax.physics.boundary import WALLS, PeriodicAxes
from gmem_jax.physics.pytree import pytree, static


class Status(enum.IntFlag):
    """Reasons to distrust a run, as bits of an integer; 0 is a clean run.

    Each replica has its own status, and a bit that is set once stays set. `explain` says what bits mean and what helps;
    docs/trust.md gives the reasons.
    """

    STALE_PAIRS = 1
    OUTSIDE_BOX = 2
    NOT_FINITE = 4
    NOT_AT_REST = 8
    OVERLAP_RANGE = 16
    STEP_TOO_LARGE = 32
    IMPOSSIBLE = 128
    DEEP_OVERLAP = 256
    NOT_QUASI_STATIC = 512
    RINGING = 1024
    SHEAR_BEYOND_COMPRESSION = 2048
    LARGE_WAVEFORM = 4096
    LARGE_FRICTION = 8192
    LARGE_STIFFNESS = 16384
    RESTLESS = 32768
    ROUNDED = 65536
    UNLOADED = 131072
    OTHER_COMPRESSION = 262144

    @property
    def fatal(self) -> bool:
        """Whether the results of the run are meaningless, not only doubtful: whether any bit but warnings is set."""
        return bool(self & ~WARNINGS)


WARNINGS = (
    Status.NOT_AT_REST
    | Status.DEEP_OVERLAP
    | Status.NOT_QUASI_STATIC
    | Status.RINGING
    | Status.SHEAR_BEYOND_COMPRESSION
    | Status.LARGE_WAVEFORM
    | Status.LARGE_FRICTION
    | Status.LARGE_STIFFNESS
    | Status.RESTLESS
    | Status.ROUNDED
    | Status.UNLOADED
    | Status.OTHER_COMPRESSION
)
"""The bits that warn and leave the numbers as they are; see `gmem_jax.experiment.validity`."""


SENTENCES = {
    Status.STALE_PAIRS: "grains moved too far for their neighbour list; gm.run renews the list, or use a smaller dt",
    Status.OUTSIDE_BOX: "a grain left the box; use a smaller dt, or check where the grains of the pack lie",
    Status.NOT_FINITE: "a position or a force is not a finite number; use a smaller dt, or check pack and friction law",
    Status.NOT_AT_REST: "grains still move when the readout begins; use a longer store or a larger hold_drag",
    Status.OVERLAP_RANGE: "an overlap exceeded what the friction law covers; use a larger p_max or a smaller delta0",
    Status.STEP_TOO_LARGE: "the time step, t0 / (256 steps), exceeds 2 t_c; use more steps or a smaller t0",
    Status.IMPOSSIBLE: "a parameter or a waveform is impossible; use numbers that `Experiment` accepts outside a trace",
    Status.DEEP_OVERLAP: "an overlap exceeded 0.2 R, and Hertz's law is for small ones; use a smaller delta0 or gamma0",
    Status.NOT_QUASI_STATIC: "the walls move too fast (inertial number above 5e-3); use a larger t0 or smaller gamma0",
    Status.RINGING: "the pack rings: F averaged over T1 exceeds F by more than 0.03; use a larger t0, or that average",
    Status.SHEAR_BEYOND_COMPRESSION: "the shear exceeds delta0 / 4, where the gain depends on it; use a smaller gamma0",
    Status.LARGE_WAVEFORM: "a waveform exceeds 2, and gains are per gamma0; use waveforms up to 1 and a larger gamma0",
    Status.LARGE_FRICTION: "a friction coefficient exceeds 10, which no material has; use a smaller mu or wall_mu",
    Status.LARGE_STIFFNESS: "tangential springs are stiffer than Hertz contacts; use stiffness < 1.5 normal_stiffness",
    Status.RESTLESS: "steps look unstable (fast grains or strong dampers); use a smaller dt, damping_time or hold_drag",
    Status.ROUNDED: "round-off is 1 % of p_sig or more; use a larger gamma0, or precision double if it was mixed",
    Status.UNLOADED: "the walls carried nothing during a whole bin, and lost the pack; use a larger t0",
    Status.OTHER_COMPRESSION: "the pack was cycled with another delta0; use one that was prepared for this delta0",
}


def combined_status(status: npt.ArrayLike) -> int:
    """The bits that any of several replicas or packs has set; 0 if there is no replica."""
    return int(np.bitwise_or.reduce(np.asarray(status, int), axis=None))


def explain(status: npt.ArrayLike) -> str:
    """The meaning of status bits, and what helps, in one line; "ok" if no bit is set.

    Args:
        status: the status of one replica, or of several, whose bits are joined.
    """
    bits = combined_status(status)
    return "; ".join(text for bit, text in SENTENCES.items() if bits & bit) or "ok"


@pytree
@dataclass(frozen=True)
class Grains:
    """Centres, orientations and their derivatives, one entry per grain (R = E = rho = 1).

    Attributes:
        position: centres, [N, 3, B], in R.
        quaternion: body-to-lab rotation (w, x, y, z), unit, [N, 4, B].
        velocity: [N, 3, B], in R / t_c.
        spin: angular velocity in the lab frame, [N, 3, B], in 1 / t_c.
        acceleration: [N, 3, B], at the time of `position`.
        spin_rate: angular acceleration, [N, 3, B], likewise.
    """

    position: jax.Array
    quaternion: jax.Array
    velocity: jax.Array
    spin: jax.Array
    acceleration: jax.Array
    spin_rate: jax.Array


@pytree
@dataclass(frozen=True)
class Box:
    """Six planes and their velocities; [3, B] each (x, y, z), in R and R / t_c.

    They are rigid walls, except the two planes of a periodic axis: beyond these lie images of the grains between them.
    """

    lower: jax.Array
    upper: jax.Array
    lower_velocity: jax.Array
    upper_velocity: jax.Array
    periodic: PeriodicAxes = static(WALLS)

    @property
    def lengths(self) -> jax.Array:
        """Edge lengths, [3, B]."""
        return self.upper - self.lower

    @property
    def growth(self) -> jax.Array:
        """Rate at which each edge grows, [3, B], in R / t_c."""
        return self.upper_velocity - self.lower_velocity

    @property
    def images(self) -> np.ndarray:
        """Whether each axis is periodic, bool [3, 1]."""
        return np.asarray(self.periodic)[:, None]


@pytree
@dataclass(frozen=True)
class HeldWalls:
    """Walls that give way to the pressure on them, axis by axis.

    Attributes:
        stretch: fraction by which each edge of the box is longer than prescribed, [3, B].
        pressure: pressure on the walls, averaged over the last bin, [3, B], in E.
    """

    stretch: jax.Array
    pressure: jax.Array


@pytree
@dataclass(frozen=True)
class State:
    """Everything that evolves: a run resumes bit for bit from this and the walls' motion.

    Attributes:
        grains: see `Grains`.
        history: what the friction law remembers of each candidate contact, a pytree with leaves [P, ..., B].
        status: sticky bits of `Status`, int32 [B].
        servo: the servo of walls that are held at a pressure; None if the walls are never held.
        cell: the box that the positions are in, if any of its axes is periodic; else None.
        wall_history: what the friction law remembers of each sphere at each plane of the box, a pytree with leaves
            [6 S, ..., B], in the order of `wall_kinematics`; None where walls are smooth. A new neighbour list does not
            change it.
    """

    grains: Grains
    history: Any
    status: jax.Array
    servo: HeldWalls | None = None
    cell: Box | None = None
    wall_history: Any = None

    @property
    def replicas(self) -> int:
        """Number of replicas B."""
        return int(self.status.shape[-1])


def still_box(lower: jax.Array, upper: jax.Array, periodic: PeriodicAxes = WALLS) -> Box:
    """Walls at rest; `lower` and `upper` are [3, B]."""
    return Box(lower, upper, jnp.zeros_like(lower), jnp.zeros_like(upper), periodic)


def replicate(tree: Any, replicas: int) -> Any:
    """Repeat the single replica of every leaf ([..., 1] to [..., B])."""
    return jax.tree.map(lambda leaf: jnp.repeat(leaf, replicas, axis=-1), tree)
