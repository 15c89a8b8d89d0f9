"""Double precision everywhere, and no programs compiled before or left for later."""

import os
from pathlib import Path

import jax
import pytest

import gmem_jax as gm

os.environ["GMEM_COMPILE_CACHE"] = "off"

jax.config.update("jax_enable_x64", True)


@pytest.fixture(scope="session")
def recalled() -> tuple[gm.Experiment, gm.Recall]:
    """Two words recalled by 27 grains, far too fast: what tests of files and pictures share."""
    pack = gm.load_pack(Path(__file__).parent / "data" / "tetra-27.h5")
    experiment = gm.Experiment(pack, gm.words(1), t0=75.0, store=0.1, rest=0.1, hold=0.1)
    return experiment, gm.run(experiment)
