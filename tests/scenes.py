"""Small deterministic scenes, and compiled runs of them, shared by the tests of the core; where files of tests are."""

import functools
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.signals import Signals
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.grain import Clump, sphere, tetra
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import Pairs, slack, sphere_centres, tabulate
from gmem_jax.physics.pytree import Scalar, pytree
from gmem_jax.physics.rotation import uniform
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Box, Grains, State, replicate, still_box
from gmem_jax.simulation.sample import Sample, end_bin
from gmem_jax.simulation.stage import Bin, Lane
from gmem_jax.simulation.strain import StrainPath

TESTS = Path(__file__).parent
ROOT = TESTS.parent
TETRA_27 = TESTS / "data" / "tetra-27.h5"
PERIODIC_27 = TESTS / "data" / "periodic-27.h5"
SPREAD_27 = TESTS / "data" / "spread-27.h5"  # grains whose sizes have an SD of 0.1
PERIODIC_XY_27 = TESTS / "data" / "periodic-xy-27.h5"  # between walls along z

ELASTIC = Material(normal_damping=0.0)
SPHERE = sphere()
THREE_LAWS: dict[str, Any] = {"H": Hooke(mu=0.3), "M1": MindlinRescaled(mu=0.3), "M2": Mindlin(mu=0.3, points=8)}
EVERY_LAW: dict[str, Any] = {
    "frictionless": Frictionless(),
    "H": Hooke(mu=0.3),
    "M1": MindlinRescaled(mu=0.3),
    **{f"M2-{variant}": Mindlin(mu=0.3, points=8, variant=variant) for variant in ("exact", "averaged", "paper")},
}
FREE = still_box(jnp.full((3, 1), -15.0), jnp.full((3, 1), 15.0))  # walls out of everybody's way

cached_tetra = functools.lru_cache(tetra)
accelerate = jax.jit(dynamics.accelerate)


def without_settings_of_jax() -> dict[str, str]:
    """The environment, less all that tells JAX of devices and the like."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "PJRT_", "XLA_"))}


def gmem(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Run the command in this process; its exit code."""
    from gmem_jax.command import app

    monkeypatch.setattr(sys, "argv", ["gmem", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        app.main()
    return int(stop.value.code or 0)


def assert_close(found: Any, expected: Any, tolerance: float) -> None:
    """Every array of a tree to `tolerance` of its own largest number."""
    for one, (path, other) in zip(
        jax.tree.leaves(found), jax.tree_util.tree_flatten_with_path(expected)[0], strict=True
    ):
        scale = float(np.abs(np.asarray(other)).max()) if other.size else 0.0
        np.testing.assert_allclose(one, other, rtol=0.0, atol=tolerance * scale, err_msg=jax.tree_util.keystr(path))


def random_like(tree: Any, seed: int = 3) -> Any:
    """Normal numbers in the place of every number."""
    generator = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(generator.normal(size=jnp.shape(leaf))), tree)


def column(values) -> jax.Array:
    """Values of one replica, with its trailing axis added."""
    return jnp.asarray(values, dtype=float)[..., None]


def orientations(count: int, seed: int = 0) -> np.ndarray:
    """Random unit quaternions, [count, 4]."""
    return np.asarray(uniform(jax.random.PRNGKey(seed), count))


def make_grains(position, quaternion=None, velocity=None, spin=None) -> Grains:
    """Grains of one replica from [N, 3] and [N, 4] arrays; what is not given is zero (or the identity)."""
    zero = np.zeros(np.shape(position))
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(zero), 1))
    given = (
        position,
        upright if quaternion is None else quaternion,
        zero if velocity is None else velocity,
        zero if spin is None else spin,
    )
    return Grains(*(column(part) for part in (*given, zero, zero)))


def blank_state(system: dynamics.System, grains: Grains) -> State:
    """A state with untouched histories and a clean status."""
    replicas = grains.position.shape[-1]
    history = system.friction.init(system.pairs.capacity, replicas, grains.position.dtype)
    return State(grains, history, jnp.zeros(replicas, jnp.int32))


