"""The cost of a grain-step on a GPU: times if there is one; registers, launches and bytes without."""

import itertools
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.bench import measure
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.provenance import provenance
from gmem_jax.native import cuda, library
from gmem_jax.native.cuda import Needs
from gmem_jax.physics.census import take_census
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless

PACKS = ("tetra-325-a", "tetra-1024-a", "tetra-10240-b")
REPLICAS = (1, 8, 32, 128)
BINS_TIMED = 32  # bins in a timed call, as in a run; in shorter calls the work of the host would weigh more
OTHERS = (  # further cases: pack, law, backend and replicas
    ("tetra-1024-a", "M1", "native", 128),
    ("tetra-10240-b", "M1", "native", 128),
    ("tetra-1024-a", "M2", "native", 32),
    ("tetra-10240-b", "M2", "native", 8),
    ("tetra-1024-a", "H", "jax", 8),
    ("tetra-10240-b", "H", "jax", 8),
)
COPIED = 1 << 26  # numbers that are copied to measure the bandwidth
ARCHITECTURES = {"sm_80": "A100", "sm_90": "H100, H200", "sm_100": "B200", "sm_120": "RTX 50"}
GPU_LAWS = {"frictionless": Frictionless(), **measure.TIMED_LAWS}


def device() -> Any:
    """A CUDA GPU that JAX sees.

    Raises:
        ValueError: if there is none, or the native backend cannot use it.
    """
    try:
        found = jax.devices("cuda")[0]
    except RuntimeError as error:
        hint = "pip install 'gmem-jax[cuda13]', or [cuda12] for drivers of CUDA 12"
        raise ValueError(f"JAX sees no CUDA GPU here (with one: {hint})") from error
    if reason := (library.available()[1] if not library.available()[0] else cuda.missing()):
        raise ValueError(f"the native backend cannot use the GPU: {reason}")
    return found


def copied_bytes_per_second() -> float:
    """Bytes that the device reads and writes per second: the median over ten copies of `COPIED` numbers."""
    copy, numbers = jax.jit(lambda numbers: numbers + 1.0), jnp.zeros(COPIED)
    jax.block_until_ready(copy(numbers))
    taken = []
    for _ in range(10):
        began = time.perf_counter()
        jax.block_until_ready(copy(numbers))
        taken.append(time.perf_counter() - began)
    return 16.0 * COPIED / float(np.median(taken))


def bytes_per_grain_step(pack: Pack) -> dict[str, float]:
    """Bytes of a grain-step under law H with many replicas.

    Returns:
        "memory": bytes that both kernels read and write, each number counted once. "gathered": bytes that they read
        again, for the other candidates of a sphere and contacts of a grain; caches may hold these. "held": memory per
        grain and replica, between steps and in the arrays of a call.
    """
    simulation, state = measure.encode(pack, measure.TIMED_LAWS["H"], 1, "native")
    touching = float(take_census(simulation.system, state, pack.box).sphere_contacts[0]) / pack.grains
    rows, sides = float(np.asarray(pack.pairs.valid).sum()) / pack.grains, 2.0 * touching
    spheres, hot, cold, load, remembered = pack.clump.spheres, 9, 4, 6, 3
    touch = 8.0 * (3 * spheres + hot + touching * (2 * remembered + load)) + rows
    move = 8.0 * (2 * hot + 2 * cold + 3 * spheres + touching * load) + rows
    again = 8.0 * (3 * (2 * rows - spheres) + hot * (sides - 1) + touching * load) + rows
    held = 8.0 * (hot + cold + 9 * spheres + rows * (load + remembered) + 2 * 19) + rows + spheres
    return {"memory": touch + move, "gathered": again, "held": held}


