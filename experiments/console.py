"""What the long scripts print, and where they write."""

import argparse
import sys
from collections.abc import Callable
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


def new_name(text: str) -> Path:
    """The name, without a suffix, of a table and a picture that are written at the end, in a folder that is made now.

    Raises:
        ArgumentTypeError: if one of them is there, or they cannot be.
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
    """Run a script; arguments that cannot be end it with one line, as with `gmem`."""
    try:
        main()
    except (ValueError, OSError) as error:
        sys.exit(f"{Path(sys.argv[0]).name}: {' '.join(str(error).split())}")
