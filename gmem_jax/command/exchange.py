"""`gmem export`, `gmem import`: configurations to and from the formats of others."""

from pathlib import Path
from typing import Annotated

import typer

from gmem_jax.command.console import AsJson, Force, InputError, Output, claim, emit, say
from gmem_jax.files.exported import FORMATS, format_of, frames_of_pack
from gmem_jax.files.frames import load_frames
from gmem_jax.files.hdf5 import schema_of
from gmem_jax.files.packs import PACK_SCHEMA, list_packs, load_pack
from gmem_jax.files.recalls import load_recall


def export(
    file: Annotated[Path, typer.Argument(help="A pack or a recall file, or the name of a shipped pack.")],
    to: Annotated[str, typer.Option(help=f"{', '.join(FORMATS)}.")],
    output: Output,
    frames: Annotated[bool, typer.Option("--frames", help="Of a pack: the configurations of its preparation.")] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a pack, or the configurations along a recall, for other programs (docs/exchange.md)."""
    if str(file) in list_packs() or schema_of(file) == PACK_SCHEMA:
        pack = load_pack(file)
        mass, found = float(pack.clump.mass), load_frames(file) if frames else frames_of_pack(pack)
        command = "prepare"
    else:
        recall, configuration = load_recall(file)
        mass, found, command, frames = configuration["grain"]["mass"], recall.frames, "recall", True
    if found is None:
        raise InputError(f"{file}: holds no configurations; keep some with gmem {command} --frames 16")
    chosen = format_of(to, several=frames)
    claim(output, chosen.suffix, inputs=(file,), force=force)
    chosen.write(output, found, mass)
    _, grains, _ = found.position.shape
    facts = {"output": str(output), "frames": found.count, "grains": grains, "spheres": grains * len(found.offsets)}
    say(f"wrote {output}: {facts['frames']} x {facts['spheres']} spheres in {grains} grains")
    emit(as_json, {**facts, "status": 0})


COMMANDS = {"export": export}
