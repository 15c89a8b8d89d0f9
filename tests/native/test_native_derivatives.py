"""The library's derivatives are those of the definition, for every law, in both modes and under vmap."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SPREAD_27, TETRA_27, Motion, advance_by, random_like, strain_path
from transposed import assert_transposed

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.native import calls, primitives
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.state import State, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System
from gmem_jax.simulation.loop import Simulation, rollout, rollout_chunk
from gmem_jax.simulation.sample import end_bin
from gmem_jax.simulation.stage import BINS, Drive, Stage

BUILT, REASON = native.available()
# Without a C++ compiler there is no native backend to compare; plain JAX is then all there is.
pytestmark = pytest.mark.skipif(not BUILT, reason=REASON)

PACK = gm.load_pack(TETRA_27)
LAWS: dict[str, Any] = {
    "frictionless": gm.Frictionless(),
    "H": gm.Hooke(mu=0.5),
    "M1": gm.MindlinRescaled(mu=0.5),
    **{f"M2-{variant}": gm.Mindlin(mu=0.5, points=8, variant=variant) for variant in ("exact", "averaged", "paper")},
}
# Ten seconds each, nearly all of it compiling, that say of others what "H" with isotropic grains says. Backwards they
# are the transpose of forwards, which takes plain JAX to compile twice as long.
ALIKE = [
    pytest.param(name, isotropic, False, marks=pytest.mark.slow)
    for name, isotropic in [*((name, True) for name in LAWS if name != "H"), ("H", False)]
]
HEIGHTS = jnp.asarray([[1.0], [-0.4]])
# Both are exact derivatives of one program over 20 steps. Round-off is some 1e-14 of the largest, and is magnified
# where a force is carried along whose normal part nearly cancels (by 1e3 seen in one of 11,000 numbers).
TOLERANCE = 1e-9
QUICKLY = {"xla_backend_optimization_level": 0}


def squeezed(law: Any) -> tuple[System, State]:
    """Three replicas in the middle of a sheared compression by 6 %: contacts stick, slide, form and break."""
    system = System(PACK.clump, law, PACK.pairs)
    state = start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
    return system, advance_by(native.march)(system, replicate(state, 3), motion(), 0.3, bins=1, steps=600)[0]


def motion(gamma0: Any = 3e-2, heights: jax.Array = HEIGHTS) -> Motion:
    shear = gm.Bumps(heights, jnp.full_like(HEIGHTS, 0.5), 0.9)
    return Motion(PACK.lower[:, None], PACK.upper[:, None], 0.06, 0.0, 1.0, 300.0, gamma0, shear)


def end(march: native.March, system: System, state: State, theta: dict[str, Any]) -> Any:
    """Everything that 20 more steps give, as a function of everything they depend on."""
    law = replace(system.friction, **theta["law"])
    clump = replace(system.clump, **theta["clump"])
    state = replace(state, grains=theta["grains"], history=theta["history"])
    after, sample = advance_by(march)(
        replace(system, friction=law, clump=clump, gravity=theta["gravity"]),
        state,
        motion(theta["gamma0"], theta["heights"]),
        theta["dt"],
        first_bin=60,
        bins=2,
        steps=10,
        drag=theta["drag"],
    )
    return after.grains, after.history, sample.pressure


def arguments(system: System, state: State) -> dict[str, Any]:
    names = [] if isinstance(system.friction, gm.Frictionless) else ["mu", "stiffness", "damping_time"]
    return {
        "grains": state.grains,
        "history": state.history,
        "law": {name: jnp.asarray(getattr(system.friction, name)) for name in names},
        "clump": {name: getattr(system.clump, name) for name in ("offsets", "mass", "inertia")},
        "gravity": jnp.asarray(1e-3),
        "gamma0": jnp.asarray(3e-2),
        "heights": HEIGHTS,
        "dt": jnp.asarray(0.3),
        "drag": jnp.asarray(0.01),
    }


def assert_close(one: Any, other: Any) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        scale = float(jnp.abs(b).max()) if b.size else 0.0
        np.testing.assert_allclose(a, b, atol=TOLERANCE * scale, rtol=0.0)


def turning(system: System, isotropic: bool) -> System:
    """The system with grains that have equal moments of inertia, or not."""
    moments = system.clump.inertia * (1.0 if isotropic else jnp.asarray([0.8, 1.0, 1.3]))
    return replace(system, clump=replace(system.clump, isotropic=isotropic, inertia=moments))


@pytest.mark.parametrize(("name", "isotropic"), [*((name, True) for name in LAWS), ("H", False)])
def test_the_adjoint_is_the_transpose_of_the_tangent(name: str, isotropic: bool) -> None:
    system, state = squeezed(LAWS[name])
    steps = (motion().box_at(180.0 + 0.3 * (step + 1)) for step in range(20))
    boxes = jax.tree.map(lambda *leaves: jnp.stack(leaves), *steps)
    assert_transposed(replace(turning(system, isotropic), gravity=jnp.asarray(1e-3)), state, boxes)


@pytest.mark.parametrize(
    ("grains", "contacts", "steps", "replicas", "rings", "pieces"),
    [
        (10_240, 215_000, 12, 8, 0, 1),
        (10_240, 215_000, 235, 8, 0, 15),
        (10_240, 215_000, 235, 1, 0, 15),
        (3_267, 61_440, 60, 6, 32, 4),  # a state with rings takes more than a step keeps ...
        (3_267, 61_440, 60, 6, 1000, 1),  # ... or than all steps
    ],
)
def test_long_bins_of_large_packs_are_gone_back_through_in_pieces(
    grains: int, contacts: int, steps: int, replicas: int, rings: int, pieces: int
) -> None:
    def array(*shape: int) -> Any:
        return jax.ShapeDtypeStruct((*shape, replicas), jnp.float64)

    fields = [array(grains, rows) for rows in (3, 4, 3, 3)]
    history = [array(contacts, 3)] if rings == 0 else [array(contacts, *rows) for rows in ((rings, 2), (3,), (1,))]
    arrays = calls.Arrays(fields, array(22), array(steps, 12), array(4, 3), history)
    call = calls.Call(law=1, variant=0, points=rings, isotropic=1, leaves=len(history))
    assert primitives.piece_count(call, arrays) == pieces
    assert primitives.piece_count(call._replace(periodic=1), arrays) == 1


@pytest.mark.parametrize(("name", "isotropic", "backwards"), [("H", True, True), *ALIKE])
def test_modes_agree_with_plain_jax(name: str, isotropic: bool, backwards: bool) -> None:
    system, state = squeezed(LAWS[name])
    system = turning(system, isotropic)
    theta = arguments(system, state)
    touching = end_bin(system, state, motion().box_at(180.0), jnp.ones((3, 3)), 0.5)[1].contacts
    assert np.all(np.asarray(touching) > 5.0)

    def both(march: native.March) -> Callable[..., Any]:
        def derivatives(theta: Any, direction: Any, weights: Any) -> Any:
            _, forward = jax.jvp(lambda theta: end(march, system, state, theta), (theta,), (direction,))
            if not backwards:
                return (forward,)
            _, pull = jax.vjp(lambda theta: end(march, system, state, theta), theta)
            return forward, pull(weights)[0]

        return jax.jit(derivatives)

    shapes = jax.eval_shape(lambda theta: end(dynamics.march, system, state, theta), theta)
    direction, weights = random_like(theta, 0), random_like(shapes, 1)

    def known(history: Any) -> Any:
        """Without derivatives by what is zero and stays so: histories of contacts apart, Mindlin's unreached layers."""
        return jax.tree.map(lambda slope, leaf: jnp.where(leaf != 0.0, slope, 0.0), history, state.history)

    # Quaternions of unit length and forces in the tangent plane are not needed: the derivative is by each number.
    direction["history"] = known(direction["history"])
    fast = both(native.march)(theta, direction, weights)
    plain = both(dynamics.march)(theta, direction, weights)
    for pulled in (*fast[1:], *plain[1:]):
        pulled["history"] = known(pulled["history"])
        assert float(jnp.abs(pulled["gamma0"])) > 0.0
    assert_close(fast, plain)


