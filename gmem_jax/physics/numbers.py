"""Checks that arguments are real numbers, and numbers and counts in words."""

import operator
from decimal import Decimal
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

LONGEST = 160  # characters of a value in a message


def is_real(value: Any) -> bool:
    """Whether it is a real number, or an array or a sequence of them; what JAX traces is taken for one."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value)):
        return True
    try:
        kind = jnp.dtype(getattr(value, "dtype", None) or np.asarray(value).dtype)
    except (TypeError, ValueError):  # lists of unequal lengths
        return False
    if kind.kind == "O":
        return isinstance(value, Real | Decimal)
    return bool(jnp.issubdtype(kind, jnp.integer) or jnp.issubdtype(kind, jnp.floating))


def said(value: Any) -> str:
    """A value as a message names it: in one line, and no longer than that."""
    words = " ".join(repr(value).split())
    return words if len(words) <= LONGEST else f"{words[:LONGEST]}..."


def require_numbers(**values: Any) -> None:
    """Refuse what is no real number where one is asked for; None stands for a default.

    Raises:
        ValueError: naming the first that is none, and what was given.
    """
    for name, value in values.items():
        if value is not None and not (is_real(value) and np.ndim(value) == 0):
            raise ValueError(f"{name} must be a number, got {said(value)}")


def require_whole(name: str, value: Any, least: int = 0) -> int:
    """A whole number, however it was written.

    Raises:
        ValueError: if it is none, or smaller than `least`.
    """
    try:
        number = least - 1 if isinstance(value, bool | np.bool) else operator.index(value)
    except TypeError:
        number = least - 1
    if number < least:
        raise ValueError(f"{name} must be a whole number from {least}, got {said(value)}")
    return number


def plural(number: int, what: str) -> str:
    """So many of something whose plural ends in s: "1 signal", "2 signals"."""
    return f"{number} {what}{'s' * (number != 1)}"
