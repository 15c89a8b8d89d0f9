"""The package's own folder in the user's cache."""

import os
from pathlib import Path


def cache_folder() -> Path | None:
    """The package's folder in the user's cache, which need not exist; None for a user without a home."""
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if chosen.is_absolute():  # others are to be ignored, the XDG Base Directory Specification says
        return chosen / "gmem_jax"
    try:
        return Path.home() / ".cache" / "gmem_jax"
    except RuntimeError:
        return None
