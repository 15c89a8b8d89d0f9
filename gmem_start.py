"""The start of the `gmem` command, outside the package: importing that takes a second or two.

What happens in them is told in one line: Ctrl-C, and a setting that JAX refuses as soon as it is imported.
"""

import os
import signal
import sys
from typing import Any


def _interrupted(*_: Any) -> None:
    """Leave at once: half an import cannot be unwound without a traceback."""
    os.write(2, b"gmem: interrupted; nothing was begun\n")
    os._exit(130)


def main() -> None:
    """Entry point of the `gmem` command."""
    before = signal.signal(signal.SIGINT, _interrupted)
    try:
        from gmem_jax.command.app import main as begin
    except ValueError as error:  # JAX's, for JAX_ENABLE_X64=maybe and the like
        sys.stderr.write(f"gmem: cannot start: {' '.join(str(error).split())}\n")
        sys.exit(2)
    signal.signal(signal.SIGINT, before)
    begin()
