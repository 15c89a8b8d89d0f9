"""Walls with friction on the native backend, against the definition; their adjoint, against their tangents."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import PERIODIC_XY_27, SPREAD_27, TETRA_27, THREE_LAWS, assert_close, random_like
from transposed import assert_transposed

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.physics import forces
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.contact.wall import wall_forces
from gmem_jax.physics.state import Box, State, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System

pytestmark = pytest.mark.skipif(not native.available()[0], reason="the library was not built")

STEPS = 40
QUICKLY = {"xla_backend_optimization_level": 0}
Scene = tuple[System, State, Box]


@functools.cache
def thrown(law: str, replicas: int, file: Any = TETRA_27) -> Scene:
    """27 grains that fly and spin between walls that shrink, more along one axis than another, and open along z.

    In a periodic box they shrink along z too.
    """
    pack = gm.load_pack(file)
    wall_mu = jnp.linspace(0.1, 0.4, replicas)
    system = System(pack.clump, THREE_LAWS[law], pack.pairs, gm.Material(wall_rigidity=0.7), wall_mu=wall_mu)
    places = replicate((pack.position[..., None], pack.quaternion[..., None]), replicas)
    state = jax.jit(start, compiler_options=QUICKLY)(system, *places, pack.box)
    draws = 8e-3 * np.random.default_rng(0).normal(size=(2, pack.grains, 3, 5))[..., :replicas]
    grains = replace(state.grains, velocity=jnp.asarray(draws[0]), spin=jnp.asarray(draws[1]))
    along_z = 4e-3 if any(pack.periodic) else -6e-3
    inwards = jnp.asarray([2e-3, 1e-3, along_z])[:, None] * jnp.linspace(1.0, 0.5, 5)[:replicas]
    time, every = 0.3 * (1.0 + jnp.arange(STEPS))[:, None, None], jnp.ones((STEPS, 3, replicas))
    lower, upper = pack.lower[:, None] + time * inwards, pack.upper[:, None] - 2.0 * time * inwards
    boxes = Box(lower, upper, every * inwards, -2.0 * every * inwards, pack.periodic)
    return system, replace(state, grains=grains), boxes


def part(boxes: Box, which: slice) -> Box:
    return jax.tree.map(lambda leaf: leaf[which], boxes)


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICKLY)
def moved(march: Callable[..., Any], system: System, state: State, boxes: Box) -> Any:
    """All that a march gives, in two bins, and what walls remember between them."""
    middle, pressure = march(system, state, part(boxes, slice(25)), 0.3, 0.01)
    state, more = march(system, middle, part(boxes, slice(25, None)), 0.3, 0.01)
    return state.grains, state.history, state.wall_history, pressure + more, middle.wall_history


MORE = ("H", 5, TETRA_27), ("H", 1, TETRA_27), ("M1", 1, TETRA_27), ("M2", 1, TETRA_27), ("M1", 1, PERIODIC_XY_27)


@pytest.mark.parametrize(
    ("law", "replicas", "file"),
    [
        *(("M1", 5, TETRA_27), ("M2", 5, TETRA_27), ("H", 5, PERIODIC_XY_27)),
        *(pytest.param(*more, marks=pytest.mark.slow) for more in MORE),
    ],
)
def test_values_at_walls_with_friction_are_those_of_the_definition(law: str, replicas: int, file: Any) -> None:
    scene = thrown(law, replicas, file)
    found = moved(native.march, *scene)
    assert_close(found, moved(dynamics.march, *scene), 1e-12)  # one replica contact by contact, five side by side
    vectors = -2 if law == "M2" else 0  # its rings come before
    middle, end = (np.any(np.asarray(jax.tree.leaves(each)[vectors]) != 0.0, axis=1) for each in (found[4], found[2]))
    counts = (np.sum(middle & end), np.sum(middle & ~end), np.sum(end & ~middle))
    assert (
        min(counts[:1] if file == PERIODIC_XY_27 else counts) > 0
    )  # contacts stay and, where walls part, end and begin


def test_walls_of_this_scene_are_stuck_to_and_slid_on() -> None:
    system, _, boxes = scene = thrown("M1", 5)
    grains, _, history, *_ = moved(native.march, *scene)
    table, _ = forces.sphere_table(system.clump, grains)
    box, material = part(boxes, -1), system.material
    normal = wall_forces(table, box, material, material.normal_damping)  # type: ignore[arg-type]
    _, force, _, _ = forces.wall_loads(system, grains, box, *normal, history, jnp.asarray(0.3))
    limit = np.asarray(system.wall_mu) * np.asarray(jnp.concatenate(normal, axis=1)).reshape(force.shape[0], 5)
    used = np.linalg.norm(force, axis=1)[limit > 0.0] / limit[limit > 0.0]
    assert min(np.sum(used > 1.0 - 1e-9), np.sum(used < 0.9)) > 5


@pytest.mark.parametrize("law", THREE_LAWS)
def test_a_replica_between_walls_with_friction_has_the_same_bits_alone(law: str) -> None:
    system, state, boxes = thrown(law, 5)
    together = moved(native.march, system, state, boxes)
    for replica in (0, 3):
        state_of, boxes_of = jax.tree.map(lambda leaf, at=replica: leaf[..., at : at + 1], (state, boxes))
        alone = moved(native.march, replace(system, wall_mu=system.wall_mu[replica]), state_of, boxes_of)  # type: ignore[index]
        for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
            np.testing.assert_array_equal(one[..., 0], other[..., replica])


@pytest.mark.slow
def test_values_of_grains_of_sizes_are_those_of_the_definition() -> None:
    scene = thrown("M1", 5, SPREAD_27)
    assert_close(moved(native.march, *scene), moved(dynamics.march, *scene), 1e-12)


def slopes(march: Callable[..., Any], scene: Scene, steps: int) -> tuple[Callable[..., Any], Any]:
    """What some steps give, as a function of all that they depend on; and that."""
    system, state, boxes = scene
    law: Any = system.friction
    theta = {
        "grains": state.grains,
        "histories": (state.history, state.wall_history),
        "law": {name: jnp.asarray(getattr(law, name)) for name in ("mu", "stiffness", "damping_time", "spinning")},
        "wall_mu": system.wall_mu,
        "rigidity": jnp.asarray(0.7),
        "offsets": system.clump.offsets,
        "boxes": part(boxes, slice(steps)),
        "dt": jnp.asarray(0.3),
    }

    def end(theta: Any) -> Any:
        material, clump = replace(system.material, wall_rigidity=theta["rigidity"]), system.clump
        changed = replace(
            system,
            friction=replace(law, **theta["law"]),
            material=material,
            clump=replace(clump, offsets=theta["offsets"]),
            wall_mu=theta["wall_mu"],
        )
        history, walls = theta["histories"]
        before = replace(state, grains=theta["grains"], history=history, wall_history=walls)
        after, pressure = march(changed, before, theta["boxes"], theta["dt"], 0.01)
        return after.grains, after.history, after.wall_history, pressure

    return end, theta


def rubbed(law: str, file: Any) -> Scene:
    """`thrown` after its first bin, so that walls have something to remember."""
    system, state, boxes = thrown(law, 5, file)
    advanced = jax.jit(native.march)(system, state, part(boxes, slice(25)), 0.3, 0.01)[0]
    return system, advanced, part(boxes, slice(25, None))


def derivatives(march: Callable[..., Any], law: str, file: Any) -> Any:
    """Of 10 steps along some direction."""
    end, theta = slopes(march, rubbed(law, file), 10)
    direction = random_like(theta)
    # Contacts apart remember nothing, whatever a direction says; in M2 nor do rings that are not attached.
    blank = jax.tree.map(lambda along, at: jnp.where(at != 0.0, along, 0.0), direction["histories"], theta["histories"])
    along = jax.jit(lambda theta, along: jax.jvp(end, (theta,), (along,))[1], compiler_options=QUICKLY)
    return along(theta, direction | {"histories": blank})


@pytest.mark.parametrize(
    ("law", "file"),
    [
        ("M2", TETRA_27),
        *(pytest.param(*more, marks=pytest.mark.slow) for more in (("M1", TETRA_27), ("H", PERIODIC_XY_27))),
    ],
)
def test_tangents_at_walls_with_friction_are_those_of_the_definition(law: str, file: Any) -> None:
    found, expected = (derivatives(march, law, file) for march in (native.march, dynamics.march))
    # Round-off is some 1e-14, magnified in each step where contacts between grains have just begun (as much between
    # smooth walls).
    assert_close(found, expected, 1e-9)


@pytest.mark.parametrize(
    ("law", "file"),
    [("H", TETRA_27), ("M1", TETRA_27), ("M2", TETRA_27), ("H", SPREAD_27), ("M2", SPREAD_27), ("M1", PERIODIC_XY_27)],
)
def test_the_adjoint_at_walls_with_friction_is_the_transpose_of_the_tangent(law: str, file: Any) -> None:
    system, state, boxes = thrown(law, 3, file)
    state, _ = jax.jit(native.march)(system, state, part(boxes, slice(25)), 0.3, 0.01)  # walls remember something
    assert np.any(np.asarray(jax.tree.leaves(state.wall_history)[0]))
    bars = assert_transposed(system, state, part(boxes, slice(25, None)))
    assert float(np.abs(bars.parameters[-1]).min()) > 0.0  # by the friction of the walls
