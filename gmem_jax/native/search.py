"""The search for candidate contacts in the library: the pairs of `gmem_jax.physics.search`, some ten times faster."""

import ctypes
import functools

import numpy as np

from gmem_jax.native import library
from gmem_jax.physics.search import Search


@functools.cache
def search() -> Search | None:
    """The search in the library; None where it is not available."""
    if not library.available()[0]:
        return None
    call = ctypes.CDLL(str(library.path())).gmem_search
    call.restype = ctypes.c_int64
    pointer, integer = ctypes.c_void_p, ctypes.c_int64
    call.argtypes = [pointer, integer, integer, ctypes.c_double, pointer, integer]

    def keys_of(centres: np.ndarray, spheres_per_grain: int, reach: float) -> np.ndarray:
        library.require_threads()
        if not np.isfinite(centres).all():
            raise ValueError("sphere centres must be finite to look for neighbours")
        # In a dense pack a sphere has six candidates with a skin of 0.5 R, sixteen with 1 R.
        centres, room = np.ascontiguousarray(centres, dtype=np.float64), 32 * len(centres)
        while True:
            keys = np.empty(room, dtype=np.int64)
            found = call(centres.ctypes.data, len(centres), spheres_per_grain, reach, keys.ctypes.data, room)
            if found < 0:
                raise MemoryError("no memory, or no thread, to look for neighbours")
            if found <= room:
                return keys[:found].copy()
            room = found

    return keys_of
