"""Cost of a grain-step of `advance` in the encode stage: moving walls, binning and list checks included.

    python benchmarks/step_cost.py [--pack tetra-325-a] [--replicas 1 8 16 33] [-o FOLDER]

Prints a Markdown table and writes it, with a JSON of the same, beside the versions, the commit and the processor.
Compile time is apart. The final p_xy stands beside each time, so that a wrong but fast run shows.
"""

import argparse
import json
import os
import platform
import time
from pathlib import Path

import jax
import jax.numpy as jnp

import gmem_jax as gm
from gmem_jax.drive import Motion, clock
from gmem_jax.dynamics import System, advance, start
from gmem_jax.provenance import provenance
from gmem_jax.run import compiled
from gmem_jax.state import replicate

BINS = 12


def processor() -> str:
    """The processor's name, and how many cores this process may use."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").is_file() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor()}, {len(os.sched_getaffinity(0))} cores"


def measure(pack: gm.Pack, replicas: int, repeats: int) -> dict[str, float]:
    """Best microseconds per grain-step of `repeats` runs, compile seconds, and the last p_xy in E."""
    step, steps = clock(1.8e3, 0.3)
    heights = jnp.linspace(-1.0, 1.0, max(1, replicas - 1))[:, None]
    signals = gm.Bumps(heights, jnp.full_like(heights, 0.1), 0.2)
    system = System(pack.clump, gm.Hooke(), pack.pairs)
    state = start(system, pack.position[..., None], pack.quaternion[..., None], pack.box)
    state = replicate(state, replicas)
    box = pack.box
    shear = signals if replicas > 1 else None
    motion = Motion(box.lower, box.upper, pack.delta0, 0.0, 1.0, 1.8e3, 1e-3, shear)
    run = compiled(lambda system, state: advance(system, state, motion, step, bins=BINS, steps=steps))
    began = time.perf_counter()
    binary = run.lower(system, state).compile()
    compile_seconds = time.perf_counter() - began
    best, sample = float("inf"), None
    for _ in range(repeats + 1):  # the first is the warm-up
        began = time.perf_counter()
        final, sample = jax.block_until_ready(binary(system, state))
        best = min(best, time.perf_counter() - began)
    assert not int(final.status.max()), gm.explain(int(final.status.max()))
    return {
        "replicas": replicas,
        "us_per_grain_step": 1e6 * best / (BINS * steps * pack.grains * replicas),
        "compile_s": compile_seconds,
        "p_xy": float(sample.pressure[-1, 0, -1] - sample.pressure[-1, 1, -1]),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pack", default="tetra-325-a")
    parser.add_argument("--replicas", type=int, nargs="+", default=[1, 8, 16, 33])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("-o", "--output", type=Path, default=None)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    pack = gm.load_pack(arguments.pack)
    rows = [measure(pack, replicas, arguments.repeats) for replicas in arguments.replicas]
    facts = {**provenance(), "processor": processor(), "pack": pack.name, "grains": pack.grains}
    lines = [
        f"{pack.name}, Hooke, float64, {facts['processor']}, jax {facts['versions']['jax']}, commit {facts['commit']}",
        "",
        "| replicas | us per grain-step | compile, s | p_xy at the end, E |",
        "|---|---|---|---|",
    ]
    lines += [
        f"| {r['replicas']} | {r['us_per_grain_step']:.3f} | {r['compile_s']:.1f} | {r['p_xy']:.6e} |" for r in rows
    ]
    table = "\n".join(lines)
    print(table)
    if arguments.output:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / "step_cost.md").write_text(table + "\n")
        (arguments.output / "step_cost.json").write_text(json.dumps({**facts, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
