"""The commands `gmem recall` and `gmem demo`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import typer

from gmem_jax.command.console import (
    AsJson,
    DryRun,
    Force,
    InputError,
    KeptFrames,
    Output,
    PackName,
    Picture,
    announce,
    check_output,
    draw_beside,
    emit_cost,
    log,
    print_result,
    refuse_idle,
    reporting,
)
from gmem_jax.command.options import ExperimentOptions, with_experiment
from gmem_jax.command.resuming import Restart, batch_for, foresee, resumable
from gmem_jax.experiment.analysis import spread
from gmem_jax.experiment.cost import run_bytes, steps_of_grains
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.record import key_of_run, signals_to_dict
from gmem_jax.experiment.run import frame_schedule, run
from gmem_jax.experiment.signals import Signals, six_signals
from gmem_jax.experiment.stepping import at_accuracy, require_stable, stable_step
from gmem_jax.files.cache import list_packs
from gmem_jax.files.packs import load_pack
from gmem_jax.files.recalls import save_recall
from gmem_jax.files.sizes import recall_bytes, sample_bytes
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.numbers import plural
from gmem_jax.physics.state import combined_status
from gmem_jax.show import tables
from gmem_jax.show.summaries import Summary, of_recall

TYPICAL = "tetra-325-e"  # the pack with the median F among the five shipped packs of 325 grains
SHIPPED: dict[str, Any] = {
    "packs": 5,
    "gain": (0.225, 0.040),
    "fidelity": (0.803, 0.096),
}  # mean and SD over these five packs, as `demo` runs them


def _announce(experiment: Experiment, batch: int) -> dict[str, float]:
    """Say what a recall in batches will need."""
    work = steps_of_grains(experiment, batch)
    backend = experiment.runs_on
    side_by_side = min(batch, experiment.signals.count)
    what = f"{experiment.pack.grains} grains, {plural(experiment.signals.count, 'signal')}"
    memory = run_bytes(experiment, side_by_side) + sample_bytes(experiment)
    return announce(what, work, memory, backend, side_by_side + 1)


def _run(
    experiment: Experiment,
    data: Path,
    picture: Path | None,
    batch: int | None = None,
    *,
    restart: bool = False,
    target: Signals | None = None,
    frames: int = 0,
    frames_of: int = 1,
    frames_at: Sequence[float] = (),
) -> Summary:
    """Run one recall with a progress bar and write it; gives its summary."""
    batch = batch_for(experiment, data, batch, restart=restart)
    _announce(experiment, batch)
    film: Any = {"frames": frames, "frames_of": frames_of, "frames_at": list(frames_at)}
    with resumable(data, key_of_run(experiment, batch=batch, **film), restart=restart) as parts:
        with reporting(goes_on=True) as progress:
            recall = jax.block_until_ready(run(experiment, batch=batch, cache=parts, progress=progress, **film))
        configuration = recall.configuration
        if target is not None:
            configuration["target"] = signals_to_dict(target)
        recall = recall.described(configuration)
        save_recall(data, recall)
    summary = of_recall(recall)
    log(f"wrote {data}{draw_beside(picture, summary.figures['signals'])}")
    row = {**summary.facts, "seconds": configuration["seconds"], "output": str(data)}
    if row["status"]:
        log(f"warning: {row['status_text']}", style="yellow")
    return replace(summary, facts=row)


@with_experiment
def recall_command(
    chosen: ExperimentOptions,
    pack: PackName,
    output: Output = Path("recall.h5"),
    batch: Annotated[
        int | None, typer.Option(min=1, help="Number of signals run together; default as many as fit the free memory.")
    ] = None,
    frames: KeptFrames = 0,
    frames_of: Annotated[
        int, typer.Option(min=0, help="Number of the signal whose configurations are kept, from 1; 0: the zero signal.")
    ] = 1,
    frames_at: Annotated[
        str, typer.Option(metavar="U,U", help="Keep configurations wherever u passes these, as in 0,0.5,1.")
    ] = "",
    accuracy: Annotated[
        float | None, typer.Option(help="Relative error of G that is accepted, 0.002 to 0.1; chooses t0 and dt.")
    ] = None,
    restart: Restart = False,
    dry_run: DryRun = False,
    picture: Picture = True,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Store waveforms in a pack and recall them."""
    (experiment,), drawn = chosen.check_output([pack], output, ".h5", picture=picture, force=force)
    if accuracy is not None:
        refuse_idle("with --accuracy, which chooses t0 and dt", "t0", "dt")
        experiment = at_accuracy(experiment, accuracy)
        said = f"t0 = {float(np.max(experiment.t0)):.5g} t_c, dt = {float(np.max(experiment.timing.dt)):.3g} t_c"
        log(f"{said}; up to {stable_step(experiment):.3g} t_c are stable")
    target = chosen.target(experiment.signals.count)
    at = _compressions(frames_at)
    if not frames and not at:
        refuse_idle("without --frames or --frames-at, which say how many", "frames_of")
    require_stable(experiment)  # impossible options are refused before anything is begun
    frame_schedule(experiment, frames, frames_of, at)
    film: Any = {"frames": frames, "frames_of": frames_of, "frames_at": at}
    if dry_run:
        batch = batch_for(experiment, output, batch, restart=restart)
        cost = _announce(experiment, batch)
        dt, cost["stable_step"] = float(np.max(experiment.timing.dt)), stable_step(experiment)
        log(f"steps of {dt:.3g} t_c; up to {cost['stable_step']:.3g} t_c are stable")
        foresee(output, key_of_run(experiment, batch=batch, **film), restart=restart)
        emit_cost(as_json, cost, output, recall_bytes(experiment, frames))
        return
    summary = _run(experiment, output, drawn, batch, restart=restart, target=target, **film)
    print_result(as_json, summary.facts, *summary.lines)


