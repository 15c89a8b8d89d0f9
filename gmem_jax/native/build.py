"""Compile the native backend: at install time (setup.py), or in place with ``python -m gmem_jax.native.build``.

With ``--if-stale`` it is compiled only if it is missing, cannot be loaded, or was compiled from other sources.

The library has no Python in it: it is one shared object whose symbols `gmem_jax.native` registers with XLA. The time
step and its derivatives are compiled once per instruction set (see `NOT_COMPILED`); the best set that the CPU has is
chosen when the library runs. Only Python's standard library is imported here, because setup.py loads this file before
the package exists.
"""

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).resolve().parent
SOURCES = HERE / "src"
LIBRARY = "libgmem.so"
# No option here may reorder or contract arithmetic: a replica's numbers must not depend on how it is vectorised.
FLAGS = ("-std=c++17", "-O3", "-fPIC", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-pthread")
INSTRUCTION_SETS = {
    "baseline": (),
    "avx2": ("-mavx2", "-mfma"),
    "avx512": ("-mavx512f", "-mavx512dq", "-mavx512bw", "-mavx512vl", "-mfma", "-mprefer-vector-width=512"),
}
# Without these options GCC copies structures by halves of a vector of AVX2. Other compilers do not know them.
WIDE_COPIES = {"avx2": ("-mmove-max=256", "-mstore-max=256")}

# The parts of cpu/kernel.cc, each compiled by itself. With -O1 second derivatives run as fast as with -O2, and compile
# in two thirds of the time; first derivatives would be 10 to 15 % slower with -O1.
KERNELS = {
    "steps": (),
    "derivatives": ("-DGMEM_DERIVATIVES", "-O2"),
    "second_derivatives": ("-DGMEM_SECOND_DERIVATIVES", "-O1"),
}
# Left out, which saves a minute of compiling: CPUs with AVX-512 run these for AVX2.
NOT_COMPILED = {("avx512", "second_derivatives")}


class BuildError(RuntimeError):
    """The native backend could not be built; the message says why."""


def compiler() -> list[str]:
    """The C++ compiler: the environment's CXX, else the first of c++, g++ and clang++.

    Raises:
        BuildError: if there is none, or CXX does not read as a command.
    """
    if os.environ.get("CXX"):
        try:
            return shlex.split(os.environ["CXX"])
        except ValueError as error:
            raise BuildError(f"CXX: {error}") from error
    for name in ("c++", "g++", "clang++"):
        if shutil.which(name):
            return [name]
    raise BuildError("no C++ compiler (c++, g++ or clang++) was found")


def run_compiler(command: list[str]) -> None:
    """Run a compiler, given with its arguments.

    Raises:
        BuildError: if it fails.
    """
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)
    except subprocess.CalledProcessError as error:
        lines = [line for line in error.stderr.splitlines() if "error" in line] or [str(error)]
        raise BuildError(f"{command[0]} failed: {lines[0]}") from error
    except OSError as error:
        raise BuildError(f"{command[0]} did not run: {error}") from error


def known_of(cxx: list[str], flags: tuple[str, ...]) -> tuple[str, ...]:
    """The flags among `flags` that a compiler knows."""

    def known(flag: str) -> bool:
        try:
            run_compiler([*cxx, flag, "-fsyntax-only", "-x", "c++", os.devnull])
        except BuildError:
            return False
        return True

    return tuple(filter(known, flags))


def headers() -> Path:
    """Where jaxlib keeps the headers of XLA's foreign function interface.

    Raises:
        BuildError: if jaxlib is not installed.
    """
    spec = find_spec("jaxlib")
    if spec is None or spec.origin is None:
        raise BuildError("jaxlib, whose headers are needed, is not installed")
    return Path(spec.origin).parent / "include"


