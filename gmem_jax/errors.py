"""The exceptions of the package, and its way to warn."""

import contextlib
import os
import sys
import warnings
from pathlib import Path

_PASSED_OVER = (f"{Path(__file__).parent}{os.sep}", contextlib.__file__)


class RunFailedError(RuntimeError):
    """A run failed and its results are meaningless: a grain escaped, a number overflowed, ... (see `Status`)."""


class NotAtRestError(RunFailedError):
    """A pack did not come to rest within the `patience` of its recipe."""


class FileFormatError(ValueError):
    """A file is damaged, or does not hold what it should."""


def warn_caller(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn of the line outside of this package that led here, whatever functions and decorators lie in between."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PASSED_OVER):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
