"""A program as a user writes it, checked by mypy --strict: see tests/experiment/test_arguments.py."""

from pathlib import Path

import jax
import jax.numpy as jnp

import gmem_jax as gm

jax.config.update("jax_enable_x64", True)


def experiment_on(pack: gm.Pack, mu: float) -> gm.Experiment:
    """Six waveforms, one friction coefficient."""
    return gm.Experiment(pack, gm.six_signals(), friction=gm.Hooke(mu=mu), gamma0=1e-3, backend="native")


def fidelities(experiment: gm.Experiment, mus: jax.Array) -> jax.Array:
    """F by the friction coefficient."""

    def one(mu: jax.Array) -> jax.Array:
        return gm.fidelity(gm.replace(experiment, friction=gm.Hooke(mu=mu)))

    return jax.vmap(one)(mus)


def power(experiment: gm.Experiment, p_sig: jax.Array) -> jax.Array:
    """A loss."""
    return jnp.sum(p_sig**2) / experiment.signals.count


def watch(stage: str, time: float, fraction: float) -> None:
    """Progress."""
    print(f"{stage} {time:.0f} {fraction:.0%}")


def main(folder: Path) -> float:
    """Runs, gradients, designs and files."""
    names: list[str] = gm.list_packs()
    pack = gm.load_pack(names[0])
    experiment = experiment_on(pack, 0.6)
    recall: gm.Recall = gm.run(experiment, batch=3, frames=4, progress=watch)
    gm.save_recall(folder / "recall.h5", recall)
    stored = gm.load_recall(str(folder / "recall.h5"))
    configuration = stored.configuration
    gradient = gm.value_and_grad(experiment, ["gamma0", "friction.mu"], loss=power, progress=False)
    slope: float = float(gradient.slope["friction.mu"])
    kernel = gm.memory_kernel(gm.replace(experiment, {"friction.mu": 0.3}, background="sub2"), n=9)
    design: gm.Design = gm.design_waveforms(experiment, iterations=1)
    points = gm.sweep(experiment, {"friction.mu": [0.1, 0.5], "pack": names[:2]}, folder / "mu")
    best = max(points, key=lambda point: float(point.recall.fidelity))
    small = gm.prepare(grains=27, seed=3, backend="auto")
    waves = gm.waveform(jnp.sin(jnp.linspace(0.2, 3.0, 8)))
    again = gm.run(gm.Experiment(small, waves, gm.Mindlin(variant="exact"), precision="double", shear="before"))
    if gm.explain(int(again.status.max())) != "ok":
        raise gm.RunFailedError("doubtful")
    print(configuration["pack"], stored.gain, kernel.distance(), design.fidelity, best.values)
    print(fidelities(experiment, jnp.asarray([0.2, 0.6])))
    return slope
