"""The `gmem` command. Exit code 0: done; 2: bad input, said in one line; 1: the run failed; 130: interrupted."""

import io
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.exceptions import TyperException

import gmem_start
from gmem_jax.command.console import GIVEN, RunInterruptedError, UnheardError, log, print_result
from gmem_jax.errors import RunFailedError
from gmem_jax.experiment.provenance import versions

INTERRUPTED = 130
_LISTED = {  # the commands in their order: the module of each, and the beginning of its help for `gmem --help`
    "info": ("info", "Versions, devices, backend and shipped packs."),
    "prepare": ("packs", "Prepare a pack: gas, pressure, frictionless cycles, rest."),
    "recall": ("recalls", "Store waveforms in a pack and recall them."),
    "demo": ("recalls", "The main job: six waveforms stored in a pack and recalled."),
    "show": ("show", "What a file holds; with --plot, a picture of it."),
    "export": ("exchange", "Write a pack or the frames of a recall for other programs."),
    "import": ("exchange", "Make a pack of spheres or clumps of one shape, of any sizes."),
    "classify": ("classify", "Read recalled binary words."),
    "gradient": ("derive", "Exact derivatives of the fidelity."),
    "kernel": ("derive", "The linear memory kernel of a pack."),
    "design": ("derive", "Pre-distort waveforms so that recalls follow their integrals."),
    "tune": ("derive", "Choose gamma0, mu and the friction stiffness within bounds."),
    "sweep": ("sweep", "Vary anything: packs made once, points side by side."),
    "report": ("report", "One page of all that files hold, to be looked at in a browser."),
    "reproduce": ("reproduce", "Run a figure of the paper again, beside the published points."),
    "bench": ("benchmark", "Measure what a grain-step costs."),
}
_ELSEWHERE = {  # words that are not commands, nor spelt like one, and how to do what they mean
    "view": "gm.view shows a pack or a recall in a notebook, gmem report FILE as a page for a browser",
    "run": "gmem recall runs an experiment, gmem sweep many",
    "plot": "gmem show FILE --plot WHAT -o x.png draws what a file holds",
    "train": "gmem classify trains nets and reads recalled words",
    "convert": "gmem export writes a pack or a recall for other programs, gmem import reads a pack of theirs",
    "list": "gmem info lists the packs, gmem show FILE says what a file holds",
    "help": "gmem --help, or gmem COMMAND --help",
    "version": "gmem --version",
}


def _typer_s_own_are_off(params: list[Any]) -> list[Any]:
    """The parameters, with False as default of --help and the like: for None typer imports pydantic, in 0.1 s."""
    for one in params:
        if not one.expose_value and one.default is None:
            one.default = False
    return params


