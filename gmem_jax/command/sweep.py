"""The command `gmem sweep`."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from gmem_jax.command.console import (
    AsJson,
    DryRun,
    Force,
    InputError,
    check_output,
    log,
    print_result,
    refuse_idle,
    reporting,
)
from gmem_jax.command.resuming import check_folder
from gmem_jax.errors import FileFormatError, RunFailedError
from gmem_jax.files.checkpoints import locked
from gmem_jax.physics.numbers import plural
from gmem_jax.show.sweeps import means_table, points_table, sweep_facts
from gmem_jax.sweeps.cost import cost_of
from gmem_jax.sweeps.executors import executor as executor_named
from gmem_jax.sweeps.executors import require_options
from gmem_jax.sweeps.making import AS_THEY_ARE
from gmem_jax.sweeps.processes import stop, waiting
from gmem_jax.sweeps.spec import Spec, read_spec
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.sweep import SweepRunner
from gmem_jax.sweeps.table import TABLE_FORMATS, doubts, export_table, means, names_in, points_in, rows

VERBS = ("status", "show", "export", "stop")
RUN = ("executor", "workers", AS_THEY_ARE)


def sweep_command(
    what: Annotated[str, typer.Argument(help="A sweep file (.toml) to run; or a verb: status, show, export, stop.")],
    folder: Annotated[Path | None, typer.Argument(help="With a verb: the folder of the sweep.")] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", help="Folder of the sweep, default the name of its file; with export, the table to write."
        ),
    ] = None,
    executor: Annotated[
        str, typer.Option(help="processes, slurm or local; default as in the file, else processes.")
    ] = "",
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of workers; default as in the file, else 1, or one for 8 CPUs with processes."
        ),
    ] = None,
    over: Annotated[str, typer.Option(help="With show: names to average over, separated by commas.")] = "",
    retry: Annotated[bool, typer.Option("--retry", help="Run failed points again.")] = False,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Vary anything: packs made once, points side by side, results kept by content; resumes, and grows.

    gmem sweep mu.toml; gmem sweep status mu; gmem sweep show mu --over pack; gmem sweep export mu -o mu.csv;
    gmem sweep stop mu
    """
    if what in VERBS:
        refuse_idle(f"with {what}: it runs no points", "executor", "workers", "retry")
        if what != "show":
            refuse_idle(f"with {what}; use it with gmem sweep show", "over")
        if what != "export":
            refuse_idle(f"with {what}, which writes no file", "output", "force")
        if folder is None:
            raise InputError(f"gmem sweep {what}: name the folder of a sweep")
        store = there(folder)
        if what == "export":
            _export(store, output, force, as_json)
        elif what == "status":
            _status(store, as_json)
        elif what == "stop":
            _stop(store, as_json)
        else:
            show_sweep(store, over, as_json)
        return
    if folder is not None and Path(what).suffix == ".toml":
        raise InputError(f"{folder}: does nothing after a sweep file; name its folder with -o {folder}")
    refuse_idle("when a sweep runs: a sweep goes on in its folder and replaces nothing", "force")
    refuse_idle("when a sweep runs; use it with gmem sweep show FOLDER", "over")
    path = Path(what)
    if path.suffix != ".toml":
        raise InputError(f"{what}: neither a sweep file (.toml) nor one of {', '.join(VERBS)}")
    spec = read_spec(path)
    options = {name: value for name, value in spec.run.items() if name not in RUN}
    count = workers or spec.run.get("workers")
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise InputError(f"{path}: workers must be a whole number from 1, got {count!r}")
    target = output or path.with_suffix("")
    kind = executor or str(spec.run.get("executor", "processes"))
    if dry_run:
        require_options(kind, options)
        with _of_file(path):
            cost = cost_of(spec, target, workers=count or 1)
        print_result(as_json, {"folder": str(target), **cost._asdict(), "status": 0}, *cost.lines)
        return
    chosen = executor_named(kind, count, options)
    check_folder(target)
    with locked(target), reporting(goes_on=True) as progress:
        runner = planned(path, spec, target)
        if retry and (count := runner.store.clear_failures()):
            log(f"trying {plural(count, 'failed point')} again")
        runner.run(chosen, progress)
    table = rows(runner.store)
    failed = [row for row in table if row["state"] == "failed"]
    for row in failed[:3]:
        log(f"failed: {_values(row, spec.names)}: {row['why']}", style="yellow")
    for line in doubts(table):
        log(f"warning: {line}", style="yellow")
    count = len(points_in(table))
    log(f"{count - len(failed)} of {plural(count, 'point')} in {target}; gmem sweep show {target}")
    print_result(as_json, sweep_facts(runner.store, table), points_table(table, spec.names))
    if failed:
        raise RunFailedError(f"{len(failed)} of {plural(count, 'point')} failed; try them again with --retry")


