"""Progress of a run in a notebook or a terminal."""

import importlib
import sys
import time
from html import escape
from typing import Any

EVERY = 0.3  # seconds between changes of what is shown


class ProgressBar:
    """A bar for `gm.run(experiment, progress=gm.ProgressBar())`, and whatever else takes a progress callback."""

    _line = ""  # what stands unfinished in the terminal

    def __init__(self) -> None:
        self._began = self._told = time.perf_counter()
        self._first = -1.0
        self._display = _notebook()

    def __call__(self, stage: str, moment: float, fraction: float) -> None:
        """Show how far a run is; see `gmem_jax.experiment.host.Progress`."""
        now = time.perf_counter()
        if self._first < 0.0:
            self._began, self._first = now, fraction  # what came before the first chunk was compiling
        elif now - self._told < EVERY and fraction < 1.0:
            return
        self._told = now
        words = f"{fraction:.0%} {stage}" + (f", t = {moment:.0f} t_c" if moment else "")
        done = fraction - self._first
        if done > 0.01 and fraction < 1.0:
            words += f", {(now - self._began) * (1.0 - fraction) / done:.0f} s left"
        if self._display is not None:
            bar = f'<progress value="{fraction:.4f}" max="1"></progress> {escape(words)}'
            self._display.update({"text/html": bar, "text/plain": words}, raw=True)
        else:
            self._line = "" if fraction >= 1.0 else words
            sys.stderr.write(f"\r\033[K{words}" + ("" if self._line else "\n"))
            sys.stderr.flush()

    def close(self) -> None:
        """Leave the terminal at the beginning of a line, and the notebook without a bar that never moved."""
        if self._line:
            sys.stderr.write("\n")
            self._line = ""
        if self._display is not None and self._first < 0.0:
            self._display.update({"text/plain": ""}, raw=True)


def watched() -> bool:
    """Whether someone looks on: at a notebook, or at a terminal in which the program runs."""
    return _shell() is not None or (sys.stderr is not None and sys.stderr.isatty())


def _notebook() -> Any:
    """Where a notebook shows something that changes; None elsewhere."""
    if _shell() is None:
        return None
    return importlib.import_module("IPython.display").display({"text/plain": "compiling"}, raw=True, display_id=True)


def _shell() -> Any:
    """The notebook's; None elsewhere."""
    module = sys.modules.get("IPython")
    shell = module.get_ipython() if module else None
    return shell if hasattr(shell, "kernel") else None