@pytest.mark.slow
def test_derivatives_through_200_steps_are_those_of_the_definition() -> None:
    def last(march: native.March, mu: jax.Array) -> jax.Array:
        system = System(PACK.clump, gm.Hooke(mu=mu), PACK.pairs)
        state = start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
        walls = Motion(PACK.lower[:, None], PACK.upper[:, None], 0.05, 0.0, 1.0, 60.0)
        _, sample = advance_by(march)(system, state, walls, 0.3, bins=2, steps=100)
        return 1e3 * jnp.sum(sample.pressure[-1])

    mu = jnp.asarray(0.3)
    for derivative in (jax.grad, jax.jacfwd):
        fast, plain = (
            jax.jit(derivative(lambda m, by=march: last(by, m)))(mu) for march in (native.march, dynamics.march)
        )
        assert abs(float(plain)) > 1e-3
        np.testing.assert_allclose(fast, plain, rtol=1e-8)


@pytest.mark.slow
def test_vmap_and_grad_in_either_order() -> None:
    system, state = squeezed(LAWS["H"])
    theta = arguments(system, state)

    def loss(mu: jax.Array, gamma0: jax.Array) -> jax.Array:
        law = {**theta["law"], "mu": mu}
        return jnp.sum(end(native.march, system, state, {**theta, "law": law, "gamma0": gamma0})[2][-1] ** 2)

    several = jnp.asarray([0.3, 0.5])
    one_by_one = jnp.stack([jax.grad(loss, argnums=1)(mu, theta["gamma0"]) for mu in several])
    outside = jax.vmap(jax.grad(loss, argnums=1), in_axes=(0, None))(several, theta["gamma0"])
    inside = jax.grad(lambda gamma0: jnp.sum(jax.vmap(loss, in_axes=(0, None))(several, gamma0)))(theta["gamma0"])
    np.testing.assert_allclose(outside, one_by_one, rtol=TOLERANCE)
    np.testing.assert_allclose(inside, one_by_one.sum(), rtol=TOLERANCE)


