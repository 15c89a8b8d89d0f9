"""What tables of the long scripts say of several packs."""

from collections.abc import Mapping, Sequence

import numpy as np


def over_packs(rows: Sequence[Mapping[str, str]], by: str, column: str) -> tuple[list[float], list[float], list[float]]:
    """Values of one column, in order, and of another the mean and the SD (0 of one pack) over packs at each of them."""
    places = sorted({float(row[by]) for row in rows})
    values = [[float(row[column]) for row in rows if float(row[by]) == place] for place in places]
    deviations = [float(np.std(some, ddof=1)) if len(some) > 1 else 0.0 for some in values]
    return places, [float(np.mean(some)) for some in values], deviations
