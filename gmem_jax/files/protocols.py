"""Protocols as TOML: stages one after the other, and the sets of waveforms that they write.

    [[stage]]
    kind = "cycle"              # a builder, as gm.cycle, with its arguments
    [[stage]]
    kind = "write"
    xy = "first"                # waveforms by channel: the name of a set, "sine:n", or samples
    [[stage]]
    name = "wait"               # or the fields of a gm.Stage
    role = "hold"
    length = 2.0
    pressure = {z = 2e-3}       # by axis
    [[stage]]
    kind = "read"
    [signals]                   # sets of waveforms by name, each as `--signals` takes it
    first = "six"

TOML has no None: with `to = "stay"` u stands still in a stage that writes or reads.
"""

import inspect
import json
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from gmem_jax.errors import FileFormatError
from gmem_jax.experiment import protocols, stages
from gmem_jax.files.atomic import atomic
from gmem_jax.files.validation import is_number, refusing, title, whole
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.channels import CHANNELS
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stage import Drive, Stage

BUILDERS: dict[str, Callable[..., Stage | tuple[Stage, ...]]] = {
    one.__name__: one
    for one in (
        stages.cycle,
        stages.rest,
        stages.hold,
        stages.compress,
        stages.write,
        stages.read,
        stages.train,
        stages.shake,
    )
}
MOST_STAGES = 10_000  # stages: more are a mistake
STAY = "stay"
_BUILT = ("start", "stop", "length", "role", "drives", "along", "of")  # fields that only builders set
_MORE = [entry.name for entry in fields(Stage) if entry.name not in _BUILT]
_OF_ALL = [name for name in _MORE if name not in ("name", "pressure", "mark")]  # for kinds that make several stages
_AXES = ("x", "y", "z")
_SHOWN = 80  # characters of a value that is refused


class ProtocolFile(NamedTuple):
    """The content of a protocol's file.

    Attributes:
        protocol: the protocol.
        signals: pairs of the name of a set of waveforms and its value for `--signals`; () if the file names none.
    """

    protocol: Protocol
    signals: tuple[tuple[str, str], ...] = ()


def ready_protocols() -> dict[str, Callable[[], Protocol]]:
    """The protocols of `gm.protocols` that need no arguments, by name."""
    found: dict[str, Callable[[], Protocol]] = {}
    for name, made in vars(protocols).items():
        if inspect.isfunction(made) and made.__module__ == protocols.__name__ and not name.startswith("_"):
            needed = [one for one in inspect.signature(made).parameters.values() if one.default is one.empty]
            if not needed:
                found[name] = made
    return found


def named_protocol(name: Any) -> ProtocolFile:
    """A protocol by its name on the command line and in sweeps.

    Args:
        name: a .toml file, one of `ready_protocols`, or the tables of such a file.

    Raises:
        ValueError: if there is no protocol of this name, or the tables do not make one.
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file does not make a protocol.
    """
    if isinstance(name, Mapping):
        return written_of(name)
    known = ready_protocols()
    if isinstance(name, str) and name in known:
        return ProtocolFile(known[name]())
    if not isinstance(name, str) or Path(name).suffix.lower() != ".toml":
        one_of = f" or one of {', '.join(known)}" if known else ""
        raise ValueError(f"protocol {_shown(name)}: must be a .toml file{one_of}")
    return read_protocol(Path(name))


@usual_rules()
def load_protocol(path: str | Path) -> Protocol:
    """Read a protocol from a TOML file; docs/tutorial_protocols.md describes the format.

    A table [signals] in the file is not read here: it is for `gmem recall --protocol` and sweeps.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is no TOML, or makes no protocol; the message names the stage.
    """
    return read_protocol(Path(path)).protocol


@usual_rules()
def save_protocol(path: str | Path, protocol: Protocol) -> None:
    """Write a protocol as a TOML file, from which `load_protocol` makes the same protocol.

    Raises:
        OSError: if the path cannot be written.
    """
    with atomic(Path(path)) as temporary:
        temporary.write_text("\n".join(_toml(protocol)), encoding="utf-8")


