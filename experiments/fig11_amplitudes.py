"""Fig. 11: G and F against compression and amplitude, and the shape of the grains.

    python experiments/fig11_amplitudes.py [laptop|workstation|paper]

The same as `gmem reproduce fig11`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import reproduce

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    reproduce("fig11", scale=(sys.argv[1:] or ["laptop"])[0])
