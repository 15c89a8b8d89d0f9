"""Output of all commands: logs and progress on stderr, results on stdout, and checks of output files."""

import contextlib
import errno
import json
import math
import os
import stat
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table

from gmem_jax.files.atomic import probe
from gmem_jax.files.ours import WRITTEN, promise, remove_leftovers
from gmem_jax.files.printing import finite, printable

if TYPE_CHECKING:  # modules that import JAX are imported where they are used: `gmem --help` needs none
    from gmem_jax.show.figure import Figure
    from gmem_jax.simulation.progress import Progress


def _give_up(stream: int) -> None:
    """Send a stream to the null device from now on; else the rest of its buffer would fail again when Python ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream)


class _Log(Console):
    """The log. A run does not end if the reader of its log is gone, or the disk of the log is full."""

    def print(self, *objects: Any, **options: Any) -> None:
        """Print, unless the stream cannot be written."""
        try:
            super().print(*objects, **options)
        except OSError:
            self.on_broken_pipe()

    def on_broken_pipe(self) -> None:
        """Print nothing from now on."""
        _give_up(2)


class _Out(Console):
    """The results. If their reader leaves, `heard` handles it; rich would end the command as if it had failed."""

    def on_broken_pipe(self) -> None:
        """Raise the error, for `heard`."""
        raise BrokenPipeError


if not os.environ.get("COLUMNS", "1").strip("0"):  # unknown width; at 0 columns rich would print nothing
    del os.environ["COLUMNS"]
# Markup would let names in files style or break a line; of "words:x: ..." rich would make "words" and an emoji.
stderr = _Log(stderr=True, highlight=False, markup=False, emoji=False)
out = _Out(highlight=False, markup=False, emoji=False)

LONGEST_DURATION = 3e9  # seconds, a century: longer runs are a mistake
LOG_INTERVAL = 30.0  # seconds between lines of progress where there is no terminal

Output = Annotated[Path, typer.Option("-o", "--output", readable=False, help="File to write.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout; logs go to stderr.")]
Picture = Annotated[bool, typer.Option(help="Also draw a picture, beside the output.")]
Force = Annotated[bool, typer.Option("--force", help="Replace outputs that exist.")]
KeptFrames = Annotated[
    int,
    typer.Option(
        "--frames", min=0, help="Number of configurations to keep along the run, the first and last among them."
    ),
]
PackName = Annotated[str, typer.Argument(help="A pack file, or the name of a pack that is shipped or made.")]


# Options and arguments that were typed for the command that runs: parameters by name, as written on the command line.
GIVEN: ContextVar[Mapping[str, str]] = ContextVar("GIVEN", default=MappingProxyType({}))


DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Say what it would cost in time, memory and disk, and do nothing.")
]


class InputError(ValueError):
    """Bad input, with a message for the command line."""


def refuse_idle(why: str, *names: str) -> None:
    """Refuse options that were typed and would do nothing.

    Args:
        why: end of the sentence "--frames-of does nothing ...".
        names: names of the parameters of the command.

    Raises:
        InputError: naming the first of them that was typed.
    """
    given = GIVEN.get()
    for name in names:
        if name in given:
            raise InputError(f"{given[name]} does nothing {why}")


class UnheardError(Exception):
    """The result could not be written to stdout; all files are written."""


BEGINS_ANEW = "nothing was kept yet; the same command begins anew"


class RunInterruptedError(Exception):
    """Ctrl-C in a run, with how to go on. It is not a KeyboardInterrupt, at which typer exits without a message."""


def log(line: str, **style: Any) -> None:
    """Print a line of the log."""
    stderr.print(printable(line), soft_wrap=True, markup=False, **style)


@contextlib.contextmanager
def heard() -> Iterator[None]:
    """Make sure that the output of the block is written to stdout, unless the reader of stdout has left.

    Raises:
        UnheardError: if stdout cannot be written.
    """
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:  # as with `| head`, which has read enough
        _give_up(1)
    except OSError as error:
        _give_up(1)
        raise UnheardError(os.strerror(error.errno) if error.errno else str(error)) from error


def print_result(as_json: bool, result: Any, *tables: Any) -> None:
    """Print the result: one JSON object, or tables and lines for a person.

    Raises:
        UnheardError: if stdout cannot be written.
    """
    with heard():
        if as_json:
            sys.stdout.write(json.dumps(finite(result), allow_nan=False) + "\n")
        else:
            for table in tables:
                words = isinstance(table, str)
                for part in [table] if words else _fitted(table):
                    out.print(printable(part) if words else part, soft_wrap=words, crop=False)


def _fitted(table: Table) -> list[Table]:
    """The table, no wider than the terminal; if its columns do not fit side by side, a table for each row."""
    if _keep_whole(table) <= out.width or not (out.is_terminal or os.environ.get("COLUMNS")):
        return [table]
    if len(table.columns) < 3:
        return [table]
    rows = [Table(title=table.title if not number else None, show_header=False) for number in range(table.row_count)]
    for column in table.columns:
        for row, cell in zip(rows, column.cells, strict=True):
            row.add_row(str(column.header), cell)
    for row in rows:
        row.columns[1].overflow = "fold"
        _keep_whole(row)
    if rows:
        rows[-1].caption, rows[-1].caption_justify = table.caption, table.caption_justify
    return rows


def _keep_whole(table: Table) -> int:
    """Make a table so wide that rich cuts no number or word, even wider than the terminal; gives its width."""
    least = 1
    for column in table.columns:
        breaks = column.overflow == "fold" and not column.no_wrap  # texts may break anywhere, but not heads and numbers
        cells = (cell for cell in map(str, column.cells) if not breaks or cell[:1] in "-+.0123456789")
        texts = [str(column.header), *cells]
        pieces = [piece for text in texts for piece in (text.splitlines() if column.no_wrap else text.split())]
        column.min_width = max([column.min_width or 0, *map(cell_len, pieces)])
        least += column.min_width + 3  # a blank on either side, and a rule
    table.width = least if least > out.width else table.width
    return least


def require_name(name: str) -> None:
    """Refuse a name that our files cannot hold.

    Raises:
        InputError: saying what a name may be.
    """
    from gmem_jax.files.validation import NAME, title

    if not title(name):
        raise InputError(f"--name: must be a line of at most {NAME} printable characters")


def check_output(
    path: Path, suffix: str, *, inputs: tuple[Any, ...] = (), force: bool, option: str = "--output"
) -> Path:
    """Make sure that an output can be written and destroys nothing, before a long run; gives `path`.

    Args:
        path: the file to write.
        suffix: the suffix that its name must have; "" for any.
        inputs: files that the command reads, which are never replaced.
        force: whether a file that exists may be replaced.
        option: the option to name in an error.

    Raises:
        InputError: saying what is wrong, and what would be right.
    """
    folder = path.parent
    try:
        path.lstat()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise InputError(f"{option} {path}: this name is too long for the file system; shorten it") from None
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder; name a file")
    if not folder.is_dir():
        raise InputError(f"{option} {path}: folder {folder} does not exist")
    if suffix and path.suffix.lower() != suffix:
        raise InputError(f"{option} {path}: this is a {suffix} file; name it {path.with_suffix(suffix).name}")
    if os.path.lexists(path) and not path.is_file():
        raise InputError(f"{option} {path}: is neither a file nor free; name a file")
    for read in inputs:
        if path.exists() and Path(read).exists() and path.samefile(read):
            raise InputError(f"{option} {path}: is an input of this command; name another file")
    if path.exists() and not force:
        raise InputError(f"{option} {path}: exists; name another file, or allow its replacement with --force")
    if path.exists() and not _may_replace(path):
        raise InputError(
            f"{option} {path}: belongs to another user, and in {folder} only owners may replace files; name another"
        )
    try:
        probe(path)
    except OSError as error:
        raise InputError(f"{option} {path}: cannot write there ({error.strerror})") from error
    remove_leftovers(folder, path.name, age=WRITTEN)
    promise(path, replace=force)
    return path


def _may_replace(path: Path) -> bool:
    """Whether a file may be replaced; in a sticky folder, such as /tmp, only its owner and the folder's may."""
    folder = path.parent.stat()
    return not folder.st_mode & stat.S_ISVTX or os.geteuid() in (0, folder.st_uid, path.lstat().st_uid)


