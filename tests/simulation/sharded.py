"""What `test_sharding` runs in a process of its own, in which the CPU is split into eight devices.

    XLA_FLAGS=--xla_force_host_platform_device_count=8 python tests/simulation/sharded.py native

It prints one JSON object: what was checked, and "" or what was wrong.
"""

import json
import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.physics.state import Box, replicate
from gmem_jax.physics.step import mark_varying, start
from gmem_jax.physics.system import System
from gmem_jax.simulation.sharding import placement_of

REPLICAS, STEPS, BINS = 8, 5, 2
jax.config.update("jax_enable_x64", True)  # before the first array

PACK = gm.load_pack(Path(__file__).parents[1] / "data" / "tetra-27.h5")
MUS = jnp.linspace(0.2, 0.9, 8)
RATES = jnp.linspace(0.7, 1.3, REPLICAS)
WEIGHTS = jnp.asarray([[1e3], [2e3], [-1e3]])


class Runs:
    """Two bins of steps of a squeezed pack on one backend, as functions of a number and of one for each replica."""

    def __init__(self, backend: str) -> None:
        self.backend = backend
        self.system = System(PACK.clump, gm.Hooke(), PACK.pairs)
        blank = start(self.system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
        self.state = replicate(blank, REPLICAS)

    def end(self, mu: Any, rates: Any) -> tuple[Any, jax.Array]:
        """The state after the bins, and their summed pressures, [bins, 3, B]."""
        system = replace(self.system, friction=gm.Hooke(mu=mu))
        march = native.marcher(self.backend)
        state = self.state
        if len(rates) < REPLICAS:  # on one of several devices
            state = jax.tree.map(lambda leaf: leaf[..., : len(rates)], state)

        def one_bin(state: Any, begun: jax.Array) -> tuple[Any, jax.Array]:
            time = (begun + 1 + jnp.arange(STEPS))[:, None, None] * 0.3
            rate = 3e-2 * jnp.asarray([[1.0], [0.5], [0.3]]) * rates
            upper = PACK.upper[:, None] - rate * time
            lower, still = jnp.zeros_like(upper) + PACK.lower[:, None], jnp.zeros_like(upper)
            return march(system, state, Box(lower, upper, still, still - rate), 0.3, 0.0)

        return jax.lax.scan(one_bin, mark_varying((state, mu, rates))[0], STEPS * jnp.arange(BINS))

    def loss(self, mu: Any, rates: Any) -> jax.Array:
        """One number for each replica, [B]."""
        state, total = self.end(mu, rates)
        return jnp.sum(total * WEIGHTS, axis=(0, 1)) + jnp.sum(state.grains.velocity**2, axis=(0, 1))

    def derivatives(self, mu: Any, rates: Any) -> Any:
        """Of the sum over replicas, by both arguments, with the value."""
        return jax.value_and_grad(lambda mu, rates: jnp.sum(self.loss(mu, rates)), argnums=(0, 1))(mu, rates)

    def slopes(self, mu: Any, rates: Any) -> Any:
        """Along both arguments, [B]."""
        return jax.jvp(self.loss, (mu, rates), (jnp.ones_like(mu), jnp.ones_like(rates)))[1]


def split(array: jax.Array, *axes: str | None, kind: AxisType = AxisType.Auto, shape: Any = None) -> jax.Array:
    """`array` on all devices, its axes split over the mesh's "a" and "b"."""
    shape = shape or {"a": 8}
    mesh = Mesh(np.array(jax.devices()).reshape(*shape.values()), tuple(shape), axis_types=(kind,) * len(shape))
    return jax.device_put(array, NamedSharding(mesh, PartitionSpec(*axes)))


def compare(
    function: Callable[..., Any], alone: tuple[Any, ...], split: tuple[Any, ...], tolerance: float, other: Any = None
) -> Any:
    """Run on one device and (perhaps an `other`) on all; returns the latter's results and kinds of communication."""
    one, many = jax.jit(function), jax.jit(other or function)
    text = many.lower(*split).compile().as_text()
    wanted, found = one(*alone), many(*split)
    for a, b in zip(jax.tree.leaves(wanted), jax.tree.leaves(found), strict=True):
        scale = float(jnp.abs(a).max()) if a.size else 0.0
        np.testing.assert_allclose(b, np.asarray(a), rtol=0.0, atol=tolerance * scale)
    return found, set(re.findall(r"\b(all-gather|all-reduce|all-to-all|collective-permute)(?:-start)?\(", text))


def replicas(runs: Runs, tolerance: float) -> None:
    """Split by the innermost axis."""
    alone, shared = (jnp.asarray(0.5), RATES), (jnp.asarray(0.5), split(RATES, "a"))
    (state, total), sent = compare(runs.end, alone, shared, 0.0 if runs.backend == "native" else tolerance)
    assert not sent, sent
    assert total.sharding.shard_shape(total.shape) == (BINS, 3, 1), total.sharding
    history = jax.tree.leaves(state.history)[0]
    assert history.sharding.shard_shape(history.shape)[-1] == 1, history.sharding


def replicas_backwards(runs: Runs, tolerance: float) -> None:
    alone, shared = (jnp.asarray(0.5), RATES), (jnp.asarray(0.5), split(RATES, "a"))
    (_, (by_mu, by_rates)), sent = compare(runs.derivatives, alone, shared, tolerance)
    assert float(jnp.abs(by_mu)) > 0.0, "nothing slides"
    assert by_rates.sharding.shard_shape(by_rates.shape) == (1,), by_rates.sharding
    assert sent == {"all-reduce"}, sent


def replicas_forwards(runs: Runs, tolerance: float) -> None:
    alone, shared = (jnp.asarray(0.5), RATES), (jnp.asarray(0.5), split(RATES, "a"))
    _, sent = compare(runs.slopes, alone, shared, tolerance)
    assert not sent, sent


def replicas_twice(runs: Runs, tolerance: float) -> None:
    """Second derivatives, of split arrays and within a map."""

    def bend(loss: Callable[..., Any]) -> Callable[..., Any]:
        slope = jax.grad(lambda mu, rates: jnp.sum(loss(mu, rates) ** 2), argnums=(0, 1))
        return lambda mu, rates: jax.jvp(slope, (mu, rates), (jnp.ones_like(mu), jnp.sin(rates)))[1]

    alone, shared = (jnp.asarray(0.5), RATES), (jnp.asarray(0.5), split(RATES, "a"))
    (_, by_rates), sent = compare(bend(runs.loss), alone, shared, tolerance)
    assert by_rates.sharding.shard_shape(by_rates.shape) == (1,), by_rates.sharding
    assert sent == {"all-reduce"}, sent
    mesh, each = Mesh(np.array(jax.devices()), ("a",)), PartitionSpec("a")
    mapped = jax.shard_map(runs.loss, mesh=mesh, in_specs=(PartitionSpec(), each), out_specs=each)
    compare(bend(runs.loss), alone, alone, tolerance, bend(mapped))


def in_types(runs: Runs, tolerance: float) -> None:
    """The mesh is part of types, as `jax.make_mesh` has it; a loop's first state must be split as the next ones are."""
    rates, placed = split(RATES, "a", kind=AxisType.Explicit), Runs(runs.backend)
    placed.state = jax.tree.map(
        lambda leaf: split(leaf, *(None for _ in leaf.shape[1:]), "a", kind=AxisType.Explicit), runs.state
    )
    (state, _), sent = compare(runs.end, (0.5, RATES), (0.5, rates), 0.0, placed.end)
    assert not sent, sent
    assert jax.typeof(state.grains.position).sharding.spec == PartitionSpec(None, None, "a")
    _, sent = compare(runs.derivatives, (0.5, RATES), (0.5, rates), tolerance, placed.derivatives)
    assert sent == {"all-reduce"}, sent


def sweep(runs: Runs, tolerance: float) -> None:
    """Split by the axis of a vmap; the rates and all else are shared."""
    end = jax.vmap(runs.end, in_axes=(0, None))
    (state, _), sent = compare(
        end, (MUS, RATES), (split(MUS, "a"), RATES), 0.0 if runs.backend == "native" else tolerance
    )
    assert not sent, sent
    history = jax.tree.leaves(state.history)[0]
    assert history.sharding.shard_shape(history.shape)[0] == 1, history.sharding


def sweep_backwards(runs: Runs, tolerance: float) -> None:
    """Derivatives by what all points share are summed over the devices."""

    def total(mus: jax.Array, rates: jax.Array) -> jax.Array:
        return jnp.sum(jax.vmap(runs.loss, in_axes=(0, None))(mus, rates))

    derivatives = jax.value_and_grad(total, argnums=(0, 1))
    _, sent = compare(derivatives, (MUS, RATES), (split(MUS, "a"), RATES), tolerance)
    assert sent == {"all-reduce"}, sent


def sweep_of_split_replicas(runs: Runs, tolerance: float) -> None:
    """Both axes at once, and derivatives within the vmap."""
    shape = {"a": 4, "b": 2}
    derivatives = jax.vmap(runs.derivatives, in_axes=(0, None))
    shared = split(MUS, "a", shape=shape), split(RATES, "b", shape=shape)
    (_, (_, by_rates)), sent = compare(derivatives, (MUS, RATES), shared, tolerance)
    assert sent <= {"all-reduce"}, sent
    assert by_rates.sharding.shard_shape(by_rates.shape) == (2, 4), by_rates.sharding


def few_replicas(runs: Runs, tolerance: float) -> None:
    """Replicas that cannot be dealt out evenly."""
    mesh = Mesh(np.array(jax.devices()), ("a",))

    def end(mu: jax.Array, rates: jax.Array) -> Any:
        return runs.end(mu, jax.lax.with_sharding_constraint(rates[:5], NamedSharding(mesh, PartitionSpec("a"))))[1]

    compare(end, (jnp.asarray(0.5), RATES), (jnp.asarray(0.5), split(RATES, "a")), tolerance)


def mapped(runs: Runs, tolerance: float) -> None:
    """`jax.shard_map` with its check of what varies: values and both modes."""
    mesh = Mesh(np.array(jax.devices()), ("a",))
    each, none = PartitionSpec("a"), PartitionSpec()
    loss = jax.shard_map(runs.loss, mesh=mesh, in_specs=(none, each), out_specs=each)
    alone = (jnp.asarray(0.5), RATES)

    def backwards(function: Callable[..., Any]) -> Callable[..., Any]:
        return jax.value_and_grad(lambda mu, rates: jnp.sum(function(mu, rates)), argnums=(0, 1))

    def forwards(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda mu, rates: jax.jvp(function, (mu, rates), (jnp.ones_like(mu), jnp.ones_like(rates)))

    for mode in (backwards, forwards):
        wanted, found = jax.jit(mode(runs.loss))(*alone), jax.jit(mode(loss))(*alone)
        for a, b in zip(jax.tree.leaves(wanted), jax.tree.leaves(found), strict=True):
            np.testing.assert_allclose(b, a, rtol=0.0, atol=tolerance * float(jnp.abs(a).max()))


def mapped_inside(runs: Runs, tolerance: float) -> None:
    """Derivatives and a vmap within the map; that by a shared number is summed over the devices."""
    mesh = Mesh(np.array(jax.devices()), ("a",))
    each, none = PartitionSpec("a"), PartitionSpec()
    within = jax.shard_map(
        lambda mu, rates: jax.grad(lambda mu, rates: jnp.sum(runs.loss(mu, rates)), argnums=(0, 1))(mu, rates),
        mesh=mesh,
        in_specs=(none, each),
        out_specs=(none, each),
    )
    points = jax.shard_map(
        lambda mus: jax.vmap(runs.loss, in_axes=(0, None))(mus, RATES), mesh=mesh, in_specs=each, out_specs=each
    )
    pairs = (
        (jax.jit(within)(0.5, RATES), jax.jit(runs.derivatives)(0.5, RATES)[1]),
        (jax.jit(points)(MUS), jax.jit(jax.vmap(runs.loss, in_axes=(0, None)))(MUS, RATES)),
    )
    for found, wanted in pairs:
        for a, b in zip(jax.tree.leaves(wanted), jax.tree.leaves(found), strict=True):
            np.testing.assert_allclose(b, a, rtol=0.0, atol=tolerance * float(jnp.abs(a).max()))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Weights:
    """Of a law, as many as there are replicas, before or after they were made up to a multiple of the devices."""

    three: Any = field(default_factory=lambda: jnp.asarray([3.0, -2.0, 1.0]))
    eight: Any = field(default_factory=lambda: jnp.arange(8.0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Learnt(gm.Hooke):
    weights: Weights = field(default_factory=Weights)


def weights_of_a_law(runs: Runs, tolerance: float) -> None:
    """What lies deeper in a law is of all replicas, whatever its shape; its own numbers are split."""
    placement = placement_of(3)
    assert placement is not None
    law = Learnt(mu=jnp.asarray([0.3, 0.4, 0.5]))
    signals = gm.Bumps(jnp.asarray([[0.5], [1.0]]), jnp.asarray([[0.5], [0.5]]), 0.2)
    experiment = gm.Experiment(PACK, signals, gm.Hooke(), backend=runs.backend)
    simulation = experiment.simulation(sheared=False)
    simulation = replace(simulation, system=replace(simulation.system, friction=law))
    placed: Any = placement.put_simulation(simulation).system.friction
    jax.tree.map(np.testing.assert_array_equal, placed.weights, law.weights)
    np.testing.assert_array_equal(placed.mu[:3], law.mu)
    assert placed.mu.sharding.shard_shape(placed.mu.shape)[0] < len(placed.mu), placed.mu.sharding


ALWAYS = (replicas, replicas_backwards, sweep, mapped)
# The rest is about the library's calls; in plain JAX it would test JAX, and compile for minutes.
CHECKS: dict[str, tuple[Callable[[Runs, float], None], ...]] = {
    "jax": ALWAYS,
    "native": (
        *ALWAYS,
        replicas_forwards,
        replicas_twice,
        in_types,
        sweep_backwards,
        sweep_of_split_replicas,
        few_replicas,
        mapped_inside,
        weights_of_a_law,
    ),
}
# Forces are 1e-3 and come with round-off of 1e-16; derivatives magnify it (see test_native_derivatives).
TOLERANCE = 1e-9


def main(backend: str) -> None:
    runs, found = Runs(backend), {}
    for check in CHECKS[backend]:
        try:
            check(runs, TOLERANCE)
            found[check.__name__] = ""
        except Exception:
            found[check.__name__] = traceback.format_exc()
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1])
