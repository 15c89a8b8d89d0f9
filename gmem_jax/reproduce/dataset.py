"""The recalls behind the figures as one archive for others: files of recalls, a table of them, and how to read both."""

import csv
import hashlib
import io
import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gmem_jax.experiment.provenance import versions
from gmem_jax.experiment.record import values_of
from gmem_jax.files.atomic import atomic
from gmem_jax.files.datasets import plain_cell
from gmem_jax.files.schemas import RECALL
from gmem_jax.physics.numbers import plural
from gmem_jax.reproduce.compare import ComputedPoint, counted
from gmem_jax.sweeps.store import Store

COLLECTED = ("fig06", "fig08", "fig09", "fig11", "fig12a", "fig12b", "fig13")
"""Figures whose points are in the archive; the other figures show the same points, or none."""

README = """# Recalled waveforms of granular packs

A jammed pack of frictional grains that is slowly compressed while a small shear waveform is applied gives the waveform
back on decompression, as shear stress on its walls (arXiv:2603.14595). These are {count} such experiments, simulated by
gmem_jax {version} (`gmem reproduce dataset --scale {scale}`): the points of figs. {figures} of the paper.{missing}

- points.csv: a line for each experiment: its file, the SHA-256 of that, the conditions, the pack's name and SHA-256,
  t0 (duration of one compression, in units of t_c = R sqrt(rho / E)), gain G and fidelity F, and the bits of its status
  (0: sound).
- recalls/*.h5: HDF5, schema {schema}. `p_sig` [signal, u] is the recalled stress, and `J` [signal, u] the integral of
  the waveform: p_sig = G E delta0 gamma0 J, ideally. `u` is the compression, from 0 to 1. Groups below `stages` hold
  pressures, filling, contacts and more in time. Every array has its units and a description. The attribute
  `configuration` has all numbers of the experiment and its pack as JSON, with the versions that computed it. The first
  512 bytes of a file hold the SHA-256 of the others; HDF5 steps over them.

    import h5py
    with h5py.File("recalls/{example}.h5") as file:
        p_sig, J, u = (file[name][...] for name in ("p_sig", "J", "u"))

`gmem_jax.load_recall("recalls/{example}.h5")` reads one and checks it; `gmem report` draws it.

{measure}
"""


def write_dataset(
    path: Path, store: Store, points: Sequence[ComputedPoint], scale: str, t0: float, failed: int = 0
) -> None:
    """Write the archive (ZIP): README.md, points.csv, and the files of the recalls as they are.

    Args:
        path: path of the archive; an older one is replaced.
        store: the store with the recalls.
        points: the points of the archive.
        scale: scale of the figures, as it was asked for.
        t0: t0 of that scale, in t_c, which decides which G and F count (`counted`).
        failed: number of points that failed, and so are missing.

    Raises:
        OSError: if it cannot be written.
    """
    gain, fidelity = counted(t0)
    table = io.StringIO()
    rows = [_row(store, point, gain, fidelity) for point in points]
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    averaged = "over the ringing period of the pack, since this rate makes it ring" if gain != "gain" else "as recalled"
    told = README.format(
        count=len(points),
        version=versions()["gmem-jax"],
        scale=scale,
        figures=", ".join(name.removeprefix("fig").lstrip("0") for name in COLLECTED),
        missing=f"\nMissing: {plural(failed, 'more point')}, whose runs failed." if failed else "",
        schema=RECALL.name,
        example=points[0].key,
        measure=f"G and F of points.csv are {averaged}. Versions: {json.dumps(versions())}.",
    )
    with (
        atomic(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, strict_timestamps=False) as archive,
    ):
        archive.writestr("README.md", told)
        archive.writestr("points.csv", table.getvalue())
        for point in points:
            archive.write(store.at(point.key), f"recalls/{point.key}.h5")


def _row(store: Store, point: ComputedPoint, gain: str, fidelity: str) -> dict[str, Any]:
    """A line of points.csv."""
    configuration = store.load(point.key).configuration
    pack = configuration["experiment"]["pack"]
    numbers = {
        "file": f"recalls/{point.key}.h5",
        "sha256": hashlib.sha256(store.at(point.key).read_bytes()).hexdigest(),
        **asdict(point.conditions),
        "pack": pack["name"],
        "pack_sha256": pack["sha256"],
        "t0": values_of(configuration)["t0"],
        "G": point.numbers[gain],
        "F": point.numbers[fidelity],
        "status": point.numbers["status"],
    }
    return {name: plain_cell(value) for name, value in numbers.items()}
