"""What a backend is: which code a program gets on which platform, and what is refused or said."""

import functools
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.native import calls, cuda, library, primitives
from gmem_jax.native.calls import Arrays, StepOutput
from gmem_jax.native.march import PlainDefinition, arrays_of, call_of, fixed_of, warn_no_library
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.state import Box, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System

BUILT, REASON = native.available()
needs_library = pytest.mark.skipif(not BUILT, reason=REASON)

REPLICAS = 3
PACK = gm.load_pack(TETRA_27)
SYSTEM = System(PACK.clump, gm.Hooke(mu=0.5), PACK.pairs)
STATE = replicate(start(SYSTEM, PACK.position[..., None], PACK.quaternion[..., None], PACK.box), REPLICAS)
MUS = jnp.asarray([0.3, 0.6])
RATES = jnp.linspace(0.8, 1.2, REPLICAS)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Own(gm.Hooke):
    """A law the library has not seen."""


def squeeze(rates: Any, steps: int = 6) -> Box:
    """Walls that move fast enough for contacts to slide within a few steps."""
    moved = 3e-2 * jnp.asarray([[1.0], [0.5], [0.3]]) * rates
    upper = PACK.upper[:, None] - moved * 0.3 * jnp.arange(1.0, steps + 1)[:, None, None]
    still = jnp.zeros_like(upper)
    return Box(still + PACK.lower[:, None], upper, still, still - moved)


def loss(march: native.March, mu: Any, rates: Any, system: System = SYSTEM) -> jax.Array:
    """Of everything a march gives, for one law and state."""
    law = replace(system.friction, mu=mu)
    history = law.init(PACK.pairs.capacity, REPLICAS, np.dtype(float))
    state, total = march(
        replace(system, friction=law), replace(STATE, history=history), squeeze(rates), 0.3, jnp.asarray(0.01)
    )
    after = sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves((state.grains, state.history)))
    return after + 1e3 * jnp.sum(total)


def derivatives(march: native.March, system: System = SYSTEM) -> Callable[..., Any]:
    """By a number of each point of a sweep, and by some that all points share."""
    function = jax.value_and_grad(functools.partial(loss, march, system=system), argnums=(0, 1))
    return jax.vmap(function, in_axes=(0, None))


@pytest.fixture
def no_library(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(library, "load_library", lambda: ("", "it was not built"))
    warn_no_library.cache_clear()
    yield
    warn_no_library.cache_clear()


CALLS_ALLOWED = [export.DisabledSafetyCheck.custom_call(target) for target in calls.TARGETS]


def lowered(march: native.March, platform: str) -> str:
    """The program of a sweep's derivatives on a platform."""
    program = jax.jit(derivatives(march))
    return export.export(program, platforms=[platform], disabled_checks=CALLS_ALLOWED)(MUS, RATES).mlir_module()


@needs_library
def test_auto_is_the_library_where_it_runs_and_the_definition_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "missing", lambda: "")
    auto = native.marcher("auto")
    found = {
        platform: {target for target in calls.TARGETS if f"custom_call @{target}" in lowered(auto, platform)}
        for platform in ("cpu", "cuda", "tpu")
    }
    both = {"gmem_advance", "gmem_adjoint"}
    assert found == {"cpu": both, "cuda": both, "tpu": set()}
    assert "custom_call @gmem_advance" in lowered(native.march, "cuda")


@needs_library
def test_a_gpu_without_nvrtc_runs_plain_jax_and_says_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "missing", lambda: "NVRTC was not found")
    cuda.warn_no_nvrtc.cache_clear()
    with pytest.warns(UserWarning, match=r"plain JAX runs on the GPU.*NVRTC"):
        program = lowered(native.marcher("auto"), "cuda")
    assert "custom_call @gmem" not in program
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lowered(native.marcher("auto"), "cuda")
    cuda.warn_no_nvrtc.cache_clear()
    with pytest.raises(NotImplementedError, match="NVRTC was not found"):
        lowered(native.march, "cuda")


