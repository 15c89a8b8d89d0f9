"""mu and k_H from one noisy recall: their posterior by NUTS, and by quadrature on a grid beside it.

python experiments/estimate.py [-o estimate] [--pack tests/data/tetra-27.h5] [--signals 3] [--noise 2] [--samples 100]

It needs blackjax. The recall of some waveforms is read as the means of p_sig over each sixteenth of u, with Gaussian
noise of `--noise` times their root mean square. For a given pack the recall is a function of mu and k_H, and the
logarithm of each has a normal prior. NUTS starts from four places, with reverse-mode gradients through all steps: for
two numbers they cost as much as two tangents. The grid shows whether the chains found the posterior.
"""

import argparse
import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import blackjax
import jax
import jax.numpy as jnp
import numpy as np
from console import in_one_line, new_name

import gmem_jax as gm
from gmem_jax.show.render_matplotlib import pyplot, save_picture

NAMES = {"friction.mu": "friction coefficient $\\mu$", "friction.stiffness": "stiffness $k_H$ (E R)"}
TICKS = ((0.2, 0.5, 1.0, 2.0), (0.03, 0.1, 0.3))
TRUE = np.array([0.5, 0.13])
MIDDLE = np.array([0.7, 0.1])  # median of the prior
WIDTH = 0.5  # standard deviation of each logarithm in the prior
STARTS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])  # of the chains, in widths from the middle
REACH = 2.5  # half width of the grid, in widths of the prior
READINGS = 16  # readings of each waveform

LogDensity = Callable[[jax.Array], jax.Array]


def numbers(place: Any) -> Any:
    """mu and k_H at places [..., 2], which are given in widths of the prior from its middle."""
    return MIDDLE * jnp.exp(WIDTH * place)


