"""The cost of a gradient of the fidelity in forward runs: CPU seconds of `gm.run` and `gm.value_and_grad` in turn.

    GMEM_THREADS=1 python benchmarks/gradient.py --pack tetra-325-a --t0 450 --repeats 5

The six signals are stored. "waveforms" are derivatives by all amplitudes, on which the shear-free prefix does not
depend; "all" are those by the waveforms, gamma0 and the friction law, through the prefix too. `--second` adds the
product of the matrix of second derivatives by the amplitudes with one direction. A first round compiles and is not
counted.
"""

import argparse
import os
import resource
import time
from collections.abc import Callable
from typing import Any

import jax

import gmem_jax as gm

NAMES = {"waveforms": ["signals.amplitudes"], "all": ["signals", "gamma0", "friction"]}


def cpu_seconds(run: Callable[[], Any]) -> float:
    """CPU time of this process during a call, over all threads."""
    before = time.process_time()
    jax.block_until_ready(jax.tree.leaves(run()))
    return time.process_time() - before


def main() -> None:
    """Print a line for each round."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pack", default="tetra-325-a")
    parser.add_argument("--t0", type=float, default=450.0)
    parser.add_argument("--law", default="H", choices=("H", "M1", "M2"))
    parser.add_argument("--by", nargs="+", default=list(NAMES), choices=NAMES)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--second", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    law = {"H": gm.Hooke, "M1": gm.MindlinRescaled, "M2": gm.Mindlin}[options.law]()
    experiment = gm.Experiment(gm.load_pack(options.pack), gm.six_signals(), t0=options.t0, friction=law)

    def fidelity(amplitudes: jax.Array) -> jax.Array:
        return gm.fidelity(gm.replace(experiment, {"signals.amplitudes": amplitudes}))

    amplitudes = experiment.signals.amplitudes
    slope = jax.jit(jax.grad(fidelity))
    product = jax.jit(lambda way: jax.jvp(jax.grad(fidelity), (amplitudes,), (way,))[1])
    for repeat in range(options.repeats + 1):
        forward = cpu_seconds(lambda: gm.run(experiment).p_sig)
        line = [f"forward {forward:.2f} s"]
        for name in options.by:
            back = cpu_seconds(lambda by=NAMES[name]: gm.value_and_grad(experiment, by, progress=False).slope)
            line.append(f"{name} {back:.2f} s = {back / forward:.2f} forward runs")
        whole = {"jax.grad": lambda: slope(amplitudes), "jax.jvp of it": lambda: product(amplitudes)}
        for name, run in whole.items() if options.second else ():
            spent = cpu_seconds(run)
            line.append(f"{name} {spent:.2f} s = {spent / forward:.2f} forward runs")
        if repeat:
            print(*line, f"load {os.getloadavg()[0]:.1f}", sep="; ", flush=True)
    print(f"largest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
