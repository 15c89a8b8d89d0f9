"""The Jacobian of a recall by 16 amplitudes, gamma0, mu and k_H against central differences over step sizes.

python experiments/gradient_check.py [-o gradient_check] [--pack tetra-325-a] [--t0 1800]

Also the error against the horizon: the derivative of p_xy in every bin from the encoding on. At t0 = 1,800 t_c the
exact Jacobian takes some twenty minutes on one core, each step size of the differences one minute.
"""

import argparse
import csv
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import gmem_jax as gm
from gmem_jax import jacobian

AMPLITUDES = 16
STEPS = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)


def waveform() -> gm.Bumps:
    """One signal of both signs on 16 overlapping bumps, none of them zero."""
    centres = (np.arange(AMPLITUDES) + 1.0) / (AMPLITUDES + 1)
    heights = np.sin(2.0 * np.pi * centres) + 0.5 * np.sin(3.0 * np.pi * centres)
    return gm.Bumps(jnp.asarray([heights / np.abs(heights).max()]), jnp.asarray([centres]), 2.0 / (AMPLITUDES + 1))


def horizon_error(exact: jacobian.Jacobian, other: jacobian.Jacobian) -> np.ndarray:
    """|exact - other| / |other| of p_xy in every bin over the amplitudes, [bins]."""
    one, two = exact.p_xy[:AMPLITUDES], other.p_xy[:AMPLITUDES]
    error: np.ndarray = np.linalg.norm(one - two, axis=0) / np.linalg.norm(two, axis=0)
    return error


def draw(path: Path, table: dict[float, dict[str, float]], horizons: dict[float, np.ndarray], steps: int) -> None:
    """Error against step size and against horizon."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.9))
    for group in next(iter(table.values())):
        left.loglog(list(table), [row[group] for row in table.values()], "o-", markersize=4, label=group)
    left.axhline(0.01, color="0.7", linewidth=0.8)
    left.set(xlabel="relative step of the differences", ylabel="|exact - differences| / |differences|")
    left.legend(fontsize=7, frameon=False)
    for step, error in horizons.items():
        right.loglog(steps * (1 + np.arange(error.size)), error, linewidth=0.8, label=f"step {step:g}")
    right.set(xlabel="steps since the encoding began", ylabel="error of dp_xy / da")
    right.legend(fontsize=7, frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main() -> None:
    """Compute both, print and draw the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("gradient_check"), help="folder to write to")
    parser.add_argument("--pack", default="tetra-325-a")
    parser.add_argument("--t0", type=float, default=1.8e3)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    timing = gm.Timing(t0=arguments.t0)
    experiment = gm.Experiment(gm.load_pack(arguments.pack), waveform(), timing=timing)
    stages: list[str] = []

    def say(stage: str, _: float, fraction: float) -> None:
        if stages[-1:] != [stage]:
            stages.append(stage)
            print(f"{fraction:5.0%}  {stage}", flush=True)

    exact = jacobian.exact(experiment, progress=say)
    differences = {step: jacobian.differences(experiment, step) for step in STEPS}
    table = {step: jacobian.mismatch(exact, other) for step, other in differences.items()}
    with (arguments.output / "gradient_check.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["step", *next(iter(table.values()))])
        for step, row in table.items():
            writer.writerow([step, *row.values()])
            print(f"{step:8.0e}  " + "  ".join(f"{group} {error:.1e}" for group, error in row.items()))
    horizons = {step: horizon_error(exact, other) for step, other in differences.items()}
    draw(arguments.output / "gradient_check.png", table, horizons, timing.steps)


if __name__ == "__main__":
    main()
