"""Put the short table of bench.json, as `gmem bench -o benchmarks` left it, into the README.

python benchmarks/readme.py
"""

import json
from pathlib import Path

from gmem_jax.bench.table import into, short

HERE = Path(__file__).parent
README = HERE.parent / "README.md"

if __name__ == "__main__":
    README.write_text(into(README.read_text(), short(json.loads((HERE / "bench.json").read_text()))))