def all_pairs(clump: Clump, count: int, capacity: int = 8) -> Pairs:
    """Every pair of spheres of `count` grains, for scenes too small to need a search."""
    grain = np.arange(count * clump.spheres) // clump.spheres
    found = np.stack(np.nonzero(grain[:, None] < grain))
    blank = np.zeros((len(grain), 3, 1))
    return tabulate(found, blank, np.ones(3), np.inf, clump.spheres, capacity=capacity)


def scene(
    clump: Clump,
    position,
    quaternion=None,
    velocity=None,
    spin=None,
    *,
    friction=None,
    material: Material | None = None,
    box: Box = FREE,
    replicas: int = 1,
) -> tuple[dynamics.System, State, Box]:
    """A few grains in a box, every pair of them listed, with their accelerations."""
    grains = make_grains(position, quaternion, velocity, spin)
    friction = Hooke() if friction is None else friction
    pairs = all_pairs(clump, len(position))
    system = dynamics.System(clump, friction, pairs, Material() if material is None else material)
    state = accelerate(system, replicate(blank_state(system, grains), replicas), box)
    return system, state, box


@pytree
@dataclass(frozen=True)
class Motion:
    """One stage of a drive: the walls as a function of time alone.

    Attributes:
        lower: lower planes at u = 0, [3, 1].
        upper: upper planes, alike.
        delta0: areal compression at u = 1, scalar or [B].
        start: u at the beginning of the stage.
        stop: u at its end.
        duration: in t_c.
        gamma0: shear amplitude, scalar or [B].
        signals: the waveforms, or None for no shear.
        sheared: whether they are applied.
    """

    lower: jax.Array
    upper: jax.Array
    delta0: Scalar
    start: Scalar
    stop: Scalar
    duration: Scalar
    gamma0: Scalar = 0.0
    signals: Signals | None = None
    sheared: Scalar | bool = True

    def box_at(self, time: jax.Array) -> Box:
        """The walls at `time` since the start of the stage."""
        drive = strain_path(self.lower, self.upper, self.delta0, self.gamma0, self.signals)
        amplitudes = () if self.signals is None else (jnp.asarray(self.sheared, float),)
        still = self.start == self.stop
        row = Bin(self.start, self.stop, 1, 0, timed=still, still=still, amplitudes=amplitudes)
        return drive.box_at(row, jnp.asarray(time), self.duration)


def strain_path(lower, upper, delta0, gamma0=0.0, signals=None, **share) -> StrainPath:
    """The walls of the paper: waveforms on channel xy, or none."""
    lanes = {} if signals is None else {"waveforms": (signals,), "lanes": (Lane("xy", "xy"),)}
    return StrainPath(lower, upper, delta0, gamma0, **lanes, **share)


def advance_by(march):
    """`advance` on a backend, whose `march` does the steps: not compiled."""

    def advance(system, state, motion, dt, first_bin=0, *, bins, steps, drag=0.0) -> tuple[State, Sample]:
        """`bins` bins of `steps` steps from bin number `first_bin` of a motion; the state, and samples [bins]."""
        dt = jnp.asarray(dt)

        def one_bin(state, number):
            count = number * steps + 1 + jnp.arange(steps)
            boxes = jax.vmap(motion.box_at)(count.reshape(-1, *(1 for _ in dt.shape)) * dt)
            wide = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (steps, 3, state.replicas)), boxes)
            state, total = march(system, state, wide, dt, drag)
            return end_bin(system, state, jax.tree.map(lambda leaf: leaf[-1], wide), total / steps, 0.0)

        return jax.lax.scan(one_bin, state, first_bin + jnp.arange(bins))

    return advance


advance_plain = advance_by(dynamics.march)
advance = jax.jit(advance_plain, static_argnames=("bins", "steps"))