@needs_library
def test_native_is_refused_where_it_cannot_run() -> None:
    with pytest.raises(NotImplementedError, match="backend='auto'"):
        lowered(native.march, "tpu")


@needs_library
@pytest.mark.parametrize(
    ("law", "isotropic"),
    [(gm.Frictionless(), True), (gm.Hooke(), False), (gm.MindlinRescaled(), True), (gm.Mindlin(points=8), True)],
    ids=["frictionless", "H", "M1", "M2"],
)
def test_the_definition_of_a_call_is_what_the_library_computes(law: Any, isotropic: bool) -> None:
    clump = PACK.clump if isotropic else replace(PACK.clump, isotropic=False, inertia=PACK.clump.inertia * MUS[0])
    system = System(clump, law, PACK.pairs)
    history = law.init(PACK.pairs.capacity, REPLICAS, np.dtype(float))
    call, fixed, definition = (
        call_of(system),
        fixed_of(system),
        PlainDefinition.of(system, (history, None)),
    )

    def arrays(speed: jax.Array) -> Arrays:
        numbers = jnp.asarray(0.3), jnp.asarray(0.01)
        grains = replace(STATE.grains, spin=speed + STATE.grains.spin)
        return arrays_of(system, grains, (history, None), squeeze(RATES * (1.0 + speed)), numbers)

    def both(use: Callable[[Arrays], StepOutput]) -> Any:
        def value(speed: jax.Array) -> Any:
            return jax.tree.map(lambda leaf: jnp.sum(leaf**2), use(arrays(speed)))

        return jax.jit(jax.vmap(value))(jnp.asarray([0.0, 0.02]))

    fast = both(lambda arrays: primitives.advance(call, definition, fixed, arrays))
    plain = both(lambda arrays: definition(fixed, arrays))
    for one, other in zip(jax.tree.leaves(fast), jax.tree.leaves(plain), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-18)


@pytest.mark.slow
@needs_library
def test_other_platforms_have_the_derivatives_of_a_sweep() -> None:
    """Their rules, run here: on shared arguments, with leading axes of size one."""
    system, law = SYSTEM, SYSTEM.friction
    call, fixed = call_of(system), fixed_of(system)
    definition = PlainDefinition.of(system, (STATE.history, None))

    def arrays(mu: jax.Array, rates: jax.Array) -> Arrays:
        chosen = replace(system, friction=replace(law, mu=mu))
        return arrays_of(
            chosen, STATE.grains, (STATE.history, None), squeeze(rates), (jnp.asarray(0.3), jnp.asarray(0.0))
        )

    def outer(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf[None], tree)

    shared = outer(arrays(MUS[0], RATES))
    several = jnp.stack([arrays(mu, RATES).parameters for mu in MUS])
    values = shared._replace(parameters=several)

    def known(slopes: Arrays) -> Arrays:
        """Without what the definition has no derivatives by: the material, and histories of contacts apart."""
        blank = jax.tree.map(jnp.zeros_like, slopes.history)
        return slopes._replace(parameters=slopes.parameters.at[:, 6:9].set(0.0), history=blank)

    along = known(jax.tree.map(jnp.ones_like, values))
    found = primitives.tangent(call, definition, outer(fixed), values, along)
    plain = calls.over(functools.partial(primitives._plain_tangent, definition), (2,))(outer(fixed), values, along)
    back = calls.bind(primitives._adjoint_p, call, definition, outer(fixed), values, found)
    plain_back = calls.over(functools.partial(primitives._plain_adjoint, definition), (2,))(outer(fixed), values, found)
    ours, theirs = (found, known(jax.tree.unflatten(jax.tree.structure(plain_back), back))), (plain, known(plain_back))
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-9 * float(jnp.abs(other).max()))


