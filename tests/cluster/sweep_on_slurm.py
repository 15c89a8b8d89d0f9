"""A sweep on SLURM whose workers are cancelled twice on the way: the same points, bit for bit, as without SLURM.

tests/cluster/one_node.sh python tests/cluster/sweep_on_slurm.py
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import gmem_jax as gm

PACK = Path(__file__).parents[1] / "data" / "tetra-27.h5"
ENTRY = "from gmem_jax.command.app import main; main()"
SWEEP = f"""[experiment]
pack = "{PACK}"
t0 = 360
[vary]
mu = [0.2, 0.5, 1.0]
friction = ["H", "M1"]
[run]
executor = "{{executor}}"
workers = {{workers}}
{{more}}
"""


def gmem(*arguments: object) -> subprocess.Popen[str]:
    """Start a command."""
    return subprocess.Popen([sys.executable, "-c", ENTRY, *map(str, arguments)], stderr=subprocess.PIPE, text=True)


def running() -> list[str]:
    """Numbers of the jobs that run now."""
    told = subprocess.run(["squeue", "--noheader", "--states=RUNNING", "--format=%A"], capture_output=True, text=True)
    return told.stdout.split()


def main() -> None:
    """Run it on SLURM with two cancellations, without SLURM, and compare."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        settings = {"slurm": ("slurm", 2, "timeout_min = 10\nmem_gb = 2"), "here": ("processes", 1, "")}
        for file, (executor, workers, more) in settings.items():
            text = SWEEP.format(executor=executor, workers=workers, more=more)
            (folder / f"{file}.toml").write_text(text)
        sweep = gmem("sweep", folder / "slurm.toml")
        cancelled = 0
        while sweep.poll() is None:
            time.sleep(1.0)
            if cancelled < 2 and len(list((folder / "slurm" / "parts").glob("*/*"))) > cancelled and running():
                subprocess.run(["scancel", running()[0]], check=False)
                cancelled += 1
                print(f"cancelled a worker ({cancelled})", flush=True)
        assert sweep.returncode == 0, sweep.communicate()[1]
        assert cancelled == 2, "the sweep was done before a worker could be cancelled"
        other = gmem("sweep", folder / "here.toml")
        assert other.wait() == 0
        points = sorted(path.name for path in (folder / "here" / "points").glob("*.h5"))
        assert len(points) == 6
        for point in points:
            one, two = (gm.load_recall(folder / store / "points" / point)[0] for store in ("slurm", "here"))
            np.testing.assert_array_equal(one.p_sig, two.p_sig)
    print("six points, the same bits")


if __name__ == "__main__":
    main()
