"""Waveforms from files of samples (CSV and NPY), from their written form, and by their names on the command line."""

import codecs
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.record import NAMED, SIGNALS, signals_to_dict
from gmem_jax.experiment.samples import Told, require_gentle, untold, waveform_from
from gmem_jax.experiment.signals import (
    LONGEST_WORD,
    Signals,
    SignalSets,
    Spline,
    signals,
    six_signals,
    waveform,
    words,
)
from gmem_jax.files.atomic import atomic
from gmem_jax.files.columns import SampleTable, read_columns
from gmem_jax.files.validation import json_of, numbers, read_npy, refusing, require_fields, require_kinds, title
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.stage import BINS

OF_WORDS = ("word_pad", "word_width")
OF_SAMPLES = ("smooth", "taper", "scale")
_SET = r"[A-Za-z_]\w*="  # the beginning of each of several sets
_LARGEST = 1 << 28  # bytes of a table: 4,096 words at 1,000 samples take 80 MB
_TARGET, _DESIGN = "# target: ", "# design: "


@usual_rules()
def load_waveforms(
    path: str | Path, *, smooth: float = 0.0, taper: float = 0.0, scale: bool = False, told: Told = untold
) -> np.ndarray:
    """Read samples of S waveforms from a CSV file (a column for each) or an NPY file (a row for each), for `waveform`.

    Sample k, k = 1..n, is I at u = k / (n + 1). A CSV file may begin with a line of names. If it has a column called u,
    or t or time (with or without a unit), the samples were taken there; times become u from 0 to 1, first to last, and
    the waveforms are interpolated as by `waveform_from`.

    Args:
        path: the file.
        smooth: as in `waveform_from`.
        taper: as in `waveform_from`.
        scale: as in `waveform_from`.
        told: called with one line of text on what was found and changed, if anything was, such as `print`.

    Returns:
        The samples, [S, n].

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file has other than real, finite numbers, rows of different lengths, decimal commas,
            names that do not fit its columns, or an axis under another name; or waveforms that no pack can follow.
    """
    path = Path(path)
    with refusing(path, "table of numbers"):
        if path.stat().st_size > _LARGEST:
            raise FileFormatError(f"{path}: waveforms in a file of more than {_LARGEST >> 20} MB")
        found = SampleTable(_npy(path)) if path.suffix.lower() == ".npy" else read_columns(path)
    values = found.values
    if values.ndim != 2 or values.shape[0] < 1 or values.shape[1] < 2:
        what = "a row of .npy, a column of other files"
        raise FileFormatError(f"{path}: a waveform needs at least 2 samples; found {values.shape}, where {what} is one")
    if not np.all(np.isfinite(values)):
        where = np.argwhere(~np.isfinite(values))[0]
        raise FileFormatError(f"{path}: sample {where[1] + 1} of signal {where[0] + 1} is not a finite number")
    said = list(found.said)
    try:
        if found.axis is not None or smooth or taper or scale:
            at, span = _places(found, said)
            made = waveform_from(at, values, span=span, smooth=smooth, taper=taper, scale=scale, told=said.append)
            values = np.asarray(made.nodes)[:, 1:-1]
        elif not _marked(path, _TARGET):  # designed waveforms were simulated as they are
            require_gentle(np.pad(values, ((0, 0), (1, 1))))
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error
    if said:
        told(f"{path}: {'; '.join(said)}")
    return values


def _places(found: SampleTable, said: list[str]) -> tuple[np.ndarray, tuple[float, float] | None]:
    """The places of the samples, and the two places that become u = 0 and 1; None for the first and the last."""
    if found.axis is None:
        count = found.values.shape[1]
        return np.arange(1, count + 1) / (count + 1.0), (0.0, 1.0)
    if found.name.lower().startswith("u"):
        return found.axis, (0.0, 1.0)
    said.append(f"{found.name} from {found.axis[0]:g} to {found.axis[-1]:g} is u from 0 to 1")
    return found.axis, None


def load_target(path: Path) -> Signals | None:
    """The target of a file of designed waveforms: those whose integrals their recalls follow; None without a target.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it has a target that cannot be read.
    """
    path = Path(path)
    with refusing(path, "table of numbers"):
        found = _comment(path, _TARGET)
        return signals_from_dict(found) if found else None


def load_design(path: Path) -> dict[str, Any]:
    """Facts about the design of a file of waveforms: pack, before, fidelity, gain, history; {} if there are none.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if they cannot be read.
    """
    with refusing(path, "table of numbers"):
        found = _comment(Path(path), _DESIGN)
        if found:
            amounts = dict.fromkeys(("before", "fidelity", "gain", "history"), numbers)
            require_fields(found, "design", pack=title, **amounts)
        return found


def _comment(path: Path, mark: str) -> dict[str, Any]:
    """The JSON of a comment in one of the first two lines; {} if there is none."""
    found = _marked(path, mark)
    return json_of(found.decode(), mark.strip("# :")) if found else {}


def _marked(path: Path, mark: str) -> bytes:
    with path.open("rb") as file:
        lines = [file.readline(_LARGEST) for _ in range(2)]
    for line in (line.removeprefix(codecs.BOM_UTF8) for line in lines):
        if line.startswith(mark.encode()):
            return line.removeprefix(mark.encode())
    return b""


