"""The `gmem` command. Exit code 0: done; 2: bad input, said in one line; 1: the run failed."""

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import jax
import psutil
import typer
from pydantic import ValidationError
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from typer.exceptions import TyperException

from gmem_jax import native
from gmem_jax.bench import measure as bench
from gmem_jax.command import derive
from gmem_jax.command.config import RecallConfig
from gmem_jax.experiment.host import Progress as Report
from gmem_jax.experiment.host import RunFailedError
from gmem_jax.experiment.recall import default_batch, run_memory
from gmem_jax.files import storage
from gmem_jax.files.provenance import provenance
from gmem_jax.physics import grain
from gmem_jax.physics.step import Sample
from gmem_jax.preparation.preparation import Recipe, prepare
from gmem_jax.reading import net as classifier
from gmem_jax.reading import readers
from gmem_jax.show import figures as plot
from gmem_jax.show import tables as report

app = typer.Typer(add_completion=False, rich_markup_mode=None, help="Waveform memory in granular packs.")
log = Console(stderr=True, highlight=False)
out = Console(highlight=False)

Output = Annotated[Path, typer.Option("-o", "--output", help="File to write.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout; logs go to stderr.")]


class InputError(ValueError):
    """Bad input, in words for the command line."""


@contextlib.contextmanager
def _progress() -> Iterator[Report]:
    """A progress bar on a terminal; a line per stage elsewhere."""
    if not log.is_terminal:
        stages: list[str] = []

        def line(stage: str, moment: float, fraction: float) -> None:
            if stages[-1:] != [stage]:
                stages.append(stage)
                log.print(f"{fraction:5.0%}  {stage} (t = {moment:.0f} t_c)")

        yield line
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("ETA"), TimeRemainingColumn(), console=log) as bar:
        task = bar.add_task("compiling", total=1.0)
        yield lambda stage, moment, fraction: bar.update(
            task, completed=fraction, description=f"{stage}, t = {moment:.0f} t_c"
        )


def _writable(path: Path, name: str = "--output") -> Path:
    """`path`, once it is sure that it can be written: a long run must not end in a refused file."""
    folder = path.parent
    if path.is_dir():
        raise InputError(f"{name} {path}: is a folder; name a file")
    if not folder.is_dir():
        raise InputError(f"{name} {path}: folder {folder} does not exist")
    try:
        with storage.atomic(folder / ".gmem-probe") as probe:
            probe.touch()
        (folder / ".gmem-probe").unlink()
    except OSError as error:
        raise InputError(f"{name} {path}: cannot write there ({error.strerror})") from error
    return path


def _emit(as_json: bool, result: Any, *tables: Any) -> None:
    if as_json:
        sys.stdout.write(json.dumps(result) + "\n")
    else:
        for table in tables:
            out.print(table)


@app.command()
def info(as_json: AsJson = False) -> None:
    """Versions, devices, backend and shipped packs."""
    built, why = native.available()
    facts = {
        **provenance(),
        "devices": [f"{d.platform}: {d.device_kind}" for d in jax.devices()],
        "backend": f"native ({why})" if built else f"jax (no native backend: {why})",
        "packs": storage.list_packs(),
    }
    lines = [f"{key}: {value}" for key, value in facts["versions"].items()]
    lines += [f"commit: {facts['commit']}", f"backend: {facts['backend']}"]
    lines += [f"device: {device}" for device in facts["devices"]]
    lines += ["shipped packs: " + ", ".join(facts["packs"])]
    _emit(as_json, facts, "\n".join(lines))


