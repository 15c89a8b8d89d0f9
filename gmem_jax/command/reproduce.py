"""The command `gmem reproduce`."""

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from gmem_jax.command.console import AsJson, DryRun, InputError, log, print_result, reporting
from gmem_jax.command.resuming import check_folder
from gmem_jax.errors import RunFailedError
from gmem_jax.files.checkpoints import locked
from gmem_jax.physics.state import combined_status
from gmem_jax.reproduce import choices
from gmem_jax.reproduce.choices import Effect
from gmem_jax.reproduce.compare import Compared
from gmem_jax.reproduce.cost import spec_for_all
from gmem_jax.reproduce.dataset import COLLECTED
from gmem_jax.reproduce.figures import FIGURES, GALLERY, SCALES, scale_of
from gmem_jax.reproduce.run import RUNS, SCHEMATICS, Claims, Outcome, Reproduction, outcome_summary
from gmem_jax.show.tables import decimal
from gmem_jax.simulation.progress import Progress
from gmem_jax.sweeps.cost import cost_of
from gmem_jax.sweeps.executors import executor as executor_named
from gmem_jax.sweeps.executors import require_options
from gmem_jax.sweeps.store import Store

REPRODUCIBLE = sorted((*FIGURES, *SCHEMATICS, GALLERY, "claims", "choices", "dataset"))