@jax.jit
def coast(system, state, box, dt, steps, drag=0.0):
    """The state after `steps` steps between walls at rest."""
    alive = steps >= 0
    return jax.lax.fori_loop(0, steps, lambda _, s: dynamics.step(system, s, box, dt, drag, alive)[0], state)


@functools.partial(jax.jit, static_argnames="count")
def record(system, state, motion, dt, *, count):
    """`count` steps; returns (states after each step, wall forces [count, 2, 3, B], boxes), with a leading time axis.

    `dt` may be [B] if the walls stand still (they keep the first replica's time).
    """

    def one(state, box):
        state, walls = dynamics.step(system, state, box, dt, 0.0, jnp.all(state.status >= 0))
        return state, (state, walls)

    boxes = jax.vmap(motion.box_at)((1 + jnp.arange(count)) * jnp.ravel(dt)[0])
    _, (states, walls) = jax.lax.scan(one, state, boxes)
    return states, walls, boxes


def still(box: Box) -> Motion:
    """Walls that do not move."""
    return Motion(box.lower, box.upper, 0.0, 0.0, 0.0, 1.0)


def standing(box: Box, steps: int) -> Box:
    """Walls that stand still for some steps."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (steps, *leaf.shape)), box)


CLUSTER_EDGE = 7.6  # of the box of the 27 grains: 2e-3 E and overlaps of 0.1 R, as in a pack at u = 0


@functools.lru_cache
def _settled_cluster() -> Grains:
    """27 grains relaxed without friction from a lattice, with a drag, until they rest."""
    edge = CLUSTER_EDGE
    lattice = (np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) * edge / 3.0
    box = still_box(jnp.zeros((3, 1)), jnp.full((3, 1), edge))
    grains = make_grains(lattice, orientations(27))
    pairs = PairFinder(cached_tetra(), np.full(3, edge), skin=1.5)(grains, cached_tetra(), box)
    system = dynamics.System(cached_tetra(), Hooke(mu=0.0), pairs)
    state = coast(system, blank_state(system, grains), box, 0.3, 10000, 0.1)
    assert float(slack(pairs, sphere_centres(state.grains, cached_tetra()), box)[0]) > 0.0
    still_grains = {name: jnp.zeros((27, 3, 1)) for name in ("velocity", "spin")}
    return replace(state.grains, **still_grains)


@functools.lru_cache
def _cluster_pairs(skin: float) -> Pairs:
    grains, box = _settled_cluster(), cluster_box()
    return PairFinder(cached_tetra(), np.asarray(box.lengths)[:, 0], skin)(grains, cached_tetra(), box)


def cluster_box() -> Box:
    """The box of `cluster27`."""
    return still_box(jnp.zeros((3, 1)), jnp.full((3, 1), CLUSTER_EDGE))


def cluster27(friction=None, replicas: int = 1, skin: float = 0.5, material: Material | None = None):
    """A pack in miniature: 27 tetrahedra at rest under pressure, with friction on and blank histories."""
    friction = Hooke() if friction is None else friction
    system = dynamics.System(
        cached_tetra(), friction, _cluster_pairs(skin), Material() if material is None else material
    )
    grains = _settled_cluster()
    state = accelerate(system, replicate(blank_state(system, grains), replicas), cluster_box())
    return system, state, cluster_box()


def squeeze(box: Box, duration: float, delta0: float = 0.05, gamma0=0.0, signals=None) -> Motion:
    """Compression of `box` from u = 0 to 1."""
    return Motion(box.lower, box.upper, delta0, 0.0, 1.0, duration, gamma0, signals)


def with_skin(pack: Pack, skin: float) -> Pack:
    """The pack with a list of so small a skin that it goes stale on the way."""
    lengths = np.asarray(pack.upper - pack.lower)
    still = jnp.zeros((*pack.position.shape, 1))
    grains = Grains(pack.position[..., None], pack.quaternion[..., None], still, still, still, still)
    pairs = PairFinder(pack.clump, lengths, skin)(grains, pack.clump, pack.box)
    return replace(pack, pairs=pairs)
