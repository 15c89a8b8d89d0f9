"""The GPU's half of the library on CPUs: its kernels and handlers, compiled from tests/native/emulated.cc."""

import fcntl
import hashlib
import os
import subprocess
from pathlib import Path

from gmem_jax.native import build

NATIVE = Path(__file__).parent / "native"
FLAGS = ("-std=c++17", "-O1", "-ffp-contract=off", "-fPIC", "-Wno-psabi", "-DGMEM_ISA=emulated")


def linked(target: Path, *more: str) -> None:
    """Link a library of the kernels, and of more sources and options, to the file `target`.

    The kernels take a quarter of a minute to compile. All processes that share the folder of programs share them.
    """
    made_of = build.source_hash() + "".join((NATIVE / name).read_text() for name in ("emulated.cc", "emulated.h"))
    name = hashlib.sha256(made_of.encode()).hexdigest()[:16]
    kernels = Path(os.environ["GMEM_COMPILE_CACHE"]) / f"emulated-{name}.o"
    kernels.parent.mkdir(parents=True, exist_ok=True)
    with kernels.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kernels.exists():
            made = kernels.with_suffix(f".{os.getpid()}")
            _compile("-c", str(NATIVE / "emulated.cc"), "-o", str(made))
            made.replace(kernels)
    _compile("-shared", *more, str(kernels), "-o", str(target))


def _compile(*arguments: str) -> None:
    include = ["-I", str(build.SOURCES), "-I", str(NATIVE), "-isystem", str(build.headers())]
    done = subprocess.run([*build.compiler(), *FLAGS, *include, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:4000]
