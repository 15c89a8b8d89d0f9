"""Checks of files before their numbers are used: shapes and types of arrays, fields of JSON.

They serve packs, recalls, parts, nets and waveforms.
"""

import importlib
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import jax
import numpy as np

from gmem_jax.errors import FileFormatError
from gmem_jax.physics.grain import require_radii
from gmem_jax.physics.rules import require_started
from gmem_jax.simulation.stage import BINS

DTYPES = {"real": ("float32", "float64"), "whole": ("int32", "int64"), "text": ("bytes",)}
# Dimensions that have one length in every file.
FIXED_LENGTHS = {"u": BINS, "axis": 3, "component": 4, "side": 2, "plane": 6}
MOST_DIGITS = 18  # digits of a whole number: no count or seed has more
NAME = 200  # most characters of a name
PATH = 4096  # most characters of a path
# Names in TOML and JSON by the kind of their values; all other names have a number, or lists of numbers.
TEXTS = (
    "pack",
    "boundary",
    "signals",
    "friction",
    "law",
    "kind",
    "shape",
    "background",
    "shear",
    "backend",
    "precision",
    "variant",
    "sizes",
    "shares",
)
WHOLE_NUMBERS = ("steps", "points", "grains", "seed", "cycles")
YES_OR_NO = ("scale",)
_SHOWN = 160  # characters of a library's error that are shown


@contextmanager
def refusing(path: Path, what: str) -> Iterator[None]:
    """Turn any error in the block into one line that names the file and says that it is not a readable `what`.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: for any other error that the file causes.
        StartError: if JAX does not start; see `gmem_jax.physics.rules`.
    """
    if not Path(path).is_file():
        there = "is a folder, not a file" if Path(path).is_dir() else "is no regular file"
        raise FileNotFoundError(f"{path}: {there if Path(path).exists() else 'no such file'}")
    try:
        yield
    except FileFormatError as error:
        said = str(error)
        raise FileFormatError(said if str(path) in said else f"{path}: {said}") from error
    except jax.errors.JaxRuntimeError:  # the machine's error, like no memory on a device
        raise
    except Exception as error:  # a broken file may make a parser stumble in any way
        require_started()
        said = " ".join(str(error.args[0] if isinstance(error, KeyError) and error.args else error).split())[:_SHOWN]
        raise FileFormatError(f"{path}: not a readable {what} ({said or type(error).__name__})") from error


def optional(name: str, extra: str) -> Any:
    """A module of an optional package, which an extra of this package installs.

    Raises:
        ValueError: if it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ValueError(f"this needs {name}, of the extra {extra}: pip install '.[{extra}]' in a checkout") from None


class Array(NamedTuple):
    """A declared array.

    Attributes:
        kind: "real", "whole" or "text".
        shape: lengths of its dimensions, or names; a name stands for the same length everywhere.
        units: units of its numbers.
        words: a description in one line.
    """

    kind: str
    shape: tuple[int | str, ...] = ()
    units: str = "1"
    words: str = ""

    @property
    def attributes(self) -> dict[str, str]:
        """Units and description, as files and datasets carry them."""
        return {"units": self.units, "description": self.words}


def fit(declared: Mapping[str, Array], found: Mapping[str, Any]) -> dict[str, int]:
    """The lengths that the names in a declaration stand for.

    Args:
        declared: declarations by name of array.
        found: arrays, or other objects with a shape and a dtype, by name; undeclared ones are ignored.

    Raises:
        FileFormatError: if an array is missing, or has another shape or kind than declared.
    """
    lengths = dict(FIXED_LENGTHS)
    for name, (kind, shape, *_) in declared.items():
        if name not in found:
            raise FileFormatError(f"incomplete file, {name!r} is missing")
        own, dtype = tuple(found[name].shape), np.dtype(found[name].dtype)
        if not dtype.name.startswith(DTYPES[kind]) or not dtype.isnative:
            raise FileFormatError(f"{name!r} holds {dtype}, must hold {' or '.join(DTYPES[kind])}")
        if len(own) == len(shape):
            for length, symbol in zip(own, shape, strict=True):
                if isinstance(symbol, str):
                    lengths.setdefault(symbol, length)
        wanted = tuple(lengths.get(symbol, -1) if isinstance(symbol, str) else symbol for symbol in shape)
        if own != wanted:
            words = ", ".join(str(FIXED_LENGTHS.get(str(symbol), symbol)) for symbol in shape)
            known = ", ".join(
                f"{name} = {lengths[name]}" for name in lengths if name in shape and name not in FIXED_LENGTHS
            )
            raise FileFormatError(
                f"{name!r} has shape {list(own)}, must be [{words}]" + (f" with {known}" * bool(known))
            )
    return lengths


def require(holds: Any, words: str) -> None:
    """Refuse a file if a condition does not hold everywhere.

    Raises:
        FileFormatError: with these words.
    """
    if not np.all(holds):
        raise FileFormatError(words)


def require_finite(arrays: Mapping[str, np.ndarray]) -> None:
    """Refuse numbers that are not finite.

    Raises:
        FileFormatError: naming the first array that holds one.
    """
    for name, array in arrays.items():
        require(np.isfinite(array), f"{name} holds numbers that are not finite")


def require_sizes(radii: np.ndarray | None, sizes: np.ndarray | None) -> None:
    """Refuse radii of a grain's spheres and sizes of grains that no pack can have; None means that all are 1.

    Raises:
        FileFormatError: saying what they are, and what they may be.
    """
    one = np.ones(1)
    try:
        require_radii(np.outer(one if sizes is None else sizes, one if radii is None else radii))
    except ValueError as error:
        raise FileFormatError(str(error)) from error


def json_of(text: Any, what: str) -> dict[str, Any]:
    """The JSON object in a text.

    Raises:
        FileFormatError: if the text is not a JSON object.
    """
    try:
        value = json.loads(text, parse_int=_whole)
    except (ValueError, TypeError, RecursionError) as error:
        raise FileFormatError(f"its {what} is not JSON ({error})") from error
    require(isinstance(value, dict), f"its {what} is not a JSON object")
    return dict(value)


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def is_number(value: Any) -> bool:
    """Whether a value is a finite real number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf


