"""Where things are kept between runs that no user named: compiled programs, and packs made by name."""

import os
from pathlib import Path


def kept() -> Path | None:
    """The package's folder in the user's cache, which need not exist; None for a user without a home."""
    if chosen := os.environ.get("XDG_CACHE_HOME"):
        return Path(chosen) / "gmem_jax"
    try:
        return Path.home() / ".cache" / "gmem_jax"
    except RuntimeError:
        return None


def kept_pack(name: str) -> Path | None:
    """Where `gmem prepare NAME` keeps a standard pack; it need not be there. None as in `kept`."""
    folder = kept()
    return folder and folder / "packs" / f"{name}.h5"
