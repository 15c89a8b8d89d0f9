"""Tables that grow while a script runs; a script does not repeat the work of their rows."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def done(path: Path) -> list[dict[str, str]]:
    """The rows of a table; none if the file does not exist."""
    return list(csv.DictReader(path.open())) if path.exists() else []


def note(path: Path, columns: Sequence[str], rows: list[dict[str, Any]]) -> None:
    """Add rows to a table."""
    new = not path.exists()
    with path.open("a") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(rows)
