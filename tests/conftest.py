"""Double precision everywhere, and no silent rank promotion of Python scalars to float32."""

import jax

jax.config.update("jax_enable_x64", True)
