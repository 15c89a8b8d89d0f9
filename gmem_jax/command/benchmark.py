"""The command `gmem bench`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from gmem_jax.bench import gpu, measure
from gmem_jax.bench.table import markdown, save_benchmark
from gmem_jax.command.console import AsJson, InputError, check_output, print_result, refuse_idle, reporting
from gmem_jax.files.cache import list_packs
from gmem_jax.files.packs import load_pack
from gmem_jax.files.validation import json_of, refusing


def bench_command(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for bench.json and bench.md.")] = Path("bench"),
    packs: Annotated[str, typer.Option(help="Packs, separated by commas; default one of each shipped size.")] = "",
    laws: Annotated[str, typer.Option(help="Friction laws among H, M1, M2, separated by commas.")] = "H,M1,M2",
    replicas: Annotated[str, typer.Option(help="Numbers of replicas, separated by commas.")] = "1,8,32,64",
    t0: Annotated[
        float, typer.Option(help="Duration of the compression whose first bins are timed, in t_c.", metavar="<float>")
    ] = measure.T0,
    with_lammps: Annotated[bool, typer.Option("--lammps/--no-lammps", help="Measure LAMMPS too.")] = True,
    with_jax: Annotated[bool, typer.Option("--jax/--no-jax", help="Measure plain JAX too.")] = True,
    scaling: Annotated[
        bool, typer.Option("--scaling/--no-scaling", help="Measure cost against N, memory and gradients too.")
    ] = True,
    baseline: Annotated[Path | None, typer.Option(help="A bench.json to compare with.")] = None,
    device: Annotated[
        Literal["cpu", "gpu"],
        typer.Option(help="gpu measures the native backend there, for N = 325 to 10,240, and writes no files."),
    ] = "cpu",
    as_json: AsJson = False,
) -> None:
    """Measure what a grain-step costs: native backend, plain JAX and LAMMPS, side by side.

    The folder's bench.json and bench.md are replaced, and hold what has been measured so far.
    """
    if device == "gpu":
        others = ("output", "packs", "laws", "replicas", "t0", "with_lammps", "with_jax", "scaling", "baseline")
        refuse_idle("with --device gpu, which measures one fixed set and writes no files", *others)
        return _on_gpu(as_json)
    shipped = {int(name.split("-")[1]): name for name in reversed(list_packs())}
    names = packs.split(",") if packs else [shipped[size] for size in sorted(shipped)]
    chosen = laws.split(",")
    if unknown := [law for law in chosen if law not in measure.TIMED_LAWS]:
        raise InputError(f"--laws {unknown[0]}: no such law; there are {', '.join(measure.TIMED_LAWS)}")
    counts = replicas.split(",")
    if not all(count.isdigit() and int(count) > 0 for count in counts):
        raise InputError(f"--replicas {replicas}: must be positive whole numbers, separated by commas")
    if not t0 > 0.0:
        raise InputError(f"--t0 {t0}: must be positive")
    before = None
    if baseline:
        with refusing(baseline, "bench.json"):
            before = json_of(baseline.read_text(encoding="utf-8"), "content")
    check_output(output.parent / "bench.json" if not output.is_dir() else output / "bench.json", ".json", force=True)
    with reporting() as progress:
        result = measure.run_benchmark(
            load_pack,
            names,
            laws=chosen,
            replicas=[int(count) for count in counts],
            t0=t0,
            with_lammps=with_lammps,
            with_jax=with_jax,
            scaling=scaling,
            keep=lambda so_far: save_benchmark(output, so_far, markdown(so_far, before)),
            say=lambda what, fraction: progress(what, 0.0, fraction),
        )
    print_result(as_json, {**result, "status": 0}, markdown(result, before))


def _on_gpu(as_json: bool) -> None:
    try:
        gpu.device()
    except ValueError as error:
        raise InputError(f"--device gpu: {error}") from error
    with reporting() as progress:
        times = gpu.timed(load_pack, say=lambda what, fraction: progress(what, 0.0, fraction))
    facts = gpu.kernel_facts(load_pack)
    print_result(as_json, {**facts, **times, "status": 0}, gpu.gpu_markdown(facts, times))


COMMANDS = {"bench": bench_command}