def test_any_number_of_threads_gives_the_same_derivatives(monkeypatch: pytest.MonkeyPatch) -> None:
    pack = gm.load_pack("tetra-325-a")  # large enough for the threads to share a block
    system = System(pack.clump, gm.Hooke(), pack.pairs)
    state = replicate(start(system, pack.position[..., None], pack.quaternion[..., None], pack.box), 3)
    walls = Motion(pack.lower[:, None], pack.upper[:, None], 0.05, 0.0, 1.0, 300.0)

    def last(grains: Any, mu: jax.Array) -> jax.Array:
        chosen = replace(system, friction=gm.Hooke(mu=mu))
        advanced = advance_by(native.march)(chosen, replace(state, grains=grains), walls, 0.3, bins=1, steps=20)
        return advanced[1].pressure

    slope = jax.grad(lambda grains, mu: jnp.sum(last(grains, mu) ** 2), argnums=(0, 1))
    # ... and second ones.
    run = jax.jit(lambda *point: jax.jvp(slope, point, (random_like(point[0], 2), jnp.ones(()))))

    def derivatives(threads: int) -> list[jax.Array]:
        monkeypatch.setenv("GMEM_THREADS", str(threads))
        return jax.tree.leaves(jax.block_until_ready(run(state.grains, jnp.asarray(0.3))))

    alone = derivatives(1)
    assert all(bool(jnp.any(leaf != 0.0)) for leaf in alone)
    for threads in (2, 5):
        for one, other in zip(derivatives(threads), alone, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("instructions", ["baseline", pytest.param("avx2", marks=pytest.mark.slow)])
def test_every_instruction_set_has_the_same_derivatives(monkeypatch: pytest.MonkeyPatch, instructions: str) -> None:
    system, state = squeezed(LAWS["M1"])
    theta = arguments(system, state)

    def pull() -> Any:
        result, back = jax.vjp(lambda theta: end(native.march, system, state, theta), theta)
        return back(jax.tree.map(jnp.ones_like, result))[0]

    best = pull()
    monkeypatch.setenv("GMEM_ISA", instructions)
    assert_close(pull(), best)


@pytest.mark.slow
def test_bins_counted_only_at_run_time_are_differentiated_forwards() -> None:
    system, state = squeezed(LAWS["H"])
    walls = motion()
    drive = strain_path(walls.lower, walls.upper, walls.delta0, walls.gamma0, walls.signals)
    # Of 100 bins of 10 steps: as long as `motion`.
    encode = Stage("encode", 0.0, 1.0, 100.0 / BINS, "write", (Drive("xy", "xy"),))

    def simulation(mu: jax.Array, backend: str) -> Simulation:
        return Simulation(replace(system, friction=gm.Hooke(mu=mu)), drive, 0.3, steps=10, backend=backend)

    for backend in ("native", "jax"):

        def counted(mu: jax.Array, count: Any, by: str = backend) -> jax.Array:
            return rollout_chunk(simulation(mu, by), state, encode.rows(60), count, 3)[1].pressure[:2]

        def listed(mu: jax.Array, by: str = backend) -> jax.Array:
            return rollout(simulation(mu, by), state, encode.rows(60, 2))[1].pressure

        slope = jax.jit(lambda mu, count, of=counted: jax.jvp(lambda mu: of(mu, count), (mu,), (1.0,)))(0.3, 2)
        for found, known in zip(slope, jax.jvp(listed, (0.3,), (1.0,)), strict=True):
            assert np.abs(known[-1]).max() > 0.0
            np.testing.assert_allclose(found, known, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("march", [native.march, pytest.param(dynamics.march, marks=pytest.mark.slow)])
def test_nothing_changes_where_programs_are_not_compiled_as_a_whole(march: native.March) -> None:
    system = System(PACK.clump, LAWS["H"], PACK.pairs)
    state = start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
    boxes = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), PACK.box)

    def pressure(dt: jax.Array) -> jax.Array:
        return jnp.sum(march(system, state, boxes, dt, 0.0)[1])

    compiled = jax.jit(jax.value_and_grad(pressure))(jnp.asarray(0.3))
    with jax.disable_jit():
        plain = jax.value_and_grad(pressure)(jnp.asarray(0.3))
    assert_close(plain[0], compiled[0])
    # At rest the pressure, 0.013, hardly depends on dt: its slope, 8e-12, is what large terms leave of one another. The
    # two ways of compiling round them differently, at most by the last digit of the pressure in a step.
    np.testing.assert_allclose(plain[1], compiled[1], rtol=0.0, atol=np.finfo(float).eps * float(plain[0]) / 0.3)


