"""The command `gmem classify`."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich import progress

from gmem_jax.command.console import (
    BEGINS_ANEW,
    LOG_INTERVAL,
    AsJson,
    Force,
    InputError,
    Output,
    Picture,
    RunInterruptedError,
    check_output,
    draw_beside,
    log,
    print_result,
    stderr,
)
from gmem_jax.experiment.recall import Recall
from gmem_jax.files.recalls import load_recall
from gmem_jax.files.results import save_result
from gmem_jax.files.schemas import READING
from gmem_jax.files.waveforms import signals_from_dict
from gmem_jax.physics.state import combined_status, explain
from gmem_jax.show import summaries

if TYPE_CHECKING:
    from gmem_jax.reading import training


@contextlib.contextmanager
def _training(budget: float) -> Iterator["training.Listener"]:
    """Show loss and validation accuracy of a training: with a bar of its time on a terminal, else as lines."""

    def words(one: "training.Training") -> str:
        passed = f"seed {one.seed}: step {one.step}, loss {one.loss:.3f}"
        return f"{passed}, held-out accuracy {one.validation:.4f}"

    began = time.perf_counter()
    if not stderr.is_terminal:
        last = began

        def line(one: "training.Training") -> None:
            nonlocal last
            if one.finished or time.perf_counter() - last > LOG_INTERVAL:
                last = time.perf_counter()
                log(words(one))

        yield line
        return
    columns = (progress.TextColumn("{task.description}"), progress.BarColumn())
    more = (progress.TextColumn("of the time budget"), progress.TimeElapsedColumn())
    with progress.Progress(*columns, *more, console=stderr) as bar:
        task = bar.add_task("compiling", total=budget)
        yield lambda one: bar.update(task, completed=min(time.perf_counter() - began, budget), description=words(one))


def _chosen(found: Recall, file: Path, read: str, channel: str) -> Recall:
    """The part of a recall for the read and channel that were asked for."""
    for option, known, wanted in (("read", found.reads, read), ("channel", found.channels, channel)):
        if wanted not in known and (wanted or len(known) > 1):
            raise InputError(f"{file}: say --{option}, one of {', '.join(known)}")
    return found.at(read or 0, channel or 0)


def classify_command(
    recall: Annotated[Path, typer.Argument(help="A recall of binary words (gmem recall --signals words:L).")],
    output: Output = Path("classify.json"),
    seeds: Annotated[int, typer.Option(min=1, help="Number of nets to train, with seeds 0, 1, ...")] = 3,
    budget: Annotated[float, typer.Option(min=0.0, help="Longest training of one net, in s.")] = 300.0,
    nets: Annotated[
        Path | None,
        typer.Option(help="Folder of trained nets, which are used and added to; default gmem-nets beside the recall."),
    ] = None,
    read: Annotated[str, typer.Option(help="Name of the read; needed if the recall has several.")] = "",
    channel: Annotated[str, typer.Option(help="Name of the channel; needed if the recall has several.")] = "",
    picture: Picture = True,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Read recalled binary words: the paper's neural net, trained on inputs only, and two baselines.

    A net depends on the length of the words and its seed, not on the recall: nets in the folder are used again, and
    those that ran out of time are trained on.
    """
    kept = _chosen(load_recall(recall), recall, read, channel)
    configuration = kept.configuration
    # Imported here, since flax takes a second to load and no other command needs it.
    from gmem_jax.reading import report, training
    from gmem_jax.reading.lessons import TrainingConfig
    from gmem_jax.reading.readers import stored_words

    try:
        designed = configuration.get("target")
        stored = stored_words(kept, signals_from_dict(designed) if designed else None)
    except ValueError as error:
        raise InputError(f"{recall}: {error}; make one with gmem recall --signals words:L") from error
    check_output(output, ".json", inputs=(recall,), force=force)
    drawn = check_output(output.with_suffix(".png"), ".png", inputs=(recall,), force=force) if picture else None
    folder = recall.parent / "gmem-nets" if nets is None else nets
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--nets {folder}: cannot make this folder ({error.strerror})") from error
    log(f"{stored.bits}-bit words of pack {configuration['pack']}, background {stored.background.upper()}")
    if status := combined_status(kept.status):
        log(f"{recall}: {explain(status)}", style="yellow")
    began = time.perf_counter()
    trained: list[training.Training] = []
    for seed in range(seeds):
        file = check_output(folder / f"words-{stored.bits}-seed-{seed}.msgpack", "", force=True, option="--nets")
        try:
            with _training(budget) as listener:
                one = training.train_net(
                    TrainingConfig(stored.bits), seed, budget=budget, checkpoint=file, listener=listener
                )
        except KeyboardInterrupt:
            goes_on = f"the same command goes on with the nets in {folder}"
            raise RunInterruptedError(goes_on if trained or file.exists() else BEGINS_ANEW) from None
        trained.append(one)
        state = "trained" if one.finished else "out of time"
        log(f"seed {seed}: {state}, {one.step} steps, held-out accuracy {one.validation:.4f}")
    result = report.reading_report(stored, trained)
    seconds = time.perf_counter() - began
    result = {"recall": str(recall), "pack": configuration["pack"], "status": status, "seconds": seconds, **result}
    save_result(output, READING, result)
    summary = summaries.of_reading(result)
    log(f"wrote {output}{draw_beside(drawn, summary.figures['confusion'])}")
    print_result(as_json, result, *summary.lines)


COMMANDS = {"classify": classify_command}