@app.command("prepare")
def prepare_command(
    output: Output,
    grains: Annotated[int, typer.Option(help="Number of grains N.")] = 325,
    shape: Annotated[str, typer.Option(help="tetra or sphere.")] = "tetra",
    overlap: Annotated[float, typer.Option(help="Overlap O of a tetra grain, in [0, 1).")] = 0.6,
    seed: Annotated[int, typer.Option(help="Random seed.")] = 1,
    delta0: Annotated[float, typer.Option(help="Areal compression of the cycles and of the experiment.")] = 0.05,
    t0: Annotated[float, typer.Option(help="Duration of one compression, t_c.")] = 1.8e3,
    dt: Annotated[float, typer.Option(help="Largest time step, t_c.")] = 0.3,
    name: Annotated[str, typer.Option(help="Name of the pack; default from grain, size and seed.")] = "",
    backend: Annotated[str, typer.Option(help="auto, jax or native.")] = "auto",
    as_json: AsJson = False,
) -> None:
    """Prepare a pack: gas, pressure, frictionless cycles, rest."""
    if shape not in ("tetra", "sphere"):
        raise InputError(f"--shape must be tetra or sphere, got {shape!r}")
    clump = grain.tetra(overlap) if shape == "tetra" else grain.sphere()
    recipe = Recipe(grains=grains, seed=seed, delta0=delta0, t0=t0, dt=dt)
    _writable(output)
    began = time.perf_counter()
    stages: dict[str, Sample] = {}
    with _progress() as progress:
        pack = prepare(recipe, clump, name=name, backend=backend, progress=progress, log=stages)
    storage.save_pack(output, pack, stages)
    seconds = time.perf_counter() - began
    rest = pack.info["at_rest"]
    log.print(f"at rest: largest grain speed {rest['largest_speed']:.1e} R/t_c; wrote {output} in {seconds:.0f} s")
    result = {"pack": pack.name, "output": str(output), "seconds": seconds, "status": 0, **rest}
    _emit(as_json, result, report.pack_table(pack))