def announce(what: str, grain_steps: float, memory: float, backend: str, replicas: int = 1) -> dict[str, float]:
    """Say what a run will need before it begins, and refuse one that does not fit into the free memory.

    Args:
        what: a description of the run.
        grain_steps: grains times steps times replicas.
        memory: memory that it takes, in bytes.
        backend: the backend that computes the steps.
        replicas: number of replicas side by side; with several, a grain-step is cheaper than with one.

    Returns:
        The needs as numbers: grain_steps, seconds and memory_bytes.

    Raises:
        InputError: if the run takes too long or too much memory, saying what is needed and what there is.
        ValueError: if GMEM_THREADS is not a number of threads.
    """
    import psutil

    from gmem_jax.files.sizes import STEP_SECONDS, in_bytes, in_time
    from gmem_jax.native.library import require_threads

    if backend == "native":
        require_threads()
    free = psutil.virtual_memory().available
    seconds = STEP_SECONDS[backend][replicas > 1] * grain_steps
    if not seconds < LONGEST_DURATION:
        years = seconds / 3.15e7
        raise InputError(f"{what} would take {years:.0e} years; choose a larger dt, a smaller t0 or fewer grains")
    takes = f"{in_time(seconds)} on a free machine once compiled"
    needs = f"{takes}, and {in_bytes(memory)} of memory"
    if memory > free:
        raise InputError(f"{what} needs {needs}, and {in_bytes(free)} are free")
    log(f"{what}: {needs}{', in plain JAX' if backend == 'jax' else ''}")
    return {"grain_steps": grain_steps, "seconds": seconds, "memory_bytes": memory}