def read_protocol(path: Path) -> ProtocolFile:
    """The content of a protocol's file; errors are those of `load_protocol`."""
    tables = toml_of(path)
    try:
        return written_of(tables)
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def toml_of(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it is not TOML.
    """
    with refusing(path, "TOML file"):
        try:
            return tomllib.loads(path.read_text(encoding="utf-8-sig"))
        except (ValueError, RecursionError) as error:
            raise FileFormatError(f"{path}: not TOML ({error})") from error


def written_of(tables: Mapping[str, Any]) -> ProtocolFile:
    """The protocol and the sets of waveforms that tables describe.

    Raises:
        ValueError: naming the stage, and what would be right.
    """
    if unknown := sorted(set(tables) - {"stage", "signals"}):
        raise ValueError(f"no table {unknown[0]!r} in a protocol; there are [[stage]] and [signals]")
    listed, sets = tables.get("stage"), tables.get("signals", {})
    if not isinstance(listed, list) or not listed or not all(isinstance(one, Mapping) for one in listed):
        raise ValueError("a protocol is made of tables [[stage]], and there are none")
    if not isinstance(sets, Mapping) or ("signals" in tables and not sets):
        raise ValueError('[signals] is a table of sets by name, as xy = "six"')
    for name, value in sets.items():
        if not (name.isidentifier() and name != "kind"):
            raise ValueError(f"[signals] {name!r}: the name of a set is made of letters, digits and _")
        if not isinstance(value, str):
            raise ValueError(f'[signals] {name}: must be "six", "words:L" or a file, got {_shown(value)}')
    parts: list[tuple[Stage, ...]] = []
    for number, one in enumerate(listed, 1):
        try:
            parts.append(_built(one))
            if sum(map(len, parts)) > MOST_STAGES:
                raise ValueError(f"more than {MOST_STAGES} stages")
        except (ValueError, TypeError) as error:
            raise ValueError(f"stage {number}: {error}") from error
    return ProtocolFile(_joined(parts), tuple(sets.items()))


def _joined(parts: list[tuple[Stage, ...]]) -> Protocol:
    try:
        return Protocol(parts)
    except ValueError:
        for number in range(1, len(parts) + 1):  # an error of a stage does not depend on later stages
            try:
                Protocol(parts[:number])
            except ValueError as error:
                raise ValueError(f"stage {number}: {error}") from error
        raise


def _built(table: Mapping[str, Any]) -> tuple[Stage, ...]:
    """The stages of a table."""
    if "kind" not in table:
        _require_keys(table, "a stage without a kind", [entry.name for entry in fields(Stage)], ["name"])
        return (Stage(**{name: stage_value(name, value) for name, value in table.items()}),)
    kind = table["kind"]
    if not isinstance(kind, str) or kind not in BUILDERS:
        raise ValueError(f"its kind must be one of {', '.join(BUILDERS)}; got {_shown(kind)}")
    builder = BUILDERS[kind]
    signature = inspect.signature(builder).parameters
    own = [name for name, one in signature.items() if one.kind != one.VAR_KEYWORD]
    needed = [name for name in own if signature[name].default is inspect.Parameter.empty]
    more = [name for name in (_OF_ALL if kind in ("cycle", "train") else _MORE) if name not in own]
    more += ["along"] if kind == "read" else []
    written = [*own, *(CHANNELS if "channels" in signature else ())]
    given = {name: value for name, value in table.items() if name != "kind"}
    _require_keys(given, f"a stage of kind {kind!r}", [*written, *more], needed)
    arguments = {name: given[name] for name in written if name in given}
    made = builder(**{name: _argument(name, value, signature.get(name)) for name, value in arguments.items()})
    changed = {name: stage_value(name, value) for name, value in given.items() if name in more}
    return tuple(replace(stage, **changed) for stage in (made if isinstance(made, tuple) else (made,)))


def _require_keys(table: Mapping[str, Any], what: str, known: list[str], needed: list[str]) -> None:
    if unknown := [name for name in table if name not in known]:
        raise ValueError(f"{what} has no {unknown[0]!r}; it has {', '.join(known)}")
    if missing := [name for name in needed if name not in table]:
        raise ValueError(f"{what} needs {' and '.join(missing)}")


def _argument(name: str, value: Any, parameter: inspect.Parameter | None = None) -> Any:
    """The value of an argument of a builder, or of a field of a drive."""
    if name == "waveform" or name in CHANNELS:
        return _waveform(name, value)
    if name == "to" and value == STAY and parameter is not None and "None" in str(parameter.annotation):
        return None
    return stage_value(name, value)


def _waveform(name: str, value: Any) -> Any:
    if isinstance(value, str) and title(value):
        return value
    if isinstance(value, list) and len(value) > 1 and all(map(is_number, value)):
        return tuple(map(float, value))
    raise ValueError(f'{name} must be the name of a set, "sine:n", or two or more samples; got {_shown(value)}')


def _pressure(value: Any) -> tuple[float | None, ...]:
    known = isinstance(value, Mapping) and value and set(value) <= set(_AXES)
    if not known or not all(map(is_number, value.values())):
        raise ValueError(f"pressure must be numbers by axis, as {{z = 2e-3}}; got {_shown(value)}")
    return tuple(value.get(axis) for axis in _AXES)


def _drives(value: Any) -> tuple[Drive, ...]:
    known = [entry.name for entry in fields(Drive)]
    if not isinstance(value, list) or not all(isinstance(one, Mapping) for one in value):
        raise ValueError(f'drives must be tables, as [{{channel = "xy", waveform = "xy"}}]; got {_shown(value)}')
    found = []
    for one in value:
        _require_keys(one, "a drive", known, [])
        found.append(Drive(**{name: _argument(name, part) for name, part in one.items()}))
    return tuple(found)


_TEXTS = ("name", "role", "along", "of", "channel")
_FLAGS = ("friction", "mark", "recorded")
_WHOLE = ("times", "periods")


def stage_value(name: str, value: Any) -> Any:
    """The value of a field of a stage, or of an argument of a builder, from its value in TOML.

    Raises:
        ValueError: if the value is not of the kind that belongs to the name.
    """
    if name == "pressure":
        return _pressure(value)
    if name == "drives":
        return _drives(value)
    if name in _TEXTS:
        right, words = title(value), "a text"
    elif name in _FLAGS:
        right, words = isinstance(value, bool), "true or false"
    elif name in _WHOLE:
        right, words = whole(value) and 1 <= value <= MOST_STAGES, f"a whole number from 1 to {MOST_STAGES}"
    else:
        right, words = is_number(value), "a number"
    if not right:
        raise ValueError(f"{name} must be {words}, got {_shown(value)}")
    return float(value) if words == "a number" else value


def _shown(value: Any) -> str:
    return json.dumps(value, default=str, ensure_ascii=False)[:_SHOWN]


def _toml(protocol: Protocol) -> Iterator[str]:
    """The lines of a protocol's file."""
    for stage in protocol.to_list():
        yield "[[stage]]"
        if "pressure" in stage:
            held = zip(_AXES, stage["pressure"], strict=True)
            stage["pressure"] = {axis: value for axis, value in held if value is not None}
        for name, value in stage.items():
            yield f"{name} = {_text(value)}"
        yield ""


def _text(value: Any) -> str:
    """A value in TOML."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name} = {_text(part)}" for name, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_text, value)) + "]"
    return json.dumps(value, ensure_ascii=False)
