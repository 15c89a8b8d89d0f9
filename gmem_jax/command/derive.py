"""The commands `gmem gradient`, `gmem kernel`, `gmem design` and `gmem tune`."""

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from gmem_jax.command.console import (
    AsJson,
    Force,
    InputError,
    Output,
    PackName,
    Picture,
    announce,
    draw_beside,
    print_result,
    refuse_idle,
    reporting,
)
from gmem_jax.command.options import ExperimentOptions, with_experiment
from gmem_jax.command.resuming import Restart, batch_for, resumable
from gmem_jax.derivatives.gradient import Gradient, value_and_grad
from gmem_jax.design import waveforms
from gmem_jax.design.by_kernel import (
    KERNEL_BUMP_WIDTH,
    KERNEL_BUMPS,
    KERNEL_ITERATIONS,
    design_by_kernel,
    kernel_design_cost,
)
from gmem_jax.design.drive import PARAMETERS, design_drive, start_within
from gmem_jax.design.kernel import memory_kernel, relative_error
from gmem_jax.design.stored import save_kernel
from gmem_jax.experiment.changes import value_at
from gmem_jax.experiment.cost import COPIES, run_bytes, steps_of_grains
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.identity import fingerprint
from gmem_jax.experiment.record import describe, key_of_run, pack_fingerprint
from gmem_jax.experiment.run import prefix_of, run
from gmem_jax.experiment.signals import Bumps, Spline, waveform
from gmem_jax.files import schemas
from gmem_jax.files.results import save_result
from gmem_jax.files.waveforms import load_waveforms, save_waveforms
from gmem_jax.show import summaries
from gmem_jax.show.figures import design_figure, history_figure
from gmem_jax.show.tables import cell
from gmem_jax.simulation.checkpoints import Checkpoint, ResultCache
from gmem_jax.simulation.observers import CHUNK
from gmem_jax.simulation.progress import within

GRADIENT_COST = 5.5  # cost of a gradient through the whole experiment, in runs (docs/speed.md)
MANY = 16  # signals; with more, designs use one kernel instead of a Jacobian for each


def _announce(experiment: Experiment, what: str, runs: float, side_by_side: int, memory: float = 1.0) -> None:
    """Say what a command will need; see `announce`.

    Args:
        experiment: the experiment of one run.
        what: name of the command.
        runs: number of runs of all signals of the experiment that it takes.
        side_by_side: number of signals that run together.
        memory: memory that it takes, over that of a run of these signals.
    """
    steps = steps_of_grains(experiment, experiment.signals.count)
    backend = experiment.runs_on
    needs = memory * run_bytes(experiment, side_by_side)
    announce(f"{what}, {experiment.pack.grains} grains", runs * steps, needs, backend, side_by_side + 1)


def _require_one_fidelity(experiment: Experiment) -> None:
    """Refuse a protocol of several reads or channels, and several sets of waveforms."""
    reads, channels = experiment.readings.reads, experiment.readings.channels
    if len(reads) * len(channels) > 1 or len(experiment.sets) > 1:
        raise InputError(
            f"this command needs one read, one channel and one set of waveforms; there are reads {', '.join(reads)}, "
            f"channels {', '.join(channels)} and sets {', '.join(experiment.sets)}; in the library gm.value_and_grad "
            "differentiates any loss, and gm.kernel_matrix and gm.design_waveforms take several channels"
        )


def _waveform_of(experiment: Experiment) -> tuple[str, np.ndarray]:
    """The field that holds the heights of the waveforms, and where in u each of them acts, [S, n]."""
    signals = experiment.signals
    if isinstance(signals, Bumps):
        return "signals.amplitudes", np.asarray(signals.centres)
    assert isinstance(signals, Spline)
    nodes = np.asarray(signals.nodes)
    return "signals.nodes", np.broadcast_to(np.linspace(0.0, 1.0, nodes.shape[1]), nodes.shape)


