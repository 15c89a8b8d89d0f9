"""Hashes of laws, waveforms and observers by their numbers and their code, the same in every process.

The name of a class says nothing of its formula, `repr` shortens large arrays, and `jax.tree.structure` does not tell
classes apart: on JAX 0.12 the structures of two dataclasses with the same fields are equal.
"""

import hashlib
import os
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path, PurePath
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_INSTALLED = tuple(
    f"{folder}{os.sep}"
    for folder in {*map(sysconfig.get_path, ("stdlib", "purelib", "platlib")), str(Path(__file__).parents[1])}
)
"""Folders of installed code. Its names suffice, since keys hold its versions and sources already."""
_PLAIN = (str, bytes, int, float, complex, range, slice, Enum, PurePath, np.dtype)
_HOLDING = (list, tuple, set, frozenset, Mapping)
_OF_NO_WEIGHT = ("__repr__", "__str__", "__annotate__", "__annotate_func__", "__class__")
_ARRAYS = (jax.Array, np.ndarray, np.generic)


def fingerprint(tree: Any) -> str:
    """SHA-256 of the arrays of a pytree, shapes and types included."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        array = np.asarray(jax.random.key_data(leaf) if is_key else leaf)
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def identity(value: Any) -> str:
    """SHA-256 of an object: of its numbers and of the code of its class; of the code, if the object is a function.

    Code is hashed by its byte code, constants, defaults, closure, and the objects that it names in its own module and
    in other modules that are not installed; so are the functions that it calls there. Code of installed packages is
    hashed by its name. Byte code differs between versions of Python. Data that an object reads elsewhere, as from a
    file, are not hashed.
    """
    digest = hashlib.sha256()
    for part in _parts(value, {}):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()


def _parts(value: Any, seen: dict[int, Any]) -> Iterator[str]:
    """The parts of an object as texts, to be hashed.

    `seen` has the objects by id that were hashed already. It also keeps them alive, since Python reuses ids.
    """
    if not isinstance(value, type) and not _is_installed_type(type(value)) and isinstance(value, _PLAIN + _HOLDING):
        yield from _parts(type(value), seen)  # as of a NamedTuple, or of a kind of number
    if isinstance(value, _PLAIN) or value is None:
        yield f"{type(value).__name__} {value!r}"
    elif isinstance(value, _ARRAYS):
        yield fingerprint(value)
    elif isinstance(value, set | frozenset):
        yield repr(sorted(map(repr, value)))  # the order of a set differs between processes
    elif id(value) in seen:
        yield "again"
    else:
        seen[id(value)] = value
        if isinstance(value, Mapping):
            value = sorted(value.items(), key=lambda item: repr(item[0]))
        if isinstance(value, list | tuple):
            yield f"{type(value).__name__} {len(value)}"
            for each in value:
                yield from _parts(each, seen)
        else:
            yield from _parts_of_code(value, seen)


def _parts_of_code(value: Any, seen: dict[int, Any]) -> Iterator[str]:
    if isinstance(value, CodeType):
        yield from _parts((value.co_code, value.co_names, value.co_consts), seen)
    elif isinstance(value, MethodType):
        yield from _parts((value.__func__, value.__self__), seen)
    elif isinstance(value, property):  # Python 3.13 gives it a name
        yield from _parts(value.fget, seen)
    elif hasattr(value, "__wrapped__") and not _is_own_function(value):  # as of jax.jit and staticmethod
        inner, held = value.__wrapped__, getattr(value, "__dict__", {}).items()
        yield from _parts(inner, seen)
        if more := {name: each for name, each in held if _is_own_function(each) and each is not inner}:
            yield from _parts(more, seen)  # for example, a derivative of its own
    elif name := getattr(value, "__qualname__", getattr(value, "__name__", "")):
        yield f"{getattr(value, '__module__', '')}.{name}"
        if _is_own_function(value):
            closed = [cell.cell_contents for cell in value.__closure__ or ()]
            parts = (value.__code__, value.__defaults__, value.__kwdefaults__, closed, _named(value))
            yield from _parts(parts, seen)
        elif isinstance(value, type) and not _is_installed_type(value):
            yield from _parts({name: each for name, each in vars(value).items() if _is_own(name, each)}, seen)
            yield from _parts(value.__bases__, seen)
    else:
        yield from _parts(type(value), seen)
        if is_dataclass(value):
            yield from _parts({entry.name: getattr(value, entry.name) for entry in fields(value)}, seen)
        else:
            yield from _parts(_held(value), seen)


def _held(value: Any) -> Any:
    """The data of an object, as `copy` would take them."""
    try:
        made = value.__reduce_ex__(2)
    except Exception:  # it cannot be copied, for whatever reason of its class
        return getattr(value, "__dict__", {})
    return made if isinstance(made, str) else made[1:3]


def _is_own(name: str, value: Any) -> bool:
    """Whether an attribute of a class was written by its author and can change its results."""
    return not (name.startswith("__") and name.endswith("__")) or (callable(value) and name not in _OF_NO_WEIGHT)


def _named(function: FunctionType) -> dict[str, Any]:
    """The objects that a function names in its module and in modules that are not installed, however deep."""
    names, package = _names(function.__code__), function.__globals__.get("__package__")
    imported = {name: sys.modules.get(name) or sys.modules.get(f"{package}.{name}") for name in names}
    found = {name: module for name, module in imported.items() if _is_own_module(module)}
    found |= {name: function.__globals__[name] for name in names if name in function.__globals__}
    modules, looked_into = list(found.items()), set()
    for name, each in modules:  # the list grows in this loop
        if _is_own_module(each) and id(each) not in looked_into:
            looked_into.add(id(each))
            within = {of: vars(each)[of] for of in names if of in vars(each)}
            found |= {f"{name}.{of}": one for of, one in within.items()}
            modules += within.items()
    return found


def _names(code: CodeType) -> set[str]:
    """The names that code looks up, its inner functions included."""
    inner = (_names(each) for each in code.co_consts if isinstance(each, CodeType))
    return set(code.co_names).union(*inner)


def _is_own_function(value: Any) -> bool:
    return isinstance(value, FunctionType) and not _is_installed(value.__code__.co_filename)


def _is_own_module(value: Any) -> bool:
    """Whether it is a module of the user's: from a file or made by hand, neither installed nor built in."""
    return (
        isinstance(value, ModuleType)
        and value.__name__ not in sys.builtin_module_names
        and not _is_installed(_file(value))
    )


def _is_installed(file: str) -> bool:
    return file.startswith((*_INSTALLED, "<frozen"))


def _is_installed_type(kind: type) -> bool:
    return kind.__module__ in sys.builtin_module_names or _is_installed(_file(sys.modules.get(kind.__module__)))


def _file(module: ModuleType | None) -> str:
    """The file of a module; "" for one that was typed or is built into Python."""
    return getattr(module, "__file__", None) or ""
