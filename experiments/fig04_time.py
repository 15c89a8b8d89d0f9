"""Fig. 4: phi, Z and pressures through the experiment.

    python experiments/fig04_time.py [laptop|workstation|paper]

The same as `gmem reproduce fig04`: writes to the folder reproduce/.
"""

import sys

import jax

from gmem_jax.reproduce.run import reproduce

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    reproduce("fig04", scale=(sys.argv[1:] or ["laptop"])[0])