def reproduce_command(
    what: Annotated[str, typer.Argument(help=f"{', '.join(REPRODUCIBLE)}, or all.")],
    scale: Annotated[
        str, typer.Option(help=f"How large and slow: {', '.join(SCALES)}; or changed, as in paper,t0=5400,packs=1.")
    ] = "laptop",
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for pictures, tables and runs.")] = Path(
        "reproduce"
    ),
    executor: Annotated[str, typer.Option(help="Who runs the points: processes, slurm or local.")] = "processes",
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of workers; default 1, or one for 8 CPUs with processes.")
    ] = None,
    option: Annotated[
        list[str] | None, typer.Option(help="Option of submitit as NAME=VALUE, like timeout_min=240; may be repeated.")
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Run failed points and packs again.")] = False,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Run a figure of the paper again, beside the published points.

    Says what it will cost, resumes, and computes no point twice, whichever figures need it. Writes NAME-SCALE.png,
    .svg and .csv, each of our points beside the published one; claims writes claims-SCALE.json. all leaves dataset out,
    which writes the recalls of the figures as one archive, dataset-SCALE.zip.
    """
    if what not in (*REPRODUCIBLE, "all"):
        raise InputError(f"reproduce {what}: no such figure; there are {', '.join(REPRODUCIBLE)} and all")
    try:
        scale_of(scale)
    except ValueError as error:
        raise InputError(f"--scale {scale}: {error}") from None
    options = _options(option or [])
    check_folder(output)
    if dry_run:
        require_options(executor, options)
        _say_cost(what, scale, output, workers or 1, as_json)
        return
    executor_named(executor, workers, options)  # refuses an impossible executor before anything is written
    output.mkdir(exist_ok=True)
    outcomes, tested, drawn = [], None, []
    weighed: Outcome[Effect] = Outcome("choices", [], [], {})
    archives: list[Path] = []
    broken: dict[str, str] = {}
    statuses: list[int] = []

    def wanted(names: Iterable[str]) -> list[str]:
        return [name for name in names if what in (name, "all")]

    def reproduction(progress: Progress) -> Reproduction:
        return Reproduction(output, scale, executor_named(executor, workers, options), progress, log, statuses)

    with locked(output / "figures", f"{output}: another run is writing it; call again when it has ended"):
        _require_ours(output, wanted(REPRODUCIBLE))
        if retry and (count := Store(output / RUNS).clear_failures()):
            log(f"trying what failed again: {count} of the points and packs")
        for name in wanted((GALLERY, *SCHEMATICS)):
            with _going_on(broken), reporting(goes_on=True) as progress:
                drawn += (pictures := reproduction(progress).picture(name))
                for path in pictures:
                    log(f"wrote {path}")
        if wanted(["claims"]):
            with _going_on(broken), reporting(goes_on=True) as progress:
                tested = reproduction(progress).claims()
                log(f"wrote {tested.path}")
        if wanted(["choices"]):
            with reporting(goes_on=True) as progress:
                weighed = reproduction(progress).sensitivity()
            _say_written(weighed)
        if what == "dataset":
            with reporting(goes_on=True) as progress:
                archives, broken = reproduction(progress).dataset()
            for path in archives:
                log(f"wrote {path}")
        for name in wanted(FIGURES):
            log(f"{name}: {FIGURES[name].title}")
            with reporting(goes_on=True) as progress:
                outcomes.append(reproduction(progress).figure(name))
            _say_written(outcomes[-1])
    result = {
        "figures": [outcome_summary(outcome) for outcome in outcomes],
        "claims": tested.rows() if tested else [],
        "choices": choices.effect_rows(weighed.rows),
        "pictures": [str(path) for path in drawn],
        "dataset": [str(path) for path in archives],
        "status": combined_status(statuses),
    }
    lines = _claims_lines(tested) if tested else []
    more = [_choices_table(weighed.rows)] if weighed.rows else []
    print_result(as_json, result, *lines, *more, *map(_table, outcomes))
    broken |= weighed.failed
    for outcome in outcomes:
        broken |= outcome.failed
    if broken:
        raise RunFailedError(f"{len(broken)} of the points and packs failed; try them again with --retry")


def _require_ours(output: Path, names: Iterable[str]) -> None:
    """Mark a folder as one of ours; refuse it if it is not and has files with the names of figures.

    Raises:
        InputError: naming such a file.
        FileFormatError: if the runs of the folder are something else.
    """
    if not (output / RUNS).exists():
        for taken in (path for name in names for path in output.glob(f"{name}[-.]*")):
            raise InputError(f"{taken}: is not of this command, and would be replaced; move it away, or use --output")
    if (nets := output / "nets").exists() and not nets.is_dir():
        raise InputError(f"{nets}: is a file, and a folder is needed; move it away")
    Store(output / RUNS)


def _say_cost(what: str, scale: str, output: Path, workers: int, as_json: bool) -> None:
    """Print the cost of the missing points, and the longest training of nets."""
    size, names = scale_of(scale), [name for name in (*FIGURES, GALLERY, "claims", "choices") if what in (name, "all")]
    names = list(COLLECTED) if what == "dataset" else names
    facts, lines = {}, ["seconds: no experiment is run"]
    if names:
        cost = cost_of(spec_for_all(names, scale), output / RUNS, workers=workers, only_packs=names == [GALLERY])
        facts, lines = cost._asdict(), cost.lines
    training = size.nets * len(size.lengths) * size.budget if "fig14" in names else 0.0
    lines += [f"nets: trained for {training / 60.0:.0f} min at most"] if training else []
    print_result(as_json, {**facts, "training_seconds": training, "status": 0}, *lines)


@contextlib.contextmanager
def _going_on(broken: dict[str, str]) -> Iterator[None]:
    """Report a run that fails in the block, and go on."""
    try:
        yield
    except RunFailedError as error:
        broken[str(error)] = str(error)
        log(f"failed: {error}", style="yellow")


def _options(texts: Sequence[str]) -> dict[str, Any]:
    """Options of an executor by name; values that look like numbers become numbers.

    Raises:
        InputError: if one does not read like timeout_min=240.
    """
    options: dict[str, Any] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if not (name and value):
            raise InputError(f"--option {text}: should read like timeout_min=240")
        if name in options:
            raise InputError(f"--option {name}: is given twice")
        options[name] = value
        for kind in (float, int):
            with contextlib.suppress(ValueError):
                options[name] = kind(value)
    return options


def _claims_lines(tested: Claims) -> list[str]:
    """The verdicts, below the conditions of their runs."""
    answers = {True: "yes", False: "NO", None: "?"}
    lines = [f"claims on one pack, {tested.pack}: {tested.grains:,} grains, t0 = {tested.t0:,.0f} t_c"]
    for verdict in tested.verdicts:
        lines += [f"{answers[verdict.holds]:4}{verdict.claim}", f"    {verdict.numbers}"]
        if verdict.holds is None:
            lines.append(f"    cannot be told: {verdict.why}")
    return lines


def _say_written(done: Outcome[Any]) -> None:
    for reason in sorted(set(done.failed.values())):
        log(f"failed: {reason}", style="yellow")
    if done.files:
        log(f"wrote {', '.join(map(str, done.files))}")


def _choices_table(effects: Sequence[Effect]) -> Table:
    """A table of the effects of choices; the default of each is in bold."""
    table = Table(title="What the paper leaves open", caption="mean ± SE over packs; changes on the same packs")
    for name in ("choice", "value", "G", "F", "change of G", "change of F"):
        table.add_column(name, justify="left" if name == "choice" else "right")
    for effect in effects:
        own = [decimal(one.mean, one.error) for one in (effect.gain, effect.fidelity)]
        change = [f"{100.0 * effect.of_gain.mean:+.1f} %", f"{effect.of_fidelity.mean:+.3f}"]
        known = (effect.choice.words, str(effect.value), *own, *(["", ""] if effect.default else change))
        table.add_row(*known, style="bold" if effect.default else None)
    return table


def _table(outcome: Outcome[Compared]) -> Table:
    """A table of our measures beside the published ones, with the conditions that vary."""
    table = Table(title=outcome.name, caption="mean ± SE; difference in combined standard errors, for the same N")
    fields = [name for name in (outcome.rows[0].conditions.__dict__ if outcome.rows else ())]
    varied = [name for name in fields if len({getattr(row.conditions, name) for row in outcome.rows}) > 1]
    for name in (*varied, "", "ours", "packs", "published", "N", "apart"):
        table.add_column(name, justify="right")
    for row in outcome.rows:
        theirs = decimal(row.theirs.mean, row.theirs.error) if row.theirs else ""
        apart = "" if math.isnan(row.errors_apart) else f"{row.errors_apart:+.1f}"
        ours = decimal(row.ours.mean, row.ours.error)
        known = [str(getattr(row.conditions, name)) for name in varied]
        size = f"{row.grains:,}" if row.theirs else ""
        table.add_row(*known, row.measure, ours, str(row.ours.packs), theirs, size, apart)
    return table


COMMANDS = {"reproduce": reproduce_command}
