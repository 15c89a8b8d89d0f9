"""How much G and F change with each choice that the paper leaves open.

    python experiments/choices.py [laptop|workstation|paper]

The same as `gmem reproduce choices`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import weigh

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    weigh(scale=(sys.argv[1:] or ["laptop"])[0])
