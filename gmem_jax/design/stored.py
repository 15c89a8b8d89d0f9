"""Files of memory kernels."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.files.hdf5 import reading, write_arrays, writing
from gmem_jax.files.schemas import KERNEL
from gmem_jax.files.validation import json_of, refusing, require, require_finite

_NUMBERS = ("width", "gamma0", "delta0")


def save_kernel(path: Path, kernel: MemoryKernel, configuration: dict[str, Any]) -> None:
    """Write a kernel with the resolved configuration that it was measured with.

    Raises:
        OSError: if the path cannot be written.
    """
    with writing(path, KERNEL.name) as file:
        file.attrs["configuration"] = json.dumps(configuration)
        write_arrays(file, KERNEL.arrays, {**vars(kernel), "kernel": kernel.kernel()})


def load_kernel(path: Path) -> tuple[MemoryKernel, dict[str, Any]]:
    """Read a kernel and its configuration.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file is damaged, or not a complete kernel of this schema.
    """
    with refusing(path, "kernel"), reading(path, KERNEL.name) as content:
        configuration = json_of(content.text("configuration"), "configuration")
        found = content.arrays(KERNEL.arrays)
        require_finite(found)
        for name in _NUMBERS:
            require(found[name] > 0.0, f"its {name} is not positive")
        require(found["width"] < 1.0, "its bumps are wider than the waveform")
        require(len(found["centres"]) > 1, "it was measured on less than 2 waveforms")
        own: dict[str, Any] = {entry.name: found[entry.name] for entry in fields(MemoryKernel)}
        kernel = MemoryKernel(**own | {name: float(found[name]) for name in _NUMBERS})
        same = np.allclose(kernel.kernel(), found["kernel"], rtol=1e-9, atol=1e-12 * np.abs(found["kernel"]).max())
        require(same, "its kernel is not that of its recalls")
        return kernel, configuration
