"""The start and the end of the `gmem` command, outside the package: importing that takes a second or two.

What happens in them is told in one line: Ctrl-C, and a setting that JAX refuses as soon as it is imported.
"""

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


# `python -m gmem_jax` imports the package, and that this module, before it comes to `main`.
if sys.argv[:1] == ["-m"] and "gmem_jax" in sys.orig_argv:
    _answer(_interrupted)


def main() -> None:
    """Entry point of the `gmem` command."""
    _answer(_interrupted)
    try:
        from gmem_jax.command.app import main as begin
    except ValueError as error:  # JAX's, for JAX_ENABLE_X64=maybe and the like
        sys.stderr.write(f"gmem: cannot start: {' '.join(str(error).split())}\n")
        sys.exit(2)
    try:
        _answer(BEFORE)
        begin()
    except KeyboardInterrupt:  # before it listens, or once more while it tells of the first
        _leave()
    finally:
        _answer(_leave)
