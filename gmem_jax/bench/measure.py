"""Measuring the cost of a grain-step: native backend, plain JAX and LAMMPS in one run on one machine.

The unit is the microsecond of wall time per grain-step (one grain, one time step, one replica), in the encode stage:
moving walls, binning and list checks included. Results are checked in the same run: native and plain JAX must end at
the same wall pressures.
"""

import math
import os
import platform
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.bench import lammps
from gmem_jax.bench.race import REPEATS, Candidate, Row, interleave
from gmem_jax.derivatives.gradient import value_and_grad
from gmem_jax.design.kernel import bumps
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.pack import Pack, find_pairs
from gmem_jax.experiment.provenance import provenance
from gmem_jax.experiment.run import run
from gmem_jax.experiment.signals import Bumps
from gmem_jax.native.backend import backend_name
from gmem_jax.native.library import available
from gmem_jax.physics.contact import laws
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.rotation import matrix
from gmem_jax.physics.state import State, Status, explain, replicate, still_box
from gmem_jax.physics.system import System
from gmem_jax.simulation.loop import Simulation
from gmem_jax.simulation.observers import forward, told_of
from gmem_jax.simulation.runner import status_of
from gmem_jax.simulation.stage import Drive, Stage
from gmem_jax.sweeps.executors import cores

TIMED_LAWS = {entry.paper: entry.kind() for entry in laws.LAWS if entry.kind is not Frictionless}
T0 = 1.8e3  # t_c, default duration of the compression that is timed
ENCODE = Stage("encode", 0.0, 1.0, 1.0, "write", (Drive("xy", "xy"),))
BINS_PER_CALL = 8  # bins per timed call, so that checks and samples weigh as in a run, which does 32 at once
PRESSURE = 2e-3  # E, pressure of packs
AGREEMENT = 1e-8  # largest difference between backends over the pressure: round-off grows in a few hundred steps
LAMMPS_LISTS = ((0.1, 20), (0.2, 50), (0.2, 1000), (0.3, 1000))  # (skin in R, steps between checks) tried for LAMMPS
Say = Callable[[str, float], None]
"""Called with the name of the present measurement and the fraction done."""


