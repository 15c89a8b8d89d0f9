"""gpu.md of this folder: what a step takes of a GPU and, where there is one, how long it takes.

python benchmarks/gpu.py
"""

from pathlib import Path

import jax

from gmem_jax.bench import gpu
from gmem_jax.files.packs import load_pack

OTHERS = """
Launches: one a step; three more of ours a bin (numbers from the arrays of the call, pressures, histories back), and
some fifty of XLA's (`docs/gpu.md`).

DEM-Engine (`deme3`; 3.6 ns per clump of three spheres and step on two RTX 3080, published) is not run beside: it
starts on a GPU only, so that nothing about it could be tried here.
"""

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    try:
        gpu.device()
        times = gpu.timed(load_pack)
    except ValueError:
        times = None
    text = gpu.gpu_markdown(gpu.kernel_facts(load_pack), times)
    Path(__file__).with_suffix(".md").write_text(f"# On a GPU\n\n{text}{OTHERS}")
