"""Compiled programs that are kept between runs."""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from scenes import TETRA_27

PACK = TETRA_27
ENTRY = "from gmem_jax.command.app import main; main()"
SHORT = ["--t0", "75", "--store", "0.2", "--no-picture", "--json"]


def recall(output: Path, **environment: str) -> str:
    """Run one; what it said on stderr."""
    kept = {name: value for name, value in os.environ.items() if name != "GMEM_COMPILE_CACHE"}
    command = [sys.executable, "-c", ENTRY, "recall", str(PACK), "-o", str(output), *SHORT]
    done = subprocess.run(command, env={**kept, **environment}, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.slow
def test_programs_are_kept_used_again_in_silence_and_change_no_bit(tmp_path: Path) -> None:
    home = {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    recall(tmp_path / "first.h5", **home)
    kept = list((tmp_path / "cache" / "gmem_jax").rglob("*-cache"))
    assert any(path.name.startswith("jit_rollout_chunk") for path in kept)
    times = {path: path.stat().st_mtime_ns for path in kept}
    said = recall(tmp_path / "second.h5", **home)
    assert "AOT" not in said  # what XLA would say of every program that it finds
    again = {path: path.stat().st_mtime_ns for path in (tmp_path / "cache" / "gmem_jax").rglob("*-cache")}
    assert again.items() >= times.items()
    recall(tmp_path / "third.h5", GMEM_COMPILE_CACHE="off", XDG_CACHE_HOME=str(tmp_path / "none"))
    assert not (tmp_path / "none").exists()
    with h5py.File(tmp_path / "second.h5") as one, h5py.File(tmp_path / "third.h5") as other:
        np.testing.assert_array_equal(one["p_sig"], other["p_sig"])


@pytest.mark.slow
def test_a_cache_that_is_damaged_or_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    recall(tmp_path / "first.h5", GMEM_COMPILE_CACHE=str(folder))
    for path in folder.glob("*-cache"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "rror" not in recall(tmp_path / "second.h5", GMEM_COMPILE_CACHE=str(folder))
    recall(tmp_path / "third.h5", GMEM_COMPILE_CACHE="/dev/null/no-folder")