def registers() -> dict[str, dict[str, tuple[Needs, Needs]]]:
    """Needs of the kernels `touch` and `move_alone` by law and architecture; empty without NVRTC or native library."""
    if cuda.missing() or not library.available()[0]:
        return {}

    def of(law: FrictionLaw, task: cuda.Task) -> dict[str, tuple[Needs, Needs]]:
        found = {name: library.needs(law, name, task) for name in ARCHITECTURES}
        return {name: (kernels["touch"], kernels["move_alone"]) for name, kernels in found.items()}

    plain = {name: of(law, "forward") for name, law in GPU_LAWS.items()}
    return {**plain, **{f"{name}, with derivatives": of(GPU_LAWS[name], "tangent") for name in ("H", "M2")}}


def timed(load: Callable[[str], Pack], say: measure.Say = lambda what, fraction: None) -> dict[str, Any]:
    """Times of every pack and number of replicas under law H, and of `OTHERS`; and the bandwidth of a copy.

    Raises:
        ValueError: as in `device`.
    """
    on = device()
    with jax.default_device(on):
        rows = []
        every = [(name, "H", "native", count) for name, count in itertools.product(PACKS, REPLICAS)] + list(OTHERS)
        for place, (name, law, backend, count) in enumerate(every):
            say(f"{backend}, {law}, {name}, {count} replicas", place / len(every))
            row = measure.time_rollout(load(name), backend, law, count, bins=BINS_TIMED if backend == "native" else 4)
            rows.append({"pack": name, **asdict(row)})
        about = {**provenance(), "device": on.device_kind}
        return {**about, "copied_bytes_per_s": copied_bytes_per_second(), "rows": rows}


def kernel_facts(load: Callable[[str], Pack]) -> dict[str, Any]:
    """Registers and bytes of the kernels, which are known without a GPU."""
    return {
        **provenance(),
        "registers": registers(),
        "bytes": {name: bytes_per_grain_step(load(name)) for name in PACKS},
    }


def gpu_markdown(facts: dict[str, Any], times: dict[str, Any] | None) -> str:
    """Tables of `kernel_facts` and, if there was a GPU, of `timed`."""
    heads = [f"{architecture} ({name})" for architecture, name in ARCHITECTURES.items()]
    lines = ["Registers of a thread and bytes that it spills, in `touch` and in `move_alone` (`--fmad=false`):", ""]
    lines += ["| law | " + " | ".join(heads) + " |", "|---" * (1 + len(heads)) + "|"]
    for law, found in facts["registers"].items():
        cells = ("; ".join(f"{need.registers}, {need.spilt}" for need in both) for both in found.values())
        lines.append(f"| {law} | " + " | ".join(cells) + " |")
    lines += ["", "Bytes of a grain-step under law H, for many replicas:", ""]
    lines += ["| pack | from and to memory | gathered beside | held, a grain and replica |", "|---|---|---|---|"]
    for name, count in facts["bytes"].items():
        lines.append(f"| {name} | {count['memory']:.0f} | {count['gathered']:.0f} | {count['held']:.0f} |")
    if times is None:
        return "\n".join([*lines, "", "Not timed: no GPU was at hand.", ""])
    speed = times["copied_bytes_per_s"]
    lines += ["", f"{times['device']}, JAX {times['versions']['jax']}; a copy moves {speed / 1e9:.0f} GB/s.", ""]
    lines += ["| N | replicas | law, backend | ns per grain-step | us per step | GB/s of memory needed | compile, s |"]
    lines += ["|---|---|---|---|---|---|---|"]
    for row in times["rows"]:
        step = row["us"] * row["grains"] * row["replicas"]
        known = row["engine"] == "native" and row["law"] == "H"
        rate = f"{facts['bytes'][row['pack']]['memory'] / row['us'] * 1e-3:.0f}" if known else ""
        lines.append(
            f"| {row['grains']} | {row['replicas']} | {row['law']}, {row['engine']} | {1e3 * row['us']:.3f} | "
            f"{step:.1f} | {rate} | {row['compile_s']:.1f} |"
        )
    return "\n".join([*lines, ""])
