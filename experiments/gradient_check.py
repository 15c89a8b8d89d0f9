"""Derivatives through a whole experiment against central differences over step sizes, and forward against reverse.

python experiments/gradient_check.py [-o gradient_check] [--pack tetra-325-a] [--t0 1800]

Three tables and one picture: the Jacobian of a recall by 16 amplitudes, gamma0, mu and k_H; the gradient of the
fidelity of the six signals by their amplitudes, gamma0, mu and k_H, in both modes; and the error of the derivatives of
pressures against the number of steps. At t0 = 1,800 t_c it takes some fifteen minutes on two cores.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from console import in_one_line, new_folder, say

import gmem_jax as gm
from gmem_jax.derivatives import jacobian
from gmem_jax.derivatives.push import push
from gmem_jax.experiment.changes import value_at
from gmem_jax.show.render_matplotlib import pyplot, save_picture

AMPLITUDES = 16
STEPS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
SCALARS = ("gamma0", "friction.mu", "friction.stiffness")


def waveform() -> gm.Bumps:
    """One signal of both signs on 16 overlapping bumps, none of them zero."""
    centres = (np.arange(AMPLITUDES) + 1.0) / (AMPLITUDES + 1)
    heights = np.sin(2.0 * np.pi * centres) + 0.5 * np.sin(3.0 * np.pi * centres)
    return gm.Bumps(jnp.asarray([heights / np.abs(heights).max()]), jnp.asarray([centres]), 2.0 / (AMPLITUDES + 1))


def check_jacobian(experiment: gm.Experiment) -> tuple[dict[float, dict[str, float]], dict[float, np.ndarray]]:
    """Errors of the Jacobian by step size; and errors of dp_xy / da in every bin from the encoding on."""
    exact = jacobian.exact(experiment, progress=say)
    table, by_bin = {}, {}
    for step in STEPS:
        other = jacobian.differences(experiment, step)
        table[step] = jacobian.mismatch(exact, other)
        one, two = exact.stress[:AMPLITUDES], other.stress[:AMPLITUDES]
        by_bin[step] = np.linalg.norm(one - two, axis=0) / np.linalg.norm(two, axis=0)
    return table, by_bin


def check_prefix(experiment: gm.Experiment) -> dict[float, np.ndarray]:
    """Errors of dp / d mu in every bin of the experiment, by step size."""
    mu = value_at(experiment, "friction.mu")

    def joined(pressure: Any) -> np.ndarray:
        return np.concatenate([np.asarray(pressure[name])[..., -1] for name in pressure])

    exact = joined(push(experiment, {"friction.mu": 1.0}, progress=say).slope)
    by_bin = {}
    for step in STEPS:
        sides = []
        for sign in (1.0, -1.0):
            recall = gm.run(gm.replace(experiment, {"friction.mu": mu * (1.0 + sign * step)}))
            sides.append(joined({name: sample.pressure for name, sample in recall.stages.items()}))
        slope = (sides[0] - sides[1]) / (2.0 * step * mu)
        size = np.linalg.norm(slope, axis=1)  # zero before the first contact feels friction
        by_bin[step] = np.linalg.norm(exact - slope, axis=1) / np.where(size > 0.0, size, np.nan)
    return by_bin


def check_fidelity(experiment: gm.Experiment) -> tuple[list[list[Any]], float]:
    """Rows (parameter, exact, difference at each step) of dF; and the relative difference of both modes."""
    names = ("signals.amplitudes", *SCALARS)
    theta = {name: jnp.asarray(value_at(experiment, name)) for name in names}
    reverse = gm.value_and_grad(experiment, names, progress=say)
    toss = np.random.default_rng(0).normal(size=theta["signals.amplitudes"].shape)
    direction = {"signals.amplitudes": jnp.asarray(toss), **{name: theta[name] for name in SCALARS}}
    pushed = push(experiment, direction, progress=say)

    def score(theta: Any, p_sig: jax.Array) -> jax.Array:
        return gm.replace(experiment, theta).compare(p_sig).fidelity

    _, forward = jax.jvp(score, (theta, pushed.p_sig), (direction, pushed.p_sig_slope))
    back = sum(float(jnp.vdot(direction[name], reverse.slope[name])) for name in theta)

    def fidelity(theta: Any) -> float:
        return float(gm.run(gm.replace(experiment, theta)).fidelity)

    rows: list[list[Any]] = []
    for name, move in direction.items():
        exact = float(jnp.vdot(move, reverse.slope[name]))
        differences = []
        for step in STEPS:
            up, down = ({**theta, name: theta[name] + sign * step * move} for sign in (1.0, -1.0))
            differences.append((fidelity(up) - fidelity(down)) / (2.0 * step))
        rows.append([name, exact, *differences])
    return rows, abs(back - float(forward)) / abs(float(forward))


def draw(
    path: Path,
    table: dict[float, dict[str, float]],
    sheared: dict[float, np.ndarray],
    whole: dict[float, np.ndarray],
    steps: int,
) -> None:
    """Draw the errors against the step size and against the number of time steps."""
    figure, (left, middle, right) = pyplot().subplots(1, 3, figsize=(14, 3.9))
    for group in next(iter(table.values())):
        left.loglog(list(table), [row[group] for row in table.values()], "o-", markersize=4, label=group)
    left.axhline(0.01, color="0.7", linewidth=0.8)
    left.set(xlabel="relative step of the differences", ylabel="|exact - differences| / |differences|")
    left.set_title("Jacobian of p_sig", fontsize=9)
    left.legend(fontsize=7, frameon=False)
    for axis, errors, since, what in (
        (middle, sheared, "the encoding", "dp_xy / da"),
        (right, whole, "the experiment", "dp / d mu"),
    ):
        for step, error in errors.items():
            axis.semilogy(steps * (1 + np.arange(error.size)), error, linewidth=0.8, label=f"step {step:g}")
        axis.set(xlabel=f"steps since {since} began", ylabel=f"error of {what}")
    middle.set_xscale("log")
    middle.legend(fontsize=7, frameon=False)
    save_picture(path, figure)


def main() -> None:
    """Compute all, print and draw the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=new_folder, default="gradient_check", help="folder to write to")
    parser.add_argument("--pack", default="tetra-325-a")
    parser.add_argument("--t0", type=float, default=1.8e3)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    experiment = gm.Experiment(gm.load_pack(arguments.pack), waveform(), t0=arguments.t0)
    table, sheared = check_jacobian(experiment)
    with (arguments.output / "jacobian.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["step", *next(iter(table.values()))])
        for step, row in table.items():
            writer.writerow([step, *row.values()])
            print(f"{step:8.0e}  " + "  ".join(f"{group} {error:.1e}" for group, error in row.items()))
    whole = check_prefix(experiment)
    draw(arguments.output / "gradient_check.png", table, sheared, whole, experiment.steps_per_bin)

    rows, apart = check_fidelity(gm.replace(experiment, signals=gm.six_signals()))
    with (arguments.output / "fidelity.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["along", "exact", *(f"step {step:g}" for step in STEPS)])
        writer.writerows(rows)
    print("dF along (in parts of each parameter), exact, and by differences with steps " + " ".join(map(str, STEPS)))
    for name, *numbers in rows:
        print(f"{name:18}  " + "  ".join(f"{number:12.5e}" for number in numbers))
    print(f"forward against reverse mode: {apart:.1e}")


if __name__ == "__main__":
    in_one_line(main)
