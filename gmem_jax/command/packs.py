"""The command `gmem prepare`."""

import time
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any

import typer

from gmem_jax.command.console import (
    AsJson,
    DryRun,
    Force,
    InputError,
    KeptFrames,
    announce,
    check_output,
    emit_cost,
    log,
    print_result,
    refuse_idle,
    reporting,
    require_name,
)
from gmem_jax.command.options import with_recipe
from gmem_jax.command.resuming import Restart, foresee, resumable
from gmem_jax.experiment.experiment import PAPER_T0
from gmem_jax.experiment.identity import fingerprint
from gmem_jax.experiment.provenance import sources
from gmem_jax.files.cache import kept_pack, list_packs
from gmem_jax.files.packs import STANDARD_NAME, save_pack
from gmem_jax.files.sizes import pack_bytes
from gmem_jax.files.spheres import load_clump
from gmem_jax.native.backend import backend_name
from gmem_jax.physics import grain
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.grain import Clump
from gmem_jax.preparation.preparation import preparation_frames, prepare
from gmem_jax.preparation.recipe import Recipe, graded, grain_steps, pressure_over_wanted
from gmem_jax.show import tables
from gmem_jax.simulation.frames import Frames
from gmem_jax.simulation.sample import Sample

PREPARATION_BYTES = 2e4  # memory of a preparation per grain, for lists while grains fly, at N = 10,240
CLUMP_OVERLAP = 0.6


def standard_recipe(name: str) -> Recipe:
    """The recipe of a standard pack, from its name.

    Raises:
        InputError: if it is not the name of a standard pack, or that pack is shipped.
    """
    if not (found := STANDARD_NAME.fullmatch(name)):
        raise InputError(
            f"{name}: a standard pack is called tetra-N-x, N grains and a letter for the seed: tetra-31680-a"
        )
    if name in list_packs():
        raise InputError(f"{name}: is shipped, and need not be made")
    return Recipe(grains=int(found[1]), seed=ord(found[2]) - ord("a") + 1, t0=PAPER_T0)


def grain_of(shape: str, overlap: float | None) -> Clump:
    """The grain that `--shape` and `--overlap` ask for.

    Raises:
        ValueError: if they do not describe a grain.
        FileNotFoundError: if there is no such file.
    """
    if shape == "tetra":
        return grain.tetra(CLUMP_OVERLAP if overlap is None else overlap)
    if overlap is not None:
        raise InputError(f"--overlap does nothing with --shape {shape}: it is that of a tetra grain")
    if shape == "sphere":
        return grain.sphere()
    if "." not in shape and not Path(shape).is_file():
        raise InputError(f"--shape must be tetra or sphere, or a file of spheres, got {shape!r}")
    return load_clump(Path(shape))


@with_recipe
def prepare_command(
    recipe: Recipe,
    standard: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]", help="A standard pack, tetra-N-x, to be made at the paper's rate and kept by that name."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="File to write; needed without NAME.")] = None,
    shape: Annotated[
        str, typer.Option(help="Grain: tetra, sphere, or a file of spheres, x y z r in every line.")
    ] = "tetra",
    overlap: Annotated[
        float | None,
        typer.Option(help=f"Overlap O of a tetra grain, in [0, 1); default {CLUMP_OVERLAP}.", show_default=False),
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the pack; default from grain, size and seed.")] = "",
    backend: Annotated[str, typer.Option(help="Code that computes the steps: auto, jax or native.")] = "auto",
    frames: KeptFrames = 0,
    restart: Restart = False,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Prepare a pack: gas, pressure, frictionless cycles, rest.

    A standard pack (tetra-31680-a, or another N or letter) is made once and found by its name from then on.
    """
    clump = grain_of(shape, overlap)
    if standard is not None:
        own = ("output", "shape", "overlap", "name", *(entry.name for entry in fields(Recipe)))
        recipe, name, output = standard_recipe(standard), standard, kept_pack(standard)
        refuse_idle(f"beside {standard}: the name of a standard pack says all about it", *own)
        if output is None:
            raise InputError(f"{standard}: there is no home folder to keep it in; set XDG_CACHE_HOME")
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{output.parent}: cannot make this folder ({error.strerror}); set XDG_CACHE_HOME"
            ) from error
    elif output is None:
        raise InputError("--output is missing: name a file, or a standard pack like tetra-31680-a")
    require_name(name)
    preparation_frames(recipe, frames)  # refuses an impossible number before anything is begun
    check_output(output, ".h5", force=force)
    made = graded(recipe, clump)
    backend = backend_name(backend, Frictionless())
    cost = announce(f"{recipe.grains} grains", grain_steps(recipe, made), PREPARATION_BYTES * recipe.grains, backend)
    # Patience is not in the key: a pack that did not come to rest can go on with more of it.
    told = {name: value for name, value in asdict(recipe).items() if name != "patience"}
    key = {"recipe": told, "grain": fingerprint(clump), "backend": backend, "frames": frames, **sources()}
    if dry_run:
        foresee(output, key, restart=restart)
        emit_cost(as_json, cost, output, pack_bytes(recipe.grains, frames))
        return
    began = time.perf_counter()
    stages: dict[str, Sample] = {}
    film: list[Frames] = []
    with resumable(output, key, restart=restart) as parts:
        with reporting(goes_on=True) as progress:
            kept: Any = {"log": stages, "frames": frames, "film": film}
            pack = prepare(recipe, clump, name=name, backend=backend, cache=parts, progress=progress, **kept)
        save_pack(output, pack, stages, *film)
    seconds = time.perf_counter() - began
    rest = pack.info["at_rest"]
    log(f"at rest: largest grain speed {rest['largest_speed']:.1e} R/t_c; wrote {output} in {seconds:.0f} s")
    result = {"pack": pack.name, "output": str(output), "seconds": seconds, "status": 0, **rest}
    result["pressure_over_wanted"] = pressure_over_wanted(pack.info)
    print_result(as_json, result, tables.pack_table(pack))


COMMANDS = {"prepare": prepare_command}