class _Commands(TyperGroup):
    """The list of commands. The modules of a command, and JAX, are imported when it is called or its help is shown."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        for name, (_, line) in _LISTED.items():
            self.add_command(TyperCommand(name, help=line, rich_markup_mode=None))

    def get_params(self, ctx: Any) -> list[Any]:
        return _typer_s_own_are_off(super().get_params(ctx))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        try:
            name, command, others = super().resolve_command(ctx, args)
        except TyperException as error:
            if args[0] in _ELSEWHERE:
                error.message = f"No such command {args[0]!r}: {_ELSEWHERE[args[0]]}"
            elif "Did you mean" not in error.message:
                error.message = f"No such command {args[0]!r}; there are {', '.join(self.commands)}"
            raise
        return name, command and command_named(str(name)), others


def _longest(names: list[str]) -> list[str]:
    return sorted(names, key=len)[-1:]


class _Command(TyperCommand):
    def get_params(self, ctx: Any) -> list[Any]:
        return _typer_s_own_are_off(super().get_params(ctx))

    def invoke(self, ctx: Any) -> Any:
        typed = [one for one in self.params if "COMMANDLINE" in str(ctx.get_parameter_source(str(one.name)))]
        GIVEN.set({str(one.name): "/".join(_longest(one.opts) + _longest(one.secondary_opts)) for one in typed})
        gmem_start.imported()
        at_once = self.name == "info" and "jax" not in sys.modules  # these rules import JAX, which takes a second
        with nullcontext() if at_once else _rules_of_commands():
            return super().invoke(ctx)


def command_named(name: str) -> Any:
    """A command with its options.

    Raises:
        ValueError: if JAX refuses a setting of the user's.
    """
    try:
        module = import_module(f"gmem_jax.command.{_LISTED[name][0]}")
    except ValueError as error:  # JAX's, for JAX_ENABLE_X64=maybe and the like
        raise ValueError(f"cannot start: {error}") from error
    only = typer.Typer(rich_markup_mode=None, add_completion=False)
    only.command(name, cls=_Command)(module.COMMANDS[name])
    return typer.main.get_command(only)


@contextmanager
def _rules_of_commands() -> Iterator[None]:
    """Set up JAX for commands: double precision, and a cache of compiled programs."""
    import jax

    from gmem_jax.files.compilation_cache import keep_programs
    from gmem_jax.physics.rules import usual_rules
    from gmem_jax.simulation.progress import no_further_bar

    jax.config.update("jax_enable_x64", True)
    keep_programs()
    if getattr(jax.config, "jax_disable_jit", False):
        log("warning: JAX_DISABLE_JIT is set: nothing is compiled, and a run takes hours for seconds", style="yellow")
    with no_further_bar(), usual_rules():
        yield


app = typer.Typer(cls=_Commands, rich_markup_mode=None, help="Waveform memory in granular packs.")


def _version(wanted: bool) -> None:
    if wanted:
        print_result(False, {}, f"gmem-jax {versions()['gmem-jax']}")
        raise typer.Exit


@app.callback()
def _gmem(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


def _one_line(message: Warning | str, *_: Any, **__: Any) -> None:
    log(f"warning: {' '.join(str(message).split())}", style="yellow")


_OUT_OF_MEMORY = "out of memory; use fewer replicas (--batch) or a smaller pack"
_NATIVE = "gmem_jax native: "  # prefix of the errors of the native library


def _of_jax(error: Exception) -> str:
    """The message for an error that JAX raised because of the machine or its settings; else ""."""
    import jax

    from gmem_jax.physics.rules import StartError, why_not_started

    said = " ".join(str(error).split())
    if isinstance(error, StartError):
        return said
    if isinstance(error, jax.errors.JaxRuntimeError) and _NATIVE in said:
        return said.partition(_NATIVE)[2]
    if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in said:
        return _OUT_OF_MEMORY
    return why_not_started()


def _open_streams() -> None:
    """Open closed standard streams on the null device, so that no file opened later gets their numbers.

    Letters that the locale cannot write become question marks, so that a result is never cut off by one.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def main() -> None:
    """The `gmem` command, between its start and its end in `gmem_start`."""
    _open_streams()
    warnings.showwarning = _one_line
    try:
        code = app(args=sys.argv[1:] or ["--help"], prog_name="gmem", standalone_mode=False)
        if code == INTERRUPTED:  # typer's code for Ctrl-C outside of a run
            raise KeyboardInterrupt
        sys.exit(code if isinstance(code, int) else 0)
    except TyperException as error:
        problem = error.format_message()
    except (ValueError, OSError) as error:
        problem = " ".join(str(error).split())
    except OverflowError as error:
        problem = f"a number is too large ({error})"
    except RunFailedError as error:
        log(f"gmem: the run failed: {error}", style="red")
        sys.exit(1)
    except RunInterruptedError as error:
        log(f"gmem: interrupted; {error}")
        sys.exit(INTERRUPTED)
    except (KeyboardInterrupt, typer.Abort):
        log("gmem: interrupted; nothing was written, and the same command begins anew")
        sys.exit(INTERRUPTED)
    except UnheardError as error:
        problem = f"stdout takes no result ({error}); files that were to be written are complete"
    except MemoryError:
        problem = _OUT_OF_MEMORY
    except Exception as error:
        problem = _of_jax(error)
        if not problem:
            raise
    log(f"gmem: {problem}", style="red")
    sys.exit(2)
