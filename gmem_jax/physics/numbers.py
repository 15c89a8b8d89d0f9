"""Checks that arguments are real numbers in double precision, and numbers and counts in words."""

import operator
from decimal import Decimal
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

LONGEST = 160  # characters of a value in a message


def is_real(value: Any) -> bool:
    """Whether a value is a real number, or an array or a sequence of real numbers; tracers of JAX count as real."""
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
    """A value as a message shows it: its repr in one line, cut after `LONGEST` characters."""
    words = " ".join(repr(value).split())
    return words if len(words) <= LONGEST else f"{words[:LONGEST]}..."


def require_numbers(**values: Any) -> None:
    """Refuse tracers, and values that are not single real numbers; None, which stands for a default, is accepted.

    Raises:
        ValueError: naming the first such value, and what was given.
    """
    for name, value in values.items():
        if isinstance(value, jax.core.Tracer):
            raise ValueError(f"{name} is fixed when a program is compiled: it must be a number, not traced")
        if value is not None and not (is_real(value) and np.ndim(value) == 0):
            raise ValueError(f"{name} must be a number, got {said(value)}")


def require_double(**parts: Any) -> None:
    """Refuse arrays in less than double precision: those that were made before JAX's 64-bit mode was on.

    Raises:
        ValueError: naming the first such array.
    """
    for name, part in parts.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(part):
            kind = getattr(leaf, "dtype", np.dtype(float))
            if jnp.issubdtype(kind, jnp.floating) and kind.itemsize < 8:
                raise ValueError(
                    f"{name}{jax.tree_util.keystr(path)} is {kind}, and float64 is needed: make or load the {name} "
                    'after jax.config.update("jax_enable_x64", True)'
                )


def require_whole(name: str, value: Any, least: int = 0) -> int:
    """An integer of any type, as an int.

    Raises:
        ValueError: if `value` is no integer (a float or a bool is none), or smaller than `least`.
    """
    try:
        number = least - 1 if isinstance(value, bool | np.bool) else operator.index(value)
    except TypeError:
        number = least - 1
    if number < least:
        raise ValueError(f"{name} must be a whole number from {least}, got {said(value)}")
    return number


def plural(number: int, what: str) -> str:
    """A count with its noun, whose plural ends in s: "1 signal", "2 signals"."""
    return f"{number} {what}{'s' * (number != 1)}"
