"""The overhead of a sweep: one sweep by `gmem sweep`, and the same points by one call in one process.

    python benchmarks/sweeping.py --pack tetra-1024-a --mu 0.4 0.5 0.6 0.7 0.8 0.9 --t0 1800 --repeats 2

Both are whole processes, run in turn; wall time and CPU time include their children. Both keep compiled programs, so
that the first pair, which compiles, is not counted.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

DIRECT = """
import sys
import jax
import gmem_jax as gm
from gmem_jax.experiment.several import run_several
from gmem_jax.files.compilation_cache import keep_programs
keep_programs()
jax.config.update("jax_enable_x64", True)
pack = gm.load_pack(sys.argv[1])
base = gm.Experiment(pack, gm.six_signals(), t0=float(sys.argv[2]))
run_several([gm.replace(base, {"friction.mu": float(mu)}) for mu in sys.argv[3:]])
"""


def timed(command: list[str]) -> tuple[float, float]:
    """Wall and CPU seconds of a process and its children."""
    before, began = os.times(), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - began, cpu


def main() -> None:
    """Print a line for each run, and the ratio of the best runs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pack", default="tetra-1024-a")
    parser.add_argument("--mu", nargs="+", default=["0.4", "0.5", "0.6", "0.7", "0.8", "0.9"])
    parser.add_argument("--t0", default="1800")
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    if options.repeats < 1:
        parser.error(f"--repeats: at least 1, got {options.repeats}")
    best: dict[str, tuple[float, float]] = {}
    with tempfile.TemporaryDirectory() as name:
        for repeat in range(options.repeats + 1):
            folder = Path(name) / str(repeat)
            text = f'[experiment]\nt0 = {options.t0}\npack = "{options.pack}"\n[vary]\nmu = [{", ".join(options.mu)}]\n'
            folder.with_suffix(".toml").write_text(text)
            gmem = str(Path(sys.executable).with_name("gmem"))
            runs = {
                "direct": [sys.executable, "-c", DIRECT, options.pack, options.t0, *options.mu],
                "sweep": [gmem, "sweep", str(folder.with_suffix(".toml")), "-o", str(folder)],
            }
            for which, command in runs.items():
                wall, cpu = timed(command)
                print(json.dumps({"run": repeat, "what": which, "wall_s": round(wall, 1), "cpu_s": round(cpu, 1)}))
                if repeat > 0:
                    old = best.get(which, (wall, cpu))
                    best[which] = min(old[0], wall), min(old[1], cpu)
    ratios = [sweep / direct for sweep, direct in zip(best["sweep"], best["direct"], strict=True)]
    print(f"sweep / direct: {ratios[0]:.3f} of wall time, {ratios[1]:.3f} of CPU time")


if __name__ == "__main__":
    main()
