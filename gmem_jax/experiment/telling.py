"""Whom a run tells how far it is: by default the person at a terminal or a notebook, by the outermost call alone."""

import contextlib
import functools
import importlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, ParamSpec, TypeVar

from gmem_jax.experiment.host import Progress, silent

Telling = Progress | bool | None
"""A callback; False for none; True for a bar; None for a bar in a terminal or a notebook, and nothing elsewhere."""

P = ParamSpec("P")
T = TypeVar("T")

_told: ContextVar[bool] = ContextVar("_told", default=False)


@contextlib.contextmanager
def told_elsewhere() -> Iterator[None]:
    """Show no bar by default: a program shows its own."""
    before = _told.set(True)
    try:
        yield
    finally:
        _told.reset(before)


def telling(function: Callable[P, T]) -> Callable[P, T]:
    """A function whose keyword `progress` is a `Telling`; what it calls shows no bar of its own."""

    @functools.wraps(function)
    def tell(*args: P.args, **kwargs: P.kwargs) -> T:
        asked: Any = kwargs.get("progress")
        with told_elsewhere() if _told.get() else _bar(asked) as bar, told_elsewhere():
            return function(*args, **{**kwargs, "progress": asked if callable(asked) else bar})  # type: ignore[arg-type]

    return tell


@contextlib.contextmanager
def _bar(asked: Telling) -> Iterator[Progress | None]:
    from_above = importlib.import_module("gmem_jax.show.progress")  # what shows stands on a floor above
    if asked is False or callable(asked) or not (asked or from_above.watched()):
        yield None
        return
    bar = from_above.ProgressBar()
    try:
        yield bar
    finally:
        bar.close()


def callback(progress: Telling) -> Progress:
    """What to call."""
    return progress if callable(progress) else silent
