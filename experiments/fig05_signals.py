"""Fig. 5: the six waveforms and some words, with their integrals.

    python experiments/fig05_signals.py

The same as `gmem reproduce fig05`: writes to the folder reproduce/.
"""

import jax

from gmem_jax.reproduce.run import picture

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    picture("fig05")
