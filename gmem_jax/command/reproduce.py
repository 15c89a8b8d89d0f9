"""`gmem reproduce`."""

import math
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from gmem_jax.command.console import AsJson, InputError, emit, reporting, say
from gmem_jax.experiment.host import RunFailedError
from gmem_jax.files.atomic import probe
from gmem_jax.files.parts import locked
from gmem_jax.reproduce.figures import FIGURES, SCALES
from gmem_jax.reproduce.run import Outcome, judge, reproduce, summary_of
from gmem_jax.sweeps.executors import executor as executor_named


def reproduce_command(
    what: Annotated[str, typer.Argument(help=f"{', '.join(FIGURES)}, claims, or all.")],
    scale: Annotated[str, typer.Option(help=f"How large and slow: {', '.join(SCALES)}.")] = "laptop",
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for pictures, tables and runs.")] = Path(
        "reproduce"
    ),
    executor: Annotated[str, typer.Option(help="processes, slurm or local.")] = "processes",
    workers: Annotated[int | None, typer.Option(min=1, help="Workers; default 1 for 8 CPUs.")] = None,
    as_json: AsJson = False,
) -> None:
    """Run a figure of the paper again, beside the published points.

    Says what it will cost, resumes, and computes no point twice, whichever figures need it. Writes NAME-SCALE.png,
    .svg and .csv, each of our points beside the published one.
    """
    if what not in (*FIGURES, "claims", "all"):
        raise InputError(f"reproduce {what}: no such figure; there are {', '.join(FIGURES)}, claims and all")
    if scale not in SCALES:
        raise InputError(f"--scale {scale}: must be one of {', '.join(SCALES)}")
    if not output.parent.is_dir():
        raise InputError(f"--output {output}: folder {output.parent} does not exist")
    probe(output.parent)
    output.mkdir(exist_ok=True)
    outcomes, verdicts = [], []
    with locked(output / "figures"):
        if what in ("claims", "all"):
            with reporting(goes_on=True) as progress:
                verdicts = judge(output, scale, executor_named(executor, workers, {}), progress, say)
        for name in FIGURES if what == "all" else [name for name in FIGURES if name == what]:
            say(f"{name}: {FIGURES[name].title}")
            with reporting(goes_on=True) as progress:
                outcome = reproduce(name, output, scale, executor_named(executor, workers, {}), progress, say)
            outcomes.append(outcome)
            for reason in sorted(set(outcome.failed)):
                say(f"failed: {reason}", style="yellow")
            if outcome.files:
                say(f"wrote {', '.join(map(str, outcome.files))}")
    status = 0
    for outcome in outcomes:
        for row in outcome.rows:
            status |= row.status
    figures = [summary_of(outcome) for outcome in outcomes]
    result = {"figures": figures, "claims": [verdict._asdict() for verdict in verdicts], "status": status}
    lines = [f"{'yes' if verdict.holds else 'NO ':4}{verdict.claim}\n    {verdict.numbers}" for verdict in verdicts]
    emit(as_json, result, *lines, *map(_table, outcomes))
    if broken := sum(len(outcome.failed) for outcome in outcomes):
        raise RunFailedError(f"{broken} points")


def _table(outcome: Outcome) -> Table:
    """Ours beside the published, where conditions vary."""
    table = Table(title=outcome.name, caption="mean ± SE; difference in combined standard errors, for the same N")
    fields = [name for name in (outcome.rows[0].conditions.__dict__ if outcome.rows else ())]
    varied = [name for name in fields if len({getattr(row.conditions, name) for row in outcome.rows}) > 1]
    for name in (*varied, "", "ours", "packs", "published", "N", "apart"):
        table.add_column(name, justify="right")
    for row in outcome.rows:
        theirs = f"{row.theirs.mean:.3f}{_error(row.theirs.error)}" if row.theirs else ""
        apart = "" if math.isnan(row.errors_apart) else f"{row.errors_apart:+.1f}"
        ours = f"{row.ours.mean:.3f}{_error(row.ours.error)}"
        known = [str(getattr(row.conditions, name)) for name in varied]
        size = f"{row.grains:,}" if row.theirs else ""
        table.add_row(*known, row.measure, ours, str(row.ours.packs), theirs, size, apart)
    return table


def _error(value: float) -> str:
    return "" if math.isnan(value) else f" ± {value:.3f}"


COMMANDS = {"reproduce": reproduce_command}
