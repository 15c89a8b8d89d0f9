"""Fig. 9: G and F under the three friction laws, M2 also in the paper's own weights.

    python experiments/fig09_models.py [laptop|workstation|paper]

The same as `gmem reproduce fig09`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import reproduce

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    reproduce("fig09", scale=(sys.argv[1:] or ["laptop"])[0])
