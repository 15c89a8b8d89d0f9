"""Fig. 8: G and F against friction.

    python experiments/fig08_friction.py [laptop|workstation|paper]

The same as `gmem reproduce fig08`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import reproduce

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    reproduce("fig08", scale=(sys.argv[1:] or ["laptop"])[0])
