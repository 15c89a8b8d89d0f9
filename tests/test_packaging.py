"""What is released is whole: the sources and the wheel hold all that the package reads, and say what they are."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
import zlib
from email.parser import Parser
from pathlib import Path
from typing import NamedTuple

import pytest

from gmem_jax.native import build

pytest.importorskip("setuptools", minversion="77")  # older ones do not know licences by name

ROOT = Path(__file__).parents[1]
PACKAGE = {
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "gmem_jax").rglob("*")
    if path.is_file() and path.name != build.LIBRARY and "__pycache__" not in path.parts
}


class Built(NamedTuple):
    """What setup.py makes of this checkout where no compiler works."""

    wheel: Path
    sources: set[str]
    said: str


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    folder = tmp_path_factory.mktemp("built")
    egg = ["egg_info", "--egg-base", str(folder)]
    wheel = ["build", "--build-base", str(folder / "build"), "bdist_wheel", "--dist-dir", str(folder / "dist")]
    command = [sys.executable, "-W", "ignore", "setup.py", *egg, *wheel]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, "CXX": "false"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    [path] = (folder / "dist").iterdir()
    sources = (folder / "gmem_jax.egg-info" / "SOURCES.txt").read_text().split("\n")
    return Built(path, set(sources), done.stdout)


def test_the_wheel_holds_every_file_of_the_package(built: Built) -> None:
    names = {name for name in zipfile.ZipFile(built.wheel).namelist() if name.startswith("gmem_jax/")}
    assert names == PACKAGE
    assert {Path(name).suffix for name in names} >= {".h5", ".csv", ".cu", ".h", ".cc", ".typed"}


def test_the_sources_hold_what_builds_and_tests_the_package(built: Built) -> None:
    assert built.sources >= PACKAGE
    assert built.sources >= {"setup.py", "pyproject.toml", "LICENSE", "README.md", "Makefile", "CITATION.cff"}
    assert built.sources >= {"tests/conftest.py", "tests/data/tetra-27.h5", "tests/native/check.h", "docs/recall.png"}
    assert not [name for name in built.sources if name.endswith((".so", ".pyc"))]


def test_a_wheel_serves_every_python_of_one_platform(built: Built) -> None:
    version, *tags = built.wheel.stem.split("-")[1:]
    assert tags[:2] == ["py3", "none"]
    assert tags[2] != "any"
    assert version == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def test_the_wheel_is_small(built: Built) -> None:
    library = ROOT / "gmem_jax" / "native" / build.LIBRARY
    size = built.wheel.stat().st_size + (len(zlib.compress(library.read_bytes())) if library.exists() else 0)
    # 17.9 MB: 12.7 of packs, and 4.4 of the library, which has each law's derivatives for three instruction sets and
    # second ones for two.
    assert size < 18.5e6, f"{size / 1e6:.1f} MB with the library"


def test_without_a_compiler_it_is_built_and_says_so(built: Built) -> None:
    assert "no native backend, plain JAX will be used: false failed" in built.said


def test_the_wheel_says_what_it_is(built: Built) -> None:
    archive = zipfile.ZipFile(built.wheel)
    [name] = [name for name in archive.namelist() if name.endswith("METADATA")]
    found = Parser().parsestr(archive.read(name).decode())
    assert (found["License-Expression"], found["Requires-Python"]) == ("MIT", ">=3.11")
    assert found["Summary"]
    assert found["Keywords"]
    assert "waveform" in found.get_payload()
    [scripts] = [name for name in archive.namelist() if name.endswith("entry_points.txt")]
    assert "gmem = gmem_start:main" in archive.read(scripts).decode()
    assert "gmem_start.py" in archive.namelist()


def test_the_version_is_the_same_wherever_it_stands() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    newest = re.search(r"^## (\S+?),? ", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest
    assert newest[1] == version
