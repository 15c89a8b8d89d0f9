"""The GPU's half of the library behind a driver that is none: contexts, streams, captured launches, and what fails.

The library's own handlers launch what NVRTC compiled. The driver (mock_cuda.cc) keeps the protocol of CUDA, takes
arguments as the compiled kernels have them, and runs these on the CPU. As a library's name can be taken but once, all
of it happens in a process of its own, `python test_mock_driver.py DRIVER CASE ...`.
"""

import ctypes
import functools
import json
import os
import re
import subprocess
import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from emulation import linked
from scenes import EVERY_LAW, PERIODIC_XY_27, SPREAD_27, TETRA_27

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.native import calls, cuda, library
from gmem_jax.native.calls import Arrays, Call, Fixed
from gmem_jax.native.march import arrays_of, call_of, fixed_of
from gmem_jax.physics.state import Box, replicate
from gmem_jax.physics.step import start, wall_histories
from gmem_jax.physics.system import System

REPLICAS, STEPS = 3, 3
QUICKLY = {"xla_backend_optimization_level": 0}  # for programs that run once
LAWS: dict[str, Any] = dict(EVERY_LAW)
PERIODIC = "H in a box that is periodic along two axes"
SPREAD = "H between grains of many sizes"
FILES = {PERIODIC: PERIODIC_XY_27, SPREAD: SPREAD_27}
LAWS |= dict.fromkeys(FILES, LAWS["H"])
ROUGH = "M2-exact between walls with friction"
LAWS |= {ROUGH: LAWS["M2-exact"]}
Parts = tuple[Call, Fixed, Arrays, Arrays]


class Driver:
    """The mock driver, as a test sees it."""

    def __init__(self, path: str) -> None:
        self._library = ctypes.CDLL(path)  # before the library asks for the driver
        self._library.mock_complaints.restype = ctypes.c_char_p
        handlers = ctypes.CDLL(str(library.path()))
        names = (name for symbol in cuda.CUDA_TARGETS.values() for name in (cuda.initializing(symbol), symbol))
        symbols = [ctypes.cast(getattr(handlers, name), ctypes.c_void_p) for name in names]
        kept = str(Path(os.environ["GMEM_COMPILE_CACHE"]) / "kernels").encode()
        self._library.mock_handlers(*symbols, kept)
        for kind in ("advance", "tangent", "adjoint"):
            for made in ("mock", "emulated"):
                function = getattr(self._library, f"gmem_{made}_{kind}")
                jax.ffi.register_ffi_target(f"gmem_{made}_{kind}", jax.ffi.pycapsule(function), platform="cpu")

    def begin(self, device: int = 0, replays: int = 0, initialized: bool = True) -> None:
        """Run on this device from now on, captured and replayed so often, or (0) at once; and count anew.

        Before a call runs it is initialized, as XLA does it, or not.
        """
        self._library.mock_begin(device, replays, initialized)

    def be(self, architecture: int) -> None:
        """Let GPUs be of another architecture, as 120 for sm_120."""
        self._library.mock_architecture(architecture)

    def fail(self, function: str, call: int = 1) -> None:
        """Let a function fail from that call on, counted from one."""
        self._library.mock_fail(function.encode(), call)

    def count(self, function: str) -> int:
        """How often it was called."""
        return int(self._library.mock_count(function.encode()))

    def complaints(self) -> str:
        """What broke the protocol, in lines."""
        return str(self._library.mock_complaints().decode())


@functools.cache
def at_rest(path: Path) -> tuple[Any, Any]:
    """A pack of 27 grains, and its state, whose accelerations are those of any law without a history."""
    pack = gm.load_pack(path)
    system = System(pack.clump, LAWS["H"], pack.pairs)
    begin = jax.jit(start, compiler_options=QUICKLY)
    return pack, begin(system, pack.position[..., None], pack.quaternion[..., None], pack.box)


@functools.cache
def parts_of(name: str) -> Parts:
    """Grains that fly and spin into each other, each replica at its own speed; and a direction."""
    pack, state = at_rest(FILES.get(name, TETRA_27))
    system = System(pack.clump, LAWS[name], pack.pairs, wall_mu=0.2 if name == ROUGH else None)
    draws = np.random.default_rng(0)
    scale = 5e-3 * np.linspace(0.5, 1.0, REPLICAS)
    velocity, spin = (scale * draws.normal(size=(pack.grains, 3, 1)) for _ in range(2))
    still = np.zeros((STEPS, 3, REPLICAS))
    walls = (np.broadcast_to(np.asarray(edge)[:, None], still.shape) for edge in (pack.lower, pack.upper))
    box = Box(*walls, still, still, pack.box.periodic)
    grains = replace(replicate(state, REPLICAS).grains, velocity=velocity, spin=spin)
    history = system.friction.init(pack.pairs.capacity, REPLICAS, np.dtype(float))
    numbers = jnp.asarray(0.3), jnp.asarray(0.01)
    at_walls = wall_histories(system, REPLICAS, pack.grains)
    arrays = jax.tree.map(jnp.asarray, arrays_of(system, grains, (history, at_walls), box, numbers, state.cell))
    along = jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), arrays)
    return call_of(system, pack.box.periodic), fixed_of(system), arrays, along


