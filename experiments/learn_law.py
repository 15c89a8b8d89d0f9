"""A friction law with a network in it, taught by a recall: which stiffness of a contact gives this memory?

python experiments/learn_law.py [-o learn-law] [--pack tests/data/tetra-27.h5] [--t0 60] [--updates 200]

It needs equinox. The pack's contacts follow a law whose tangential stiffness is k(p) = k_M sqrt(p), where p is the
overlap. The fit does not know this function: it has a network instead of k(p), and only the recalled waveforms. optax
follows the gradient through all steps of the run, in plain JAX, until the recalls agree.
"""

import argparse
import csv
import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from console import in_one_line, new_name

import gmem_jax as gm
from gmem_jax.physics.contact.friction import coulomb
from gmem_jax.physics.contact.kinematics import Kinematics, transport
from gmem_jax.show.render_matplotlib import pyplot, save_picture

SCALE = 0.1  # order of magnitude of overlap and stiffness: input and output of the network are of order one


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Learnt:
    """df = k(p) dsigma below the Coulomb limit, with any function k of the overlap."""

    stiffness: Any
    mu: float = 1.0

    def init(self, contacts: int, replicas: int, dtype: Any) -> jax.Array:
        """The history of contacts that begin, without force."""
        return jnp.zeros((contacts, 3, replicas), dtype)

    def __call__(self, kin: Kinematics, normal_force: jax.Array, history: jax.Array) -> tuple[jax.Array, jax.Array]:
        """See `gmem_jax.physics.contact.friction.FrictionLaw`."""
        growth = kin.dt * self.stiffness(jnp.where(kin.touching, kin.safe_overlap, SCALE)) * kin.sliding
        force, _ = coulomb(transport(history, kin) + growth, self.mu * normal_force)
        force = jnp.where(kin.touching, force, 0.0)
        return force, force


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Mindlin:
    """The true stiffness, k(p) = k_M sqrt(p)."""

    k_M: float = 0.45

    def __call__(self, overlap: jax.Array) -> jax.Array:
        """In E R."""
        return self.k_M * jnp.sqrt(overlap)


class Network(eqx.Module):
    """A positive function k(p): a network with one hidden layer."""

    inner: jax.Array
    bias: jax.Array
    outer: jax.Array

    def __init__(self, width: int, key: jax.Array) -> None:
        keys = jax.random.split(key, 3)
        self.inner, self.bias, self.outer = (jax.random.normal(one, (1, width)) for one in keys)

    def __call__(self, overlap: jax.Array) -> jax.Array:
        """In E R."""
        hidden = jnp.tanh(jnp.log(overlap / SCALE)[..., None] * self.inner[0] + self.bias[0])
        return SCALE * jnp.exp(hidden @ (self.outer[0] / self.outer.size**0.5))


def main() -> None:
    """Make the recall, fit, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=new_name, default="learn-law", help="without a suffix")
    parser.add_argument("--pack", default="tests/data/tetra-27.h5")
    parser.add_argument("--t0", type=float, default=60.0)
    parser.add_argument("--updates", type=int, default=200)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    experiment = gm.Experiment(
        gm.load_pack(arguments.pack), gm.six_signals(), t0=arguments.t0, dt=0.6, rest=0.1, hold=0.1, store=0.1
    )

    def recalled(stiffness: Any) -> jax.Array:
        return gm.recall(dataclasses.replace(experiment, friction=Learnt(stiffness))).p_sig

    began = time.perf_counter()
    wanted = jax.jit(recalled)(Mindlin())
    network = best = Network(8, jax.random.key(1))
    print(f"the recall to learn from after {time.perf_counter() - began:.0f} s", flush=True)

    def loss(network: Network) -> jax.Array:
        return jnp.mean((recalled(network) - wanted) ** 2) / jnp.mean(wanted**2)

    optimiser = optax.adam(optax.cosine_decay_schedule(0.1, arguments.updates))
    moments, first = optimiser.init(network), network
    value_and_grad = jax.jit(jax.value_and_grad(loss))
    losses: list[float] = []
    for update in range(arguments.updates + 1):
        value, slope = value_and_grad(network)
        losses.append(float(value))
        if update % 10 == 0:
            print(f"{update}: {losses[-1]:.3e} of the signal's square, {time.perf_counter() - began:.0f} s", flush=True)
        changes, moments = optimiser.update(slope, moments, network)
        best = network if losses[-1] <= min(losses) else best
        network = optax.apply_updates(network, changes)
    draw(arguments.output, {"true": Mindlin(), "before": first, "learnt": best}, losses)


def draw(output: Path, laws: dict[str, Callable[[jax.Array], jax.Array]], losses: list[float]) -> None:
    """Draw the stiffness against the overlap, and the loss of the fit; the table has the stiffness."""
    overlaps = jnp.linspace(0.005, 0.2, 40)
    curves = {name: np.asarray(law(overlaps)) for name, law in laws.items()}
    with output.with_name(f"{output.name}.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["overlap", *curves])
        writer.writerows(
            [f"{value:.5f}" for value in row] for row in zip(np.asarray(overlaps), *curves.values(), strict=True)
        )
    figure, (left, right) = pyplot().subplots(1, 2, figsize=(10, 4.2))
    for (name, curve), style in zip(curves.items(), ("-", ":", "--"), strict=True):
        left.plot(overlaps, curve, style, label=name)
    left.set(xlabel="overlap p (R)", ylabel="k(p) (E R)", ylim=(0.0, None), title="tangential stiffness")
    left.legend(fontsize=8, frameon=False)
    right.semilogy(losses)
    right.set(xlabel="updates", ylabel="square of what differs, over that of the recall", title="the fit")
    save_picture(output.with_name(f"{output.name}.png"), figure)


if __name__ == "__main__":
    in_one_line(main)
