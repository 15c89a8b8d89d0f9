"""Double precision everywhere, no programs kept or delayed, and what many tests read."""

import os
from collections.abc import Iterator
from pathlib import Path

os.environ["GMEM_COMPILE_CACHE"] = "off"  # before the package, which tells its library as soon as it is imported

import jax
import pytest

import gmem_jax as gm

jax.config.update("jax_enable_x64", True)


@pytest.fixture(autouse=True)
def no_terminal() -> None:
    """Tables are as wide as they are: some libraries say COLUMNS when they start another process."""
    os.environ.pop("COLUMNS", None)


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """Programs are forgotten before they fill the memory maps of a process (65,530 on Linux): XLA crashes there."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > 30_000:
        jax.clear_caches()


@pytest.fixture(scope="session")
def recalled() -> tuple[gm.Experiment, gm.Recall]:
    """Two words recalled by 27 grains, far too fast: what tests of files and pictures share."""
    pack = gm.load_pack(Path(__file__).parent / "data" / "tetra-27.h5")
    experiment = gm.Experiment(pack, gm.words(1), t0=75.0, store=0.1, rest=0.1, hold=0.1)
    return experiment, gm.run(experiment)
