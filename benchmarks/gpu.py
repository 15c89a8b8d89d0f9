"""gpu.md of this folder: the resources of a GPU that a step takes, and its time.

python benchmarks/gpu.py                   # on a machine with a GPU: the whole page
python benchmarks/gpu.py --times-to FILE   # on a machine with a GPU: only the times
python benchmarks/gpu.py --times FILE      # on any machine: the page with these times
"""

import argparse
import json
from pathlib import Path

import jax

from gmem_jax.bench import gpu
from gmem_jax.files.packs import load_pack

OTHERS = """
Launches: two a step, and a few more of ours a bin (numbers from the arrays of the call, pressures); some forty of XLA's
(`docs/gpu.md`).

DEM-Engine (`deme3`; 3.6 ns per clump of three spheres and step on two RTX 3080, published) was not run beside.
"""


def main() -> None:
    """Time, or write the page, or both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=Path, help="times of a GPU that is not here")
    parser.add_argument("--times-to", type=Path, help="write the times here, and no page")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.times:
        times = json.loads(arguments.times.read_text())
    else:
        gpu.device()
        times = gpu.timed(load_pack, lambda what, fraction: print(f"{fraction:4.0%} {what}", flush=True))
    if arguments.times_to:
        arguments.times_to.write_text(json.dumps(times, indent=1) + "\n")
        return
    page = f"# On a GPU\n\n{gpu.gpu_markdown(gpu.kernel_facts(load_pack), times)}{OTHERS}"
    Path(__file__).with_suffix(".md").write_text(page)


if __name__ == "__main__":
    main()
