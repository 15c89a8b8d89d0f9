"""Fig. 12a: G and F against compression.

    python experiments/fig12a_compression.py [laptop|workstation|paper]

The same as `gmem reproduce fig12a`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import reproduce

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    reproduce("fig12a", scale=(sys.argv[1:] or ["laptop"])[0])
