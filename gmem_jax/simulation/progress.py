"""Progress of runs: callbacks that report it, and bars that show it.

By default a bar appears in a terminal or a notebook, for the outermost call alone.
"""

import contextlib
import functools
import importlib
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from html import escape
from typing import Any, ParamSpec, TypeVar

from gmem_jax.simulation.stage import Stage

Progress = Callable[[str, float, float], None]
"""Called with the stage's name, the simulated time so far (t_c) and the fraction of the whole work done (0 to 1)."""

ProgressChoice = Progress | bool | None
"""A callback; False for none; True for a bar; None for a bar in a terminal or a notebook, and nothing elsewhere."""

_P = ParamSpec("_P")
_T = TypeVar("_T")

# Work of a step apart from its replicas, in units of the work of one replica: 0.9 at 10,240 grains, 1.4 at 3,267 and 2
# at 325.
STEP_WORK = 1.0
REFRESH_INTERVAL = 0.3  # seconds between changes of what a bar shows
PAUSE = 60.0, 10.0  # seconds, and multiples of the longest chunk: a wait beyond both was a pause of the program


def silent(*_: object) -> None:
    """A callback that reports nothing."""


def within(progress: Progress, begun: float, ended: float) -> Progress:
    """`progress` for a part of the work, from one fraction to another."""
    return lambda stage, time, fraction: progress(stage, time, begun + (ended - begun) * fraction)


def work_of_bin(replicas: int) -> float:
    """The work of a bin, in bins of one replica: as much as for `STEP_WORK` replicas more than there are."""
    return replicas + STEP_WORK


def work_of(stages: Iterable[Stage], replicas: int) -> float:
    """The work of some stages, in bins of one replica."""
    return sum(stage.bins for stage in stages) * work_of_bin(replicas)


def begins_anew(fraction: float, last: float) -> bool:
    """Whether a new pass has begun, such as the points of a sweep after its packs; small drops correct an estimate."""
    return fraction < 0.9 * last


class TimeLeft:
    """The time that a run still takes, from its pace since its first chunk. Compilation and pauses are left out."""

    def __init__(self) -> None:
        self._began = self._told = self._longest = 0.0
        self._first = self._last = math.inf

    def __call__(self, fraction: float) -> str:
        """The time left in words, ", 12 s left"; "" while it is not known."""
        now, (seconds, times) = time.perf_counter(), PAUSE
        waited = now - self._told
        if begins_anew(fraction, self._last):
            self._began, self._first, self._longest = now, fraction, 0.0
        elif waited > max(seconds, times * self._longest) and self._longest:
            self._began += waited
        else:
            self._longest = max(self._longest, waited)
        self._told, self._last, done = now, fraction, fraction - self._first
        return f", {(now - self._began) * (1.0 - fraction) / done:.0f} s left" if done > 0.01 and fraction < 1.0 else ""


class ProgressBar:
    """A progress bar, in a terminal or a notebook: `gm.run(experiment, progress=gm.ProgressBar())`."""

    _line = ""  # the unfinished line in the terminal

    def __init__(self) -> None:
        self._left, self._told = TimeLeft(), -math.inf
        self._display = _notebook()

    def __call__(self, stage: str, moment: float, fraction: float) -> None:
        """Show the progress; the arguments are those of `Progress`: stage, simulated time in t_c, fraction done."""
        now, left = time.perf_counter(), self._left(fraction)
        if now - self._told < REFRESH_INTERVAL and fraction < 1.0:
            return
        self._told = now
        words = f"{fraction:.0%} {stage}" + (f", t = {moment:.0f} t_c" if moment else "") + left
        if self._display is not None:
            bar = f'<progress value="{fraction:.4f}" max="1"></progress> {escape(words)}'
            self._display.update({"text/html": bar, "text/plain": words}, raw=True)
        else:
            self._line = "" if fraction >= 1.0 else words
            sys.stderr.write(f"\r\033[K{words}" + ("" if self._line else "\n"))
            sys.stderr.flush()

    def close(self) -> None:
        """End the line in the terminal; in a notebook remove a bar that never moved."""
        if self._line:
            sys.stderr.write("\n")
            self._line = ""
        if self._display is not None and self._told < 0.0:
            self._display.update({"text/plain": ""}, raw=True)


def watched() -> bool:
    """Whether the program runs in a notebook, or its standard error is a terminal."""
    return _shell() is not None or (sys.stderr is not None and sys.stderr.isatty())


def _notebook() -> Any:
    """A display in a notebook whose content can be changed; None elsewhere."""
    if _shell() is None:
        return None
    return importlib.import_module("IPython.display").display({"text/plain": "compiling"}, raw=True, display_id=True)


def _shell() -> Any:
    """The IPython shell of a notebook; None elsewhere."""
    module = sys.modules.get("IPython")
    shell = module.get_ipython() if module else None
    return shell if hasattr(shell, "kernel") else None


_bar_is_shown: ContextVar[bool] = ContextVar("_bar_is_shown", default=False)


@contextlib.contextmanager
def no_further_bar() -> Iterator[None]:
    """Show no bar by default: a program, or an outer call, shows its own."""
    before = _bar_is_shown.set(True)
    try:
        yield
    finally:
        _bar_is_shown.reset(before)


def shows_progress(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """A function whose keyword `progress` is a `ProgressChoice`; what it calls shows no bar of its own."""

    @functools.wraps(function)
    def showing(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        asked: Any = kwargs.get("progress")
        with no_further_bar() if _bar_is_shown.get() else _bar(asked) as bar, no_further_bar():
            return function(*args, **{**kwargs, "progress": asked if callable(asked) else bar})  # type: ignore[arg-type]

    return showing


@contextlib.contextmanager
def _bar(asked: ProgressChoice) -> Iterator[Progress | None]:
    if asked is False or callable(asked) or not (asked or watched()):
        yield None
        return
    bar = ProgressBar()
    try:
        yield bar
    finally:
        bar.close()


def callback(progress: ProgressChoice) -> Progress:
    """The callback of a choice; `silent` if the choice is no callback."""
    return progress if callable(progress) else silent
