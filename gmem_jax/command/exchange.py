"""The commands `gmem export` and `gmem import`: configurations in the formats of other programs."""

from pathlib import Path
from typing import Annotated

import typer

from gmem_jax.command.console import (
    AsJson,
    Force,
    InputError,
    Output,
    check_output,
    log,
    print_result,
    reporting,
    require_name,
)
from gmem_jax.files.configuration import material_from
from gmem_jax.files.exporters import EXPORT_FORMATS, format_of, frames_of_pack
from gmem_jax.files.frames import load_frames
from gmem_jax.files.hdf5 import schema_of
from gmem_jax.files.packs import load_pack, pack_called, save_pack
from gmem_jax.files.recalls import load_recall
from gmem_jax.files.schemas import PACK
from gmem_jax.show import tables


def export(
    file: Annotated[Path, typer.Argument(help="A pack or a recall file, or the name of a pack.")],
    to: Annotated[str, typer.Option(help=f"Format: {', '.join(EXPORT_FORMATS)}.")],
    output: Output,
    frames: Annotated[
        bool,
        typer.Option(
            "--frames", help="Of a pack: the configurations kept during its preparation, not the pack at rest."
        ),
    ] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a pack or the frames of a recall for other programs (docs/exchange.md)."""
    file = pack_called(str(file)) or file
    if schema_of(file) == PACK.name:
        pack = load_pack(file)
        material = material_from(pack.info.get("material", {}))
        mass, found = float(pack.clump.mass), load_frames(file) if frames else frames_of_pack(pack, material)
        command = "prepare"
    else:
        recall = load_recall(file)
        configuration = recall.configuration
        material = material_from(configuration.get("experiment", {}).get("material", {}))
        mass, found, command, frames = configuration["grain"]["mass"], recall.frames, "recall", True
    if found is None:
        raise InputError(f"{file}: holds no configurations; keep some with gmem {command} --frames 16")
    chosen = format_of(to, several=frames, suffix=output.suffix)
    check_output(output, chosen.suffix, inputs=(file,), force=force)
    beside = output.with_suffix("")
    taken = beside.exists() or beside.is_symlink()
    if chosen.folder and taken and not (force and beside.is_dir() and not beside.is_symlink()):
        raise InputError(
            f"--output {output}: {beside} beside it exists; name another file, or allow --force to fill it"
        )
    chosen.write(output, found, mass, material)
    _, grains, _ = found.position.shape
    facts = {"output": str(output), "frames": found.count, "grains": grains, "spheres": grains * len(found.offsets)}
    log(f"wrote {output}: {facts['frames']} x {facts['spheres']} spheres in {grains} grains")
    print_result(as_json, {**facts, "status": 0})


def import_command(
    file: Annotated[Path, typer.Argument(help="A LAMMPS data file (molecules are grains) or a .gsd file of clumps.")],
    output: Output,
    radius: Annotated[float, typer.Option(help="R in the file's unit of length: the radius of equal spheres.")] = 1.0,
    delta0: Annotated[float, typer.Option(help="Areal compression that the pack is meant for.")] = 0.05,
    name: Annotated[str, typer.Option(help="Name of the pack; default that of the file.")] = "",
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Make a pack of spheres or clumps of one shape, of any sizes."""
    # Imported here, since scipy takes half a second to load and no other command needs it.
    from gmem_jax.preparation.imported import import_pack

    require_name(name)
    check_output(output, ".h5", inputs=(file,), force=force)
    with reporting() as progress:
        pack = import_pack(file, radius=radius, delta0=delta0, name=name, progress=progress)
    save_pack(output, pack)
    log(f"wrote {output}: {pack.grains} grains, {pack.clump.shape}")
    facts = {"pack": pack.name, "output": str(output), "grains": pack.grains, "grain": pack.clump.shape}
    facts["notes"] = pack.info["imported"]["notes"]
    print_result(as_json, {**facts, "ringing_period": float(pack.ringing_period), "status": 0}, tables.pack_table(pack))


COMMANDS = {"export": export, "import": import_command}
