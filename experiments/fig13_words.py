"""Fig. 13: recalled words beside their scaled integrals.

    python experiments/fig13_words.py [laptop|workstation|paper]

The same as `gmem reproduce fig13`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import reproduce

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    reproduce("fig13", scale=(sys.argv[1:] or ["laptop"])[0])
