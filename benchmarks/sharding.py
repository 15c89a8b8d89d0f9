"""Time of a step with its replicas split over forced host devices, in a process for each number of them.

    python benchmarks/sharding.py --devices 1 2 4 8 --pack tetra-325-a --replicas 8 --backend native

The number of cores does not depend on the number of devices: the question is whether a step gets slower because data of
the devices are gathered. Each process also times the same march on one of its devices.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from typing import Any


def measure(pack: str, replicas: int, backend: str, steps: int, repeats: int) -> dict[str, Any]:
    """Time a squeeze of `pack` on one device of this process, and on all of them.

    Args:
        pack: name of a pack that ships.
        replicas: B, a multiple of the number of devices.
        backend: "jax" or "native".
        steps: number of steps in one march.
        repeats: number of marches that are timed; the fastest counts.

    Returns:
        "devices", their number; "alone" and "shared", microseconds of wall time per grain-step on one device and on
        all; and "gathers", the number of operations that send replicas between devices.
    """
    import jax
    import jax.numpy as jnp
    from jax.sharding import Mesh, NamedSharding, PartitionSpec

    import gmem_jax as gm
    from gmem_jax import native
    from gmem_jax.physics.state import Box, replicate
    from gmem_jax.physics.step import start
    from gmem_jax.physics.system import System

    chosen = gm.load_pack(pack)
    system = System(chosen.clump, gm.Hooke(), chosen.pairs)
    state = replicate(start(system, chosen.position[..., None], chosen.quaternion[..., None], chosen.box), replicas)
    march = native.marcher(backend)
    devices = jax.devices()

    def run(state: Any, rates: jax.Array) -> Any:
        moved = 1e-4 * rates * jnp.arange(1.0, steps + 1)[:, None, None] * jnp.ones((3, 1))
        still = jnp.zeros_like(moved)
        walls = Box(still + chosen.lower[:, None], chosen.upper[:, None] - moved, still, still)
        return march(system, state, walls, 0.3, 0.0)

    def timed(split: bool) -> tuple[float, str]:
        mesh = Mesh(devices if split else devices[:1], ("replicas",))

        def placed(leaf: jax.Array) -> jax.Array:
            places = PartitionSpec(*(None for _ in leaf.shape[1:]), "replicas")
            return jax.device_put(leaf, NamedSharding(mesh, places))

        moving, rates = jax.tree.map(placed, (state, jnp.linspace(0.9, 1.1, replicas)))
        program = jax.jit(run).lower(moving, rates).compile()
        fastest = float("inf")
        for _ in range(repeats + 1):  # the first warms up
            begun = time.perf_counter()
            jax.block_until_ready(program(moving, rates))
            fastest = min(fastest, time.perf_counter() - begun)
        return 1e6 * fastest / (steps * replicas * chosen.position.shape[0]), program.as_text() or ""

    alone, _ = timed(False)
    shared, text = timed(True)
    gathers = sum(text.count(f"{operation}(") for operation in ("all-gather", "all-to-all", "collective-permute"))
    return {"devices": len(devices), "alone": alone, "shared": shared, "gathers": gathers}


def main() -> None:
    """Print a table; or, in the process for one number of devices, a JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--pack", default="tetra-325-a")
    parser.add_argument("--replicas", type=int, default=8)
    parser.add_argument("--backend", choices=["jax", "native"], default="native")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--here", action="store_true", help="measure in this process, with the devices it has")
    options = parser.parse_args()
    if odd := [devices for devices in options.devices if devices < 1 or options.replicas % devices]:
        parser.error(f"--devices: {odd[0]} do not divide --replicas {options.replicas}")
    if options.here:
        import jax

        jax.config.update("jax_enable_x64", True)
        print(json.dumps(measure(options.pack, options.replicas, options.backend, options.steps, options.repeats)))
        return
    print("devices   one device   all devices   ratio   gathers   (us per grain-step)")
    for devices in options.devices:
        flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
        command = [sys.executable, __file__, "--here", *sys.argv[1:]]
        run = subprocess.run(command, env={**os.environ, "XLA_FLAGS": flags}, stdout=subprocess.PIPE, check=True)
        found = json.loads(run.stdout)
        ratio = found["shared"] / found["alone"]
        print(f"{devices:7} {found['alone']:12.3f} {found['shared']:13.3f} {ratio:7.2f} {found['gathers']:9}")


if __name__ == "__main__":
    main()