def processor() -> str:
    """The processor's name, and how many cores this process may use."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor()}, {len(cores())} cores"


def encode(pack: Pack, law: FrictionLaw, replicas: int, backend: str, t0: float = T0) -> tuple[Simulation, State]:
    """Simulation and state at the start of an encode stage, for a rollout."""
    heights = jnp.linspace(-1.0, 1.0, max(1, replicas - 1))[:, None]
    signals = Bumps(heights, jnp.full_like(heights, 0.1), 0.2)
    experiment = Experiment(pack, signals, law, t0=t0, backend=backend_name(backend, law))
    simulation = experiment.simulation(sheared=replicas > 1)
    return simulation, replicate(experiment.begin(), replicas)


def rival(
    pack: Pack,
    backend: str,
    law: str,
    replicas: int,
    *,
    t0: float = T0,
    seconds: float = 0.5,
    bins: int = BINS_PER_CALL,
) -> Candidate:
    """A compiled rollout of some bins on a backend, to be timed for about `seconds` each time.

    Raises:
        RuntimeError: if the simulation breaks down.
    """
    simulation, state = encode(pack, TIMED_LAWS[law], replicas, backend, t0)
    call = (simulation, state, simulation.rows(ENCODE, 0), told_of(bins, bins))
    began = time.perf_counter()
    binary = forward.program.lower(*call, most=bins).compile()
    compile_s = time.perf_counter() - began
    final, sample = jax.block_until_ready(binary(*call))  # warm-up
    if Status(status_of(final)).fatal:
        raise RuntimeError(f"{backend}, {law}, {pack.name}: {explain(status_of(final))}")
    pressure = np.asarray(sample.pressure)
    p_xy = float(pressure[-1, 0, -1] - pressure[-1, 1, -1])

    def once() -> float:
        began, calls = time.perf_counter(), 0
        while calls < 1 or time.perf_counter() - began < seconds:
            jax.block_until_ready(binary(*call))
            calls += 1
        return 1e6 * (time.perf_counter() - began) / (calls * bins * simulation.steps * pack.grains * replicas)

    return Candidate(Row(backend, law, pack.grains, replicas, compile_s=compile_s, p_xy=p_xy), once)


def time_rollout(
    pack: Pack, backend: str, law: str, replicas: int, *, seconds: float = 0.5, bins: int = BINS_PER_CALL
) -> Row:
    """Time a rollout of some bins on a backend by itself."""
    return interleave([rival(pack, backend, law, replicas, seconds=seconds, bins=bins)])[0]


def lammps_rivals(pack: Pack, law: str, *, steps: int = 1000) -> list[Candidate]:
    """LAMMPS on the same pack with its walls at rest: one core, serial runs side by side, and MPI ranks.

    Its neighbour settings are tuned first. Law H has no dashpot there (see `lammps.pair_lines`).

    Raises:
        ValueError: for law M2, which LAMMPS does not have.
    """
    friction = TIMED_LAWS[law]
    if isinstance(friction, Mindlin):
        raise ValueError("LAMMPS has no counterpart of M2")
    if isinstance(friction, Hooke):
        friction = replace(friction, damping_time=0.0)
    still, none = np.zeros(3), np.zeros((pack.grains, 3))
    quaternion, box = np.asarray(pack.quaternion), (np.asarray(pack.lower), np.asarray(pack.upper))
    scene = lammps.Scene(pack.clump, np.asarray(pack.position), quaternion, none, none, *box, still, still)
    material = System(pack.clump, friction, pack.pairs).material

    def seconds(setting: tuple[float, int], count: int, ranks: int = 1) -> float:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            skin, every = setting
            script = lammps.scene_script(scene, friction, material, 0.3, folder, skin=skin, every=every)
            return lammps.loop_seconds(script, folder, steps=count, ranks=ranks)

    setting = min(LAMMPS_LISTS, key=lambda setting: seconds(setting, max(100, steps // 4)))
    unit, many = 1e6 / (steps * pack.grains), len(cores())
    note = f"skin {setting[0]} R, every {setting[1]}"
    alone = Row("lammps", law, pack.grains, 1, note=f"1 core, {note}")
    rivals = [Candidate(alone, lambda: unit * seconds(setting, steps))]
    if many > 1:

        def together() -> float:
            with ThreadPoolExecutor(many) as pool:
                return unit * max(pool.map(lambda _: seconds(setting, steps), range(many))) / many

        beside = replace(alone, replicas=many, note=f"{many} serial runs side by side")
        rivals.append(Candidate(beside, together))
        ranks = replace(alone, note=f"{many} ranks")
        rivals.append(Candidate(ranks, lambda: unit * seconds(setting, steps, many)))
    return rivals


def tile(pack: Pack, times: tuple[int, int, int]) -> Pack:
    """Copies of a pack of spheres or tetra grains side by side in one box, each the mirror image of its neighbours.

    A rigid frictionless wall is a mirror plane, so that the copies are at rest without walls between them. The larger
    pack has the same contacts, and shows the cost of size alone.
    """
    from scipy.spatial.transform import Rotation  # here: it takes half a second to load

    lengths = np.asarray(pack.upper - pack.lower)
    offsets = np.asarray(pack.clump.offsets)
    across = offsets[0] - offsets[-1] if len(offsets) > 1 else np.array([1.0, 0.0, 0.0])
    # A reflection that maps the grain onto itself, with which a mirror image becomes a rotation.
    swap = np.eye(3) - 2.0 * np.outer(across, across) / (across @ across)
    position = np.asarray(pack.position) - np.asarray(pack.lower)
    turned = np.asarray(matrix(pack.quaternion[..., None]))[..., 0]
    places, rotations = [], []
    for cell in np.ndindex(*times):
        odd = np.asarray(cell) % 2
        places.append(np.where(odd, lengths - position, position) + np.asarray(cell) * lengths)
        mirrored = (1.0 - 2.0 * odd)[:, None] * turned
        rotations.append(mirrored @ swap if odd.sum() % 2 else mirrored)
    quaternion = Rotation.from_matrix(np.concatenate(rotations)).as_quat(scalar_first=True)
    upper = lengths * np.asarray(times)
    box = still_box(jnp.zeros((3, 1)), jnp.asarray(upper)[:, None])
    at = np.concatenate(places)
    return replace(
        pack,
        position=jnp.asarray(at),
        quaternion=jnp.asarray(quaternion),
        lower=jnp.zeros(3),
        upper=jnp.asarray(upper),
        pairs=find_pairs(pack.clump, at, quaternion, box, float(pack.delta0)),
        name=f"{pack.name} x {math.prod(times)}",
    )


def _peak_memory(load: Callable[[str], Pack], name: str, backend: str, law: str, replicas: int) -> int:
    """Peak resident bytes of a fresh process that runs one bin."""
    jax.config.update("jax_enable_x64", True)
    simulation, state = encode(load(name), TIMED_LAWS[law], replicas, backend)
    jax.block_until_ready(forward(simulation, state, simulation.rows(ENCODE, 0), 1, most=BINS_PER_CALL))
    return _peak_bytes()


def _peak_bytes() -> int:
    """Peak resident bytes of this process."""
    status = Path("/proc/self/status")
    if status.is_file():  # on Linux ru_maxrss of a child begins with its parent's
        return next(
            1024 * int(line.split()[1])
            for line in status.read_text(encoding="utf-8").splitlines()
            if line.startswith("VmHWM")
        )
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def memory(load: Callable[[str], Pack], name: str, grains: int, backend: str, law: str) -> float:
    """Bytes per grain and replica: growth of peak memory from some replicas to twice as many, each in its own process.

    There are so many replicas that their memory, some 2 kB per grain, stands out from other memory of the process.
    """
    replicas = max(16, -(-65_536 // grains))
    peaks = []
    for count in (replicas, 2 * replicas):
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            peaks.append(pool.submit(_peak_memory, load, name, backend, law, count).result())
    return (peaks[1] - peaks[0]) / (grains * replicas)


def _gradient(load: Callable[[str], Pack], name: str, backend: str, values: int, t0: float) -> dict[str, float]:
    jax.config.update("jax_enable_x64", True)
    amplitudes = np.random.default_rng(0).normal(scale=0.2, size=(6, values))
    experiment = Experiment(load(name), bumps(amplitudes, 0.2), t0=t0, backend=backend_name(backend, Hooke()))

    def seconds(timed: Callable[[], Any]) -> float:
        taken = []
        for _ in range(2):  # the first compiles
            began = time.perf_counter()
            jax.block_until_ready(timed())
            taken.append(time.perf_counter() - began)
        return min(taken)

    forward = seconds(lambda: run(experiment).p_sig)
    before = _peak_bytes()
    reverse = seconds(lambda: value_and_grad(experiment, ["signals.amplitudes"]).slope)
    return {"forward_s": forward, "gradient_s": reverse, "forward_bytes": before, "gradient_bytes": _peak_bytes()}


def gradient_cost(
    load: Callable[[str], Pack], name: str, backend: str, *, values: int = 32, t0: float = T0
) -> dict[str, float]:
    """Seconds and peak memory of the gradient of F, through the whole experiment, by `values` numbers of six waveforms.

    Returns:
        "forward_s" of one run of the same replicas, "gradient_s", and the peak resident bytes of the process after
        each. They are measured in a fresh process.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(_gradient, load, name, backend, values, t0).result()


