"""Fig. 10: the force of H, M1 and M2 along one path of overlap and displacement, beside the closed forms.

    python experiments/fig10_contact_path.py

The same as `gmem reproduce fig10`: writes to the folder reproduce/.
"""

import jax

from gmem_jax.reproduce.run import picture

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    picture("fig10")
