"""Every exception of the package that a caller may want to catch, and how it warns."""

import contextlib
import os
import sys
import warnings
from pathlib import Path

_PASSED_OVER = (f"{Path(__file__).parent}{os.sep}", contextlib.__file__)


class RunFailedError(RuntimeError):
    """A run whose numbers are meaningless: a grain escaped, a number overflowed, an overlap left the law's range."""


class NotAtRestError(RunFailedError):
    """A pack that did not come to rest in the time allowed; with more patience its preparation goes on."""


class FileFormatError(ValueError):
    """A file that is damaged, or is not what it should be."""


def warn_caller(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn of the line outside of this package that led here, whatever functions and decorators lie in between."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PASSED_OVER):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
