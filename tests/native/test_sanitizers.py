"""The kernels under sanitizers: without Python and without XLA, whose own memory and threads are not ours to judge.

A short set, in the lowest instruction set and unoptimised, because the derivatives take minutes to compile otherwise.
Each sanitizer must also notice a defect: the driver then lies to the library about its arrays.
"""

import subprocess
from pathlib import Path

import pytest
from scenes import TESTS

from gmem_jax.native import build

DRIVER = TESTS / "reliability" / "drive.cc"
# Not all of UBSan: its checks for null and for the sizes of objects quadruple the time to compile.
UNDEFINED = "signed-integer-overflow,bounds,alignment,float-cast-overflow,shift,integer-divide-by-zero,bool,enum,return"
SANITIZERS = {
    f"address,{UNDEFINED}": {"bounds": "heap-buffer-overflow", "alignment": "misaligned address"},
    "thread": {"race": "data race"},
}


def compiler(sanitizers: str, folder: Path) -> list[str]:
    """The command, or a skip where it cannot make programs with these sanitizers."""
    try:
        command = [*build.compiler(), "-std=c++17", "-O0", "-g1", "-w", "-ffp-contract=off", "-pthread"]
    except build.BuildError as reason:
        pytest.skip(str(reason))
    command += [f"-fsanitize={sanitizers}", "-I", str(build.SOURCES)]
    (folder / "probe.cc").write_text("int main() { return 0; }")
    probe = subprocess.run([*command, str(folder / "probe.cc"), "-o", str(folder / "probe")], capture_output=True)
    if probe.returncode or subprocess.run([folder / "probe"], capture_output=True).returncode:
        pytest.skip(f"{command[0]} makes no programs that run under -fsanitize={sanitizers} here")
    return command


def compiled(sanitizers: str, folder: Path) -> Path:
    command = compiler(sanitizers, folder)
    cpu, objects = build.SOURCES / "cpu", []
    for name, flags in build.KERNELS.items():
        objects.append(str(folder / f"{name}.o"))
        kernel = ["-c", str(cpu / "kernel.cc"), f"-DGMEM_ISA={name}", "-DGMEM_DOUBLE_ONLY", *flags, "-O0"]
        subprocess.run([*command, *kernel, "-o", objects[-1]], check=True)
    sources = [str(DRIVER), *(str(cpu / f"{name}.cc") for name in ("team", "cache", "plan", "scratch", "blocks"))]
    subprocess.run([*command, *sources, *objects, "-o", str(folder / "drive")], check=True)
    return folder / "drive"


@pytest.mark.slow
@pytest.mark.parametrize("sanitizers", SANITIZERS, ids=["address-undefined", "thread"])
def test_kernels_are_clean_and_defects_are_seen(sanitizers: str, tmp_path: Path) -> None:
    driver = compiled(sanitizers, tmp_path)

    def driven(*plant: str) -> tuple[int, str]:
        done = subprocess.run([driver, *plant], capture_output=True, text=True, timeout=300)
        return done.returncode, done.stdout + done.stderr

    code, report = driven()
    assert code == 0, report[:4000]
    assert "runtime error" not in report, report[:4000]  # UBSan goes on after an error
    for plant, seen in SANITIZERS[sanitizers].items():
        _, report = driven(plant)
        assert seen in report, plant