def source_hash() -> str:
    """A hash of the sources and flags from which the library is compiled; "" if the sources are not there."""
    files = sorted(path for path in SOURCES.rglob("*") if path.suffix in (".cc", ".h", ".cu"))
    if not files:
        return ""
    found = hashlib.sha256(repr((FLAGS, INSTRUCTION_SETS, WIDE_COPIES, KERNELS)).encode())
    for path in files:
        found.update(path.relative_to(SOURCES).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return found.hexdigest()[:16]


def is_stale(library: ctypes.CDLL) -> bool:
    """Whether a library was compiled from other sources or flags than those beside this file; False without sources."""
    try:
        library.gmem_source_hash.restype = ctypes.c_char_p
        compiled: str = library.gmem_source_hash().decode()
    except AttributeError:  # a library that is older than hashes
        compiled = ""
    return source_hash() not in ("", compiled)


def opened(target: Path) -> tuple[ctypes.CDLL | None, str]:
    """The library at `target`; None, and why, if it cannot be used."""
    if not target.exists():
        return None, "it was not built (no C++ compiler when gmem_jax was installed?); python -m gmem_jax.native.build"
    try:
        library = ctypes.CDLL(str(target))
    except OSError as error:
        return None, f"its library could not be loaded: {error}"
    if is_stale(library):
        return None, "its library is older than its sources; rebuild it: python -m gmem_jax.native.build"
    return library, ""


def instruction_set(library: ctypes.CDLL) -> str:
    """The instruction set of the steps of a library on this machine: "avx512", "avx2" or "baseline"."""
    library.gmem_instruction_set.restype = ctypes.c_char_p
    name: str = library.gmem_instruction_set().decode()
    return name


def build(target: Path) -> None:
    """Compile the library to the file `target`.

    Raises:
        BuildError: if there is no compiler, or it fails.
    """
    cxx, include = compiler(), headers()
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    sets = INSTRUCTION_SETS if x86 else {"baseline": ()}
    names = ("team", "cache", "plan", "scratch", "blocks", "search")
    jobs: list[tuple[str, str, tuple[str, ...]]] = [(f"cpu/{name}.cc", f"{name}.o", ()) for name in names]
    stamp = f'-DGMEM_SOURCE_HASH="{source_hash()}"'
    jobs.append(("call/kernels.cc", "kernels.o", ()))
    jobs.append(("call/handler.cc", "handler.o", (stamp, "-isystem", str(include))))
    jobs.append(("call/census.cc", "census.o", ("-isystem", str(include))))
    jobs.append(("cuda/handler.cc", "gpu_handler.o", ("-isystem", str(include))))
    jobs += [(f"cuda/{name}.cc", f"gpu_{name}.o", (stamp,)) for name in ("compile", "launch")]
    # The lowest instruction set comes first: objects share functions of the standard library, and the linker keeps the
    # first copy of each.
    for name, flags in sets.items():
        flags = (*flags, *known_of(cxx, WIDE_COPIES.get(name, ())))
        for kernel, more in KERNELS.items():
            space = name if kernel == "steps" else f"{name}_{kernel}"
            if (name, kernel) not in NOT_COMPILED:
                jobs.append(("cpu/kernel.cc", f"{space}.o", (f"-DGMEM_ISA={space}", *more, *flags)))

    with tempfile.TemporaryDirectory() as folder:

        def compile_one(job: tuple[str, str, tuple[str, ...]]) -> str:
            source, name, flags = job
            result = str(Path(folder) / name)
            run_compiler([*cxx, *FLAGS, *flags, "-I", str(SOURCES), "-c", str(SOURCES / source), "-o", result])
            return result

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            objects = list(pool.map(compile_one, jobs))
        linked = Path(folder) / LIBRARY
        run_compiler([*cxx, "-shared", "-pthread", *objects, "-ldl", "-o", str(linked)])
        target.parent.mkdir(parents=True, exist_ok=True)
        if not linked.is_file():
            raise BuildError(f"{cxx[0]} made no library")
        made = target.with_suffix(f".{os.getpid()}.new")  # named after this process: another may build too
        try:
            shutil.copyfile(linked, made)
            made.replace(target)  # atomically: a running process may have the old one loaded
        finally:
            made.unlink(missing_ok=True)


if __name__ == "__main__":
    if set(sys.argv[1:]) - {"--if-stale"}:
        sys.exit(__doc__)
    try:
        if "--if-stale" not in sys.argv or opened(HERE / LIBRARY)[0] is None:
            build(HERE / LIBRARY)
    except BuildError as reason:
        sys.exit(str(reason))
