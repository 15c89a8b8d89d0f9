"""Writing results as JSON by a schema, with the units and description of every field."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gmem_jax.errors import FileFormatError
from gmem_jax.files.atomic import atomic
from gmem_jax.files.printing import finite
from gmem_jax.files.schemas import GRADIENT, READING, TUNED, Schema, other_kind
from gmem_jax.files.validation import is_number, json_of, refusing, require, title, whole

_LARGEST = 1 << 28  # bytes
_KINDS = (GRADIENT, TUNED, READING)


def save_result(path: Path, schema: Schema, result: dict[str, Any]) -> None:
    """Write the fields of a result.

    Raises:
        OSError: if the path cannot be written.
    """
    about = {
        name: " ".join(filter(None, (field.words, f"({field.units})" if field.units else "")))
        for name, field in schema.arrays.items()
    }
    with atomic(path) as temporary:
        content = finite({"schema": schema.name, **result, "about": about})
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def load_result(path: Path) -> tuple[Schema, dict[str, Any]]:
    """Read what `save_result` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it is not a result, or a field is missing or of a wrong kind.
    """
    path = Path(path)
    with refusing(path, "result"):
        require(path.stat().st_size <= _LARGEST, f"a result of more than {_LARGEST >> 20} MB")
        found = json_of(path.read_text(encoding="utf-8"), "content")
        schema = _schema_of(found)
        for name, field in schema.arrays.items():
            value, missing = _at(found, name)
            if not (missing and field.kind == "real, if any"):
                require(not missing, f"incomplete file, {name!r} is missing")
                require(_ACCEPTS[field.kind](value), f"it has an impossible {name!r}")
        return schema, found


def _schema_of(found: dict[str, Any]) -> Schema:
    told = found.get("schema")
    for schema in _KINDS:
        if told == schema.name:
            return schema
    raise FileFormatError(other_kind(told, *(schema.name for schema in _KINDS)))


def _at(found: Any, path: str) -> tuple[Any, bool]:
    """The value at a path, and whether it is missing."""
    for name in path.split("/"):
        if not isinstance(found, dict) or name not in found:
            return None, True
        found = found[name]
    return found, False


def _real(value: Any) -> bool:
    return value is None or is_number(value) or (isinstance(value, list) and all(map(_real, value)))


_ACCEPTS: dict[str, Callable[[Any], bool]] = {
    "real": _real,
    "real, if any": _real,
    "rows": lambda value: isinstance(value, list) and all(isinstance(row, list) and _real(row) for row in value),
    "whole": whole,
    "text": title,
    "list": lambda value: isinstance(value, list),
    "object": lambda value: isinstance(value, dict),
}
