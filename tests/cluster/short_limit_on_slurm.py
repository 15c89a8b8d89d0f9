"""A run on SLURM that takes longer than its jobs may: each keeps a checkpoint, is requeued, and goes on; the same bits.

tests/cluster/one_node.sh python tests/cluster/short_limit_on_slurm.py
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from sweep_on_slurm import PACK, gmem

import gmem_jax as gm

SWEEP = f"""[experiment]
pack = "{PACK}"
t0 = 400000
[vary]
mu = [0.5]
[run]
executor = "{{executor}}"
{{more}}
"""
OPTIONS = {"slurm": "timeout_min = 1\nmem_gb = 2", "here": ""}


def names() -> list[str]:
    """What the jobs in the queue are called."""
    return subprocess.run(["squeue", "--noheader", "--format=%j"], capture_output=True, text=True).stdout.split()


def main() -> None:
    """Run it on SLURM with a limit of a minute, without SLURM, and compare."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, more in OPTIONS.items():
            executor = "processes" if file == "here" else "slurm"
            (folder / f"{file}.toml").write_text(SWEEP.format(executor=executor, more=more))
        sweep = gmem("sweep", folder / "slurm.toml")
        seen: set[str] = set()
        while sweep.poll() is None:
            time.sleep(1.0)
            seen.update(names())
        assert sweep.returncode == 0, sweep.communicate()[1]
        assert seen == {"gmem-slurm-worker-0"}, seen
        logs = "\n".join(path.read_text() for path in (folder / "slurm" / "workers" / "submitit").glob("*.err"))
        times = logs.count("Requeued job") + logs.count("DUE TO TIME LIMIT")
        assert times, "the run was over before its time was"
        assert gmem("sweep", folder / "here.toml").wait() == 0
        (point,) = (path.name for path in (folder / "here" / "points").glob("*.h5"))
        one, two = (gm.load_recall(folder / store / "points" / point)[0] for store in ("slurm", "here"))
        np.testing.assert_array_equal(one.p_sig, two.p_sig)
        print(f"a run that went on after {times} limits of its time, the same bits", flush=True)


if __name__ == "__main__":
    sys.exit(main())
