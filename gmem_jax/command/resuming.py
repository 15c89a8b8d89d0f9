"""Runs that go on where they were interrupted: parts beside the output, and a lock on it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from gmem_jax.command.console import say
from gmem_jax.files.atomic import sweep
from gmem_jax.files.parts import Parts, locked

Restart = Annotated[bool, typer.Option("--restart", help="Discard what an interrupted run left, and begin anew.")]


def folder_of(output: Path) -> Path:
    """Where the parts of an unfinished run are kept."""
    return output.with_name(f"{output.name}.parts")


@contextmanager
def resumable(output: Path, key: dict[str, Any], *, restart: bool) -> Iterator[Parts]:
    """The parts of a run into `output`, there as long as it is not written: discarded if the block succeeds.

    Args:
        output: the file to be written within the block.
        key: what the numbers depend on.
        restart: discard what is there.

    Raises:
        FileFormatError: if there are parts of another run, or another process writes the output now.
    """
    with locked(output):
        sweep(output.parent, output.name)
        parts = Parts(folder_of(output), key, restart=restart)
        if parts.finished() or parts.begun():
            begun = " and one that is begun" if parts.begun() else ""
            say(f"going on from {parts.folder}: {parts.finished()} finished parts{begun}")
        done = False
        try:
            yield parts
            done = True
        finally:
            if done or not (parts.finished() or parts.begun()):
                parts.discard()
