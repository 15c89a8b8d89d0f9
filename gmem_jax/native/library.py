"""Loading the compiled library, and its properties."""

import ctypes
import functools
import os
import re
from pathlib import Path

import jax

from gmem_jax.native import calls, cuda
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.laws import Entry, entry_of

MOST_THREADS = 4096  # most threads of a call, as in cpu/team.cc


def path() -> Path:
    """The library's file, whether it is there or not."""
    from gmem_jax.native.build import LIBRARY  # here, so that ``python -m gmem_jax.native.build`` loads it only once

    return Path(__file__).parent / LIBRARY


@functools.cache
def load_library() -> tuple[str, str]:
    """Load and register the library, once; returns its instruction set, and why that failed ("" if it did not)."""
    from gmem_jax.native.build import SOURCES, instruction_set, opened  # here, as in `path`

    library, reason = opened(path())
    if library is None:
        return "", reason
    try:
        for target in calls.TARGETS:
            jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(library, target)), platform="cpu")
        cuda.register(library, SOURCES)
        return instruction_set(library), ""
    except (OSError, AttributeError) as error:
        return "", f"its library could not be loaded: {error}"


def available() -> tuple[bool, str]:
    """Whether the native backend can run on this machine's CPU, and the instruction set it uses (or why not)."""
    instructions, reason = load_library()
    return not reason, reason or instructions


def cpus() -> int | None:
    """Number of CPUs that this process may keep busy: a quota of CPU time may allow fewer than it may run on.

    None if the library is not available.
    """
    return int(ctypes.CDLL(str(path())).gmem_cpus()) if available()[0] else None


def require_library() -> None:
    """Refuse to go on without the library.

    Raises:
        ValueError: saying why it is not available.
    """
    possible, reason = available()
    if not possible:
        raise ValueError(f"the native backend is not available: {reason}")


def require_threads() -> None:
    """Refuse a GMEM_THREADS that the library would refuse in its first call, before work is begun.

    Raises:
        ValueError: if it is not a number of threads.
    """
    told = os.environ.get("GMEM_THREADS", "")
    if told and not (re.fullmatch(r"\s*\+?[0-9]{1,9}", told) and 1 <= int(told) <= MOST_THREADS):
        raise ValueError(f'GMEM_THREADS should be a number of threads from 1 to {MOST_THREADS}; it is "{told}"')


def entry(law: FrictionLaw) -> Entry:
    """The row of a friction law in `gmem_jax.physics.contact.laws`.

    Raises:
        ValueError: if the library does not know the law.
    """
    found = entry_of(law)
    if found is None:
        raise ValueError(f"the native backend does not know the friction law {type(law).__name__}")
    return found


def needs(law: FrictionLaw, architecture: str, task: cuda.Task = "forward") -> dict[str, cuda.Needs]:
    """Registers and spills of the kernels of a law, compiled on this machine for the architecture of a GPU.

    Args:
        law: a law that the library knows.
        architecture: the architecture as NVRTC names it, like "sm_90".
        task: what the kernels are for; "adjoint" for a law that has reverse mode on GPUs.

    Raises:
        RuntimeError: if there is no NVRTC, or it does not know the architecture.
        ValueError: if the library is not available, or does not know the law.
    """
    require_library()
    row = entry(law)
    return cuda.kernel_needs(ctypes.CDLL(str(path())), row.native, row.variant(law), architecture, task)
