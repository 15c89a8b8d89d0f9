"""The start and the end of the `gmem` command, outside the package: what a command imports takes a second.

Ctrl-C in them is told in one line.
"""

import gc
import os
import signal
import sys

BEFORE = signal.getsignal(signal.SIGINT)
INTERRUPTED = 130


def _interrupted(*_: object) -> None:
    """Leave at once: half an import cannot be unwound without a traceback."""
    os.write(2, b"gmem: interrupted; nothing was begun\n")
    os._exit(INTERRUPTED)


def _leave(*_: object) -> None:
    """Leave at once, and in silence: all was said."""
    os._exit(INTERRUPTED)


def _answer(handler: object) -> None:
    """Answer Ctrl-C with a handler, unless it is ignored, as it is in the background of a script."""
    if BEFORE is signal.default_int_handler:
        signal.signal(signal.SIGINT, handler)  # type: ignore[arg-type]


# Whether this process is the command: `python -m gmem_jax` imports the package, and that this module, before `main`.
alone = sys.argv[:1] == ["-m"] and "gmem_jax" in sys.orig_argv
if alone:
    _answer(_interrupted)


def imported() -> None:
    """Leave Ctrl-C to the command, and garbage to Python, from now on: all that it needs is imported."""
    if alone:
        gc.enable()
        _answer(BEFORE)


def main() -> None:
    """Entry point of the `gmem` command."""
    global alone
    alone = True
    _answer(_interrupted)
    gc.disable()  # an import makes no garbage, and looking for it takes a tenth of a second
    try:
        from gmem_jax.command.app import main as begin

        begin()
    except KeyboardInterrupt:  # before it listens, or once more while it tells of the first
        _leave()
    finally:
        _answer(_leave)
