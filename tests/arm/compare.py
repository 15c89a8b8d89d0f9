"""Whether the library gives the promised bits on aarch64, too: `make arm`, before a release.

The driver of the sanitizers (tests/reliability/drive.cc) is compiled for aarch64 and run by emulation, and compiled and
run for those instruction sets of this machine that fuse a product and a sum, as aarch64 does. It marches packs of two
to 64 grains two steps, by every law, in values, tangents and adjoints, values in mixed precision too, and checks that
threads and company change nothing. What differs is printed; it is an error where the same bits are promised: in double
precision, but for the adjoint of law M2.

Needs Debian's packages: apt-get install g++-aarch64-linux-gnu qemu-user-static
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from gmem_jax.native import build

DRIVER = Path(__file__).resolve().parents[1] / "reliability" / "drive.cc"
CROSS, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64-static"
NEEDS = {"avx2": {"avx2", "fma"}, "avx512": {"avx512f", "avx512dq", "avx512bw", "avx512vl"}}
SECONDS = 900  # for a driver


def compiled(compiler: list[str], flags: tuple[str, ...], program: Path) -> None:
    """The driver, with the flags of the library."""
    command, cpu, objects = [*compiler, *build.FLAGS, "-I", str(build.SOURCES), "-w"], build.SOURCES / "cpu", []
    for name, more in build.KERNELS.items():
        objects.append(f"{program}-{name}.o")
        subprocess.run(
            [*command, f"-DGMEM_ISA={name}", *more, *flags, "-c", str(cpu / "kernel.cc"), "-o", objects[-1]], check=True
        )
    sources = [str(DRIVER), *(str(cpu / f"{name}.cc") for name in ("team", "cache", "plan", "blocks"))]
    subprocess.run([*command, "-static", *sources, *objects, "-o", str(program)], check=True)


def numbers(command: list[str]) -> list[str]:
    """A line for every case."""
    done = subprocess.run([*command, "numbers"], check=True, capture_output=True, text=True, timeout=SECONDS)
    return done.stdout.splitlines()


def promised(line: str) -> bool:
    """Whether a case must be the same on both; law 3 is M2, tasks 2 and 3 go backwards, as the library numbers them."""
    return "double" in line and not (line.startswith("law 3.") and ("task 2" in line or "task 3" in line))


def main() -> None:
    """Compare, and say which cases differ."""
    missing = [name for name in (CROSS, EMULATOR) if not shutil.which(name)]
    if missing:
        sys.exit(f"{' and '.join(missing)} missing: apt-get install g++-aarch64-linux-gnu qemu-user-static")
    has = set(Path("/proc/cpuinfo").read_text(encoding="utf-8").split())
    with tempfile.TemporaryDirectory() as folder:
        arm = Path(folder) / "aarch64"
        compiled([CROSS], (), arm)
        there = numbers([EMULATOR, str(arm)])
        compared = broken = 0
        for name, needed in NEEDS.items():
            if needed <= has:
                here = Path(folder) / name
                compiled(build.compiler(), build.INSTRUCTION_SETS[name], here)
                found = numbers([str(here)])
                apart = [line for line in found if line not in there]
                print(f"{name} and aarch64: {len(found)} cases, {len(apart)} of them differ", *apart, sep="\n  ")
                compared += len(found)
                broken += sum(map(promised, apart)) + (len(found) != len(there))
        if broken or not compared:
            sys.exit(f"{broken} promised cases differ" if compared else "this machine has neither AVX2 nor AVX-512")


if __name__ == "__main__":
    main()
