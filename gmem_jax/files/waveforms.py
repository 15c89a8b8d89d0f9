"""Waveforms as tables of samples: CSV and NPY."""

import codecs
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gmem_jax.experiment.signals import Signals, Spline
from gmem_jax.files.atomic import FileFormatError, atomic
from gmem_jax.files.checked import json_of, numbers, read_npy, refusing, require_fields, title
from gmem_jax.files.configuration import signals_from, written_signals

_LARGEST = 1 << 28  # bytes of a table: 4,096 words at 1,000 samples take 80 MB
_TARGET, _DESIGN = "# target: ", "# design: "


def load_waveforms(path: Path) -> np.ndarray:
    """Waveform samples [S, n] from a CSV (one column per signal) or NPY ([n] or [S, n]) file.

    Row k is I at u = k / (n + 1), k = 1..n. A CSV may have one header line of names.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it cannot be read as real numbers, is ragged, has a column of u, or holds numbers that are
            not finite.
    """
    path = Path(path)
    with refusing(path, "table of numbers"):
        if path.stat().st_size > _LARGEST:
            raise FileFormatError(f"{path}: waveforms in a file of more than {_LARGEST >> 20} MB")
        values = _npy(path) if path.suffix.lower() == ".npy" else _csv(path)
    if values.ndim != 2 or values.shape[0] < 1 or values.shape[1] < 2:
        raise FileFormatError(f"{path}: a waveform needs at least 2 samples; found an array of shape {values.shape}")
    if not np.all(np.isfinite(values)):
        where = np.argwhere(~np.isfinite(values))[0]
        raise FileFormatError(f"{path}: sample {where[1] + 1} of signal {where[0] + 1} is not a finite number")
    return values


def load_target(path: Path) -> Signals | None:
    """The waveforms whose recall those of a designed file imitate; None for a file that was not designed.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it has a target that cannot be read.
    """
    path = Path(path)
    with refusing(path, "table of numbers"):
        found = _comment(path, _TARGET)
        return signals_from(found) if found else None


def load_design(path: Path) -> dict[str, Any]:
    """How the design of a designed file went: pack, before, fidelity, gain, history; {} if the file does not say.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if what it says cannot be read.
    """
    with refusing(path, "table of numbers"):
        found = _comment(Path(path), _DESIGN)
        if found:
            amounts = dict.fromkeys(("before", "fidelity", "gain", "history"), numbers)
            require_fields(found, "design", pack=title, **amounts)
        return found


def _comment(path: Path, mark: str) -> dict[str, Any]:
    """The JSON of a comment in one of the first two lines; {} if there is none."""
    with path.open("rb") as file:
        lines = [file.readline(_LARGEST) for _ in range(2)]
    for line in (line.removeprefix(codecs.BOM_UTF8) for line in lines):
        if line.startswith(mark.encode()):
            return json_of(line.decode().removeprefix(mark), mark.strip("# :"))
    return {}


def _npy(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        return np.atleast_2d(read_npy(file, path.stat().st_size, "it").astype(float))


def _csv(path: Path) -> np.ndarray:
    lines = [line for line in path.read_text("utf-8-sig").splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        return np.zeros((0, 0))
    first = lines[0].split(",")
    numbers = [_is_number(cell) for cell in first]
    if any(numbers) and not all(numbers):
        raise FileFormatError(f"{path}: its first line mixes numbers and words ({lines[0].strip()[:40]!r})")
    names = [] if all(numbers) else [cell.strip().lower() for cell in first]
    rows = lines[1:] if names else lines
    values = np.loadtxt(rows, delimiter=",", ndmin=2).T if rows else np.zeros((0, 0))
    u = (np.arange(values.shape[1]) + 1.0) / (values.shape[1] + 1.0)
    if "u" in names or (len(values) > 1 and np.allclose(values[0], u, atol=1e-6)):
        raise FileFormatError(f"{path}: has a column of u; give the waveforms alone, row k at u = k / (n + 1)")
    return values


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def save_waveforms(
    path: Path, signals: Spline, target: Signals | None = None, *, design: Mapping[str, Any] | None = None
) -> None:
    """Write waveforms as a CSV that `load_waveforms` and `gmem recall --signals` read: a column for every signal.

    Args:
        path: the file.
        signals: the waveforms.
        target: those whose recall they imitate, kept in a comment that `load_target` reads.
        design: how that went, kept in a comment that `load_design` reads.

    Raises:
        OSError: if the path cannot be written.
    """
    values = np.asarray(signals.nodes)[:, 1:-1].T
    header = ",".join(f"signal_{number + 1}" for number in range(values.shape[1]))
    if design is not None:
        header = f"{_DESIGN}{json.dumps(design)}\n{header}"
    if target is not None:
        header = f"{_TARGET}{json.dumps(written_signals(target))}\n{header}"
    with atomic(path) as temporary:
        np.savetxt(temporary, values, delimiter=",", header=header, comments="", fmt="%.17g", encoding="utf-8")
