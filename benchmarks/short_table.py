"""Put the short table of bench.json, which `gmem bench -o benchmarks` writes, into docs/speed.md.

python benchmarks/short_table.py
"""

import json
from pathlib import Path

from gmem_jax.bench.table import into, short

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "speed.md"

if __name__ == "__main__":
    PAGE.write_text(into(PAGE.read_text(), short(json.loads((HERE / "bench.json").read_text()))))
