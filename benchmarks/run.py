"""The table of this folder: `gmem bench` against the stored baseline.

python benchmarks/run.py [options of gmem bench]
"""

import sys
from pathlib import Path

from gmem_jax.command.app import main

HERE = Path(__file__).parent

if __name__ == "__main__":
    stored = HERE / "baseline.json"
    against = ["--baseline", str(stored)] if stored.is_file() else []
    sys.argv[1:] = ["bench", "-o", str(HERE), *against, *sys.argv[1:]]
    main()
