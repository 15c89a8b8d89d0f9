"""Where things are that no user named: packs that ship, and what is kept between runs, compiled programs and packs."""

import os
from importlib import resources
from pathlib import Path


def kept() -> Path | None:
    """The package's folder in the user's cache, which need not exist; None for a user without a home."""
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if chosen.is_absolute():  # others are to be ignored, the XDG Base Directory Specification says
        return chosen / "gmem_jax"
    try:
        return Path.home() / ".cache" / "gmem_jax"
    except RuntimeError:
        return None


def kept_pack(name: str) -> Path | None:
    """Where `gmem prepare NAME` keeps a standard pack; it need not be there. None as in `kept`."""
    folder = kept()
    return folder and folder / "packs" / f"{name}.h5"


def list_packs() -> list[str]:
    """Names of the packs that ship with the package."""
    folder = resources.files("gmem_jax") / "packs"
    if not folder.is_dir():
        return []
    return sorted(entry.name.removesuffix(".h5") for entry in folder.iterdir() if entry.name.endswith(".h5"))
