"""The places of packs that ship with the package, and of packs that are kept between runs."""

from importlib import resources
from pathlib import Path

from gmem_jax.home import cache_folder


def kept_pack(name: str) -> Path | None:
    """Where `gmem prepare NAME` keeps a standard pack; it need not exist. None if `cache_folder` gives None."""
    folder = cache_folder()
    return folder and folder / "packs" / f"{name}.h5"


def list_packs() -> list[str]:
    """Names of the packs that ship with the package, for `load_pack`."""
    folder = resources.files("gmem_jax") / "packs"
    if not folder.is_dir():
        return []
    return sorted(entry.name.removesuffix(".h5") for entry in folder.iterdir() if entry.name.endswith(".h5"))