@functools.partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=QUICKLY)
def called(target: str, in_place: bool, call: Call, *parts: Any) -> list[jax.Array]:
    shapes = (calls.of_arrays if target.endswith("adjoint") else calls.of_results)(parts[:2])
    return list(cuda.call_kernels(target, call, in_place, parts, shapes)[: len(shapes)])


def values(made: str, law: str, in_place: bool = False) -> list[np.ndarray]:
    call, fixed, arrays, _ = parts_of(law)
    return [np.asarray(leaf) for leaf in called(f"gmem_{made}_advance", in_place, call, fixed, arrays)]


def tangents(made: str, law: str) -> list[np.ndarray]:
    call, fixed, arrays, along = parts_of(law)
    return [np.asarray(leaf) for leaf in called(f"gmem_{made}_tangent", False, call, fixed, arrays, along)]


def adjoints(made: str, law: str) -> list[np.ndarray]:
    call, fixed, arrays, _ = parts_of(law)
    draws = np.random.default_rng(1)
    shapes = calls.results_of(arrays, calls.of_results((fixed, arrays)))
    bars = jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), shapes)
    return [np.asarray(leaf) for leaf in called(f"gmem_{made}_adjoint", False, call, fixed, arrays, bars)]


def assert_same(found: list[Any], expected: list[Any]) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def refused(law: str = "H") -> str:
    """What is said of a call that fails."""
    try:
        values("mock", law)
    except Exception as error:
        return str(error)
    raise AssertionError("the call did not fail")


def numbers_of_a_law(driver: Driver, law: str) -> None:
    """Values, in place as in a run, and tangents."""
    driver.begin()
    expected = values("emulated", law, in_place=True)
    moved = np.abs(expected[0] - np.asarray(parts_of(law)[2].fields[0])).max()
    assert moved > 1e-3
    assert_same(values("mock", law, in_place=True), expected)
    assert driver.count("cuModuleLoadData") == 1
    assert driver.count("cuLaunchKernel") == 5 + 2 * STEPS
    assert_same(tangents("mock", law), tangents("emulated", law))
    assert driver.count("cuModuleLoadData") == 2


def reverse_mode(driver: Driver) -> None:
    """At once, and captured and replayed."""
    driver.begin()
    expected = adjoints("emulated", "H")
    assert all(np.abs(leaf).max() > 1e-6 for leaf in expected)
    assert_same(adjoints("mock", "H"), expected)
    assert driver.count("cuModuleLoadData") == 1
    assert driver.count("cuLaunchKernel") == 7 + 6 * STEPS
    driver.begin(replays=2)
    assert_same(adjoints("mock", "H"), expected)
    assert driver.count("cuModuleLoadData") == 0


def many_replicas(driver: Driver) -> None:
    """So many that one thread does a grain: each has the numbers that it has among few."""
    call, fixed, arrays, _ = parts_of("H")
    arrays = arrays._replace(walls=arrays.walls[:1])
    times = 131_072 // (len(arrays.fields[0]) * REPLICAS) + 1
    driver.begin()
    few = called("gmem_emulated_advance", False, call, fixed, arrays)
    many = called("gmem_mock_advance", False, call, fixed, jax.tree.map(lambda leaf: jnp.tile(leaf, times), arrays))
    assert_same([np.asarray(leaf) for leaf in many], [np.tile(leaf, times) for leaf in few])


def captured(driver: Driver) -> None:
    """The arguments of launches that run later are those of the call."""
    driver.begin()
    at_once = values("mock", "H"), tangents("mock", "H")
    for replays in (1, 2):
        driver.begin(replays=replays)
        assert_same(values("mock", "H"), at_once[0])
        assert_same(tangents("mock", "H"), at_once[1])
        assert driver.count("cuModuleLoadData") == 0


def two_devices(driver: Driver) -> None:
    """Each has modules of its own, and they are loaded once, before anything is captured."""
    expected = values("emulated", "H")
    for device, replays in ((1, 0), (2, 1)):
        driver.begin(device, replays)
        for _ in range(2):
            assert_same(values("mock", "H"), expected)
        assert driver.count("cuModuleLoadData") == 1
        assert driver.count("loads while capturing") == 0
    driver.begin(1)
    assert_same(values("mock", "H"), expected)
    assert driver.count("cuModuleLoadData") == 0


def not_initialized(driver: Driver) -> None:
    """Modules are then loaded while launches are captured."""
    driver.begin(3, replays=1, initialized=False)
    assert_same(values("mock", "H"), values("emulated", "H"))
    assert driver.count("loads while capturing") == 1