def _run(config: RecallConfig, data: Path, picture: Path | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run one recall with a progress bar and write it; its summary and its resolved configuration."""
    pack, signals = storage.load_pack(config.pack), config.waveforms()
    began = time.perf_counter()
    folder = data.with_name(f"{data.name}.parts")
    free = psutil.virtual_memory().available
    batch = config.batch or storage.Parts.key_of(folder).get("batch") or default_batch(pack, config.law(), free)
    parts = storage.Parts(folder, config.key(pack, batch))
    if parts.finished():
        log.print(f"going on from {parts.folder}: {parts.finished()} finished parts", soft_wrap=True)
    with _progress() as progress:
        options = {**config.arguments(), "batch": batch, "keep": parts, "progress": progress}
        recall = jax.block_until_ready(run_memory(pack, signals, **options))
    resolved = config.resolved(pack, time.perf_counter() - began)
    storage.save_recall(data, recall, resolved)
    parts.discard()
    if picture is not None:
        plot.recall_figure(picture, recall, resolved["delta0"], config.gamma0, config.pack)
    log.print(f"wrote {data}" + (f" and {picture}" if picture else ""), soft_wrap=True)
    row = {**report.summary(recall, resolved), "seconds": resolved["seconds"], "output": str(data)}
    if row["status"]:
        log.print(f"warning: {row['status_text']}", style="yellow", soft_wrap=True)
    return row, resolved


def _tables(row: dict[str, Any], resolved: dict[str, Any]) -> list[Any]:
    """What to print of one recall."""
    more = [report.backgrounds_table(row), report.second_readout_lines(row)] if "backgrounds" in row else []
    return [report.recall_table([row], resolved), *more]


@app.command("recall")
def recall_command(
    pack: Annotated[str, typer.Argument(help="A pack file, or the name of a shipped pack.")],
    output: Output = Path("recall.h5"),
    signals: Annotated[
        str, typer.Option(help="six; words:L, all words of L bits; or a .csv (a column per signal) or .npy file.")
    ] = "six",
    friction: Annotated[str, typer.Option(help="Friction law: hooke (H), m1 or m2 (Mindlin).")] = "hooke",
    mu: Annotated[float, typer.Option(help="Friction coefficient.")] = 1.0,
    stiffness: Annotated[float | None, typer.Option(help="k_H in E R, or k_M in E R^0.5; default the law's.")] = None,
    p_max: Annotated[float, typer.Option(help="m2: largest overlap of its history, R.")] = 0.2,
    points: Annotated[int, typer.Option(help="m2: points of its history.")] = 100,
    delta0: Annotated[float | None, typer.Option(help="Areal compression; default the pack's own.")] = None,
    gamma0: Annotated[float, typer.Option(help="Shear amplitude.")] = 1e-3,
    t0: Annotated[float, typer.Option(help="Duration of one compression, t_c (the paper's is 18000).")] = 1.8e3,
    dt: Annotated[float, typer.Option(help="Largest time step, t_c.")] = 0.3,
    backend: Annotated[str, typer.Option(help="auto, jax or native.")] = "auto",
    background: Annotated[str, typer.Option(help="sub0, sub2 or sub2-bl.")] = "sub0",
    rest: Annotated[float, typer.Option(help="Rests at u = 0, in t0.")] = 0.2,
    hold: Annotated[float, typer.Option(help="Holds at u = 1, in t0.")] = 0.2,
    store: Annotated[float, typer.Option(help="Storage, in t0.")] = 2.0,
    hold_drag: Annotated[float | None, typer.Option(help="Drag in holds, 1/t_c; default 0.05 if t0 < 18000.")] = None,
    batch: Annotated[int | None, typer.Option(help="Signals run together; default what fits the free memory.")] = None,
    picture: Annotated[bool, typer.Option(help="Also draw it, beside the output.")] = True,
    as_json: AsJson = False,
) -> None:
    """Store waveforms in a pack and recall them."""
    given = {key: value for key, value in locals().items() if key in RecallConfig.model_fields}
    config = RecallConfig(**given)
    _writable(output)
    row, resolved = _run(config, output, output.with_suffix(".png") if picture else None)
    _emit(as_json, row, *_tables(row, resolved))


@app.command()
def demo(
    packs: Annotated[str, typer.Option(help="all, or names of shipped packs, separated by commas.")] = "",
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write to.")] = Path("gmem-demo"),
    mu: Annotated[float, typer.Option(help="Friction coefficient.")] = 1.0,
    as_json: AsJson = False,
) -> None:
    """The main job: six waveforms stored in a shipped pack and recalled; table, recall.h5 and recall.png."""
    shipped = storage.list_packs()
    default = [name for name in shipped if name.startswith("tetra-325")]
    names = default if packs == "all" else packs.split(",") if packs else default[:1]
    unknown = [name for name in names if name not in shipped]
    if unknown:
        raise InputError(f"--packs {unknown[0]}: no such shipped pack; there are {', '.join(shipped)}")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--output {output}: cannot make this folder ({error.strerror})") from error
    _writable(output / "recall.h5")
    rows = []
    for name in names:
        log.print(f"pack {name}")
        stem = "recall" if len(names) == 1 else f"recall-{name}"
        config = RecallConfig(pack=name, mu=mu)
        row, resolved = _run(config, output / f"{stem}.h5", output / f"{stem}.png")
        rows.append(row)
    means = {key: report.spread([row[key] for row in rows])[0] for key in ("gain", "fidelity")}
    total = {"status": max(row["status"] for row in rows), "seconds": sum(row["seconds"] for row in rows)}
    _emit(as_json, {**means, **total, "packs": rows}, report.recall_table(rows, resolved))


@app.command()
def show(
    file: Annotated[Path, typer.Argument(help="A pack or a recall file, or the name of a shipped pack.")],
    as_json: AsJson = False,
) -> None:
    """What a file holds."""
    if str(file) in storage.list_packs() or storage.schema_of(file) == storage.PACK_SCHEMA:
        pack = storage.load_pack(file)
        facts = {"pack": pack.name, "grains": pack.grains, "ringing_period": float(pack.ringing_period), **pack.info}
        _emit(as_json, facts, report.pack_table(pack))
        return
    recall, configuration = storage.load_recall(file)
    row = report.summary(recall, configuration)
    _emit(as_json, {**row, "configuration": configuration}, *_tables(row, configuration))


@contextlib.contextmanager
def _training(budget: float) -> Iterator[classifier.Progress]:
    """Loss and validation accuracy of a training: in a bar of its time on a terminal, a line every 10 s elsewhere."""

    def words(training: classifier.Training) -> str:
        passed = f"seed {training.seed}: step {training.step}, loss {training.loss:.3f}"
        return f"{passed}, held-out accuracy {training.validation:.4f}"

    began = time.perf_counter()
    if not log.is_terminal:
        last = began

        def line(training: classifier.Training) -> None:
            nonlocal last
            if training.finished or time.perf_counter() - last > 10.0:
                last = time.perf_counter()
                log.print(words(training))

        yield line
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("of the time budget"), TimeElapsedColumn())
    with Progress(*columns, console=log) as bar:
        task = bar.add_task("compiling", total=budget)
        yield lambda training: bar.update(
            task, completed=min(time.perf_counter() - began, budget), description=words(training)
        )


@app.command("classify")
def classify_command(
    recall: Annotated[Path, typer.Argument(help="A recall of binary words (gmem recall --signals words:L).")],
    output: Output = Path("classify.json"),
    seeds: Annotated[int, typer.Option(min=1, help="Nets to train, with seeds 0, 1, ...")] = 3,
    budget: Annotated[float, typer.Option(min=0.0, help="Longest training of one net, seconds.")] = 300.0,
    nets: Annotated[
        Path | None,
        typer.Option(help="Folder of trained nets, used and added to; default gmem-nets beside the recall."),
    ] = None,
    picture: Annotated[bool, typer.Option(help="Also draw the nets' confusion matrix, beside the output.")] = True,
    as_json: AsJson = False,
) -> None:
    """Read recalled binary words: the paper's neural net, trained on inputs only, and two baselines.

    A net depends on the length of the words and its seed, not on the recall: nets in the folder are used again, and
    those that ran out of time are trained on.
    """
    kept, configuration = storage.load_recall(recall)
    try:
        stored = readers.stored_words(kept)
    except ValueError as error:
        raise InputError(f"{recall}: {error}; make one with gmem recall --signals words:L") from error
    _writable(output)
    folder = recall.parent / "gmem-nets" if nets is None else nets
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--nets {folder}: cannot make this folder ({error.strerror})") from error
    log.print(f"{stored.bits}-bit words of pack {configuration['pack']}, background {stored.background.upper()}")
    began = time.perf_counter()
    trained = []
    for seed in range(seeds):
        file = _writable(folder / f"words-{stored.bits}-seed-{seed}.msgpack", "--nets")
        with _training(budget) as progress:
            one = classifier.train(
                classifier.Recipe(stored.bits), seed, budget=budget, checkpoint=file, progress=progress
            )
        trained.append(one)
        state = "trained" if one.finished else "out of time"
        log.print(f"seed {seed}: {state}, {one.step} steps, held-out accuracy {one.validation:.4f}", soft_wrap=True)
    result = report.reading(stored, trained)
    seconds = time.perf_counter() - began
    result = {"recall": str(recall), "pack": configuration["pack"], "status": 0, "seconds": seconds, **result}
    with storage.atomic(output) as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n")
    if picture:
        net = result["readers"]["net"]
        title = f"{configuration['pack']}, {stored.bits} bits: accuracy {net['accuracy']:.3f} ({seeds} nets)"
        table = readers.confusion(net["read"], len(stored.signals))
        plot.confusion_figure(output.with_suffix(".png"), table, title)
    log.print(f"wrote {output}" + (f" and {output.with_suffix('.png')}" if picture else ""), soft_wrap=True)
    _emit(as_json, result, *report.reading_tables(result))


@app.command("bench")
def bench_command(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for bench.json and bench.md.")] = Path("bench"),
    packs: Annotated[str, typer.Option(help="Packs, separated by commas; default one of each shipped size.")] = "",
    laws: Annotated[str, typer.Option(help="Friction laws among H, M1, M2, separated by commas.")] = "H,M1,M2",
    replicas: Annotated[str, typer.Option(help="Numbers of replicas, separated by commas.")] = "1,8,16,32",
    with_lammps: Annotated[bool, typer.Option("--lammps/--no-lammps", help="Measure LAMMPS beside us.")] = True,
    baseline: Annotated[Path | None, typer.Option(help="A bench.json to compare with.")] = None,
    as_json: AsJson = False,
) -> None:
    """Measure what a grain-step costs: native backend, plain JAX and LAMMPS, side by side."""
    shipped = [f"tetra-{size}-a" for size in (325, 1024, 3267)]
    names = packs.split(",") if packs else [name for name in shipped if name in storage.list_packs()]
    chosen = laws.split(",")
    if unknown := [law for law in chosen if law not in bench.LAWS]:
        raise InputError(f"--laws {unknown[0]}: no such law; there are {', '.join(bench.LAWS)}")
    counts = replicas.split(",")
    if not all(count.isdigit() and int(count) > 0 for count in counts):
        raise InputError(f"--replicas {replicas}: must be positive whole numbers, separated by commas")
    before = json.loads(baseline.read_text()) if baseline else None
    _writable(output.parent / "bench.json" if not output.is_dir() else output / "bench.json")
    with _progress() as progress:
        result = bench.run(
            storage.load_pack,
            names,
            laws=chosen,
            replicas=[int(count) for count in counts],
            with_lammps=with_lammps,
            say=lambda what, fraction: progress(what, 0.0, fraction),
        )
    text = bench.markdown(result, before)
    bench.save(output, result, text)
    _emit(as_json, {**result, "status": 0}, text)


PackName = Annotated[str, typer.Argument(help="A pack file, or the name of a shipped pack.")]
SignalFile = Annotated[str, typer.Option(help="six, or a .csv (a column per signal) or .npy file of samples.")]
Law = Annotated[str, typer.Option(help="Friction law: hooke (H), m1 or m2 (Mindlin).")]
Mu = Annotated[float, typer.Option(help="Friction coefficient.")]
Gamma0 = Annotated[float, typer.Option(help="Shear amplitude.")]
T0 = Annotated[float, typer.Option(help="Duration of one compression, t_c.")]
Hold = Annotated[float, typer.Option(help="Holds at u = 1, in t0.")]
Rest = Annotated[float, typer.Option(help="Rests at u = 0, in t0.")]
Store = Annotated[float, typer.Option(help="Storage, in t0.")]
Picture = Annotated[bool, typer.Option(help="Also draw it, beside the output.")]


def _given(values: dict[str, Any]) -> RecallConfig:
    return RecallConfig(**{key: value for key, value in values.items() if key in RecallConfig.model_fields})


@app.command("gradient")
def gradient_command(
    pack: PackName,
    output: Output = Path("gradient.json"),
    signals: SignalFile = "six",
    friction: Law = "hooke",
    mu: Mu = 1.0,
    gamma0: Gamma0 = 1e-3,
    t0: T0 = 1.8e3,
    rest: Rest = 0.2,
    hold: Hold = 0.2,
    store: Store = 2.0,
    picture: Picture = True,
    as_json: AsJson = False,
) -> None:
    """Exact derivatives of the fidelity by waveforms, gamma0, mu and stiffness (reverse mode; minutes)."""
    config = _given(locals())
    _writable(output)
    began = time.perf_counter()
    with _progress() as progress:
        result = derive.run_gradient(config, output.with_suffix(".png") if picture else None, progress)
    result = {**result, "seconds": time.perf_counter() - began, "status": 0}
    with storage.atomic(output) as temporary:
        temporary.write_text(json.dumps({**result, "configuration": config.model_dump(), **provenance()}))
    slopes = result["gradient"]
    lines = [f"F = {result['fidelity']:.4f}"]
    lines += [f"dF/d{name} = {slopes[name]:.5g}" for name in ("gamma0", "mu", "stiffness")]
    for number, row in enumerate(slopes["waveform"]):
        lines.append(f"dF/da of signal {number + 1}: " + " ".join(f"{value:.4g}" for value in row))
    _emit(as_json, result, "\n".join(lines))


@app.command("kernel")
def kernel_command(
    pack: PackName,
    output: Output = Path("kernel.h5"),
    signals: SignalFile = "six",
    n: Annotated[int, typer.Option("-n", "--bumps", min=2, help="Basis waveforms.")] = 17,
    width: Annotated[float, typer.Option(min=0.01, max=0.9, help="Width of the bumps, in u.")] = 0.2,
    noise: Annotated[float, typer.Option(min=0.0, help="Noise in the recall, Pa RMS.")] = 1.0,
    friction: Law = "hooke",
    mu: Mu = 1.0,
    gamma0: Gamma0 = 1e-3,
    t0: T0 = 1.8e3,
    rest: Rest = 0.2,
    hold: Hold = 0.2,
    store: Store = 2.0,
    picture: Picture = True,
    as_json: AsJson = False,
) -> None:
    """The linear memory kernel of a pack: singular values, resolution, capacity, and what it predicts."""
    config = _given(locals())
    _writable(output)
    began = time.perf_counter()
    drawn = output.with_suffix(".png") if picture else None
    with _progress() as progress:
        result = derive.run_kernel(config, output, drawn, n, width, noise, progress)
    result = {**result, "seconds": time.perf_counter() - began, "status": 0}
    keys = ("gain", "distance", "asymmetry", "resolution")
    lines = [*(f"{key}: {result[key]:.3f}" for key in keys), f"values above {noise:g} Pa: {result['capacity']} of {n}"]
    lines.append("superposition's error: " + " ".join(f"{value:.2%}" for value in result["prediction_error"]))
    _emit(as_json, result, "\n".join(lines))


@app.command("design")
def design_command(
    pack: PackName,
    output: Output = Path("designed.csv"),
    signals: SignalFile = "six",
    iterations: Annotated[int, typer.Option(min=1, help="Corrections; each takes a Jacobian.")] = 3,
    gain: Annotated[float | None, typer.Option(help="Wanted gain; default half of the untouched waveforms'.")] = None,
    friction: Law = "hooke",
    mu: Mu = 1.0,
    gamma0: Gamma0 = 1e-3,
    t0: T0 = 1.8e3,
    rest: Rest = 0.2,
    hold: Hold = 0.2,
    store: Store = 2.0,
    picture: Picture = True,
    as_json: AsJson = False,
) -> None:
    """Pre-distort waveforms so that the recall follows their integrals; writes a CSV for `gmem recall` (minutes)."""
    config = _given(locals())
    _writable(output)
    began = time.perf_counter()
    with _progress() as progress:
        drawn = output.with_suffix(".png") if picture else None
        result = derive.run_design(config, output, drawn, iterations, gain, progress)
    result = {**result, "seconds": time.perf_counter() - began, "status": 0}
    line = f"F of the recall with respect to the wanted J: {result['before']:.4f} -> {result['fidelity']:.4f}"
    _emit(as_json, result, f"{line} (gain {result['gain']:.3f}); wrote {output}")


@app.command("tune")
def tune_command(
    packs: Annotated[str, typer.Argument(help="Pack files or names of shipped packs, separated by commas.")],
    output: Output = Path("tuned.json"),
    bounds: Annotated[
        str, typer.Option(help="Lowest and highest value of gamma0, mu or stiffness, as in mu=0.5:2,gamma0=3e-4:3e-3.")
    ] = "gamma0=3e-4:3e-3,mu=0.5:2,stiffness=0.07:0.29",
    signals: SignalFile = "six",
    iterations: Annotated[int, typer.Option(min=1, help="Steps; each 7 runs a pack.")] = 6,
    friction: Law = "hooke",
    mu: Mu = 1.0,
    gamma0: Gamma0 = 1e-3,
    t0: T0 = 1.8e3,
    rest: Rest = 0.2,
    hold: Hold = 0.2,
    store: Store = 2.0,
    picture: Picture = True,
    as_json: AsJson = False,
) -> None:
    """Choose gamma0, mu and the friction stiffness within bounds so that the mean fidelity of packs grows."""
    names, limits = packs.split(","), derive.parse_bounds(bounds)
    config = _given({**locals(), "pack": names[0]})
    _writable(output)
    began = time.perf_counter()
    drawn = output.with_suffix(".png") if picture else None
    with _progress() as progress:
        result = derive.run_tune(config, names, limits, output, drawn, iterations, progress)
    result = {**result, "seconds": time.perf_counter() - began, "status": 0}
    found = ", ".join(f"{name} = {value:.4g}" for name, value in result["values"].items())
    _emit(as_json, result, f"mean F {result['before']:.4f} -> {result['fidelity']:.4f} with {found}; wrote {output}")


def _first_problem(error: ValidationError) -> str:
    """One line of the first thing pydantic objects to."""
    problem = error.errors()[0]
    option = "--" + "-".join(str(part).replace("_", "-") for part in problem["loc"])
    return f"{option}: {problem['msg'].lower()}, got {problem['input']!r}"


def main() -> None:
    """Entry point of the `gmem` command."""
    jax.config.update("jax_enable_x64", True)
    try:
        code = app(args=sys.argv[1:] or ["--help"], standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except TyperException as error:
        problem = error.format_message()
    except ValidationError as error:
        problem = _first_problem(error)
    except (ValueError, OSError) as error:
        problem = " ".join(str(error).split())
    except RunFailedError as error:
        log.print(f"gmem: the run failed: {error}", style="red", soft_wrap=True)
        sys.exit(1)
    except (KeyboardInterrupt, typer.Abort):
        log.print("gmem: interrupted")
        sys.exit(130)
    log.print(f"gmem: {problem}", style="red", soft_wrap=True, markup=False)
    sys.exit(2)
