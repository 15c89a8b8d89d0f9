"""Large packs on CPUs, and what mixed precision gains and costs; writes large_packs.md beside this file.

    python benchmarks/large_packs.py [--t0 1.8e4] [--seconds 4] [--errors tetra-325-a tetra-325-b ...] [--only-errors]

With --only-errors the errors are printed, and nothing is written.

Each size and number of replicas is timed in both precisions in turn, so that other load of the machine affects both. A
time is the best of the calls, with their median beside it. Errors are those of whole recalls at t0 = 1.8e3 against
double precision.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)

import gmem_jax as gm  # noqa: E402
from gmem_jax.bench.measure import ENCODE, TIMED_LAWS, encode, processor  # noqa: E402
from gmem_jax.experiment.provenance import provenance  # noqa: E402
from gmem_jax.simulation.observers import forward  # noqa: E402

PRECISIONS = ("double", "mixed")
SIZES = ("tetra-325-a", "tetra-3267-a", "tetra-10240-b")


def costs(pack: gm.Pack, replicas: int, seconds: float, t0: float) -> dict[str, np.ndarray]:
    """Microseconds per grain-step of every call, by precision."""
    simulation, state = encode(pack, TIMED_LAWS["H"], replicas, "native", t0)
    calls = {name: (replace(simulation, precision=name), state, simulation.rows(ENCODE, 0), 1) for name in PRECISIONS}
    taken: dict[str, list[float]] = {name: [] for name in PRECISIONS}
    for call in calls.values():
        jax.block_until_ready(forward(*call, most=4))
    began = time.perf_counter()
    while time.perf_counter() - began < seconds or len(taken["mixed"]) < 3:
        for name, call in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(forward(*call, most=4))
            taken[name].append(time.perf_counter() - start)
    unit = 1e6 / (simulation.steps * pack.grains * replicas)
    return {name: unit * np.asarray(times) for name, times in taken.items()}


def speeds(seconds: float, t0: float) -> list[str]:
    """The table of costs."""
    lines = [
        "| N | replicas | double: best (median), us | mixed: best (median), us | double / mixed |",
        "|---|---|---|---|---|",
    ]
    for name in SIZES:
        pack = gm.load_pack(name)
        for replicas in (1, 8, 16, 32):
            found = costs(pack, replicas, seconds, t0)
            double, mixed = (found[name] for name in PRECISIONS)
            cells = " | ".join(f"{times.min():.4f} ({np.median(times):.4f})" for times in (double, mixed))
            lines.append(f"| {pack.grains} | {replicas} | {cells} | {double.min() / mixed.min():.2f} |")
            print(lines[-1], flush=True)
    return lines


def errors(names: list[str]) -> list[str]:
    """The table of errors."""
    lines = ["| pack | F, double | F, mixed - double | G, mixed / double - 1 | p_sig: largest difference / largest |"]
    lines.append("|---|---|---|---|---|")
    for name in names:
        experiment = gm.Experiment(gm.load_pack(name), gm.six_signals(), t0=1.8e3)
        double, mixed = (gm.run(replace(experiment, precision=precision)) for precision in PRECISIONS)
        apart = float(np.abs(mixed.p_sig - double.p_sig).max() / np.abs(double.p_sig).max())
        gain = float(mixed.gain / double.gain - 1.0)
        change = float(mixed.fidelity - double.fidelity)
        lines.append(f"| {name} | {float(double.fidelity):.4f} | {change:+.1e} | {gain:+.1e} | {apart:.1e} |")
        print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--t0", type=float, default=1.8e4, help="of what is timed; the paper's")
    parser.add_argument("--seconds", type=float, default=4.0, help="for each size and number of replicas")
    parser.add_argument("--errors", nargs="*", default=[f"tetra-325-{one}" for one in "abcde"], help="packs")
    parser.add_argument("--only-errors", action="store_true")
    chosen = parser.parse_args()
    head = f"{processor()}, commit {(provenance()['commit'] or 'unknown')[:9]}, law H, all cores."
    cost = f"Microseconds of wall time per grain-step, t0 = {chosen.t0:g}."
    parts = [] if chosen.only_errors else [[cost, "", *speeds(chosen.seconds, chosen.t0)]]
    if chosen.errors:
        parts.append(["Errors of whole recalls, t0 = 1.8e3, six signals.", "", *errors(chosen.errors)])
    text = "\n".join(["# Large packs, and mixed precision", "", head, *("\n" + "\n".join(part) for part in parts), ""])
    if chosen.only_errors:
        print(text)
    else:
        Path(__file__).with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()
