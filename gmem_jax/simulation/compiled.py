"""`jax.jit` with compiler settings for the default device, chosen at the first call."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from gmem_jax.physics.pytree import typed


@functools.cache
def _settings(quick: bool) -> dict[str, Any] | None:
    """Compiler settings that suit this code on the default device; with `quick` it compiles in a third of the time.

    On CPUs XLA's newer fusion emitters do not vectorise the contact law over the replicas; the older ones do, and
    make a step of plain JAX 1.3 times faster (8 replicas, jax 0.9.2). Later releases have the newer ones alone.
    """
    settings = {"xla_cpu_use_fusion_emitters": False, **({"xla_backend_optimization_level": 0} if quick else {})}
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda: 0, compiler_options=settings)()
    except jax.errors.JaxRuntimeError:  # no such option
        return None
    return settings


class Compiled:
    """`jax.jit` with settings chosen when it is first called: importing must not start a backend.

    `quick` is for functions that are called once in a run, on small arrays, and whose results bear round-off.
    """

    def __init__(self, function: Callable[..., Any], *, quick: bool = False, **options: Any) -> None:
        self._function, self._quick, self._options = function, quick, options

    @functools.cached_property
    def program(self) -> Any:
        """The function as `jax.jit` compiles it."""
        return jax.jit(self._function, compiler_options=_settings(self._quick), **self._options)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function. A number that is given as a float uses the same program as one given as an array."""
        args, kwargs = typed((args, kwargs))
        return self.program(*args, **kwargs)


def require_x64() -> None:
    """Refuse to simulate in single precision: a contact slides about 1e-6 R in a step.

    Raises:
        ValueError: if JAX's 64-bit mode is off.
    """
    if jax.dtypes.canonicalize_dtype(np.float64) != np.float64:
        raise ValueError(
            'float64 is needed but JAX runs in 32 bits: call jax.config.update("jax_enable_x64", True) first'
        )