def _compressions(text: str) -> list[float]:
    """The compressions in --frames-at."""
    try:
        return [float(each) for each in text.split(",")] if text else []
    except ValueError:
        raise InputError(
            f"--frames-at {text}: must be numbers from 0 to 1 with commas between, as in 0,0.5,1"
        ) from None


def demo(
    packs: Annotated[
        str, typer.Option(help="all, or names of shipped packs, separated by commas; default one typical pack.")
    ] = "",
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write to.")] = Path("gmem-demo"),
    mu: Annotated[float, typer.Option(help="Friction coefficient.")] = 1.0,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """The main job: six waveforms stored in a pack and recalled; table, recall.h5 and recall.png."""
    shipped = list_packs()
    default = [name for name in shipped if name.startswith("tetra-325")]
    names = default if packs == "all" else packs.split(",") if packs else [TYPICAL]
    unknown = [name for name in names if name not in shipped]
    if unknown:
        raise InputError(f"--packs {unknown[0]}: no such shipped pack; there are {', '.join(shipped)}")
    law = Hooke(mu=mu)
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--output {output}: cannot make this folder ({error.strerror})") from error
    stems = [output / ("recall.h5" if len(names) == 1 else f"recall-{name}.h5") for name in names]
    for data in stems:
        check_output(data, ".h5", force=force)
        check_output(data.with_suffix(".png"), ".png", force=force)
    rows = []
    for name, data in zip(names, stems, strict=True):
        log(f"pack {name}")
        experiment = Experiment(load_pack(name), six_signals(), law)
        rows.append(_run(experiment, data, data.with_suffix(".png")).facts)
    means = {key: spread([row[key] for row in rows])[0] for key in ("gain", "fidelity")}
    bits = combined_status([row["status"] for row in rows])
    total = {"status": bits, "seconds": sum(row["seconds"] for row in rows)}
    result: dict[str, Any] = {**means, **total, "packs": rows}
    lines: list[Any] = [tables.recall_table(rows, rows[-1]["configuration"])]
    if law == Hooke() and set(names) < set(default):
        result["shipped"] = SHIPPED
        (gain, gain_sd), (fidelity, fidelity_sd) = SHIPPED["gain"], SHIPPED["fidelity"]
        lines.append(
            f"Packs of 325 grains differ: the five that are shipped have G = {gain:.3f} ± {gain_sd:.3f},\n"
            f"F = {fidelity:.3f} ± {fidelity_sd:.3f} (mean ± SD) at this rate (gmem demo --packs all).\n"
            "Larger ones remember better: 10,240 grains, driven ten times more slowly, have F = 0.900."
        )
    print_result(as_json, result, *lines)


COMMANDS = {"recall": recall_command, "demo": demo}
