"""`gm.run` on several devices, of one process and of two, gives the numbers of one."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scenes import TESTS
from xla_flags import COMPILED_SOON

from gmem_jax import native

Numbers = dict[str, np.ndarray]
pytestmark = pytest.mark.slow
HERE = Path(__file__).parent
BUILT, REASON = native.available()


def start(devices: int, *arguments: object) -> subprocess.Popen[str]:
    """A process whose CPU counts as some devices."""
    paths = os.pathsep.join([str(TESTS), *filter(None, [os.environ.get("PYTHONPATH")])])
    flags = f"--xla_force_host_platform_device_count={devices} {COMPILED_SOON}"
    environment = {**os.environ, "PYTHONPATH": paths, "XLA_FLAGS": flags}
    command = [sys.executable, str(HERE / "several_devices.py"), *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)


def ended(*processes: subprocess.Popen[str]) -> None:
    for process in processes:
        _, said = process.communicate(timeout=300)
        assert process.returncode == 0, said


def found(path: Path, devices: int) -> Numbers:
    with np.load(path) as file:
        numbers = dict(file)
    assert numbers.pop("devices") == devices
    return numbers


@pytest.fixture(scope="module", params=["native", "jax"])
def alone(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Numbers]:
    """The numbers of one device."""
    if request.param == "native" and not BUILT:
        pytest.skip(REASON)
    target = tmp_path_factory.mktemp("alone") / "out.npz"
    ended(start(1, "alone", request.param, target))
    return request.param, found(target, 1)


def compare(backend: str, one: Numbers, many: Numbers) -> None:
    assert one.keys() == many.keys()
    for name, numbers in one.items():
        # XLA's vector code differs with the number of replicas on a device: round-off, grown over 900 steps.
        # Observers are XLA's on every backend.
        rounding = {"native": 1e-14 if name == "nonaffine" else 0.0, "jax": 1e-6}[backend]
        tolerance = rounding * np.abs(numbers).max(initial=0.0)
        np.testing.assert_allclose(many[name], numbers, rtol=0.0, atol=tolerance, err_msg=name)


def test_eight_devices_give_the_numbers_of_one(alone: tuple[str, Numbers], tmp_path: Path) -> None:
    backend, wanted = alone
    ended(start(8, "alone", backend, tmp_path / "out.npz"))
    compare(backend, wanted, found(tmp_path / "out.npz", 8))


def test_two_processes_give_the_numbers_of_one(alone: tuple[str, Numbers], tmp_path: Path) -> None:
    backend, wanted = alone
    if backend == "jax" and BUILT:
        pytest.skip("the native backend was tried; what differs between processes is not the backend's")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    ended(*(start(2, address, backend, tmp_path / "out.npz", 2, number) for number in range(2)))
    compare(backend, wanted, found(tmp_path / "out.npz", 4))