@with_experiment
def gradient_command(
    chosen: ExperimentOptions,
    pack: PackName,
    output: Output = Path("gradient.json"),
    restart: Restart = False,
    picture: Picture = True,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Exact derivatives of the fidelity by waveforms, gamma0, mu and stiffness (reverse mode; minutes)."""
    (experiment,), drawn = chosen.check_output([pack], output, ".json", picture=picture, force=force)
    _require_one_fidelity(experiment)
    began = time.perf_counter()
    waves, places = _waveform_of(experiment)
    law = experiment.friction
    names = {"waveform": waves, **{name: path for name, path in PARAMETERS.items() if _has(law, path)}}
    # Reverse mode needs the state at the beginning of every chunk.
    chunks = experiment.protocol.bins / CHUNK
    _announce(experiment, "gradient", GRADIENT_COST, experiment.signals.count, 1.0 + chunks / COPIES)
    with resumable(output, key_of_run(experiment, by=list(names)), restart=restart) as parts:
        found = _gradient(experiment, tuple(names.values()), parts)
        slopes = {name: np.asarray(found.slope[path]) for name, path in names.items()}
        rows = _of_waveforms(experiment, waves, places, slopes["waveform"])
        gradient = {
            **{name: slope.tolist() for name, slope in slopes.items()},
            "waveform": [row[1].tolist() for row in rows],
        }
        result: dict[str, Any] = {
            "pack": pack,
            "fidelity": float(found.value),
            "places": [row[0].tolist() for row in rows],
            "gradient": gradient,
            "seconds": time.perf_counter() - began,
            "status": 0,
        }
        result["configuration"] = describe(experiment, result["seconds"])
        save_result(output, schemas.GRADIENT, result)
    summary = summaries.of_gradient(result)
    draw_beside(drawn, summary.figures["waveforms"])
    print_result(as_json, result, *summary.lines)


def _of_waveforms(
    experiment: Experiment, name: str, places: np.ndarray, slopes: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The places in u where each waveform can be changed, in order, and the derivatives there.

    Amplitudes that are zero are left out as padding, and so are the ends of samples, which are fixed.
    """
    rows = []
    for place, height, slope in zip(places, np.asarray(value_at(experiment, name)), slopes, strict=True):
        real = (height != 0.0) if name == "signals.amplitudes" else (place > 0.0) & (place < 1.0)
        order = np.argsort(place[real], kind="stable")
        rows.append((place[real][order], slope[real][order]))
    return rows


def _gradient(experiment: Experiment, by: tuple[str, ...], cache: ResultCache) -> Gradient:
    with reporting(goes_on=True) as progress:

        def run(checkpoint: Checkpoint) -> tuple[Any, ...]:
            found = value_and_grad(experiment, by, checkpoint=checkpoint, progress=progress)
            return found.value, tuple(found.slope[name] for name in by), found.p_sig

        value, slopes, p_sig = cache("gradient", run)
    return Gradient(value, dict(zip(by, slopes, strict=True)), p_sig)


def _has(law: Any, path: str) -> bool:
    kind, _, name = path.partition(".")
    return kind != "friction" or hasattr(law, name)


@with_experiment
def kernel_command(
    chosen: ExperimentOptions,
    pack: PackName,
    output: Output = Path("kernel.h5"),
    n: Annotated[int, typer.Option("-n", "--bumps", min=2, max=512, help="Number of basis waveforms.")] = 17,
    width: Annotated[float, typer.Option(min=0.01, max=0.9, help="Width of the bumps, in u.")] = 0.2,
    noise: Annotated[
        float, typer.Option(min=0.0, help="RMS of the noise in a recall, in Pa; for resolution and capacity.")
    ] = 1.0,
    restart: Restart = False,
    picture: Picture = True,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """The linear memory kernel of a pack: singular values, resolution, capacity, and what it predicts."""
    (experiment,), drawn = chosen.check_output([pack], output, ".h5", picture=picture, force=force)
    _require_one_fidelity(experiment)
    _needs_sub0(experiment, "a kernel is measured")
    began = time.perf_counter()
    runs = 2.0 * n / experiment.signals.count
    _announce(experiment, "kernel", 1.0 + runs, 2 * n)
    with resumable(output, key_of_run(experiment, bumps=n, width=width), restart=restart) as parts:
        with reporting(goes_on=True) as progress:
            prefix = prefix_of(experiment, cache=parts, progress=within(progress, 0.0, 0.05))
            most = within(progress, 0.05, 0.05 + 0.95 * runs / (1.0 + runs))
            kernel = memory_kernel(experiment, n, width, prefix=prefix, cache=parts, progress=most)
            rest = within(progress, 0.05 + 0.95 * runs / (1.0 + runs), 1.0)
            p_sig = run(experiment, prefix=prefix, cache=parts.scoped("check"), progress=rest).p_sig
        signals, configuration = experiment.waveforms, describe(experiment, time.perf_counter() - began)
        summary = summaries.of_kernel(kernel, configuration, noise)
        result = {
            **summary.facts,
            "pack": pack,
            "prediction_error": relative_error(kernel.predict(signals), p_sig).tolist(),
            "prediction_error_linear": relative_error(kernel.predict(signals, even=False), p_sig).tolist(),
            "output": str(output),
            "seconds": time.perf_counter() - began,
            "status": 0,
        }
        save_kernel(output, kernel, configuration)
    draw_beside(drawn, summary.figures["kernel"])
    errors = " ".join(f"{error:.2%}" for error in result["prediction_error"])
    told = f"superposition's error: {errors}  (of each signal's recall, against what the kernel says)"
    print_result(as_json, result, *summary.lines, told)


def _needs_sub0(experiment: Experiment, what: str) -> None:
    if experiment.background != "sub0":
        raise InputError(f"--background {experiment.background}: {what} with sub0")


def _require_designable(experiment: Experiment) -> None:
    _needs_sub0(experiment, "designs are made")
    if experiment.shear != "during":
        raise InputError(f"--shear {experiment.shear}: designs need shear during the compression; use --shear during")


@with_experiment
def design_command(
    chosen: ExperimentOptions,
    pack: PackName,
    output: Output = Path("designed.csv"),
    words: Annotated[int | None, typer.Option(help="Design all words of so many bits, like --signals words:L.")] = None,
    by: Annotated[
        str | None,
        typer.Option(
            help=f"jacobian, of each waveform; or kernel, of the pack: default for --words and above {MANY} signals."
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(
            min=1,
            help=f"Corrections, default {waveforms.ITERATIONS}; by the kernel simulations, {KERNEL_ITERATIONS}.",
        ),
    ] = None,
    bumps: Annotated[
        int | None,
        typer.Option(
            min=2, help=f"Bumps of a waveform; default {waveforms.BUMPS} by Jacobians, {KERNEL_BUMPS} by the kernel."
        ),
    ] = None,
    width: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=1.0,
            help=f"Width of bumps, in u; default {waveforms.BUMP_WIDTH}; by the kernel {KERNEL_BUMP_WIDTH}.",
        ),
    ] = None,
    gain: Annotated[
        float | None,
        typer.Option(help="Wanted gain; default that of --start, or at most half of that of the original waveforms."),
    ] = None,
    start: Annotated[
        Path | None, typer.Option(help="File of designed waveforms to improve; by the kernel only.")
    ] = None,
    measured: Annotated[
        int,
        typer.Option(
            min=0,
            help="Mean number of directions in which slopes of a waveform are measured, at 2 times; for --by kernel.",
        ),
    ] = 0,
    restart: Restart = False,
    picture: Picture = True,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Pre-distort waveforms so that recalls follow their integrals; writes a CSV for `gmem recall` (minutes)."""
    if by not in (None, "jacobian", "kernel"):
        raise InputError(f"--by must be jacobian or kernel, got {by!r}")
    if words is not None:
        refuse_idle("beside --words, which says what they are", "signals")
    chosen = chosen if words is None else chosen.with_signals(f"words:{words}")
    if start is not None and not start.is_file():
        raise InputError(f"--start {start}: is no file of waveforms")
    history, read = output.with_name(f"{output.stem}-history.png"), () if start is None else (start,)
    (experiment,), drawn = chosen.check_output(
        [pack], output, ".csv", picture=picture, force=force, inputs=read, pictures=(history,)
    )
    _require_one_fidelity(experiment)
    _require_designable(experiment)
    if chosen.target(experiment.signals.count) is not None:
        raise InputError("--signals: these are designed waveforms; give the wanted ones, and these as --start to go on")
    began = time.perf_counter()
    count = experiment.signals.count
    by = by or ("kernel" if words is not None or count > MANY else "jacobian")
    asked = {"iterations": iterations, "n": bumps, "width": width}
    options: dict[str, Any] = {"gain": gain} | {name: value for name, value in asked.items() if value is not None}
    if by == "kernel":
        options["batch"] = batch_for(experiment, output, restart=restart)
        options["measured"] = measured
        effort = kernel_design_cost(experiment, iterations, bumps or KERNEL_BUMPS, measured)
        _announce(experiment, "design", effort, min(count * max(1, measured), options["batch"]))
        if start is not None:
            options["start"] = waveform(load_waveforms(start))
    elif measured or start is not None:
        option = "--measured" if measured else "--start"
        raise InputError(f"{option}: designs by Jacobians have no use for it; add --by kernel")
    else:
        n = bumps or waveforms.BUMPS
        _announce(experiment, "design", waveforms.cost(experiment, iterations, n), 2 * n * count)
    begun = {"start": fingerprint(options["start"])} if start is not None else {}
    with resumable(output, key_of_run(experiment, by=by, **{**options, **begun}), restart=restart) as parts:
        with reporting(goes_on=True) as progress:
            design = design_by_kernel if by == "kernel" else waveforms.design_waveforms
            found = design(experiment, cache=parts, progress=progress, **options)
        way = {"pack": pack, **{name: getattr(found, name) for name in ("before", "fidelity", "gain", "history")}}
        save_waveforms(output, found.signals, experiment.waveforms, design=way)
    draw_beside(drawn, lambda: design_figure(found, float(experiment.scale), cell(pack)))
    draw_beside(history if picture else None, lambda: history_figure({cell(pack): found.history}))
    result = {
        "pack": pack,
        "before": found.before,
        "fidelity": found.fidelity,
        "gain": found.gain,
        "history": list(found.history),
        "output": str(output),
        "seconds": time.perf_counter() - began,
        "status": 0,
    }
    line = f"F of the recall with respect to the wanted J: {found.before:.4f} -> {found.fidelity:.4f}"
    print_result(as_json, result, f"{line} (gain {found.gain:.3f}); wrote {output}")


def parse_bounds(text: str) -> dict[str, tuple[float, float]]:
    """Bounds by name from "gamma0=3e-4:3e-3,mu=0.5:2".

    Raises:
        InputError: if it does not read like that.
    """
    bounds = {}
    for item in text.split(","):
        name, _, span = item.partition("=")
        low, _, high = span.partition(":")
        if name.strip() in bounds:
            raise InputError(f"--bounds: {name.strip()} is given twice")
        try:
            bounds[name.strip()] = float(low), float(high)
        except ValueError:
            raise InputError(f"--bounds: {item!r} should read like mu=0.5:2") from None
    if unknown := set(bounds) - set(PARAMETERS):
        raise InputError(f"--bounds: {min(unknown)!r} cannot be tuned; {', '.join(PARAMETERS)} can")
    return bounds


@with_experiment
def tune_command(
    chosen: ExperimentOptions,
    packs: Annotated[str, typer.Argument(help="Pack files or names of shipped packs, separated by commas.")],
    output: Output = Path("tuned.json"),
    bounds: Annotated[
        str, typer.Option(help="Lowest and highest value of gamma0, mu or stiffness, as in mu=0.5:2,gamma0=3e-4:3e-3.")
    ] = "gamma0=3e-4:3e-3,mu=0.5:2,stiffness=0.07:0.29",
    iterations: Annotated[
        int, typer.Option(min=1, help="Steps; each takes 2 n + 1 runs of each pack, for n bounds.")
    ] = 6,
    restart: Restart = False,
    picture: Picture = True,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Choose gamma0, mu and the friction stiffness within bounds so that the mean fidelity of packs grows."""
    names, limits = packs.split(","), parse_bounds(bounds)
    if not all(names):
        raise InputError(f"{packs}: no pack is named beside a comma; name packs as in tetra-325-a,tetra-325-b")
    experiments, drawn = chosen.check_output(names, output, ".json", picture=picture, force=force)
    _require_one_fidelity(experiments[0])
    _require_designable(experiments[0])
    start_within(experiments, limits)
    began = time.perf_counter()
    first = experiments[0]
    _announce(first, "tune", len(names) * ((2 * len(limits) + 1) * iterations + 1), first.signals.count)
    key = key_of_run(first, packs=[pack_fingerprint(each.pack) for each in experiments], bounds=list(limits.items()))
    with resumable(output, key, restart=restart) as parts:
        with reporting(goes_on=True) as progress:
            found = design_drive(experiments, limits, iterations=iterations, cache=parts, progress=progress)
        result: dict[str, Any] = {
            "packs": names,
            "before": found.before,
            "fidelity": found.fidelity,
            "each": found.each.tolist(),
            "values": found.values,
            "history": [{**values, "fidelity": fidelity} for values, fidelity in found.history],
            "output": str(output),
            "seconds": time.perf_counter() - began,
            "status": 0,
        }
        save_result(output, schemas.TUNED, {**result, "configuration": describe(first, result["seconds"])})
    summary = summaries.of_tuned(result)
    draw_beside(drawn, summary.figures["history"])
    print_result(as_json, result, *summary.lines, f"wrote {output}")


COMMANDS = {"gradient": gradient_command, "kernel": kernel_command, "design": design_command, "tune": tune_command}
