"""A recall that is killed and started again."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from scenes import TETRA_27

PACK = TETRA_27
ENTRY = "from gmem_jax.command.app import main; main()"


def recall(target: Path) -> subprocess.Popen:
    """Start one; its log goes to a file of the target's name."""
    options = ["--signals", "words:4", "--t0", "75", "--store", "0.2", "--batch", "4", "--no-picture", "--json"]
    command = [sys.executable, "-c", ENTRY, "recall", str(PACK), "-o", str(target), *options]
    with target.with_suffix(".log").open("w") as log:
        return subprocess.Popen(command, stdout=log, stderr=log)


def datasets(path: Path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


@pytest.mark.slow
def test_a_recall_killed_in_the_middle_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    target, parts = tmp_path / "killed.h5", tmp_path / "killed.h5.parts"
    run = recall(target)
    deadline = time.monotonic() + 300.0
    while not (parts / "batch-0000.npz").exists():
        assert run.poll() is None, target.with_suffix(".log").read_text()
        assert time.monotonic() < deadline, "no batch was finished in five minutes"
        time.sleep(0.01)
    run.send_signal(signal.SIGKILL)
    run.wait()
    assert not target.exists()
    code = recall(target).wait(timeout=300)
    log = target.with_suffix(".log").read_text()
    assert code == 0, log
    assert "going on from" in log
    assert not parts.exists()

    undisturbed = tmp_path / "undisturbed.h5"
    assert recall(undisturbed).wait(timeout=300) == 0
    one, other = datasets(target), datasets(undisturbed)
    assert one.keys() == other.keys()
    for name, values in one.items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)
