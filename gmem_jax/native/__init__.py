"""The steps of one bin in C++, behind jax.ffi: the numbers of `gmem_jax.physics.step.march`, several times faster.

One call into the library runs all steps of one bin for all replicas; walls, checks and samples are computed in JAX.
It works under `jax.jit`, `jax.vmap`, `jax.shard_map`, on sharded arrays, and in both modes of differentiation, whose
derivatives are computed in the library too. The modules: `backend` decides which code runs the steps, `march` puts a
state into the arrays of a call, `calls` makes a call an operation of JAX, `primitives` says how the calls are
differentiated, `library` loads the library that `build` compiled, `cuda` makes the calls on GPUs, `census` counts
contacts, and `search` looks for candidate contacts.

On CUDA GPUs the same C++ runs as kernels; see `gmem_jax.native.cuda` and docs/gpu.md. The rest of this text is about
CPUs.

Numbers depend neither on threads nor on what else is in a batch, and are the same with AVX2 and AVX-512. CPUs without
fused multiply-add ("baseline" in `available`) give numbers that differ in the last digits, and fidelities that differ
by some 1e-11. Calls at the same time share the CPUs; GMEM_THREADS limits the threads of each call. GMEM_CACHE (in MB)
replaces the size of the caches that the library finds, from which it decides how many blocks of replicas fit into them.
JAX does not survive os.fork: start processes by "spawn".
"""

import sys
from typing import TYPE_CHECKING

import gmem_start

# In a process of the command, modules import only what they need, as in `gmem_jax`.
if TYPE_CHECKING or not gmem_start.alone:
    from gmem_jax.native import library
    from gmem_jax.native.backend import backend_name, marcher, resolve
    from gmem_jax.native.calls import TARGETS
    from gmem_jax.native.library import available, needs
    from gmem_jax.native.march import March, march
    from gmem_jax.native.search import search

    # The library is loaded at import, not at the first march: a program that `jax.export` wrote calls it by name, in a
    # process that may only have imported the package. Loading starts no backend of JAX. The library must not be loaded
    # while Python looks for the module of ``python -m gmem_jax.native.build``, which compiles it.
    if getattr(sys, "argv", [""])[:1] != ["-m"]:
        library.load_library()

__all__ = [
    "TARGETS",
    "March",
    "available",
    "backend_name",
    "march",
    "marcher",
    "needs",
    "resolve",
    "search",
]
