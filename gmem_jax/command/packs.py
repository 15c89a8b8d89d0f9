"""`gmem info`, `gmem prepare`."""

import time
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import jax
import typer

from gmem_jax import native
from gmem_jax.command.console import (
    AsJson,
    DryRun,
    Force,
    InputError,
    KeptFrames,
    announce,
    claim,
    emit,
    emit_cost,
    reporting,
    require_name,
    say,
)
from gmem_jax.command.resuming import Restart, resumable
from gmem_jax.experiment.experiment import PAPER_T0
from gmem_jax.experiment.frames import Frames
from gmem_jax.files.configuration import fingerprint
from gmem_jax.files.home import kept_pack
from gmem_jax.files.packs import STANDARD, list_packs, save_pack
from gmem_jax.files.provenance import provenance, sources
from gmem_jax.files.sizes import pack_bytes
from gmem_jax.physics import grain
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.sample import Sample
from gmem_jax.preparation.preparation import Recipe, film_of, grain_steps, prepare
from gmem_jax.show import tables


def info(as_json: AsJson = False) -> None:
    """Versions, devices, backend and shipped packs."""
    built, why = native.available()
    facts: dict[str, Any] = {
        **provenance(),
        "devices": [f"{d.platform}: {d.device_kind}" for d in jax.devices()],
        "backend": f"native ({why})" if built else f"jax (no native backend: {why})",
        "packs": list_packs(),
    }
    lines = [f"{key}: {value}" for key, value in facts["versions"].items()]
    lines += [f"commit: {facts['commit']}", f"backend: {facts['backend']}"]
    lines += [f"device: {device}" for device in facts["devices"]]
    lines += ["shipped packs: " + ", ".join(facts["packs"])]
    emit(as_json, facts, "\n".join(lines))


PREPARATION_BYTES = 2e4  # of memory a grain: lists while grains fly, at N = 10,240
_DEFAULT = Recipe()


def standard_recipe(name: str) -> Recipe:
    """The recipe of a pack that is made by its name.

    Raises:
        InputError: if it is no such name.
    """
    if not (found := STANDARD.fullmatch(name)):
        raise InputError(
            f"{name}: a standard pack is called tetra-N-x, N grains and a letter for the seed: tetra-31680-a"
        )
    if name in list_packs():
        raise InputError(f"{name}: is shipped, and need not be made")
    return Recipe(grains=int(found[1]), seed=ord(found[2]) - ord("a") + 1, t0=PAPER_T0)


def prepare_command(
    standard: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]", help="A standard pack, tetra-N-x, to be made at the paper's rate and kept by that name."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="File to write.")] = None,
    grains: Annotated[int, typer.Option(help="Number of grains N.")] = _DEFAULT.grains,
    shape: Annotated[str, typer.Option(help="tetra or sphere.")] = "tetra",
    overlap: Annotated[float, typer.Option(help="Overlap O of a tetra grain, in [0, 1).")] = 0.6,
    seed: Annotated[int, typer.Option(help="Random seed.")] = _DEFAULT.seed,
    delta0: Annotated[
        float, typer.Option(help="Areal compression of the cycles and of the experiment.")
    ] = _DEFAULT.delta0,
    t0: Annotated[float, typer.Option(help="Duration of one compression, t_c.")] = _DEFAULT.t0,
    dt: Annotated[float, typer.Option(help="Largest time step, t_c.")] = _DEFAULT.dt,
    name: Annotated[str, typer.Option(help="Name of the pack; default from grain, size and seed.")] = "",
    backend: Annotated[str, typer.Option(help="auto, jax or native.")] = "auto",
    frames: KeptFrames = 0,
    restart: Restart = False,
    dry_run: DryRun = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Prepare a pack: gas, pressure, frictionless cycles, rest.

    A standard pack (tetra-31680-a, or another N or letter) is made once and found by its name from then on.
    """
    if shape not in ("tetra", "sphere"):
        raise InputError(f"--shape must be tetra or sphere, got {shape!r}")
    clump = grain.tetra(overlap) if shape == "tetra" else grain.sphere()
    recipe = Recipe(grains=grains, seed=seed, delta0=delta0, t0=t0, dt=dt)
    if standard is not None:
        if output is not None or name or recipe != _DEFAULT or (shape, overlap) != ("tetra", 0.6):
            raise InputError(f"{standard}: the name of a standard pack says all about it; leave other options away")
        recipe, name, output = standard_recipe(standard), standard, kept_pack(standard)
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{output.parent}: cannot make this folder ({error.strerror}); set XDG_CACHE_HOME"
            ) from error
    elif output is None:
        raise InputError("--output is missing: name a file, or a standard pack like tetra-31680-a")
    require_name(name)
    film_of(recipe, frames)  # refuses what cannot be before anything is begun
    claim(output, ".h5", force=force)
    backend = native.name(backend, Frictionless())
    cost = announce(f"{recipe.grains} grains", grain_steps(recipe, clump), PREPARATION_BYTES * recipe.grains, backend)
    if dry_run:
        emit_cost(as_json, cost, output, pack_bytes(recipe.grains, frames))
        return
    began = time.perf_counter()
    stages: dict[str, Sample] = {}
    film: list[Frames] = []
    key = {"recipe": asdict(recipe), "grain": fingerprint(clump), "backend": backend, "frames": frames, **sources()}
    with resumable(output, key, restart=restart) as parts:
        with reporting(goes_on=True) as progress:
            kept: Any = {"log": stages, "frames": frames, "film": film}
            pack = prepare(recipe, clump, name=name, backend=backend, keep=parts, progress=progress, **kept)
        save_pack(output, pack, stages, *film)
    seconds = time.perf_counter() - began
    rest = pack.info["at_rest"]
    say(f"at rest: largest grain speed {rest['largest_speed']:.1e} R/t_c; wrote {output} in {seconds:.0f} s")
    result = {"pack": pack.name, "output": str(output), "seconds": seconds, "status": 0, **rest}
    emit(as_json, result, tables.pack_table(pack))


COMMANDS = {"info": info, "prepare": prepare_command}