def loss_of(system: System, state: State) -> Callable[..., jax.Array]:
    """A number by law, drive and friction, neither linear nor quadratic in what steps give."""
    theta = arguments(system, state)

    def loss(some: dict[str, Any], march: native.March = native.march) -> jax.Array:
        found = jax.tree.leaves(end(march, system, state, {**theta, **some}))
        return sum(jnp.sum((1.0 + number) * leaf + 0.3 * jnp.sin(leaf)) for number, leaf in enumerate(found))

    return loss


# Plain JAX compiles them for ten seconds; differences say the same of every law more quickly (`assert_transposed`).
@pytest.mark.slow
@pytest.mark.parametrize("name", ["H", "M1", "M2-paper"])
def test_second_derivatives_are_those_of_plain_jax(name: str) -> None:
    system, state = squeezed(LAWS[name])
    loss, theta = loss_of(system, state), arguments(system, state)
    # Of histories those numbers that are zero stay so, as above: here they are held.
    point = {name: value for name, value in theta.items() if name != "history"}
    direction = random_like(point, 0)

    def product(march: native.March) -> Any:
        slope = jax.grad(functools.partial(loss, march=march))
        return jax.jit(lambda point, direction: jax.jvp(slope, (point,), (direction,)))

    fast, plain = (product(march)(point, direction) for march in (native.march, dynamics.march))
    assert_close(fast, plain)
    assert all(bool(jnp.any(leaf != 0.0)) for leaf in jax.tree.leaves(fast[1]))