def planned(path: Path, spec: Spec, folder: Path) -> SweepRunner:
    """The sweep of a file, after a check that its points are possible.

    Raises:
        FileFormatError: if one is not, or the folder holds something else.
    """
    with _of_file(path):
        runner = SweepRunner(spec, folder, log)
        runner.check()  # writes nothing if it refuses
    return runner


@contextlib.contextmanager
def _of_file(path: Path) -> Iterator[None]:
    """Turn errors of the values in a sweep file into errors of the file."""
    try:
        yield
    except (ValueError, TypeError, FileNotFoundError) as error:
        raise FileFormatError(f"{path}: {' '.join(str(error).split())}") from error


def there(folder: Path) -> Store:
    """The sweep in a folder.

    Raises:
        InputError: if there is no such folder.
        FileFormatError: if it holds no sweep.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    return Store(folder, make=False)


def _values(row: dict[str, Any], names: list[str]) -> str:
    return ", ".join(f"{name} = {row[name]}" for name in names)


def _status(store: Store, as_json: bool) -> None:
    table = rows(store)
    summary = sweep_facts(store, table)
    lines = [f"{summary[state]} {state}" for state in ("done", "failed", "open")]
    taken = {job["name"] for job in store.jobs() if store.taken(job)}
    at_work = [one for one in store.progress() if one["job"].partition("-")[0] in taken]
    busy = [f"{one['what']}, {one['fraction']:.0%}" for one in at_work if one["fraction"] < 1.0]
    reasons = sorted({row["why"] for row in table if row["state"] == "failed"})
    problems = [*(f"failed: {reason}" for reason in reasons), *(f"warning: {line}" for line in doubts(table))]
    waits = waiting(store)
    print_result(as_json, {**summary, "waiting": waits}, ", ".join(lines), *busy, *waits, *problems)


def split_names(text: str) -> list[str]:
    """Names separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _stop(store: Store, as_json: bool) -> None:
    """End all processes and jobs of a sweep; finished points stay."""
    ended, left = stop(store)
    for line in left:
        log(line, style="yellow")
    told = [f"ended {one}" for one in ended] or ([] if left else ["nobody is at work here"])
    print_result(as_json, {"folder": str(store.folder), "ended": ended, "left": left}, *told)
    if left:
        raise RunFailedError(f"{plural(len(left), 'worker')} cannot be ended from here")


def show_sweep(store: Store, over: str, as_json: bool) -> None:
    """Print the points of a sweep, or means over some names, separated by commas."""
    table = rows(store)
    names = names_in(table, store.card()["names"])
    averaged = split_names(over)
    if unknown := sorted(set(averaged) - set(names)):
        raise InputError(f"--over {unknown[0]}: does not vary here; {', '.join(names)} do")
    if averaged:
        found = means(table, names, averaged)
        print_result(
            as_json,
            {"folder": str(store.folder), "means": found},
            means_table(found, [name for name in names if name not in averaged]),
        )
    else:
        print_result(as_json, sweep_facts(store, table), points_table(table, names))


def _export(store: Store, output: Path | None, force: bool, as_json: bool) -> None:
    if output is None or output.suffix.lower() not in TABLE_FORMATS:
        raise InputError(f"gmem sweep export: name a file with -o that ends in one of {', '.join(TABLE_FORMATS)}")
    check_output(output, "", force=force)
    about = export_table(store, output)
    log(f"wrote {output}" + (f": {about}" if about else ""))
    print_result(as_json, {"output": str(output), "about": about, "status": 0})


COMMANDS = {"sweep": sweep_command}
