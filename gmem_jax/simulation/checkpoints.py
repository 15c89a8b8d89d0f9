"""The interfaces of checkpoints and of caches of finished parts; `files.checkpoints` implements them."""

from collections.abc import Callable
from typing import Any


class Checkpoint:
    """The saved state of an unfinished part of a long run. This base class saves nothing."""

    def restore(self) -> Any:
        """What was saved when the run was interrupted; None for a run that begins."""
        return None

    def maybe_save(self, state: Callable[[], Any], *, milestone: bool = False) -> None:
        """Save the tree of arrays that `state` returns, if enough time has passed; less is enough at milestones."""

    def save(self, state: Callable[[], Any]) -> None:
        """Save the tree of arrays that `state` returns, now."""


NO_CHECKPOINT = Checkpoint()

Run = Callable[[Checkpoint], Any]
"""A function that runs a part of a long run from its checkpoint on and returns its result, a tree of arrays."""


class ResultCache:
    """Results of the parts of a long run, by name: stored earlier, or made by running the part.

    This base class stores nothing, and runs every part.
    """

    def __call__(self, name: str, run: Run) -> Any:
        """The result of the part `name`."""
        return run(NO_CHECKPOINT)

    def scoped(self, scope: str) -> "ResultCache":
        """The same cache for one of several runs: `scope` stands before the names of its parts."""
        return _Asking(lambda name, run: self(f"{scope}-{name}", run))

    def memoised(self) -> "ResultCache":
        """A cache over this one that runs or loads each part once, however often it is asked for."""
        found: dict[str, Any] = {}

        def ask(name: str, run: Run) -> Any:
            if name not in found:
                found[name] = self(name, run)
            return found[name]

        return _Asking(ask)

    def shared(self, part: str, other: "ResultCache") -> "ResultCache":
        """This cache for all parts but one, which is taken from `other`."""
        return _Asking(lambda name, run: (other if name == part else self)(name, run))


class _Asking(ResultCache):
    """A cache that gets its results from a function of the part's name and run."""

    def __init__(self, ask: Callable[[str, Run], Any]) -> None:
        self._ask = ask

    def __call__(self, name: str, run: Run) -> Any:
        return self._ask(name, run)


no_cache = ResultCache()
