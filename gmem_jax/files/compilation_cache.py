"""The cache of compiled programs, which saves half of the time of a short command."""

import errno
import hashlib
import os
import platform
import warnings
from pathlib import Path

import jax

from gmem_jax.files.ours import remove_empty
from gmem_jax.home import cache_folder

SWITCH = "GMEM_COMPILE_CACHE"  # another folder, or "off"


def _processor() -> str:
    """A short hash that differs between CPUs that cannot run each other's programs: clusters share home folders."""
    facts = Path("/proc/cpuinfo")
    lines = facts.read_text(encoding="utf-8").splitlines() if facts.is_file() else []
    known = [line for line in lines if line.startswith(("model name", "flags", "Features"))][:2] or [
        platform.processor()
    ]
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:8]


def keep_programs() -> None:
    """Turn on JAX's persistent compilation cache, unless the user turned it off or chose one; call it before JAX runs.

    If the folder cannot be written, no programs are kept; there is a warning only if the user chose that folder.
    """
    chosen = os.environ.get(SWITCH, "")
    if chosen == "off" or getattr(jax.config, "jax_compilation_cache_dir", None):
        return
    if chosen:
        folder = Path(chosen)
    elif home := cache_folder():
        folder = home / f"jax-{jax.__version__}-{_processor()}"
    else:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        if chosen:
            why = f"{SWITCH}={chosen}: cannot write there ({error.strerror})"
            warnings.warn(f"{why}; compiled programs are not kept", stacklevel=2)
        return
    # XLA logs an error for every cached program, since it names CPU features that are in no CPU's list.
    if getattr(jax.config, "jax_logging_level", None) == "NOTSET":
        jax.config.update("jax_logging_level", "CRITICAL")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # Keep small programs too: a recall has a hundred of them (0.5 MB), which are read faster than compiled.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    remove_empty(folder, "-cache")  # programs that a full disk left empty: JAX would never write them again
    # Programs that a killed process left half written are compiled again.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache")
