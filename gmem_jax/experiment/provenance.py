"""Where a result comes from: versions, backend and device, for files and logs."""

import functools
import hashlib
import os
import platform
import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def _commit() -> str | None:
    """The git commit of a source checkout, read without running git; None for an installed package."""
    git = Path(__file__).resolve().parents[2] / ".git"
    head = git / "HEAD"
    if not head.is_file():
        return None
    text = head.read_text(encoding="utf-8").strip()
    if not text.startswith("ref: "):
        return text
    name = text.removeprefix("ref: ")
    if (git / name).is_file():
        return (git / name).read_text(encoding="utf-8").strip()
    packed = git / "packed-refs"
    lines = packed.read_text(encoding="utf-8").splitlines() if packed.is_file() else []
    return next((line.split()[0] for line in lines if line.endswith(" " + name)), None)


@functools.cache
def versions() -> dict[str, str]:
    """Versions of Python, this package and the packages that decide its numbers."""
    names = ("gmem-jax", "jax", "jaxlib", "jax-md", "flax", "numpy", "h5py")
    found = {}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return {"python": platform.python_version(), **found}


def code() -> dict[str, Any]:
    """Versions and git commit of the code that made a number."""
    return {"versions": dict(versions()), "commit": _commit()}


@functools.cache
def sources() -> dict[str, Any]:
    """A hash of the code that makes numbers, and versions of libraries: numbers depend on them, too."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for folder in ("physics", "native", "simulation", "experiment", "preparation"):
        for path in sorted((root / folder).rglob("*")):
            if path.suffix in (".py", ".h", ".cc", ".cu"):
                digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    own = ("jax", "jaxlib", "jax-md", "numpy")
    return {"sources": digest.hexdigest(), "versions": {name: versions()[name] for name in own}}


_ASKED_BY = ("JAX_", "PJRT_", "XLA_")  # prefixes of the environment variables by which JAX chooses devices


def is_one_cpu() -> bool:
    """Whether JAX has one device only, a CPU; found without importing JAX, which takes half a second.

    False if JAX may have other devices: it was imported before, an environment variable of JAX is set, or a plugin for
    other devices is installed.
    """
    told = "jax" in sys.modules or any(name.startswith(_ASKED_BY) for name in os.environ)
    return not (told or metadata.entry_points(group="jax_plugins") or find_spec("jax_plugins") or find_spec("libtpu"))


def devices() -> list[str]:
    """The devices of JAX, like "cpu: cpu"."""
    if is_one_cpu():
        return ["cpu: cpu"]
    import jax

    return [f"{device.platform}: {device.device_kind}" for device in jax.devices()]


def provenance() -> dict[str, Any]:
    """Versions, git commit and device."""
    return {**code(), "device": devices()[0]}