def main() -> None:
    """Measure, sample, integrate, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=new_name, default="estimate", help="without a suffix")
    parser.add_argument("--pack", default="tests/data/tetra-27.h5")
    parser.add_argument("--t0", type=float, default=600.0)
    parser.add_argument("--signals", type=int, default=3, help="of the six waveforms, the first so many")
    parser.add_argument("--noise", type=float, default=2.0, help="of a reading, over the root mean square of all")
    parser.add_argument("--samples", type=int, default=100, help="of each of the four chains")
    parser.add_argument("--warm", type=int, default=50, help="samples that tune a chain before")
    parser.add_argument("--doublings", type=int, default=4, help="of a trajectory of NUTS, at most")
    parser.add_argument("--points", type=int, default=31, help="of the grid on each axis, odd")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    six, count = gm.six_signals(), arguments.signals
    signals = gm.Bumps(six.amplitudes[:count], six.centres[:count], six.width)
    experiment = gm.Experiment(
        gm.load_pack(arguments.pack), signals, t0=arguments.t0, dt=1.2, rest=0.1, hold=0.1, store=0.1
    )

    def readings(values: jax.Array) -> jax.Array:
        p_sig = gm.recall(gm.replace(experiment, dict(zip(NAMES, values, strict=True)))).p_sig
        return jnp.mean(p_sig.reshape(len(p_sig), READINGS, -1), axis=2)

    clean = jax.jit(readings)(jnp.asarray(TRUE))
    noise = arguments.noise * float(jnp.sqrt(jnp.mean(clean**2)))
    measuring, sampling = jax.random.split(jax.random.key(arguments.seed))
    measured = clean + noise * jax.random.normal(measuring, clean.shape)

    def log_density(place: jax.Array) -> jax.Array:
        misfit = (readings(numbers(place)) - measured) / noise
        return -0.5 * (jnp.sum(misfit**2) + jnp.sum(place**2))

    axis = np.linspace(-REACH, REACH, arguments.points)
    weights = integrate(log_density, axis)
    for name, every in (("grid", 1), ("every second point", 2)):
        mesh = np.stack(np.meshgrid(axis[::every], axis[::every], indexing="ij"), -1)
        tell(name, np.asarray(numbers(mesh)), weights[::every, ::every])
    places = sample(log_density, sampling, arguments.warm, arguments.samples, arguments.doublings)
    found = np.asarray(numbers(places))
    tell("NUTS", found, np.ones(found.shape[:2]))
    table, picture = (arguments.output.with_name(arguments.output.name + suffix) for suffix in (".csv", ".png"))
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["chain", "mu", "k_H"])
        writer.writerows([n, *(f"{value:.5f}" for value in row)] for n, chain in enumerate(found) for row in chain)
    draw(picture, places, axis, weights, np.asarray(measured), np.asarray(clean), noise)


def sample(log_density: LogDensity, key: jax.Array, warm: int, count: int, doublings: int) -> np.ndarray:
    """Four chains, [4, count, 2], each tuned by itself, all run together."""

    @jax.jit
    @jax.vmap
    def chain(key: jax.Array, start: jax.Array) -> Any:
        tuning, sampling = jax.random.split(key)
        tuned = blackjax.window_adaptation(
            blackjax.nuts,
            log_density,
            is_mass_matrix_diagonal=False,
            initial_step_size=0.3,
            max_num_doublings=doublings,
        )
        (state, parameters), _ = tuned.run(tuning, start, num_steps=warm)
        kernel = blackjax.nuts(log_density, **parameters)

        def step(state: Any, key: jax.Array) -> Any:
            state, info = kernel.step(key, state)
            return state, (state.position, info)

        return jax.lax.scan(step, state, jax.random.split(sampling, count))[1]

    began = time.process_time()
    places, info = chain(jax.random.split(key, len(STARTS)), jnp.asarray(STARTS))
    print(
        f"{places[..., 0].size} samples, {float(info.num_integration_steps.mean()):.1f} gradients each, acceptance "
        f"{float(info.acceptance_rate.mean()):.2f}, {int(info.is_divergent.sum())} divergent, "
        f"{time.process_time() - began:.0f} s of CPU with compilation and warm-up",
        flush=True,
    )
    scale = blackjax.diagnostics.potential_scale_reduction(places)
    effective = blackjax.diagnostics.effective_sample_size(places)
    print(f"R-hat {scale[0]:.3f}, {scale[1]:.3f}; effective samples {effective[0]:.0f}, {effective[1]:.0f}")
    return np.asarray(places)


def integrate(log_density: LogDensity, axis: np.ndarray) -> np.ndarray:
    """The posterior on a square grid, [mu, k_H], normalised to a sum of 1."""
    began, row = time.process_time(), jax.jit(jax.vmap(log_density))
    logs = np.asarray([row(jnp.stack([jnp.full(len(axis), mu), jnp.asarray(axis)], axis=1)) for mu in axis])
    print(f"{logs.size} points, {np.isnan(logs).sum()} of them failed, {time.process_time() - began:.0f} s of CPU")
    weights = np.exp(np.nan_to_num(logs - np.nanmax(logs), nan=-np.inf))
    return np.asarray(weights / weights.sum())


def tell(name: str, found: np.ndarray, weights: np.ndarray) -> None:
    """Print means and standard deviations of mu and k_H, [..., 2], with weights."""
    mean = np.average(found, axis=(0, 1), weights=np.stack([weights] * 2, -1))
    deviation = np.sqrt(np.average((found - mean) ** 2, axis=(0, 1), weights=np.stack([weights] * 2, -1)))
    print(f"{name}: mu {mean[0]:.3f} +- {deviation[0]:.3f}, k_H {mean[1]:.4f} +- {deviation[1]:.4f}")


def draw(
    path: Path,
    places: np.ndarray,
    axis: np.ndarray,
    weights: np.ndarray,
    measured: np.ndarray,
    clean: np.ndarray,
    noise: float,
) -> None:
    """Draw the readings of one waveform, the posterior by NUTS and by the grid, and the marginals of both numbers."""
    figure, ((top, joint), margins) = pyplot().subplots(2, 2, figsize=(10, 8))
    u, grid = (np.arange(READINGS) + 0.5) / READINGS, np.asarray(numbers(np.stack([axis, axis], 1)))
    top.errorbar(u, measured[0] * 1e6, noise * 1e6, fmt="o", ms=4, color="0.4", capsize=2, label="read, ± noise")
    top.plot(u, clean[0] * 1e6, color="#1f5fa8", label="without noise")
    top.set(xlabel="compression variable u", ylabel="$p_{sig}$ ($10^{-6}$ E)", title="one of the recalled waveforms")
    falling = np.sort(weights.ravel())[::-1]
    ends = np.searchsorted(np.cumsum(falling), (0.95, 0.5))
    levels = sorted({float(falling[place]) for place in ends})  # one, where a point of the grid has nearly all
    joint.contourf(*grid.T, weights.T, [*levels, 2.0], colors=["#dbe6f2", "#a9c4e2"][-len(levels) :])
    for chain in np.asarray(numbers(places)):
        joint.plot(*chain.T, ".", ms=3)
    joint.plot(*TRUE, "k+", ms=14, mew=2, label="true")
    joint.plot(*MIDDLE, "kx", ms=7, label="middle of the prior")
    x_label, y_label = NAMES.values()
    joint.set(xscale="log", yscale="log", xlabel=x_label, ylabel=y_label, title="NUTS over 50 % and 95 % by the grid")
    for number, (panel, label) in enumerate(zip(margins, NAMES.values(), strict=True)):
        heights, edges = np.histogram(places[..., number], 24, density=True)
        panel.stairs(heights / WIDTH, MIDDLE[number] * np.exp(WIDTH * edges), fill=True, color="#e8b89c", label="NUTS")
        density = weights.sum(1 - number) / (axis[1] - axis[0])
        panel.plot(grid[:, number], density / WIDTH, color="#1f5fa8", label="grid")
        panel.plot(
            grid[:, number], np.exp(-0.5 * axis**2) / np.sqrt(2.0 * np.pi) / WIDTH, ":", color="0.4", label="prior"
        )
        panel.axvline(TRUE[number], color="k", lw=1, label="true")
        panel.set(xscale="log", xlabel=label, ylabel="density of the logarithm", ylim=(0.0, None))
    for side, ticks in zip((joint.xaxis, joint.yaxis, *(panel.xaxis for panel in margins)), TICKS * 2, strict=True):
        side.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
        side.set_minor_formatter("")
    for panel in (top, joint, *margins):
        panel.legend(fontsize=8, frameon=False)
    save_picture(path, figure)


if __name__ == "__main__":
    in_one_line(main)
