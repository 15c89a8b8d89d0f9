"""Large packs: memory and time of a step, without a prepared pack of this size.

    python benchmarks/large.py --grains 100450 --replicas 1 8 --steps 200

Copies of a shipped pack are set side by side until there are enough grains: the cost of a step depends on the number of
contacts, not on whether the whole is at rest. Each number of replicas runs in a process of its own; its memory is the
peak of the process less the memory before the replicas were made.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np


def heap(grains: int, source: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres [N, 3] and quaternions [N, 4] of copies of a pack, and the edge lengths of the box around them."""
    import gmem_jax as gm

    pack = gm.load_pack(source)
    lengths = np.asarray(pack.upper - pack.lower)
    copies = -(-grains // pack.grains)
    side = max(1, round((copies / (lengths[2] / lengths[0])) ** (1.0 / 3.0)))
    high = -(-copies // side**2)
    places = np.stack(np.meshgrid(range(side), range(side), range(high), indexing="ij"), axis=-1).reshape(-1, 3)
    places = places[np.argsort(places[:, 2], kind="stable")]
    position = (places[:, None] * lengths + np.asarray(pack.position - pack.lower)).reshape(-1, 3)[:grains]
    quaternion = np.tile(np.asarray(pack.quaternion), (len(places), 1))[:grains]
    return position, quaternion, lengths * [side, side, high]


def resident(name: str) -> int:
    """Bytes of memory of this process, from a line of its status: VmRSS, the present value, or VmHWM, the peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name))


def measure(grains: int, replicas: int, steps: int, source: str) -> dict[str, float]:
    """Time and memory of a squeeze."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    import gmem_jax as gm
    from gmem_jax import native
    from gmem_jax.experiment.pack import find_pairs
    from gmem_jax.physics.state import Box, replicate, still_box
    from gmem_jax.physics.step import start
    from gmem_jax.physics.system import System

    clump = gm.load_pack(source).clump
    position, quaternion, lengths = heap(grains, source)
    box = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None])
    began = time.perf_counter()
    pairs = find_pairs(clump, position, quaternion, box, 0.05)
    search = time.perf_counter() - began
    system = System(clump, gm.Hooke(), pairs)
    alone = start(system, jnp.asarray(position)[..., None], jnp.asarray(quaternion)[..., None], box)
    march = jax.jit(native.marcher("native"))
    before = resident("VmRSS")
    state = replicate(alone, replicas)
    moved = 1e-5 * jnp.arange(1.0, steps + 1)[:, None, None] * jnp.linspace(0.9, 1.1, replicas) * jnp.ones((3, 1))
    still = jnp.zeros_like(moved)
    walls = Box(still, jnp.asarray(lengths)[:, None] - moved, still, still)
    jax.block_until_ready(march(system, state, walls, 0.3, 0.0))  # compiles
    began = time.perf_counter()
    state, _ = jax.block_until_ready(march(system, state, walls, 0.3, 0.0))
    seconds = time.perf_counter() - began
    assert int(np.bitwise_or.reduce(np.asarray(state.status))) == 0
    return {
        "grains": grains,
        "replicas": replicas,
        "contacts_listed": int(np.asarray(pairs.valid).sum()),
        "search_seconds": search,
        "us_per_grain_step": 1e6 * seconds / (steps * replicas * grains),
        "kb_per_grain_and_replica": (resident("VmHWM") - before) / (1e3 * replicas * grains),
    }


def main() -> None:
    """Print a line for each number of replicas."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grains", type=int, default=100_450)
    parser.add_argument("--replicas", type=int, nargs="+", default=[1, 8])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--source", default="tetra-3267-a")
    parser.add_argument("--json", action="store_true", help="of the one number of replicas, in this process")
    given = parser.parse_args()
    if given.json:
        print(json.dumps(measure(given.grains, given.replicas[0], given.steps, given.source)))
        return
    for replicas in given.replicas:
        options = ["--grains", given.grains, "--steps", given.steps, "--source", given.source, "--replicas", replicas]
        subprocess.run([sys.executable, __file__, *map(str, options), "--json"], check=True)


if __name__ == "__main__":
    main()
