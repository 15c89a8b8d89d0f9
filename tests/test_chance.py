"""A seed gives the same numbers whatever JAX was told about random numbers on this machine."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import gmem_jax
from gmem_jax.physics import chance

DRAWN = """
import hashlib, sys
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from gmem_jax.physics.grain import tetra
from gmem_jax.preparation.preparation import Recipe, _gas
from gmem_jax.reading.lessons import TrainingConfig, examples
from gmem_jax.reading.net import initial
small = TrainingConfig(1, hidden=(4,), shifts=3, amplitudes=3, draws=3, batch=4)
data = examples(small, 3)
made = [_gas(Recipe(grains=27, seed=2**33 + 5), tetra()), data.order, data.held_out(np.arange(4)),
        data.training(jax.random.split(data.noise)[0]), initial(small, 3).parameters]
print(hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(made))).hexdigest())
"""
SETTINGS = ("JAX_DEFAULT_PRNG_IMPL=rbg", "JAX_THREEFRY_PARTITIONABLE=0", "JAX_RANDOM_SEED_OFFSET=4")


def drawn(*settings: str) -> str:
    """A hash of packs' first configurations, lessons and nets, from a process with these settings."""
    told = dict(setting.split("=") for setting in settings)
    done = subprocess.run(
        [sys.executable, "-c", DRAWN], env={**os.environ, **told}, capture_output=True, text=True, check=True
    )
    return done.stdout


def test_a_seed_gives_the_same_pack_and_net_under_any_setting_of_jax() -> None:
    assert drawn(*SETTINGS) == drawn()


@pytest.mark.parametrize("seed", [0, 7, 2**33 + 5])
def test_the_numbers_are_those_of_jax_where_nothing_is_set(seed: int) -> None:
    with jax.threefry_partitionable(True):
        theirs = jax.random.key(seed, impl="threefry2x32")
        ours = chance.key(seed)
        for draw in (
            jax.random.key_data,
            lambda key: jax.random.key_data(jax.random.split(key, 5)),
            lambda key: jax.random.key_data(jax.random.fold_in(key, 11)),
            lambda key: jax.random.normal(key, (3, 5)),
            lambda key: jax.random.normal(key, (7,), np.float32),
            lambda key: jax.random.permutation(key, 100),
            lambda key: jax.random.randint(key, (9,), 0, 1000),
        ):
            np.testing.assert_array_equal(draw(ours), draw(theirs))


def test_no_other_place_makes_a_key_of_a_seed() -> None:
    root = Path(gmem_jax.__file__).parent
    made = re.compile(r"random\.(key|PRNGKey)\(|wrap_key_data\(")
    assert [path.name for path in root.rglob("*.py") if made.search(path.read_text())] == ["chance.py"]
