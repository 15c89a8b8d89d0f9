"""Fig. 7: two grains, and how the friction force between them keeps a shear and is read out reversed.

    python experiments/fig07_two_grains.py

The same as `gmem reproduce fig07`: writes to the folder reproduce/.
"""

import jax

from gmem_jax.reproduce.run import picture

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    picture("fig07")
