"""Printing values safely: text without control characters, and values that JSON can hold."""

import math
from typing import Any


def printable(text: Any) -> str:
    """A text in which nothing acts on a terminal: control characters, as in the names of foreign files, are escaped."""
    return "".join(one if one.isprintable() or one in "\n\t" else ascii(one)[1:-1] for one in str(text))


def finite(value: Any) -> Any:
    """The same with null for numbers that are none, which JSON does not have."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
