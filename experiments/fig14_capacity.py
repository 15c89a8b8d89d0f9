"""Fig. 14: F by each background, and accuracy of the readers, against the length of the words.

    python experiments/fig14_capacity.py [laptop|workstation|paper]

The same as `gmem reproduce fig14`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import reproduce

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    reproduce("fig14", scale=(sys.argv[1:] or ["laptop"])[0])
