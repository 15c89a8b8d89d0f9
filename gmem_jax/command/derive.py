"""What `gmem gradient`, `gmem kernel`, `gmem design` and `gmem tune` do, apart from reading the command line."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.command.config import RecallConfig
from gmem_jax.derivatives import gradient
from gmem_jax.design import kernel as response
from gmem_jax.design import waveforms as design
from gmem_jax.experiment import walk as sweep
from gmem_jax.experiment.experiment import Experiment, Timing
from gmem_jax.experiment.host import Progress
from gmem_jax.experiment.signals import Bumps, Samples
from gmem_jax.files import storage
from gmem_jax.files.provenance import provenance
from gmem_jax.physics.material import Material
from gmem_jax.show import figures_of_designs as plot_gradient

KERNEL_SCHEMA = "gmem-kernel/1"
DRIVE = ("gamma0", "mu", "stiffness")


def experiment_of(config: RecallConfig) -> Experiment:
    """The experiment that a configuration describes.

    Raises:
        ValueError: if the background is not "sub0".
    """
    if config.background != "sub0":
        raise ValueError(f"--background: derivatives are taken with sub0, got {config.background}")
    names = ("t0", "dt", "rest", "hold", "store", "hold_drag", "backend")
    return Experiment(
        pack=storage.load_pack(config.pack),
        signals=config.waveforms(),
        friction=config.law(),
        gamma0=config.gamma0,
        delta0=config.delta0,
        timing=Timing(**{name: getattr(config, name) for name in names}),
    )


def run_gradient(config: RecallConfig, picture: Path | None, progress: Progress) -> dict[str, Any]:
    """F of a recall and its derivatives by the waveforms, gamma0, mu and the stiffness."""
    experiment = experiment_of(config)
    signals, law = experiment.signals, experiment.friction
    if isinstance(signals, Bumps):
        waveforms, places = signals.amplitudes, np.asarray(signals.centres)
    else:
        assert isinstance(signals, Samples)
        waveforms = signals.nodes[:, 1:-1]
        places = np.broadcast_to(np.linspace(0.0, 1.0, signals.nodes.shape[1])[1:-1], waveforms.shape)

    def make(theta: Any) -> Experiment:
        shapes: Any = (
            replace(signals, amplitudes=theta["waveform"])
            if isinstance(signals, Bumps)
            else Samples(jnp.pad(theta["waveform"], ((0, 0), (1, 1))))
        )
        friction = replace(law, mu=theta["mu"], stiffness=theta["stiffness"])  # type: ignore[type-var]
        return replace(experiment, signals=shapes, gamma0=theta["gamma0"], friction=friction)

    chosen: Any = law
    theta = {"waveform": waveforms, "gamma0": config.gamma0, "mu": chosen.mu, "stiffness": chosen.stiffness}
    result = gradient.value_and_grad(make, theta, progress=progress)
    slope = {name: np.asarray(value).tolist() for name, value in result.slope.items()}
    if picture is not None:
        title = f"{config.pack}: F = {float(result.value):.4f}"
        plot_gradient.gradient_figure(picture, places, np.asarray(result.slope["waveform"]), title)
    return {"pack": config.pack, "fidelity": float(result.value), "places": places.tolist(), "gradient": slope}


def run_kernel(
    config: RecallConfig, output: Path, picture: Path | None, n: int, width: float, noise: float, progress: Progress
) -> dict[str, Any]:
    """Measure a memory kernel and write it; its numbers, and how well it predicts the configuration's signals."""
    experiment = experiment_of(config)
    state = sweep.prefix(experiment, progress=progress)
    kernel = response.memory_kernel(experiment.pack, n, width, state=state, experiment=experiment, progress=progress)
    p_sig, _ = sweep.simulate(experiment, state)
    floor = noise / Material().modulus
    numbers = {
        "gain": kernel.gain(),
        "distance": kernel.distance(),
        "asymmetry": kernel.asymmetry(),
        "capacity": kernel.capacity(floor),
        "resolution": kernel.resolution(floor),
        "singular_values_pa": (kernel.singular_values() * Material().modulus).tolist(),
        "prediction_error": response.relative_error(kernel.predict(experiment.signals), p_sig).tolist(),
        "prediction_error_linear": response.relative_error(
            kernel.predict(experiment.signals, even=False), p_sig
        ).tolist(),
    }
    arrays = {name: getattr(kernel, name) for name in ("u", "centres", "width", "odd", "even", "gamma0", "delta0")}
    storage.save_arrays(output, KERNEL_SCHEMA, config.model_dump(), kernel=kernel.kernel(), **arrays)
    if picture is not None:
        plot_gradient.kernel_figure(picture, kernel, floor, config.pack)
    return {"pack": config.pack, "noise_pa": noise, "n": n, "width": width, **numbers, "output": str(output)}


def run_design(
    config: RecallConfig, output: Path, picture: Path | None, iterations: int, gain: float | None, progress: Progress
) -> dict[str, Any]:
    """Design waveforms for the integrals of the configuration's signals and write them as a CSV."""
    experiment = experiment_of(config)
    found = design.design_waveforms(experiment, iterations=iterations, gain=gain, progress=progress)
    storage.save_waveforms(output, found.signals)
    if picture is not None:
        unit = float(experiment.compression) * config.gamma0
        plot_gradient.design_figure(picture, found, unit, config.pack)
        plot_gradient.history_figure(picture.with_name(f"{picture.stem}-history.png"), {config.pack: found.history})
    return {
        "pack": config.pack,
        "before": found.before,
        "fidelity": found.fidelity,
        "gain": found.gain,
        "history": list(found.history),
        "output": str(output),
    }


def parse_bounds(text: str) -> dict[str, tuple[float, float]]:
    """Bounds by name from "gamma0=3e-4:3e-3,mu=0.5:2".

    Raises:
        ValueError: if it does not read like that.
    """
    bounds = {}
    for item in text.split(","):
        name, _, span = item.partition("=")
        low, _, high = span.partition(":")
        try:
            bounds[name.strip()] = float(low), float(high)
        except ValueError:
            raise ValueError(f"--bounds: {item!r} should read like mu=0.5:2") from None
    if unknown := set(bounds) - set(DRIVE):
        raise ValueError(f"--bounds: {min(unknown)!r} is none of {', '.join(DRIVE)}")
    return bounds


def run_tune(
    config: RecallConfig,
    packs: list[str],
    bounds: dict[str, tuple[float, float]],
    output: Path,
    picture: Path | None,
    iterations: int,
    progress: Progress,
) -> dict[str, Any]:
    """Choose drive parameters within bounds for several packs; writes them as JSON."""
    experiments = [experiment_of(config.model_copy(update={"pack": name})) for name in packs]
    found = design.design_drive(experiments, bounds, iterations=iterations, progress=progress)
    result = {
        "packs": packs,
        "before": found.before,
        "fidelity": found.fidelity,
        "each": found.each.tolist(),
        "values": found.values,
        "history": [{**values, "fidelity": fidelity} for values, fidelity in found.history],
        "output": str(output),
    }
    with storage.atomic(output) as temporary:
        temporary.write_text(json.dumps({**result, "configuration": config.model_dump(), **provenance()}))
    if picture is not None:
        plot_gradient.history_figure(picture, {" ".join(packs): [value for _, value in found.history]})
    return result