def require_kinds(values: Mapping[str, Any]) -> None:
    """Refuse values of TOML, JSON or the command line that are not of the kind that belongs to their names.

    Args:
        values: values by name, which may be dotted; None stands for a default.

    Raises:
        ValueError: naming the first value of a wrong kind, such as a text instead of a number.
    """
    for name, value in values.items():
        kind = name.rpartition(".")[2]
        if name.partition(".")[0] == "protocol":  # checked by `gmem_jax.files.protocols`
            continue
        if kind in TEXTS:
            right, words = isinstance(value, str), "a text"
        elif kind in YES_OR_NO:
            right, words = isinstance(value, bool), "true or false"
        elif kind in WHOLE_NUMBERS:
            right, words = isinstance(value, int) and not isinstance(value, bool), "a whole number"
        else:
            right, words = _numeric(value), "a number"
        if value is not None and not right:
            raise ValueError(f"{name} must be {words}, got {json.dumps(value, default=str)[:_SHOWN]}")


def _numeric(value: Any) -> bool:
    """Whether a value is a number or lists of numbers. Values that JSON cannot hold pass: their users check them."""
    return all(map(_numeric, value)) if isinstance(value, list) else not isinstance(value, bool | str | Mapping | None)


def numbers(value: Any) -> bool:
    """Whether a value is a finite real number, or a list of such numbers that is not empty."""
    return is_number(value) or (isinstance(value, list) and len(value) > 0 and all(map(is_number, value)))


def title(value: Any, most: int = NAME) -> bool:
    """Whether a value is a text of at most `most` characters that can be printed in a line."""
    return isinstance(value, str) and len(value) <= most and value.isprintable()


def source(value: Any) -> bool:
    """Whether a value can be the path of a file or the name of a pack."""
    return title(value, PATH)


def whole(value: Any) -> bool:
    """Whether a value is a whole number from 0 that a float holds exactly (below 2^53)."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 53


def require_fields(value: Any, what: str, **wanted: Any) -> None:
    """Refuse a JSON object in which a field is missing or fails its test.

    Raises:
        FileFormatError: naming the field.
    """
    require(isinstance(value, dict), f"its {what} is not a JSON object")
    for name, accepts in wanted.items():
        require(name in value, f"its {what} has no {name!r}")
        require(accepts(value[name]), f"its {what} has an impossible {name!r}")


def read_npy(file: BinaryIO, size: int, name: str) -> np.ndarray:
    """The array of an .npy file of a known size, which is compared with its header before anything is allocated.

    Raises:
        FileFormatError: if it holds other data than plain numbers, or other than `size` bytes in all.
        ValueError: if its header cannot be read.
    """
    version = np.lib.format.read_magic(file)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    require(read is not None, f"{name} has a header of another version")
    assert read is not None
    shape, fortran, dtype = read(file)
    require(dtype.kind in "fiub", f"{name}: samples must be real numbers, found {dtype}")
    require(len(shape) <= 32 and all(isinstance(length, int) and length >= 0 for length in shape), f"{name}: its shape")
    declared = math.prod(shape) * dtype.itemsize
    left = size - file.tell()
    require(declared == left, f"{name} declares shape {list(shape)}, {declared} bytes; the file holds {left} of them")
    values = np.frombuffer(file.read(declared), dtype).copy()
    return values.reshape(shape[::-1]).T if fortran else values.reshape(shape)
