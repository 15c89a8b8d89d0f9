"""Packs of the long scripts: their names, and means over several of them."""

import argparse
from collections.abc import Mapping, Sequence

import numpy as np

import gmem_jax as gm

FIVE = "tetra-325-a,tetra-325-b,tetra-325-c,tetra-325-d,tetra-325-e"  # all shipped packs of this size


def called(text: str) -> list[str]:
    """Names of shipped packs, separated by commas: an argument of scripts whose files are named by the pack.

    Raises:
        ArgumentTypeError: if there is no shipped pack of a name.
    """
    names, known = [name for name in text.split(",") if name], gm.list_packs()
    if unknown := [name for name in names if name not in known]:
        raise argparse.ArgumentTypeError(f"no pack is called {unknown[0]!r}; there are {', '.join(known)}")
    return names


def over_packs(rows: Sequence[Mapping[str, str]], by: str, column: str) -> tuple[list[float], list[float], list[float]]:
    """The values of one column, in order; and mean and SD over packs of another column at each (SD 0 for one pack)."""
    places = sorted({float(row[by]) for row in rows})
    values = [[float(row[column]) for row in rows if float(row[by]) == place] for place in places]
    deviations = [float(np.std(some, ddof=1)) if len(some) > 1 else 0.0 for some in values]
    return places, [float(np.mean(some)) for some in values], deviations
