"""Printing values safely: text without control characters, and values that JSON can hold."""

import math
from typing import Any


def printable(text: Any) -> str:
    """A text that is safe for a terminal: control characters, as in names of foreign files, are escaped."""
    return "".join(one if one.isprintable() or one in "\n\t" else ascii(one)[1:-1] for one in str(text))


def finite(value: Any) -> Any:
    """The same value with None for numbers that are not finite, which JSON does not have."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