@pytest.mark.slow
@needs_library
def test_points_of_a_sweep_may_share_their_state() -> None:
    value, (by_mu, by_rates) = jax.jit(derivatives(native.march))(MUS, RATES)
    for point, mu in enumerate(MUS):
        alone = jax.jit(jax.value_and_grad(functools.partial(loss, dynamics.march), argnums=(0, 1)))(mu, RATES)
        np.testing.assert_allclose(value[point], alone[0], rtol=1e-10)
        np.testing.assert_allclose(by_mu[point], alone[1][0], rtol=1e-7)
        np.testing.assert_allclose(by_rates[point], alone[1][1], rtol=1e-7)


def test_without_the_library_auto_says_so_once_and_runs_in_plain_jax(no_library: None) -> None:
    march = native.marcher("auto")
    with pytest.warns(UserWarning, match="plain JAX runs.*not built"):
        found = jax.eval_shape(functools.partial(loss, march), 0.5, RATES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.eval_shape(functools.partial(loss, march), 0.6, RATES)
    assert found.shape == ()
    assert native.backend_name("auto", gm.Hooke()) == "jax"
    with pytest.raises(ValueError, match="not available: it was not built"):
        native.marcher("native")


def test_a_law_of_ones_own_runs_in_plain_jax_without_a_word(no_library: None) -> None:
    own = replace(SYSTEM, friction=Own())
    jax.eval_shape(functools.partial(loss, native.marcher("auto"), system=own), 0.5, RATES)
    assert native.backend_name("auto", Own()) == "jax"


def test_backends_have_names() -> None:
    assert native.marcher("jax") is dynamics.march
    with pytest.raises(ValueError, match="auto, jax, native; got 'fortran'"):
        native.marcher("fortran")


@needs_library
def test_the_library_refuses_laws_it_does_not_know() -> None:
    assert native.marcher("native") is native.march
    with pytest.raises(ValueError, match="does not know the friction law Own"):
        loss(native.march, 0.5, RATES, system=replace(SYSTEM, friction=Own()))


@pytest.mark.parametrize("backend", ["jax", pytest.param("native", marks=needs_library)])
def test_numbers_that_do_not_fit_the_replicas_are_named(backend: str) -> None:
    march, walls, wrong = native.marcher(backend), squeeze(RATES), jnp.full(2, 0.3)
    with pytest.raises(ValueError, match=r"dt must be a number or one for each of 3 replicas, got \(2,\)"):
        march(SYSTEM, STATE, walls, wrong, 0.0)
    with pytest.raises(ValueError, match="drag must be a number"):
        march(SYSTEM, STATE, walls, 0.3, wrong)
    with pytest.raises(ValueError, match=r"boxes.upper must be \[steps, 3, 3\], got \(6, 3, 2\)"):
        march(SYSTEM, STATE, replace(walls, upper=walls.upper[..., :2]), 0.3, 0.0)
    if backend == "native":  # parameters of a user's law may have any shape
        with pytest.raises(ValueError, match="mu must be a number"):
            march(replace(SYSTEM, friction=gm.Hooke(mu=wrong)), STATE, walls, 0.3, 0.0)


@needs_library
def test_a_backend_is_resolved_once_for_a_law_whatever_its_parameters() -> None:
    found = native.resolve("auto", "double", gm.Hooke())
    assert (found.name, found.precision, found.why) == ("native", "double", REASON)
    assert native.resolve("auto", "double", gm.Hooke(mu=0.2)) is found
    assert native.resolve("native", "double", gm.Hooke()).march is native.march
    assert native.resolve("jax", "double", gm.Hooke()).march is dynamics.march
    with pytest.raises(ValueError, match="auto, jax, native; got 'fortran'"):
        native.resolve("fortran", "double", gm.Hooke())


def test_a_resolved_backend_says_why_plain_jax_runs(no_library: None) -> None:
    found = native.resolve("auto", "double", gm.Hooke())
    assert (found.name, found.why) == ("jax", "it was not built")
    assert native.resolve("jax", "double", gm.Hooke()).why == "it was asked for"


@needs_library
def test_a_law_of_ones_own_is_named_where_it_keeps_the_library_out() -> None:
    found = native.resolve("auto", "double", Own())
    assert (found.name, found.why) == ("jax", "the native backend does not know the friction law Own")
