"""The interfaces of checkpoints and of caches of finished parts; `files.checkpoints` implements them."""

from collections.abc import Callable
from typing import Any


class Checkpoint:
    """Where an unfinished part of a long run stands. This one keeps nothing."""

    def restore(self) -> Any:
        """What was saved when the run was interrupted; None for a run that begins."""
        return None

    def maybe_save(self, state: Callable[[], Any], *, milestone: bool = False) -> None:
        """Save what `state` gives, a tree of arrays, if enough time has passed; at milestones less is enough."""

    def save(self, state: Callable[[], Any]) -> None:
        """Save it now."""


NO_CHECKPOINT = Checkpoint()

Run = Callable[[Checkpoint], Any]
"""Runs a part of a long run from its checkpoint on, and gives its result: a tree of arrays."""


class ResultCache:
    """Results of the parts of a long run by name, as stored earlier or by running the part. This one stores nothing."""

    def __call__(self, name: str, run: Run) -> Any:
        """The result of the part of that name."""
        return run(NO_CHECKPOINT)

    def scoped(self, scope: str) -> "ResultCache":
        """The same cache for one of several runs, whose parts have this name before their own."""
        return _Asking(lambda name, run: self(f"{scope}-{name}", run))

    def memoised(self) -> "ResultCache":
        """The same cache, by which a part is run or loaded once, however often it is asked for."""
        found: dict[str, Any] = {}

        def ask(name: str, run: Run) -> Any:
            if name not in found:
                found[name] = self(name, run)
            return found[name]

        return _Asking(ask)

    def shared(self, part: str, other: "ResultCache") -> "ResultCache":
        """This cache, but for one part, of which `other` is asked."""
        return _Asking(lambda name, run: (other if name == part else self)(name, run))


class _Asking(ResultCache):
    """A cache that asks a function."""

    def __init__(self, ask: Callable[[str, Run], Any]) -> None:
        self._ask = ask

    def __call__(self, name: str, run: Run) -> Any:
        return self._ask(name, run)


no_cache = ResultCache()