def an_architecture_of_the_future(driver: Driver) -> None:
    """What NVRTC does not know is compiled by the driver, from PTX."""
    driver.begin(4)
    driver.be(990)
    assert_same(values("mock", "H"), values("emulated", "H"))
    assert driver.count("cuModuleLoadData") == 1
    (kept,) = Path(os.environ["GMEM_COMPILE_CACHE"]).glob("kernels/*.ptx")
    assert re.search(r"-compute_\d+-nvrtc[\d.]+-law10\.ptx$", kept.name)
    assert not re.search(r"(mul|add|sub)\.f64", kept.read_text())  # which could be contracted


def files_that_are_not_what_they_seem(driver: Driver) -> None:
    """They are compiled anew, once."""
    expected = values("emulated", "H")
    driver.begin(5)
    driver.be(80)
    assert_same(values("mock", "H"), expected)
    folder = Path(os.environ["GMEM_COMPILE_CACHE"]) / "kernels"
    (other,) = folder.glob("*-sm_80-*-law10.cubin")
    kept = Path(str(other).replace("-sm_80-", "-sm_90-"))
    whole = kept.read_bytes()
    wrong = {"nothing": (b"", 1), "cut short": (whole[:-100], 1), "of another GPU": (other.read_bytes(), 2)}
    for device, (bytes_of, loads) in enumerate(wrong.values(), start=6):
        kept.write_bytes(bytes_of)
        driver.begin(device)
        assert_same(values("mock", "H"), expected)
        assert driver.count("cuModuleLoadData") == loads
        assert kept.read_bytes() == whole
    assert not list(folder.glob("*.cubin.*"))


FAILURES = [  # functions of the driver, and the call of them from which on they fail
    ("cuStreamGetCtx", 1),
    ("cuStreamGetCtx", 2),
    ("cuCtxPushCurrent_v2", 1),
    ("cuCtxPushCurrent_v2", 2),
    ("cuCtxGetDevice", 1),
    ("cuDeviceGetAttribute", 2),
    ("cuThreadExchangeStreamCaptureMode", 1),
    ("cuModuleLoadData", 1),
    ("cuModuleGetFunction", 3),
    ("cuFuncGetAttribute", 2),
    ("cuLaunchKernel", 4),
]


def failures(driver: Driver) -> None:
    """Each is one line, disturbs nothing, and the next call works."""
    expected = values("emulated", "H")
    for device, (function, call) in enumerate(FAILURES, start=10):
        driver.begin(device)
        driver.fail(function, call)
        said = refused()
        assert re.search(r"gmem_jax native: the GPU's driver: [a-z ]+: out of memory", said), (function, said)
        assert "\n" not in said, (function, said)
        assert driver.complaints() == "", (function, driver.complaints())
        driver.begin(device)
        assert_same(values("mock", "H"), expected)
    driver.begin(99)
    driver.fail("cuStreamGetCtx")
    driver.fail("cuGetErrorString")
    assert refused().endswith("the GPU's driver: context of the stream: unknown")


CASES: dict[str, Callable[[Driver], None]] = {
    **{f"the numbers of {law}": functools.partial(numbers_of_a_law, law=law) for law in LAWS},
    "reverse mode": reverse_mode,
    "many replicas": many_replicas,
    "launches that are captured and replayed": captured,
    "two devices": two_devices,
    "a GPU that NVRTC does not know": an_architecture_of_the_future,
    "files that are not what they seem": files_that_are_not_what_they_seem,
    "calls that were not initialized": not_initialized,
    "functions of the driver that fail": failures,
}
SLOW = {"reverse mode", *(f"the numbers of {law}" for law in LAWS if law != "H")}  # NVRTC takes its time


@functools.cache
def driver_of(folder: Path) -> Path:
    """The mock driver, compiled."""
    path = folder / "libcuda.so.1"
    linked(path, f"-Wl,-soname,{path.name}", str(Path(__file__).parent / "mock_cuda.cc"))
    return path


@functools.cache
def outcomes(folder: Path, slow: bool) -> dict[str, str]:
    """What went wrong, by case."""
    chosen = [name for name in CASES if (name in SLOW) == slow]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "JAX_PLATFORMS": "cpu"}
    environment["GMEM_COMPILE_CACHE"] = str(folder)
    command = [sys.executable, __file__, str(driver_of(folder)), *chosen]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-4000:]
    return dict(json.loads(done.stdout))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("driver")


@pytest.mark.skipif(not native.available()[0], reason=native.available()[1])
@pytest.mark.skipif(bool(cuda.missing()), reason=cuda.missing())
@pytest.mark.parametrize("case", [pytest.param(case, marks=[pytest.mark.slow] * (case in SLOW)) for case in CASES])
def test_calls_keep_the_protocol_of_the_driver(case: str, folder: Path) -> None:
    assert outcomes(folder, case in SLOW)[case] == ""


def outcome(driver: Driver, case: str) -> str:
    try:
        CASES[case](driver)
    except Exception:
        return traceback.format_exc()
    return driver.complaints()


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    mock = Driver(sys.argv[1])
    print(json.dumps({case: outcome(mock, case) for case in sys.argv[2:]}))
