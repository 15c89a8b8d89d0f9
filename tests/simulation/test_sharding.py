"""Replicas and sweeps on several devices: the numbers of one device, and no array is gathered."""

import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from sharded import CHECKS, sweep

from gmem_jax import native

HERE = Path(__file__).parent
BUILT, REASON = native.available()


@functools.cache
def found(backend: str) -> dict[str, str]:
    """What each check found wrong, from a process whose CPU counts as eight devices."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=8"
    command = [sys.executable, str(HERE / "sharded.py"), backend]
    run = subprocess.run(command, env={**os.environ, "XLA_FLAGS": flags}, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    wrong: dict[str, str] = json.loads(run.stdout)
    return wrong


def cases() -> list[object]:
    built = pytest.mark.skipif(not BUILT, reason=REASON)
    return [
        pytest.param(
            backend,
            check.__name__,
            marks=[built] * (backend == "native") + [pytest.mark.slow] * (backend == "jax" or check is sweep),
            id=f"{backend}-{check.__name__}",
        )
        for backend, checks in CHECKS.items()
        for check in checks
    ]


@pytest.mark.parametrize(("backend", "check"), cases())
def test_devices_share_out_replicas_and_sweeps(backend: str, check: str) -> None:
    wrong = found(backend)[check]
    assert not wrong, wrong
