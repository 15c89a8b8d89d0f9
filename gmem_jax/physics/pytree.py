"""Frozen dataclasses as pytrees; their numbers are checked when a user makes one, not when JAX does.

A field is data (an array, a number, another pytree) unless it says otherwise: `static` fields are part of the
structure that a program is compiled for; a `label` is carried along but compiles nothing anew.
"""

import copy
import inspect
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import MISSING, field, fields, is_dataclass, replace
from typing import Any, NamedTuple, TypeVar

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.numbers import is_real, said
from gmem_jax.physics.rules import usual_rules

Scalar = float | jax.Array
"""A parameter: one number, or an array that broadcasts against the replica axis [B]."""

_T = TypeVar("_T")


class Interval(NamedTuple):
    """The interval in which a parameter may lie; read from words like "[0, inf)"."""

    words: str
    low: float
    high: float

    def holds(self, value: Any) -> Any:
        """Whether a value lies in the interval, elementwise; False for NaN."""
        above = value >= self.low if self.words.startswith("[") else value > self.low
        return above & (value <= self.high if self.words.endswith("]") else value < self.high)


def interval(words: str) -> Interval:
    """The interval that words like "[0, inf)" describe."""
    low, high = words[1:-1].split(",")
    return Interval(words, float(low), float(high))


def parameter(default: Any, within: str = "(-inf, inf)", words: str = "", unit: str = "", **more: bool) -> Any:
    """A data field that is a float: one number, or one for each replica [B].

    Args:
        default: its default; None where it follows from others.
        within: an interval, like "[0, inf)".
        words: what it is, for `--help` and the tables of the documentation.
        unit: its unit, "" for a pure number.
        more: further metadata (see `gmem_jax.experiment.experiment.NUMBERS`).
    """
    return field(default=default, metadata={"interval": interval(within), "words": words, "unit": unit, **more})


def static(default: Any = MISSING, words: str = "", unit: str = "", **more: bool) -> Any:
    """A field that programs are compiled for: hashable, and no array; arguments are those of `parameter`."""
    return field(default=default, metadata={"static": True, "words": words, "unit": unit, **more})


def label(default: str, *, given: bool = True) -> Any:
    """A text field that no program is compiled for; the result of a transformation may carry another object's label.

    Args:
        default: its default.
        given: whether it is an argument of `__init__`, and `==` compares it.
    """
    return field(default=default, metadata={"label": True}, init=given, compare=given)


RECORDS: dict[str, type] = {}
"""Every class that `static_record` registered, by name."""


def static_record(cls: type[_T]) -> type[_T]:
    """Register a frozen, hashable dataclass that may be the value of a static field of an exported program."""
    RECORDS[cls.__name__] = cls
    return cls


