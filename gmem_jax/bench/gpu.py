"""What a grain-step costs on a GPU: timed where there is one; registers, launches and bytes are known without."""

import itertools
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax import native
from gmem_jax.bench import measure
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.provenance import provenance
from gmem_jax.native import cuda
from gmem_jax.native.cuda import Needs
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.simulation import sample

PACKS = ("tetra-1024-a", "tetra-10240-b")
REPLICAS = (1, 8, 32, 128)
COPIED = 1 << 26  # numbers, for the bandwidth
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
        raise ValueError("JAX sees no CUDA GPU here (with one: pip install 'gmem-jax[cuda13]')") from error
    if reason := (native.available()[1] if not native.available()[0] else cuda.missing()):
        raise ValueError(f"the native backend cannot use the GPU: {reason}")
    return found


def copied_bytes_per_second() -> float:
    """What the device reads and writes in a second at best: the median of ten copies of `COPIED` numbers."""
    copy, numbers = jax.jit(lambda numbers: numbers + 1.0), jnp.zeros(COPIED)
    jax.block_until_ready(copy(numbers))
    taken = []
    for _ in range(10):
        began = time.perf_counter()
        jax.block_until_ready(copy(numbers))
        taken.append(time.perf_counter() - began)
    return 16.0 * COPIED / float(np.median(taken))


def bytes_per_grain_step(pack: Pack) -> dict[str, float]:
    """Bytes of a grain-step under law H, many replicas: what must come from memory or go there, and what is gathered.

    Returns:
        "memory": own numbers and histories, each read and written once. "gathered": beside them the spheres of all
        candidates and the grains of those that touch, which caches may hold. "held": memory of a grain and replica,
        between steps and in the arrays of a call.
    """
    simulation, state = measure.encode(pack, measure.TIMED_LAWS["H"], 1, "native")
    touching = float(sample.measure(simulation.system, state, pack.box, jnp.ones((3, 1)), 0.0).contacts[0])
    sides = 2.0 * float(np.asarray(pack.pairs.valid).sum()) / pack.grains
    remembered = 3  # numbers of a contact
    spheres, own = pack.clump.spheres, 9 + 4
    memory = 8.0 * (2 * own + 2 * 3 * spheres + remembered * (sides + touching))
    held = 8.0 * (9 + own + 6 * spheres + 3 + sides * remembered + 2 * own + sides * remembered / 2.0)
    return {"memory": memory, "gathered": 8.0 * (3 * sides + 9 * touching), "held": held}


def registers() -> dict[str, dict[str, Needs]]:
    """What the step takes, by law and architecture; empty without NVRTC or library."""
    if cuda.missing() or not native.available()[0]:
        return {}

    def of(law: FrictionLaw, tangent: bool) -> dict[str, Needs]:
        return {name: native.needs(law, name, tangent=tangent)["advance"] for name in ARCHITECTURES}

    plain = {name: of(law, tangent=False) for name, law in GPU_LAWS.items()}
    return {**plain, **{f"{name}, with derivatives": of(GPU_LAWS[name], tangent=True) for name in ("H", "M2")}}


def timed(load: Callable[[str], Pack], say: measure.Say = lambda what, fraction: None) -> dict[str, Any]:
    """Every pack and number of replicas under law H, and the bandwidth of a copy.

    Raises:
        ValueError: see `device`.
    """
    on = device()
    with jax.default_device(on):
        rows = []
        for place, (name, count) in enumerate(itertools.product(PACKS, REPLICAS)):
            say(f"native, {name}, {count} replicas", place / (len(PACKS) * len(REPLICAS)))
            rows.append({"pack": name, **asdict(measure.time_rollout(load(name), "native", "H", count))})
        return {"device": on.device_kind, "copied_bytes_per_s": copied_bytes_per_second(), "rows": rows}


def kernel_facts(load: Callable[[str], Pack]) -> dict[str, Any]:
    """What is known without a GPU."""
    return {
        **provenance(),
        "registers": registers(),
        "bytes": {name: bytes_per_grain_step(load(name)) for name in PACKS},
    }


def gpu_markdown(facts: dict[str, Any], times: dict[str, Any] | None) -> str:
    """Tables of `kernel_facts` and, where there was a GPU, of `timed`."""
    heads = [f"{architecture} ({name})" for architecture, name in ARCHITECTURES.items()]
    lines = ["Registers of a thread and bytes that it spills, for one step (`--fmad=false`, blocks of 128):", ""]
    lines += ["| law | " + " | ".join(heads) + " |", "|---" * (1 + len(heads)) + "|"]
    for law, found in facts["registers"].items():
        lines.append(f"| {law} | " + " | ".join(f"{used}, {spilt}" for used, spilt in found.values()) + " |")
    lines += ["", "Bytes of a grain-step under law H, for many replicas:", ""]
    lines += ["| pack | from and to memory | gathered beside | held, a grain and replica |", "|---|---|---|---|"]
    for name, count in facts["bytes"].items():
        lines.append(f"| {name} | {count['memory']:.0f} | {count['gathered']:.0f} | {count['held']:.0f} |")
    if times is None:
        return "\n".join([*lines, "", "Not timed: no GPU was at hand.", ""])
    speed = times["copied_bytes_per_s"]
    lines += ["", f"{times['device']}; a copy moves {speed / 1e9:.0f} GB/s. Nanoseconds per grain-step, law H:", ""]
    lines += ["| N | replicas | ns | GB/s of memory needed | compile, s |", "|---|---|---|---|---|"]
    for row in times["rows"]:
        rate = facts["bytes"][row["pack"]]["memory"] / row["us"] * 1e-3
        lines.append(
            f"| {row['grains']} | {row['replicas']} | {1e3 * row['us']:.3f} | {rate:.0f} | {row['compile_s']:.1f} |"
        )
    return "\n".join([*lines, ""])
