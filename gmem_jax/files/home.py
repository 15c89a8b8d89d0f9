"""Where things are kept between runs that no user named: compiled programs, and packs made by name."""

import os
from pathlib import Path


def kept() -> Path:
    """The package's folder in the user's cache, which need not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gmem_jax"


def kept_pack(name: str) -> Path:
    """Where `gmem prepare NAME` keeps a standard pack; it need not be there."""
    return kept() / "packs" / f"{name}.h5"
