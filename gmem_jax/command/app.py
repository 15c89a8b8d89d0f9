"""The `gmem` command. Exit code 0: done; 2: bad input, said in one line; 1: the run failed; 130: interrupted."""

import sys
import warnings
from typing import Any

import jax
import typer
from typer.exceptions import TyperException

from gmem_jax.command import benchmark, classify, derive, exchange, packs, recalls, report, reproduce, show, sweep
from gmem_jax.command.console import RunInterruptedError, say
from gmem_jax.errors import RunFailedError
from gmem_jax.files.programs import keep_programs
from gmem_jax.physics.rules import StartError, usual_rules, why_not_started
from gmem_jax.simulation.progress import no_further_bar

app = typer.Typer(rich_markup_mode=None, help="Waveform memory in granular packs.")
for group in (packs, recalls, show, exchange, classify, derive, sweep, report, reproduce, benchmark):
    for name, command in group.COMMANDS.items():
        app.command(name)(command)


def _one_line(message: Warning | str, *_: Any, **__: Any) -> None:
    say(f"warning: {' '.join(str(message).split())}", style="yellow")


_OUT_OF_MEMORY = "out of memory; use fewer replicas (--batch) or a smaller pack"
_NATIVE = "gmem_jax native: "  # what the library's own refusals begin with


def _of_jax(error: Exception) -> str:
    """What an error says that no line of ours raised, where the machine or its settings are at fault; else ""."""
    said = " ".join(str(error).split())
    if isinstance(error, StartError):
        return said
    if isinstance(error, jax.errors.JaxRuntimeError) and _NATIVE in said:
        return said.partition(_NATIVE)[2]
    if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in said:
        return _OUT_OF_MEMORY
    return why_not_started()


def main() -> None:
    """The `gmem` command, once all is imported; see `gmem_start`."""
    jax.config.update("jax_enable_x64", True)
    keep_programs()
    warnings.showwarning = _one_line
    if getattr(jax.config, "jax_disable_jit", False):
        say("warning: JAX_DISABLE_JIT is set: nothing is compiled, and a run takes hours for seconds", style="yellow")
    try:
        with no_further_bar(), usual_rules():
            code = app(args=sys.argv[1:] or ["--help"], prog_name="gmem", standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except TyperException as error:
        problem = error.format_message()
    except (ValueError, OSError) as error:
        problem = " ".join(str(error).split())
    except RunFailedError as error:
        say(f"gmem: the run failed: {error}", style="red")
        sys.exit(1)
    except RunInterruptedError:
        say("gmem: interrupted; the same command goes on from the finished parts")
        sys.exit(130)
    except (KeyboardInterrupt, typer.Abort):
        say("gmem: interrupted; nothing was written, and the same command begins anew")
        sys.exit(130)
    except MemoryError:
        problem = _OUT_OF_MEMORY
    except Exception as error:
        problem = _of_jax(error)
        if not problem:
            raise
    say(f"gmem: {problem}", style="red")
    sys.exit(2)