def _npy(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        return np.atleast_2d(read_npy(file, path.stat().st_size, "it").astype(float))


@usual_rules()
def save_waveforms(
    path: str | Path, signals: Signals, target: Signals | None = None, *, design: Mapping[str, Any] | None = None
) -> None:
    """Write waveforms as a CSV file, a column for each, which `load_waveforms` and `gmem recall --signals` read.

    Args:
        path: the file.
        signals: the waveforms. The samples of a `Spline` are written as they are; others are sampled at k / 256,
            k = 1..255.
        target: if they were designed, the waveforms whose J their recalls follow; kept in a comment.
        design: if they were designed, facts about the design; kept in a comment.

    Raises:
        OSError: if the path cannot be written.
    """
    require_kind("save_waveforms(path, signals)", signals, Signals)
    inner = jnp.arange(1, BINS) / BINS
    values = np.asarray(signals.nodes)[:, 1:-1].T if isinstance(signals, Spline) else np.asarray(signals.shear(inner))
    header = ",".join(f"signal_{number + 1}" for number in range(values.shape[1]))
    if design is not None:
        header = f"{_DESIGN}{json.dumps(design)}\n{header}"
    if target is not None:
        header = f"{_TARGET}{json.dumps(signals_to_dict(target))}\n{header}"
    with atomic(Path(path)) as temporary:
        np.savetxt(temporary, values, delimiter=",", header=header, comments="", fmt="%.17g", encoding="utf-8")


def signals_from_dict(written: Mapping[str, Any]) -> Signals:
    """The waveforms of a written form.

    Raises:
        ValueError: if waveforms of this kind cannot be made from it, or its numbers are impossible.
    """
    kind = written.get("kind")
    if "sha256" in written:
        raise ValueError(
            f"waveforms of the class {kind}, which the library lacks, are stored only as a hash; make them in Python"
        )
    require_kinds(written)
    makers: dict[str, Callable[..., Signals]] = {**NAMED, **SIGNALS}
    if kind not in makers:
        raise ValueError(f"signals of kind {kind!r} cannot be read back")
    numbers = {name: value for name, value in written.items() if name != "kind"}
    return makers[kind](
        **{name: jnp.asarray(value, float) if isinstance(value, list) else value for name, value in numbers.items()}
    )


Sets = tuple[tuple[str, str], ...]
"""Pairs of the name of a set of waveforms and its value for `--signals`."""


def named_signals(
    name: str | Sets,
    pad: float | None = None,
    width: float | None = None,
    smooth: float | None = None,
    taper: float | None = None,
    scale: bool | None = None,
    *,
    told: Told = untold,
) -> Signals | SignalSets:
    """Waveforms by their name on the command line.

    Args:
        name: "six", "words:3" or a file; or several sets by name, as "xy=six,z=words:3".
        pad: free widths of a bit at either end of words; None here and below stands for the default.
        width: width of the bumps of words, in widths of a bit.
        smooth: for samples in a file; see `load_waveforms`.
        taper: for samples in a file.
        scale: for samples in a file.
        told: called with a line of text on what was found and changed in a file.

    Raises:
        ValueError: if the name is wrong, or one of the numbers does not apply to these waveforms.
        FileNotFoundError: if there is no such file.
        FileFormatError: if a file cannot be read.
    """
    of_words = {key: float(value) for key, value in (("pad", pad), ("width", width)) if value is not None}
    asked: dict[str, Any] = {"smooth": smooth, "taper": taper, "scale": scale}
    of_samples = {key: value for key, value in asked.items() if value is not None}
    if named := sets_named(name):
        return signals(**{one: _one_set(what, of_words, of_samples, told) for one, what in named})
    return _one_set(str(name), of_words, of_samples, told)


def sets_named(name: str | Sets) -> Sets:
    """The names of several sets of waveforms, and the value of each; () for one set.

    Raises:
        ValueError: if two sets have one name, or one is called "kind".
    """
    if not isinstance(name, str):
        return name
    if not re.match(_SET, name) or Path(name).is_file():
        return ()
    found = tuple((one.partition("=")[0], one.partition("=")[2]) for one in re.split(rf",(?={_SET})", name))
    if len(dict(found)) < len(found) or "kind" in dict(found):
        raise ValueError(f"--signals {name}: sets of waveforms have different names, and none is called kind")
    return found


def _one_set(name: str, of_words: dict[str, float], of_samples: dict[str, Any], told: Told) -> Signals:
    kind, _, length = name.lower().partition(":")
    if of_words and kind != "words":
        raise ValueError(f"--signals {name}: word_pad and word_width are for words:L only")
    if of_samples and kind in ("six", "words"):
        raise ValueError(f"--signals {name}: {', '.join(of_samples)}: for samples in a file only")
    if kind == "six":
        return six_signals()
    if kind == "words":
        if not length.isdecimal() or not 1 <= int(length) <= LONGEST_WORD:
            raise ValueError(f"--signals {name}: words need a length from 1 to {LONGEST_WORD}, as in words:3")
        return words(int(length), **of_words)
    if Path(name).suffix.lower() not in (".csv", ".npy"):
        raise ValueError(f'--signals {name}: must be "six", "words:L" or a .csv or .npy file')
    made = waveform(load_waveforms(Path(name), told=told, **of_samples))
    if Path(name).suffix.lower() == ".csv" and load_target(Path(name)) is not None:
        told(f"{name}: holds designed waveforms and their target; only gmem recall compares with the target, too")
    return made


def waveforms_of(values: Mapping[str, Any]) -> tuple[Any, ...]:
    """The arguments of `named_signals` among named values."""
    return values.get("signals") or "six", *(values.get(name) for name in (*OF_WORDS, *OF_SAMPLES))
