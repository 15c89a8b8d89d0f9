"""The choice of the backend: which code computes the steps for a friction law, precision and device."""

import functools
from dataclasses import dataclass
from typing import Literal, cast, get_args

from jax.extend.backend import get_backend

from gmem_jax.native import cuda, library
from gmem_jax.native.census import census_anywhere, census_by_library
from gmem_jax.native.march import March, march, march_anywhere, march_mixed, require_mixed
from gmem_jax.physics import step as dynamics
from gmem_jax.physics.boundary import PeriodicAxes
from gmem_jax.physics.census import TakeCensus, take_census
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.laws import entry_of

Backend = Literal["auto", "jax", "native"]
Precision = Literal["double", "mixed"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)
PRECISIONS: tuple[Precision, ...] = get_args(Precision)


@dataclass(frozen=True)
class ResolvedBackend:
    """The backend that runs on JAX's default device.

    Attributes:
        name: "jax" or "native".
        precision: "double" or "mixed".
        march: runs the steps of a bin; that of "auto" also serves programs for other devices than the default one.
        census: takes the census at the end of a bin; likewise.
        why: the instruction set of the native backend on CPUs, or why plain JAX runs.
    """

    name: Backend
    precision: Precision
    march: March
    census: TakeCensus
    why: str


def supports(law: FrictionLaw) -> bool:
    """Whether the native backend knows this friction law (a user's own runs in plain JAX)."""
    return entry_of(law) is not None


def resolve(backend: str, precision: str, law: FrictionLaw) -> ResolvedBackend:
    """The backend that runs the steps under a friction law; one object for equal arguments.

    Args:
        backend: as in `marcher`.
        precision: likewise.
        law: the friction law; only its class matters, not its parameters.

    Raises:
        ValueError: if the backend is unknown or not available, or does not have the precision.
    """
    lacks = "" if supports(law) else f"the friction law {type(law).__name__}"
    return _resolve(backend, precision, lacks, *library.available())


@functools.cache
def _resolve(backend: str, precision: str, lacks: str, built: bool, said: str) -> ResolvedBackend:
    steps = marcher(backend, precision)
    why = "it was asked for" if backend == "jax" else _why_not(lacks, built, said) if backend == "auto" else ""
    name: Backend = "jax" if why else "native"
    census = {"jax": take_census, "native": census_by_library, "auto": census_anywhere}[backend]
    return ResolvedBackend(name, cast(Precision, precision), steps, census, why or said)


def _why_not(lacks: str, built: bool, said: str) -> str:
    """Why "auto" means plain JAX on the default device, where the library lacks something; "" if it does not."""
    if not built:
        return said
    if lacks:
        return f"the native backend does not know {lacks}"
    client = get_backend()
    if client.platform == "gpu" and "cuda" in client.platform_version:
        return cuda.missing()
    return "" if client.platform == "cpu" else f"the native backend does not run on {client.platform}"


def backend_name(backend: str, law: FrictionLaw) -> Backend:
    """The backend that "auto" chooses on JAX's default device, "jax" or "native"; other names stay as they are.

    Args:
        backend: as in `resolve`.
        law: likewise.

    Raises:
        ValueError: if there is no such backend.
    """
    _require_known(backend)
    if backend != "auto":
        return cast(Backend, backend)
    return resolve(backend, "double", law).name


def _require_known(backend: str) -> None:
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}; got {backend!r}")


def require_precision(
    precision: str, backend: str, law: FrictionLaw, periodic: PeriodicAxes, equal: bool, smooth: bool
) -> None:
    """Refuse a backend or a precision that is unknown, or a precision that is not available.

    Args:
        precision: as in `marcher`.
        backend: likewise.
        law: the friction law.
        periodic: the periodic axes of the box.
        equal: whether all spheres are of radius 1.
        smooth: whether walls are without friction.

    Raises:
        ValueError: saying why.
    """
    _require_known(backend)
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}; got {precision!r}")
    if precision == "double":
        return
    if backend_name(backend, law) != "native":
        built, said = library.available()
        why = "" if backend == "jax" or built else f", which is not available: {said}"
        raise ValueError(f"precision='mixed' is a mode of the native backend{why}; here plain JAX would run")
    require_mixed(law, periodic, equal, smooth)


def marcher(backend: str = "auto", precision: str = "double") -> March:
    """The `march` of a backend, for any friction law.

    Args:
        backend: "jax", the definition; "native", the library, refused if it is not available; or "auto": native in
            programs for CPUs and CUDA GPUs, if the library is available and knows the friction law, else plain JAX.
        precision: "double", or "mixed": contacts and their histories in single precision, on the native backend; see
            `gmem_jax.native.march.march_mixed`.

    Raises:
        ValueError: if the backend is unknown or not available, or does not have the precision.
    """
    _require_known(backend)
    if precision not in PRECISIONS or (precision == "mixed" and backend == "jax"):
        raise ValueError(f"precision {precision!r} is not one of the backend {backend!r}")
    if backend == "native" or precision == "mixed":
        library.require_library()
    if precision == "mixed":
        return march_mixed
    return {"jax": dynamics.march, "native": march, "auto": march_anywhere}[backend]
