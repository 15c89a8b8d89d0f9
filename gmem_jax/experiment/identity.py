"""What a user's own law, waveform or observer is, told by its numbers and by its code: a hash that outlasts a process.

The name of a class says nothing of its formula, and `repr` shortens large arrays.
"""

import functools
import hashlib
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import CodeType, FunctionType, MethodType
from typing import Any

import jax
import numpy as np

_INSTALLED = tuple({*map(sysconfig.get_path, ("stdlib", "purelib", "platlib")), str(Path(__file__).parents[1])})
"""Folders whose code is told by its name: versions and sources are in keys already."""
_PLAIN = (str, bytes, int, float, complex)
_ARRAYS = (jax.Array, np.ndarray, np.generic)


def fingerprint(tree: Any) -> str:
    """SHA-256 of the arrays of a pytree, shapes and types included."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = np.asarray(leaf)
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def identity(value: Any) -> str:
    """SHA-256 of an object: its numbers, and the code of its class or of the function that it is.

    Of code it is the byte code, its constants, what it closes over, its defaults, and what it names of its module, down
    to functions called from there. Code of installed packages is told by its name. Another version of Python has other
    byte code. What an object reads elsewhere, as in a file, is not seen.
    """
    digest = hashlib.sha256()
    for part in _parts(value, {}):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()


def _parts(value: Any, seen: dict[int, Any]) -> Iterator[str]:
    """What makes an object, in words; `seen` has what is told already, and keeps it, since an id is used again."""
    if isinstance(value, _PLAIN) or value is None:
        yield f"{type(value).__name__} {value!r}"
    elif isinstance(value, _ARRAYS):
        yield fingerprint(value)
    elif isinstance(value, set | frozenset):
        yield repr(sorted(map(repr, value)))  # the order of a set is another in each process
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
    elif isinstance(value, functools.partial):
        yield from _parts((value.func, value.args, value.keywords), seen)
    elif isinstance(value, MethodType):
        yield from _parts((value.__func__, value.__self__), seen)
    elif hasattr(value, "__wrapped__"):  # as of jax.jit
        yield from _parts(value.__wrapped__, seen)
    elif hasattr(value, "__qualname__"):
        yield f"{value.__module__}.{value.__qualname__}"
        if isinstance(value, FunctionType) and not _is_installed(value.__code__.co_filename):
            closed = [cell.cell_contents for cell in value.__closure__ or ()]
            named = {name: value.__globals__[name] for name in _names(value.__code__) if name in value.__globals__}
            yield from _parts((value.__code__, value.__defaults__, value.__kwdefaults__, closed, named), seen)
        elif isinstance(value, type) and not _is_installed_type(value):
            yield from _parts({name: each for name, each in vars(value).items() if _is_code(name, each)}, seen)
            yield from _parts(value.__bases__, seen)
    else:
        yield from _parts(type(value), seen)
        if is_dataclass(value):
            yield from _parts({entry.name: getattr(value, entry.name) for entry in fields(value)}, seen)
        elif isinstance(value, property | staticmethod | classmethod | functools.cached_property):
            yield from _parts([getattr(value, name, None) for name in ("fget", "func", "__func__")], seen)
        elif not _is_installed_type(type(value)):
            yield from _parts(vars(value) if hasattr(value, "__dict__") else (), seen)


def _is_code(name: str, value: Any) -> bool:
    """Whether an attribute of a class is a method, a property or a constant, and none that Python has made."""
    own = not name.startswith("__") or name in ("__call__", "__post_init__", "__init__", "__getattr__")
    kinds = (FunctionType, property, staticmethod, classmethod, functools.cached_property, tuple)
    return own and isinstance(value, (*_PLAIN, *_ARRAYS, *kinds))


def _names(code: CodeType) -> set[str]:
    """The names that code looks up, its inner functions included."""
    inner = (_names(each) for each in code.co_consts if isinstance(each, CodeType))
    return set(code.co_names).union(*inner)


def _is_installed(file: str) -> bool:
    return file.startswith((*_INSTALLED, "<frozen"))


def _is_installed_type(kind: type) -> bool:
    file = getattr(sys.modules.get(kind.__module__), "__file__", None)
    return kind.__module__ in sys.builtin_module_names or (file is not None and _is_installed(file))
