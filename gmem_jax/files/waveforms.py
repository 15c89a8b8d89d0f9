"""Waveforms as tables of samples: CSV and NPY."""

from pathlib import Path

import numpy as np

from gmem_jax.experiment.signals import Spline
from gmem_jax.files.atomic import FileFormatError, atomic


def load_waveforms(path: Path) -> np.ndarray:
    """Waveform samples [S, n] from a CSV (one column per signal) or NPY ([n] or [S, n]) file.

    Row k is I at u = k / (n + 1), k = 1..n. A CSV may have one header line of names.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it cannot be read as real numbers, is ragged, has a column of u, or holds numbers that are
            not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        values = _npy(path) if path.suffix.lower() == ".npy" else _csv(path)
    except FileFormatError:
        raise
    except (ValueError, TypeError, EOFError, UnicodeDecodeError, MemoryError) as error:
        raise FileFormatError(f"{path}: not a table of numbers ({error})") from error
    if values.ndim != 2 or values.shape[1] < 2:
        raise FileFormatError(f"{path}: a waveform needs at least 2 samples; found an array of shape {values.shape}")
    if not np.all(np.isfinite(values)):
        where = np.argwhere(~np.isfinite(values))[0]
        raise FileFormatError(f"{path}: sample {where[1] + 1} of signal {where[0] + 1} is not a finite number")
    return values


def _npy(path: Path) -> np.ndarray:
    values = np.load(path, allow_pickle=False)
    if not np.issubdtype(values.dtype, np.floating) and not np.issubdtype(values.dtype, np.integer):
        raise FileFormatError(f"{path}: samples must be real numbers, found {values.dtype}")
    return np.atleast_2d(values.astype(float))


def _csv(path: Path) -> np.ndarray:
    lines = [line for line in path.read_text().splitlines() if line.strip()]
    first = lines[0].split(",") if lines else []
    numbers = [_is_number(cell) for cell in first]
    if any(numbers) and not all(numbers):
        raise FileFormatError(f"{path}: its first line mixes numbers and words ({lines[0].strip()[:40]!r})")
    names = [] if all(numbers) else [cell.strip().lower() for cell in first]
    values = np.loadtxt(lines[1:] if names else lines, delimiter=",", ndmin=2).T
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


def save_waveforms(path: Path, signals: Spline) -> None:
    """Write waveforms as a CSV that `load_waveforms` and `gmem recall --signals` read: a column for every signal.

    Raises:
        OSError: if the path cannot be written.
    """
    values = np.asarray(signals.nodes)[:, 1:-1].T
    header = ",".join(f"signal_{number + 1}" for number in range(values.shape[1]))
    with atomic(path) as temporary:
        np.savetxt(temporary, values, delimiter=",", header=header, comments="", fmt="%.17g")