def emit_cost(as_json: bool, cost: dict[str, float], output: Path, disk_bytes: float) -> None:
    """Print the result of a dry run: the numbers of `announce`, and the disk space of the output."""
    from gmem_jax.files.sizes import in_bytes

    line = f"disk: {in_bytes(disk_bytes)} for {output}; nothing was run or written"
    print_result(as_json, {**cost, "disk_bytes": disk_bytes, "status": 0}, line)


def draw_beside(picture: Path | None, figure: "Callable[[], Figure]") -> str:
    """Draw a picture beside a result that is already written; an error becomes a warning, so that nothing is lost.

    Args:
        picture: file to write; None if no picture is wanted.
        figure: makes the figure.

    Returns:
        " and FILE", for the line that says what was written; "" if no picture was.

    Raises:
        RunInterruptedError: on Ctrl-C, saying that the result is there.
    """
    from gmem_jax.show.render_matplotlib import to_matplotlib

    if picture is None:
        return ""
    try:
        to_matplotlib(figure()).save(picture)
    except KeyboardInterrupt:
        raise RunInterruptedError(f"the result is written, its picture {picture} is not") from None
    except Exception as error:  # from matplotlib, with the user's fonts and settings
        why = " ".join(str(error).split()) or type(error).__name__
        log(f"warning: {picture}: could not be drawn ({why})", style="yellow")
        return ""
    return f" and {picture}"


@contextlib.contextmanager
def reporting(*, goes_on: bool = False) -> "Iterator[Progress]":
    """Show the progress of a run: a bar on a terminal; else a line for every stage, and one every 30 s at most.

    Args:
        goes_on: whether the same command, called again, goes on from where it was interrupted.
    """
    try:
        with _reporting() as progress:
            yield progress
    except KeyboardInterrupt:
        if goes_on:
            raise RunInterruptedError("the same command goes on from what is done") from None
        raise RunInterruptedError("nothing was written, and the same command begins anew") from None


@contextlib.contextmanager
def _reporting() -> "Iterator[Progress]":
    from rich import progress

    from gmem_jax.simulation.progress import TimeLeft, begins_anew

    if not stderr.is_terminal:
        told, at, time_left = "", -math.inf, TimeLeft()

        def line(stage: str, moment: float, fraction: float) -> None:
            nonlocal told, at
            now, left = time.perf_counter(), time_left(fraction)
            if stage == told and now - at < LOG_INTERVAL:
                return
            told, at = stage, now
            log(f"{fraction:5.0%}  {stage}" + (f" (t = {moment:.0f} t_c{left})" if moment else left))

        yield line
        return
    columns = (progress.TextColumn("{task.description}"), progress.BarColumn(), progress.TaskProgressColumn())
    times = (progress.TimeElapsedColumn(), progress.TextColumn("ETA"), progress.TimeRemainingColumn())
    with progress.Progress(*columns, *times, console=stderr) as bar:
        task = bar.add_task("compiling", total=1.0)

        def move(stage: str, moment: float, fraction: float) -> None:
            if begins_anew(fraction, bar.tasks[task].completed):
                bar.reset(task)
            bar.update(task, completed=fraction, description=f"{stage}, t = {moment:.0f} t_c" if moment else stage)

        yield move