def test_all_ways_to_a_second_derivative_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    system, state = squeezed(LAWS["H"])
    boxes = jax.tree.map(lambda leaf: jnp.stack([leaf] * 5), motion().box_at(180.0))
    point = {"mu": jnp.asarray(0.5), "dt": jnp.asarray(0.3), "position": state.grains.position}
    direction = random_like(point, 0)

    def loss(point: dict[str, Any]) -> jax.Array:
        chosen = replace(system, friction=gm.Hooke(mu=point["mu"]))
        moved = replace(state, grains=replace(state.grains, position=point["position"]))
        first, _ = native.march(chosen, moved, boxes, point["dt"], 0.01)
        last, pressure = native.march(chosen, first, boxes, point["dt"], 0.01)
        return 1e3 * jnp.sum(pressure**2) + jnp.sum(jnp.sin(last.grains.velocity))

    def dot(one: Any, other: Any) -> jax.Array:
        return sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))

    slope = jax.grad(loss)
    forward = jax.jit(lambda direction: jax.jvp(slope, (point,), (direction,))[1], compiler_options=QUICKLY)
    expected = forward(direction)
    ways = [
        jax.grad(lambda at: dot(slope(at), direction)),  # reverse over reverse
        jax.grad(lambda at: jax.jvp(loss, (at,), (direction,))[1]),  # reverse over forward
        lambda at: jax.linearize(slope, at)[1](direction),
        lambda at: jax.jvp(jax.checkpoint(slope), (at,), (direction,))[1],
    ]
    for way in ways:
        assert_close(jax.jit(way, compiler_options=QUICKLY)(point), expected)
    several = jax.vmap(forward)(jax.tree.map(lambda leaf: jnp.stack([leaf, -2.0 * leaf]), direction))
    assert_close(jax.tree.map(lambda leaf: leaf[0], several), expected)
    assert_close(jax.tree.map(lambda leaf: -0.5 * leaf[1], several), expected)
    monkeypatch.setenv("GMEM_ISA", "baseline")
    assert_close(forward(direction), expected)


def test_second_derivatives_that_there_are_not_are_refused_in_one_line() -> None:
    pack = gm.load_pack(SPREAD_27)
    system = System(pack.clump, LAWS["H"], pack.pairs)
    state = start(system, pack.position[..., None], pack.quaternion[..., None], pack.box)
    boxes = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), pack.box)

    def pressure(mu: jax.Array, sizes: jax.Array) -> jax.Array:
        changed = System(replace(pack.clump, sizes=sizes), gm.Hooke(mu=mu), pack.pairs)
        return jnp.sum(native.march(changed, state, boxes, 0.3, 0.0)[1])

    sizes = jnp.asarray(pack.clump.sizes)
    slope = jax.grad(pressure)
    refused = [
        jax.jacfwd(jax.jacfwd(lambda mu: pressure(mu, sizes))),
        lambda mu: jax.jvp(lambda mu: jax.jvp(slope, (mu, sizes), (1.0, jnp.zeros_like(sizes)))[1], (mu,), (1.0,)),
        lambda mu: jax.jvp(lambda sizes: slope(mu, sizes), (sizes,), (sizes,)),
    ]
    for function in refused:
        with pytest.raises(NotImplementedError, match="backend='jax'"):
            jax.jit(function).lower(0.3)
