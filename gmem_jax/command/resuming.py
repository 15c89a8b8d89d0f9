"""Resuming interrupted commands: finished parts are kept beside the output, which is locked."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import psutil
import typer

from gmem_jax.command.console import BEGINS_ANEW, InputError, RunInterruptedError, log
from gmem_jax.experiment.cost import default_batch
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.files.atomic import probe
from gmem_jax.files.checkpoints import Checkpoints, lock_of, locked
from gmem_jax.files.ours import remove_leftovers
from gmem_jax.physics.numbers import plural

Restart = Annotated[bool, typer.Option("--restart", help="Discard what an interrupted run left, and begin anew.")]


def folder_of(output: Path) -> Path:
    """The folder of the parts of an unfinished run."""
    return output.with_name(f"{output.name}.parts")


def batch_for(experiment: Experiment, output: Path, wanted: int | None = None, *, restart: bool = False) -> int:
    """Number of signals to run together: as wanted, else as in an unfinished run, else as fits into the free memory."""
    kept = None if restart else Checkpoints.key_of(folder_of(output)).get("batch")
    known = wanted or (kept if isinstance(kept, int) and kept > 0 else None)
    return known or default_batch(experiment, psutil.virtual_memory().available)


def foresee(output: Path, key: dict[str, Any], *, restart: bool) -> None:
    """Say in a dry run how the real run would use the parts beside an output; arguments are those of `resumable`."""
    parts = folder_of(output)
    if not Checkpoints.key_of(parts):
        return
    other = Checkpoints.other_run(parts, key)
    if restart:
        log(f"{parts}: what is there would be discarded (--restart)")
    else:
        log(f"{parts}: {other}; the run is refused without --restart" if other else f"the run would go on from {parts}")


def check_folder(path: Path) -> None:
    """Refuse an `--output` if no folder can be made or written there.

    Raises:
        InputError: saying what is wrong.
    """
    if not path.parent.is_dir():
        raise InputError(f"--output {path}: folder {path.parent} does not exist")
    if path.exists() and not path.is_dir():
        raise InputError(f"--output {path}: is a file, and a folder is needed; name another")
    try:
        with suppress(FileNotFoundError):
            lock_of(path).lstat()  # fails if the name of the lock, which is longer, is too long
        probe(path / "probe" if path.is_dir() else path)
    except OSError as error:
        raise InputError(f"--output {path}: cannot write there ({error.strerror})") from error


@contextmanager
def resumable(output: Path, key: dict[str, Any], *, restart: bool) -> Iterator[Checkpoints]:
    """The parts of a run that writes `output` in the block; they are discarded if the block succeeds.

    Args:
        output: the file to be written within the block.
        key: everything that the numbers depend on.
        restart: whether to discard parts that are there.

    Raises:
        FileFormatError: if there are parts of another run, or another process writes the output now.
        RunInterruptedError: at Ctrl-C, saying how to go on.
    """
    try:
        folder_of(output).lstat()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise InputError(f"{output}: this name leaves no room for that of its parts; shorten it") from None
    with locked(output):
        remove_leftovers(output.parent, output.name)
        parts = Checkpoints(folder_of(output), key, restart=restart)
        if parts.finished() or parts.begun():
            begun = " and one that is begun" if parts.begun() else ""
            log(f"going on from {parts.folder}: {plural(parts.finished(), 'finished part')}{begun}")
        done = False
        try:
            yield parts
            done = True
        except (KeyboardInterrupt, RunInterruptedError):
            if parts.finished() or parts.begun():
                raise RunInterruptedError(f"the same command goes on from {parts.folder}") from None
            raise RunInterruptedError(BEGINS_ANEW) from None
        finally:
            if done or not (parts.finished() or parts.begun()):
                parts.discard()
