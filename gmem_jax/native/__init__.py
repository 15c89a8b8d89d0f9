"""The steps of one bin in C++, behind jax.ffi: the numbers of `gmem_jax.physics.step.march`, several times faster.

One call into the library runs all steps of one bin for all replicas; walls, checks and samples are computed in JAX.
It works under `jax.jit`, `jax.vmap`, `jax.shard_map`, on sharded arrays, and in both modes of differentiation, whose
derivatives are computed in the library too. The rooms: `backend` decides which code does the steps, `march` puts a
state into the arrays of a call, `calls` makes a call an operation of JAX, `primitives` says how the calls are
differentiated, `library` loads what `build` compiled, `cuda` has what GPUs need beside that, and `search` looks for
candidate contacts.

On CUDA GPUs the same C++ runs as kernels; see `gmem_jax.native.cuda` and docs/gpu.md. What follows is said of CPUs.

Numbers depend neither on threads nor on what else is in a batch, and are the same with AVX2 and AVX-512. CPUs without
fused multiply-add ("baseline" in `available`) differ from those in last digits, fidelities by some 1e-11. Calls at once
share out the CPUs; GMEM_THREADS limits the threads of each, and GMEM_CACHE (in MB) stands for the caches that are found
when it is not right about how many blocks of replicas fit into them. JAX does not survive os.fork: start processes by
"spawn".
"""

import sys
from typing import TYPE_CHECKING

import gmem_start

# In a process of the command a module loads what it needs, as in `gmem_jax`.
if TYPE_CHECKING or not gmem_start.alone:
    from gmem_jax.native import library
    from gmem_jax.native.backend import (
        BACKENDS,
        PRECISIONS,
        Backend,
        Precision,
        ResolvedBackend,
        backend_name,
        marcher,
        require_precision,
        resolve,
        supports,
    )
    from gmem_jax.native.calls import TARGETS
    from gmem_jax.native.library import available, cpus, needs, require_threads
    from gmem_jax.native.march import March, march
    from gmem_jax.native.search import search

    # Now, and not when a march is first asked for: a program that `jax.export` wrote calls the library by name, in a
    # process that may have imported the package and no more. It starts no backend. While Python looks for the module
    # of ``python -m gmem_jax.native.build``, which compiles the library, it must not be imported yet.
    if getattr(sys, "argv", [""])[:1] != ["-m"]:
        library.load_library()

__all__ = [
    "BACKENDS",
    "PRECISIONS",
    "TARGETS",
    "Backend",
    "March",
    "Precision",
    "ResolvedBackend",
    "available",
    "backend_name",
    "cpus",
    "march",
    "marcher",
    "needs",
    "require_precision",
    "require_threads",
    "resolve",
    "search",
    "supports",
]
