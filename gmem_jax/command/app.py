"""The `gmem` command. Exit code 0: done; 2: bad input, said in one line; 1: the run failed; 130: interrupted."""

import os
import sys
import warnings
from typing import Any

import jax
import typer
from typer.exceptions import TyperException

from gmem_jax.command import benchmark, classify, derive, exchange, packs, recalls, report, reproduce, show, sweep
from gmem_jax.command.console import RunInterruptedError, UnheardError, say
from gmem_jax.experiment.host import RunFailedError
from gmem_jax.files.programs import keep_programs

INTERRUPTED = 130

app = typer.Typer(rich_markup_mode=None, help="Waveform memory in granular packs.")
for group in (packs, recalls, show, exchange, classify, derive, sweep, report, reproduce, benchmark):
    for name, command in group.COMMANDS.items():
        app.command(name)(command)


def _one_line(message: Warning | str, *_: Any, **__: Any) -> None:
    say(f"warning: {' '.join(str(message).split())}", style="yellow")


def _open_streams() -> None:
    """Give closed standard streams a place to write to, which no file that is opened later may become."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115


def main() -> None:
    """Entry point of the `gmem` command."""
    _open_streams()
    jax.config.update("jax_enable_x64", True)
    keep_programs()
    warnings.showwarning = _one_line
    try:
        code = app(args=sys.argv[1:] or ["--help"], prog_name="gmem", standalone_mode=False)
        if code == INTERRUPTED:  # typer's word for Ctrl-C outside of a run
            raise KeyboardInterrupt
        sys.exit(code if isinstance(code, int) else 0)
    except TyperException as error:
        problem = error.format_message()
    except (ValueError, OSError) as error:
        problem = " ".join(str(error).split())
    except RunFailedError as error:
        say(f"gmem: the run failed: {error}", style="red")
        sys.exit(1)
    except RunInterruptedError as error:
        say(f"gmem: interrupted; {error}")
        sys.exit(INTERRUPTED)
    except (KeyboardInterrupt, typer.Abort):
        say("gmem: interrupted; nothing was written, and the same command begins anew")
        sys.exit(INTERRUPTED)
    except UnheardError as error:
        problem = f"stdout takes no result ({error}); files that were to be written are complete"
    except MemoryError:
        problem = "out of memory; use fewer replicas (--batch) or a smaller pack"
    say(f"gmem: {problem}", style="red")
    sys.exit(2)
