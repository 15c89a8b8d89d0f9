"""docs/files.md, from the tables that files are written from and read by.

python docs/make/files_page.py
"""

from collections.abc import Mapping
from pathlib import Path

from gmem_jax.files.schemas import FRAMES, PACK, RECALL, RUBBED, SCHEMAS, STAGE, Schema
from gmem_jax.files.validation import FIXED_LENGTHS, Array


def page() -> str:
    """The text of docs/files.md."""
    return "\n".join([_INTRODUCTION, *(_section(schema) for schema in SCHEMAS)])


_INTRODUCTION = """# What the files hold

<!-- made by docs/make/files_page.py -->

Units are R = E = rho = 1, time in t_c = R sqrt(rho / E); `gm.Material` converts to SI. The time axis of stages is in
t0, the duration of one compression. `gmem show FILE` prints what any of these files holds, `gmem show FILE --plot WHAT
-o x.png` draws it (`--plot list` says what there is), and `gmem show FILE --csv` gives the recalled signals.

HDF5 files open without this package. Every dataset has the attributes `units` and `description`, and a dimension scale
for each of its dimensions (those that are no dataset of the tables below count from 0):

```python
import h5py
import xarray

h5py.File("recall.h5")["p_sig"].attrs["units"]
xarray.open_dataset("recall.h5", engine="h5netcdf").p_sig.isel(signal=0).plot()
xarray.open_dataset("recall.h5", engine="h5netcdf", group="stages/readout").pressure
```

With xarray (`pip install '.[export]'`), `gm.to_xarray(gm.load_recall("recall.h5"))` is one dataset, its stages one
after the other along `time`. The first 512 bytes are a SHA-256 of the rest: a file that was changed by another program
is refused here. JSON files carry their fields' units and descriptions in `about`.
"""


_SEVERAL = (
    "Where a protocol reads several times, or on several channels, the waveforms, `p_sig` and the measures have the "
    "axes read and channel before their own, and the gains a last axis, the channel that was written on. The "
    "attributes `reads` and `channels` name them. In `stages/NAME`, `observed_X` is what the observer X gave: a value "
    "or an array of them for each bin and replica."
)


_STAGES = (
    "In `stages/NAME`, in the order of the attribute `order` (in packs where they were kept). Stages that all replicas "
    "have in common, those before the first waveform and of preparations, have the dimension `common` of length 1 in "
    "the place of `replica`:"
)


_SIZES = (
    "Where spheres are not all of radius 1, the pack has one or both of these arrays, and so have `frames`. Then mass, "
    "moments, diameter and offsets are those of a grain of size 1."
)


def _section(schema: Schema) -> str:
    name = f"`{schema.name}`. " if schema.name else ""
    lines = [f"## {schema.title}", "", f"{name}{schema.words}", ""]
    lines += _table(schema.arrays)
    if schema is RECALL:
        lines += ["", _SEVERAL]
    if schema is RECALL or schema is PACK:
        lines += ["", _STAGES, ""]
        lines += _table(STAGE)
        lines += ["", "In `frames`, where they were asked for (`--frames`), whose attribute `stages` names theirs:", ""]
        lines += _table(FRAMES | RUBBED)
    if schema is PACK:
        lines += ["", _SIZES, ""]
        lines += _table(schema.unequal)
    if schema.texts:
        lines += ["", "Attributes: " + "; ".join(f"`{name}`, {words}" for name, words in schema.texts.items()) + "."]
    return "\n".join([*lines, ""])


def _table(arrays: Mapping[str, Array]) -> list[str]:
    lines = ["| name | shape | units | |", "|---|---|---|---|"]
    for path, (_, shape, units, words) in arrays.items():
        sizes = ", ".join(
            f"{name} ({FIXED_LENGTHS[name]})" if name in FIXED_LENGTHS else str(name) for name in map(str, shape)
        )
        lines.append(f"| `{path}` | {f'[{sizes}]' if sizes else ''} | {units} | {words} |")
    return lines


if __name__ == "__main__":
    Path(__file__).parents[1].joinpath("files.md").write_text(page())
