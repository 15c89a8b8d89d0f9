"""Fig. 15: M2's force on unloading along the path of Fig. 10, for several numbers of points and weights.

    python experiments/fig15_m2_convergence.py

The same as `gmem reproduce fig15`: writes to the folder reproduce/.
"""

import jax

from gmem_jax.reproduce.run import picture

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    picture("fig15")