class _Labels(tuple[str, ...]):
    """Texts that are equal to JAX, whatever they say."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Labels)

    def __hash__(self) -> int:
        return 0


REGISTERED: dict[str, type] = {}
"""Every class that `pytree` registered, by name: what files may hold."""


def _alike(one: Any, other: Any) -> bool:
    """Whether two values of fields are equal, arrays in shape and in every number."""
    if one is other:
        return True
    if isinstance(one, np.ndarray | jax.Array) or isinstance(other, np.ndarray | jax.Array):
        return bool(np.array_equal(one, other))
    if isinstance(one, dict) and isinstance(other, dict):
        return list(one) == list(other) and all(_alike(one[name], other[name]) for name in one)
    if isinstance(one, tuple | list) and type(one) is type(other):
        return len(one) == len(other) and all(map(_alike, one, other))
    return bool(one == other)


def _equal(self: Any, other: Any) -> Any:
    """Whether all fields that are compared are equal, arrays in shape and in every number."""
    if type(other) is not type(self):
        return NotImplemented
    compared = (entry.name for entry in fields(self) if entry.compare)
    return all(_alike(getattr(self, name), getattr(other, name)) for name in compared)


def _short(value: Any) -> str:
    """A value in few letters; an array is shown by its dtype and shape."""
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name!r}: {_short(each)}' for name, each in value.items())}}}"
    if isinstance(value, np.ndarray | jax.Array):
        alone = value.ndim == 0 and not isinstance(value, jax.core.Tracer)
        return repr(value.item()) if alone else f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    return said(value)


def short_repr(made: Any) -> str:
    """A `__repr__` for dataclasses with large arrays: the fields in one line, arrays by dtype and shape."""
    told = (f"{entry.name}={_short(getattr(made, entry.name))}" for entry in fields(made) if entry.repr)
    return f"{type(made).__name__}({', '.join(told)})"


def comparable(cls: type[_T]) -> type[_T]:
    """Let `==` of a dataclass that holds arrays be True or False; its hash stays, as equal objects have equal ones."""
    cls.__eq__ = _equal  # type: ignore[method-assign]
    return cls


def typed(tree: _T) -> _T:
    """The same tree without weak types: Python's floats become np.float64, weakly typed arrays strongly typed.

    So a number that was given as a float and one that was given as an array share a compiled program.
    """

    def one(leaf: Any) -> Any:
        if type(leaf) is float:
            return np.float64(leaf)
        return jax.lax.convert_element_type(leaf, leaf.dtype) if getattr(leaf, "weak_type", False) else leaf

    found: _T = jax.tree.map(one, tree)
    return found


def pytree(cls: type[_T]) -> type[_T]:
    """Register a frozen dataclass with JAX. Rebuilding one runs no checks: its leaves may be tracers, or anything."""
    REGISTERED[comparable(cls).__name__] = cls
    kinds: dict[str, list[str]] = {"data": [], "static": [], "label": []}
    for entry in fields(cls):  # type: ignore[arg-type]
        kinds[next((kind for kind in ("static", "label") if kind in entry.metadata), "data")].append(entry.name)
    data, fixed, labels = kinds.values()

    def flatten(made: _T) -> tuple[list[tuple[Any, Any]], Any]:
        children = [(jax.tree_util.GetAttrKey(name), getattr(made, name)) for name in data]
        structure = tuple(getattr(made, name) for name in fixed), _Labels(getattr(made, name) for name in labels)
        return children, structure

    def unflatten(structure: Any, children: Any) -> _T:
        made = object.__new__(cls)
        values = (*zip(data, children, strict=True), *zip(fixed, structure[0], strict=True))
        for name, value in (*values, *zip(labels, structure[1], strict=True)):
            object.__setattr__(made, name, value)
        return made

    jax.tree_util.register_pytree_with_keys(cls, flatten, unflatten)
    if cls.__module__.startswith("gmem_jax."):
        jax.export.register_pytree_node_serialization(
            cls,
            serialized_name=f"gmem_jax.{cls.__name__}",
            serialize_auxdata=lambda structure: json.dumps(structure, default=_record).encode(),
            deserialize_auxdata=_structure,
        )
    return cls


def _structure(written: bytes | bytearray) -> Any:
    """The structure that `flatten` returns beside the children, read from an exported program."""
    fixed, labels = json.loads(written)
    return tuple(map(_hashable, fixed)), _Labels(labels)


def _record(made: Any) -> dict[str, Any]:
    return {"record": type(made).__name__, **{entry.name: getattr(made, entry.name) for entry in fields(made)}}


def _hashable(value: Any) -> Any:
    if isinstance(value, dict):
        made: Any = object.__new__(RECORDS[value.pop("record")])
        for name, part in value.items():
            object.__setattr__(made, name, _hashable(part))
        return made
    return tuple(map(_hashable, value)) if isinstance(value, list) else value


def with_field(made: _T, name: str, value: Any) -> _T:
    """The same object with another value of a field.

    If `__init__` takes all fields, the class makes the object anew, with its checks. Otherwise the object is copied: a
    user's class may have an `__init__` with other arguments.
    """
    whole: Any = made
    if isinstance(made, tuple):
        return whole._replace(**{name: value})  # type: ignore[no-any-return]
    taken = inspect.signature(type(made).__init__).parameters
    anew = is_dataclass(made) and all(entry.name in taken for entry in fields(whole) if entry.init)
    if anew:
        return replace(whole, **{name: value})  # type: ignore[no-any-return]
    changed = copy.copy(made)
    object.__setattr__(changed, name, value)
    return changed


def map_numbers(change: Callable[[Any], Any], made: _T, deeper: Callable[[Any], Any] = lambda leaf: leaf) -> _T:
    """An object whose own numbers, scalar or [B], are changed by `change`, and numbers of objects in it by `deeper`.

    The two differ because an array within a friction law may have length B by chance: the weights of a network, for
    example, are shared by all replicas.
    """
    found: _T = jax.tree_util.tree_map_with_path(
        lambda path, leaf: change(leaf) if len(path) == 1 else deeper(leaf), made
    )
    return found


def traced(*trees: Any) -> bool:
    """Whether any leaf of the trees is a tracer of JAX."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def _number(value: Any) -> Any:
    """One kind of number for every way to write it, so that 1, 1.0 and np.float32(1) share a program.

    An array of JAX stays one, since some libraries differentiate with respect to arrays of JAX alone.
    """
    if not isinstance(value, jax.Array) and np.ndim(value) == 0:
        return float(value)
    return jnp.asarray(value, float)


def _parameters(made: Any) -> Iterator[tuple[str, Interval]]:
    for entry in fields(made):
        if "interval" in entry.metadata and not entry.default is getattr(made, entry.name) is None:
            yield entry.name, entry.metadata["interval"]


@usual_rules()
def validate(made: Any) -> None:
    """Bring the parameters of a new object to one kind of number, and refuse those outside their interval.

    Raises:
        ValueError: naming the parameter, where it may lie, and what was given. Traced values cannot be refused; see
            `out_of_range`.
    """
    for name, interval in _parameters(made):
        given = getattr(made, name)
        if type(given) is object:  # JAX's own placeholder, in a subclass that `pytree` did not register
            continue
        if not is_real(given):
            raise ValueError(f"{name} must be a number or an array of numbers, got {said(given)}")
        value = _number(given)
        if not traced(value) and not np.all(interval.holds(np.asarray(value))):
            raise ValueError(f"{name} must be in {interval.words}, got {_shown(given)}")
        object.__setattr__(made, name, value)


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float | int) and math.isfinite(value) else str(value)


def out_of_range(made: Any) -> jax.Array:
    """Whether any parameter in `made`, or in a pytree of this kind within it, is outside its interval; a scalar."""
    bad = jnp.asarray(False)
    for name, interval in _parameters(made):
        bad |= ~jnp.all(interval.holds(jnp.asarray(getattr(made, name))))
    for entry in fields(made):
        within = getattr(made, entry.name)
        if is_dataclass(within):
            bad |= out_of_range(within)
    return bad
