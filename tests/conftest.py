"""Double precision everywhere, every program compiled once, and what many tests read."""

import atexit
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

from xla_flags import COMPILED_SOON

# Workers of xdist, and the processes that tests start, find what others have compiled. It is gone at the end.
# Set before the package is imported, which tells its library of the folder at once.
if "GMEM_COMPILE_CACHE" not in os.environ:
    programs = tempfile.TemporaryDirectory(prefix="gmem-programs-")
    os.environ["GMEM_COMPILE_CACHE"] = programs.name
    atexit.register(programs.cleanup)

os.environ.setdefault("XLA_FLAGS", COMPILED_SOON)  # the slow tests have programs as a user's are (Makefile)

# Threads of the library wait for each other in loops, and workers side by side have no core to spare for that.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("GMEM_THREADS", "1")

# Shells let what they start in the background ignore Ctrl-C, and the programs that tests stop by it would, too.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import jax
import pytest

import gmem_jax as gm
from gmem_jax.files.compilation_cache import keep_programs

jax.config.update("jax_enable_x64", True)
keep_programs()


LONGEST = ("test_sanitizers.py", "test_native_derivatives.py", "test_devices.py", "test_docs.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The slow files that take a worker longest come first, so that no worker waits for one at the end."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


@pytest.fixture(autouse=True)
def no_terminal() -> None:
    """Tables are as wide as they are: some libraries say COLUMNS when they start another process."""
    os.environ.pop("COLUMNS", None)


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """Programs are forgotten before they fill the memory, or the maps of a process: XLA crashes at 65,530 on Linux.

    They take some 200 MB in a thousand maps, and are found again in the folder.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_text().count("\n") > 12_000:
        jax.clear_caches()


@pytest.fixture(scope="session")
def recalled() -> tuple[gm.Experiment, gm.Recall]:
    """Two words recalled by 27 grains, far too fast: what tests of files and pictures share."""
    pack = gm.load_pack(Path(__file__).parent / "data" / "tetra-27.h5")
    experiment = gm.Experiment(pack, gm.words(1), t0=75.0, store=0.1, rest=0.1, hold=0.1)
    return experiment, gm.run(experiment)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packs are imported without the run that measures the ringing period."""
    monkeypatch.setattr("gmem_jax.preparation.imported.ringing_period", lambda *_: 20.0)
