"""`gmem show`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from gmem_jax.command import sweep
from gmem_jax.command.console import AsJson, Force, InputError, claim, emit, heard, say
from gmem_jax.show.drawing import FORMATS
from gmem_jax.show.kinds import Draw, shown, sweep_pictures
from gmem_jax.show.stages import AGAINST


def show(
    file: Annotated[
        Path, typer.Argument(help="Any file that a command wrote, the folder of a sweep, or a pack by its name.")
    ],
    as_json: AsJson = False,
    plot: Annotated[str, typer.Option(metavar="WHAT", help="Draw this into --output; list says what there is.")] = "",
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Picture to write: .png, .svg, .pdf.")] = None,
    against: Annotated[str, typer.Option(help="What stages are drawn over: time or u.")] = "time",
    csv: Annotated[bool, typer.Option("--csv", help="Print the recalled signals as CSV.")] = False,
    force: Force = False,
) -> None:
    """What a file holds; with --plot, a picture of it.

    gmem show recall.h5 --plot signals -o x.png; gmem show recall.h5 --plot Z --against u -o z.png
    """
    if against not in AGAINST:
        raise InputError(f"--against {against}: must be one of {', '.join(AGAINST)}")
    folder = file.is_dir()
    if folder:
        store = sweep.there(file)
        pictures = sweep_pictures(store)
    else:
        found = shown(file, against)
        pictures = found.pictures
    if plot:
        _draw(file, pictures, plot, output, force)
    elif output is not None:
        raise InputError(f"--output {output}: say what to draw with --plot, one of {', '.join(pictures)}")
    elif csv:
        if folder or found.csv is None:
            raise InputError(f"{file}: --csv gives recalled signals, and this is no recall")
        with heard():
            sys.stdout.write(found.csv())
    elif folder:
        sweep.show(store, "", as_json)
    else:
        emit(as_json, found.facts, *found.lines)


def _draw(file: Path, pictures: dict[str, Draw], plot: str, output: Path | None, force: bool) -> None:
    names = {name.lower(): name for name in pictures}
    if plot == "list":
        with heard():
            sys.stdout.write("\n".join(pictures) + "\n")
        return
    if plot.lower() not in names:
        raise InputError(f"--plot {plot}: there is no such picture of {file}; there are {', '.join(pictures)}")
    if output is None:
        raise InputError(f"--plot {plot}: name the picture with -o, as in -o {names[plot.lower()]}.png")
    if output.suffix.lower() not in FORMATS:
        raise InputError(f"--output {output}: must end in one of {', '.join(FORMATS)}")
    pictures[names[plot.lower()]](claim(output, "", inputs=(file,), force=force))
    say(f"wrote {output}")


COMMANDS = {"show": show}
