"""The command `gmem show`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from gmem_jax.command import sweep
from gmem_jax.command.console import AsJson, Force, InputError, check_output, heard, log, print_result, refuse_idle
from gmem_jax.show.render_matplotlib import PICTURE_FORMATS, to_matplotlib
from gmem_jax.show.stages import AGAINST, OBSERVED_PLOT, QUANTITIES
from gmem_jax.show.summaries import PLOTS, Draw, summary_of

SEEN = "what an observer gave, over the stages"
_OF_STAGES = {name.lower() for name in QUANTITIES}


def show(
    file: Annotated[
        Path, typer.Argument(help="Any file that a command wrote, the folder of a sweep, or a pack by its name.")
    ],
    as_json: AsJson = False,
    plot: Annotated[
        str, typer.Option(metavar="WHAT", help="Picture to draw into --output; list prints all of a file.")
    ] = "",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Picture to write: .png, .svg, .pdf.")] = None,
    against: Annotated[str, typer.Option(help="Horizontal axis of pictures of stages: time or u.")] = "time",
    signal: Annotated[
        str,
        typer.Option(
            metavar="N,N", help="Signals of a recall to draw, from 1; 0, the zero signal, in pictures of stages."
        ),
    ] = "",
    each: Annotated[bool, typer.Option("--each", help="Of a recall: print G and F of each signal.")] = False,
    x: Annotated[str, typer.Option("--x", metavar="NAME", help="Of a sweep: the name along the horizontal axis.")] = "",
    by: Annotated[
        str, typer.Option(metavar="NAMES", help="Of a sweep: names; a line for each combination of their values.")
    ] = "",
    over: Annotated[
        str,
        typer.Option(
            metavar="NAMES", help="Of a sweep: names to average over, with standard errors; default packs and seeds."
        ),
    ] = "",
    csv: Annotated[
        bool, typer.Option("--csv", help="Print the recalled signals as CSV; with --each, a row for each.")
    ] = False,
    force: Force = False,
) -> None:
    """What a file holds; with --plot, a picture of it.

    gmem show recall.h5 --plot signals -o x.png; gmem show recall.h5 --plot Z --against u -o z.png;
    gmem show recall.h5 --plot p_xy --signal 3 -o p.png
    gmem show mu --plot fidelity --x mu --by friction --over pack -o f.png
    """
    if against not in AGAINST:
        raise InputError(f"--against {against}: must be one of {', '.join(AGAINST)}")
    if plot:
        refuse_idle("beside --plot", "csv")
    if not plot or plot == "list":
        refuse_idle("unless something is drawn with --plot", "against", "force", "signal")
    elif plot.lower() not in _OF_STAGES and not plot.lower().startswith(OBSERVED_PLOT):
        refuse_idle(f"with --plot {plot}: only pictures of stages ({', '.join(QUANTITIES)}) have it", "against")
    if csv:
        refuse_idle("beside --csv", "as_json")
    chosen = _numbers(signal)
    axes = {"x": x, "by": sweep.split_names(by), "over": sweep.split_names(over)}
    if file.is_dir():
        if chosen:
            raise InputError(f"--signal {signal}: a sweep has no signals of its own; name the file of a point")
        if over and not plot:
            return sweep.show_sweep(sweep.there(file), over, as_json)
    else:
        for name in (name for name, value in axes.items() if value):
            raise InputError(f"{file}: --{name} is for the folder of a sweep")
    found = summary_of(file, against, chosen, each=each, **axes)
    if each and found.csv is None:
        raise InputError(f"{file}: --each gives the measures of each recalled signal; name the file of a recall")
    if plot:
        _draw(file, found.figures, plot, output, force, as_json)
    elif output is not None:
        raise InputError(f"--output {output}: say what to draw with --plot, one of {', '.join(found.figures)}")
    elif csv:
        if found.csv is None:
            raise InputError(f"{file}: --csv gives recalled signals; name the file of a recall")
        with heard():
            sys.stdout.write(found.csv(each=each))
    else:
        print_result(as_json, found.facts, *found.lines)


def _numbers(text: str) -> list[int]:
    """The numbers in --signal."""
    try:
        return [int(each) for each in text.split(",")] if text else []
    except ValueError:
        raise InputError(f"--signal {text}: must be numbers with commas between, as in 1,3") from None


def _draw(file: Path, pictures: dict[str, Draw], plot: str, output: Path | None, force: bool, as_json: bool) -> None:
    names = {name.lower(): name for name in pictures}
    if plot == "list":
        refuse_idle("with --plot list, which draws nothing", "output")
        lines = "\n".join(f"{name:17}  {_words(name)}" for name in pictures)
        return print_result(as_json, {"pictures": list(pictures), "status": 0}, lines)
    if plot.lower() not in names:
        raise InputError(f"--plot {plot}: there is no such picture of {file}; there are {', '.join(pictures)}")
    if output is None:
        raise InputError(f"--plot {plot}: name the picture with -o, as in -o {names[plot.lower()]}.png")
    if output.suffix.lower() not in PICTURE_FORMATS:
        raise InputError(f"--output {output}: must end in one of {', '.join(PICTURE_FORMATS)}")
    drawn = to_matplotlib(pictures[names[plot.lower()]]())
    drawn.save(check_output(output, "", inputs=(file,), force=force))
    log(f"wrote {output}")
    print_result(as_json, {"output": str(output), "status": 0})


def _words(picture: str) -> str:
    """The description of a picture."""
    what, *part = picture.split("/")
    return ": ".join(filter(None, (PLOTS.get(what, SEEN), ", ".join(part))))


COMMANDS = {"show": show}
