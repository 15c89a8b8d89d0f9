"""The options of an experiment in docs/howto/command_line.md, from what the command line makes them of.

python docs/make/options_page.py
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gmem_jax.bench.table import into
from gmem_jax.command.options import experiment_options
from gmem_jax.experiment.experiment import NUMBERS
from gmem_jax.files.configuration import OF_LAW, OF_MATERIAL

PAGE = Path(__file__).parents[1] / "howto" / "command_line.md"


def page() -> str:
    """The page with a table of today's options."""
    known: dict[str, Mapping[str, Any]] = {
        name: entry.metadata for name, entry in {**OF_LAW, **OF_MATERIAL, **NUMBERS}.items()
    }
    lines = ["| option | | unit | in | default |", "|---|---|---|---|---|"]
    for name, (default, _, words, _) in experiment_options().items():
        entry = known.get(name, {"words": words.rstrip("."), "unit": ""})
        within = f"`{entry['interval'].words}`" if "interval" in entry else ""
        value = f"{default:g}" if isinstance(default, float) else default or ""
        lines.append(f"| `--{name.replace('_', '-')}` | {entry['words']} | {entry['unit']} | {within} | {value} |")
    return into(PAGE.read_text(), "\n".join(["", *lines, "", ""]), "docs/make/options_page.py")


if __name__ == "__main__":
    PAGE.write_text(page())
