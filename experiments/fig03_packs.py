"""Fig. 3: packs of all sizes and shapes.

    python experiments/fig03_packs.py [laptop|workstation|paper]

The same as `gmem reproduce fig03`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import picture

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    picture("fig03", scale=(sys.argv[1:] or ["laptop"])[0])
