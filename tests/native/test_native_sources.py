"""The C++ sources: their own unit tests, every compiler at hand, every header alone, and the Python they mirror."""

import ast
import contextlib
import os
import platform
import re
import shutil
import subprocess
from pathlib import Path

import jax
import pytest

import gmem_jax
from gmem_jax import native
from gmem_jax.native import build
from gmem_jax.physics.contact.laws import LAWS

ROOT = Path(gmem_jax.__file__).parent.parent
HERE = Path(__file__).parent
COMPILERS = ["g++", *(f"g++-{n}" for n in range(11, 16)), "clang++", *(f"clang++-{n}" for n in range(14, 23))]
# Those of this machine, each by one of its names.
AT_HAND = {os.path.realpath(path): name for name in reversed(COMPILERS) if (path := shutil.which(name))}
if native.available()[0]:  # one has built the library
    with contextlib.suppress(build.BuildError):
        AT_HAND.pop(os.path.realpath(shutil.which(build.compiler()[0]) or ""), None)
THREADS = ("cpu/team.cc", "cpu/cache.cc", "cpu/scratch.cc", "cpu/blocks.cc", "cpu/plan.cc")
# For sources that are only read: optimised, GCC's own headers of AVX-512 would warn, and a header by itself warns of
# its #pragma once. Of clang's warnings those are off that are of bool lanes, and of the stand-in for CUDA's streams.
STRICT = ("-fsyntax-only", "-Wall", "-Wextra", "-Werror")
STRICT += ("-Wno-bitwise-instead-of-logical", "-Wno-unused-private-field")
MIRROR = re.compile(r"^// (gmem_jax/\S+\.py): (\w[\w.]*(?:, \w[\w.]*)*)", re.MULTILINE)


def compiler() -> list[str]:
    try:
        return build.compiler()
    except build.BuildError as reason:
        pytest.skip(str(reason))


def compiled(cxx: list[str], *arguments: str) -> None:
    include = ["-I", str(build.SOURCES), "-isystem", str(build.headers())]
    command = [*cxx, "-std=c++17", "-ffp-contract=off", "-pthread", *include, *arguments, "-Wno-psabi"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:4000]


def instruction_sets() -> dict[str, tuple[str, ...]]:
    """Those that this CPU can run."""
    built, best = native.available()
    names = list(build.INSTRUCTION_SETS)
    known = names[: names.index(best) + 1] if built else names[:1]
    return {name: build.INSTRUCTION_SETS[name] for name in known}


def test_flags_that_a_compiler_does_not_know_are_left_out() -> None:
    assert build.known_of(compiler(), ("-O1", "-mno-such-flag")) == ("-O1",)
    assert build.known_of(["no-such-compiler"], ("-O1",)) == ()


@pytest.mark.parametrize(("given", "words"), [('"g++', "CXX: No closing quotation"), ("true", "true made no library")])
def test_a_compiler_that_is_none_is_told_in_one_line_and_leaves_the_library(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, given: str, words: str
) -> None:
    monkeypatch.setenv("CXX", given)
    library = tmp_path / build.LIBRARY
    library.write_bytes(b"as it was")
    with pytest.raises(build.BuildError, match=words):
        build.build(library)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"as it was"]


@pytest.mark.parametrize("name", ["numbers", "physics", "programs", "segments", "threads"])
def test_unit_tests_in_cpp(name: str, tmp_path: Path) -> None:
    more = [str(build.SOURCES / source) for source in THREADS] if name == "threads" else []
    sets = {"baseline": ()} if name == "threads" else instruction_sets()
    if name == "programs":  # takes its time, and knows of vectors only how long they are
        best = list(sets)[-1]
        sets = {best: sets[best]}
    for instructions, flags in sets.items():
        program = tmp_path / instructions
        level = "-O0" if name == "programs" else "-O1"  # where g++ 12 stops with an error of its own
        compiled(compiler(), level, *flags, str(HERE / f"{name}.cc"), *more, "-o", str(program))
        # A second or two; threads wait for each other where other programs want the cores.
        done = subprocess.run([program], capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, f"{instructions}: {done.stdout[:4000]}"


@pytest.mark.parametrize("name", AT_HAND.values())
def test_every_compiler_at_hand_takes_the_sources(name: str) -> None:
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    for flags in (build.INSTRUCTION_SETS["avx512"] if x86 else (), *build.KERNELS.values()):
        compiled([name], *STRICT, "-DGMEM_ISA=some", *flags, str(build.SOURCES / "cpu" / "kernel.cc"))
    gpu = [*map(str, sorted((build.SOURCES / "cuda").glob("*.cc"))), str(HERE / "emulated.cc")]
    compiled([name], *STRICT, '-DGMEM_SOURCE_HASH="some"', *gpu)


def test_older_compilers_are_refused_in_one_line() -> None:
    old = [*compiler(), "-U__clang__", "-U__GNUC__", "-D__GNUC__=10", "-fsyntax-only", "-x", "c++"]
    done = subprocess.run([*old, str(build.SOURCES / "numbers" / "scalar.h")], capture_output=True, text=True)
    assert "gmem_jax needs g++ 11 or newer, or clang++ 14 or newer" in done.stderr


@pytest.mark.slow
def test_every_header_compiles_alone() -> None:
    headers = sorted(map(str, build.SOURCES.rglob("*.h")))
    assert len(headers) > 10
    compiled(compiler(), "-fsyntax-only", "-x", "c++", *headers)


def test_no_header_is_included_inside_a_namespace() -> None:
    for path in build.SOURCES.rglob("*.*"):
        before, _, after = path.read_text().partition("\nnamespace ")
        assert "#include" not in after, path
        assert path.suffix != ".h" or "#pragma once" in before, path


def test_what_the_sources_mirror_is_there() -> None:
    found = [match for path in sorted(build.SOURCES.rglob("*.h")) for match in MIRROR.findall(path.read_text())]
    assert len(found) > 15
    for file, names in found:
        tree = ast.parse((ROOT / file).read_text())
        known = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                known |= {f"{node.name}.{part.name}" for part in node.body if isinstance(part, ast.FunctionDef)}
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                known.add(node.name)
            if isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                known |= {target.id for target in targets if isinstance(target, ast.Name)}
        assert set(names.split(", ")) <= known, (file, names)


def test_the_table_of_laws_says_what_the_sources_say() -> None:
    text = (build.SOURCES / "physics" / "parameters.h").read_text()

    def enum(name: str) -> dict[str, int]:
        (body,) = re.findall(rf"enum class {name} {{(.*?)}}", text)
        return {word: int(number) for word, number in re.findall(r"(\w+) = (\d+)", body)}

    assert sorted(entry.native for entry in LAWS) == sorted(enum("Law").values())
    leaves = re.findall(r"kLeaves\[kMaxHistory\] = {(.*)};", text)  # in the order of the numbers
    for entry in LAWS:
        assert tuple(re.findall(r'"[a-z ]+", "(\w+)"', leaves[entry.native])) == entry.history
        law = entry.kind()
        sizes = {"P": 7, "Q": entry.points(law), "B": 2}
        shapes = [leaf.shape for leaf in jax.tree.leaves(law.init(7, 2, float))]
        assert shapes == [tuple(sizes.get(axis) or int(axis) for axis in axes) for axes in entry.history]
        assert not entry.variants or dict(zip(entry.variants, range(3), strict=True)) == enum("Variant")
    assert f"kLawParameters = {max(len(entry.numbers) for entry in LAWS)};" in text
