"""What the long scripts print, and where they write."""

import argparse
from pathlib import Path


def say(what: str, _: float, fraction: float) -> None:
    """Progress in one line; a `gmem_jax.simulation.progress.Progress`."""
    print(f"\r{fraction:5.0%}  {what:24}", end="\n" if fraction >= 1.0 else "", flush=True)


def new_folder(text: str) -> Path:
    """A folder for results that are written at the end: an argument of scripts that do not go on from what there is.

    Raises:
        ArgumentTypeError: if there is something in it.
    """
    folder = Path(text)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise argparse.ArgumentTypeError(f"{folder} is there, and would be overwritten; name another folder")
    return folder
