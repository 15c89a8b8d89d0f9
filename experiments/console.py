"""Progress, outputs and errors of the long scripts."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path


def say(what: str, _: float, fraction: float) -> None:
    """Print progress in one line; a `gmem_jax.simulation.progress.Progress`."""
    print(f"\r{fraction:5.0%}  {what:24}", end="\n" if fraction >= 1.0 else "", flush=True)


def new_folder(text: str) -> Path:
    """A new or empty folder for results that are written at the end: an argument of scripts that do not resume.

    Raises:
        ArgumentTypeError: if the folder is not empty.
    """
    folder = Path(text)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise argparse.ArgumentTypeError(f"{folder} is there, and would be overwritten; name another folder")
    return folder


def new_name(text: str) -> Path:
    """The name, without a suffix, of a table and a picture that are written at the end; their folder is made now.

    Raises:
        ArgumentTypeError: if one of them exists, or the folder cannot be made.
    """
    name = Path(text)
    if not name.name:
        raise argparse.ArgumentTypeError(f"{text!r} is no name of files")
    for suffix in (".csv", ".png"):
        if (file := name.with_name(name.name + suffix)).exists():
            raise argparse.ArgumentTypeError(f"{file} is there, and would be overwritten; take another name")
    try:
        name.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{name.parent}: cannot make this folder ({error.strerror})") from error
    return name


def in_one_line(main: Callable[[], None]) -> None:
    """Run a script; impossible arguments end it with one line, as with `gmem`."""
    try:
        main()
    except (ValueError, OSError) as error:
        sys.exit(f"{Path(sys.argv[0]).name}: {' '.join(str(error).split())}")