def disagreements(rows: Sequence[Row]) -> list[str]:
    """The cases in which native and plain JAX differ in their last p_xy by more than `AGREEMENT`, as lines of text."""
    cases: dict[tuple[str, int, int], dict[str, float]] = {}
    for row in rows:
        if row.engine != "lammps":
            cases.setdefault((row.law, row.grains, row.replicas), {})[row.engine] = row.p_xy
    return [
        f"{law}, N = {grains}, {replicas} replicas: p_xy {found['native']:.12e} native, {found['jax']:.12e} plain JAX"
        for (law, grains, replicas), found in cases.items()
        if len(found) == 2 and not abs(found["native"] - found["jax"]) < AGREEMENT * PRESSURE
    ]


def run_benchmark(
    load: Callable[[str], Pack],
    packs: Sequence[str],
    *,
    laws: Sequence[str] = ("H", "M1", "M2"),
    replicas: Sequence[int] = (1, 8, 32, 64),
    t0: float = T0,
    with_lammps: bool = True,
    with_jax: bool = True,
    scaling: bool = True,
    sizes: Sequence[tuple[int, int, int]] = ((1, 1, 1), (2, 2, 1), (2, 2, 3), (4, 4, 2), (5, 5, 4)),
    keep: Callable[[dict[str, Any]], None] = lambda result: None,
    say: Say = lambda what, fraction: None,
) -> dict[str, Any]:
    """Measure the whole table.

    Args:
        load: gives a pack by its name.
        packs: names of packs; the first is also tiled to larger packs, and used to compare M1 and M2 in plain JAX.
        laws: friction laws.
        replicas: numbers of replicas.
        t0: duration of the compression whose first bins are timed, in t_c; the cost against N is for `T0`.
        with_lammps: measure LAMMPS too, if it can run here.
        with_jax: measure plain JAX too, if the native backend is there.
        scaling: measure also the cost against N, memory and the cost of a gradient.
        sizes: copies of the first pack along each axis, for the cost against N.
        keep: called with the results so far, after every race.
        say: see `Say`.

    Returns:
        The machine, rows, cost against N, bytes per grain and replica, cost of a gradient; see `table.markdown`.

    Raises:
        RuntimeError: if backends disagree.
    """
    loaded = {name: load(name) for name in packs}
    first = loaded[packs[0]]
    fastest = "native" if available()[0] else "jax"
    backends = [fastest, "jax"] if with_jax and fastest != "jax" else [fastest]
    absent = lammps.missing_lammps() if with_lammps else "not asked for"
    result: dict[str, Any] = {
        **provenance(),
        "processor": processor(),
        "lammps": absent or lammps.version(),
        "instruction_set": available()[1],
        "repeats": REPEATS,
        "t0": t0,
        "rows": [],
        "growth": [],
        "bytes_per_grain_replica": {},
    }

    def add(where: str, rows: Sequence[Row]) -> None:
        result[where] += [asdict(row) for row in rows]
        keep(result)

    cases = [(pack, law) for pack in loaded.values() for law in laws]
    wrong: list[str] = []
    for place, (pack, law) in enumerate(cases):
        say(f"{law}, N = {pack.grains}", (0.7 if scaling else 1.0) * place / len(cases))
        counts = [count for count in replicas if fits(pack, law, count)]
        ours = [(backend, count) for backend in backends if _worth(pack, first, backend, law) for count in counts]
        if law == "M2":  # one at a time: its histories are large, and LAMMPS does not have it
            found = [row for backend, count in ours for row in interleave([rival(pack, backend, law, count, t0=t0)])]
        else:
            theirs = lammps_rivals(pack, law) if absent is None else []
            found = interleave([*(rival(pack, backend, law, count, t0=t0) for backend, count in ours), *theirs])
        wrong += disagreements(found)  # pack by pack, since p_xy differs between packs of one size
        add("rows", found)
    if wrong:
        raise RuntimeError("backends disagree: " + "; ".join(wrong))
    if not scaling:
        return result
    for place, times in enumerate(sizes):
        tiled = first if times == (1, 1, 1) else tile(first, times)
        say(f"cost against N: {tiled.grains}", 0.7 + 0.25 * place / len(sizes))
        found = interleave([rival(tiled, fastest, "H", count) for count in (1, 8)])
        add("growth", [replace(row, note="tiled") for row in found])
    say("memory", 0.95)
    largest = max(loaded, key=lambda name: loaded[name].grains)
    for law in laws:
        if law != "M2":
            result["bytes_per_grain_replica"][law] = memory(load, largest, loaded[largest].grains, fastest, law)
    say("gradient", 0.97)
    gradient = gradient_cost(load, packs[0], fastest)
    result["gradient"] = {"grains": first.grains, "t0": T0, "commit": provenance()["commit"], **gradient}
    keep(result)
    return result


def fits(pack: Pack, law: str, replicas: int) -> bool:
    """Whether the contact histories of a case fit into a quarter of the memory (Mindlin's are dense in XLA)."""
    friction = TIMED_LAWS[law]
    points = friction.points if isinstance(friction, Mindlin) else 1
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return 2 * 8 * points * pack.pairs.capacity * replicas * 3 < 0.25 * total


def _worth(pack: Pack, first: Pack, backend: str, law: str) -> bool:
    """Whether a case is timed: plain JAX only under law H or on the first pack, since other cases take too long."""
    return backend != "jax" or law == "H" or pack is first
