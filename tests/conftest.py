"""Double precision everywhere, and no programs compiled before or left for later."""

import os

import jax

os.environ["GMEM_COMPILE_CACHE"] = "off"

jax.config.update("jax_enable_x64", True)
