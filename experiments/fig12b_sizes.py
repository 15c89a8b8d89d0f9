"""Fig. 12b: G and F against the number of grains.

    python experiments/fig12b_sizes.py [laptop|workstation|paper]

The same as `gmem reproduce fig12b`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import reproduce

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    reproduce("fig12b", scale=(sys.argv[1:] or ["laptop"])[0])
