"""The GPU's half of the native backend without a GPU: its kernels run on the CPU, thread after thread, and compiled by
NVRTC; its calls, in programs lowered for CUDA.
"""

import ctypes
import functools
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from emulation import linked
from jax import export
from scenes import EVERY_LAW, PERIODIC_XY_27, SPREAD_27, TETRA_27, assert_close, scene

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.native import build, calls, cuda, library, primitives
from gmem_jax.native.calls import Arrays, Call, Fixed, StepOutput
from gmem_jax.native.march import PlainDefinition, arrays_of, call_of, fixed_of
from gmem_jax.physics.boundary import WALLS, PeriodicAxes
from gmem_jax.physics.grain import sphere
from gmem_jax.physics.state import Box, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System
from gmem_jax.simulation.loop import rollout_chunk
from gmem_jax.simulation.stage import Drive, Stage

BUILT, REASON = native.available()
pytestmark = [
    pytest.mark.skipif(not BUILT, reason=REASON),  # without a C++ compiler there is nothing to compile it with
]
needs_nvrtc = pytest.mark.skipif(bool(cuda.missing()), reason=cuda.missing())

PACK = gm.load_pack("tetra-325-a")
REPLICAS = 3
QUICKLY = {"xla_backend_optimization_level": 0}  # for programs that run once
Scene = tuple[Call, Fixed, Arrays, Callable[..., Any]]


@pytest.fixture(scope="module", autouse=True)
def emulated(tmp_path_factory: pytest.TempPathFactory) -> None:
    """The kernels as calls of the CPU: gmem_emulated_advance, gmem_emulated_tangent and gmem_emulated_adjoint."""
    library = tmp_path_factory.mktemp("emulated") / "libemulated.so"
    linked(library)
    functions = ctypes.CDLL(str(library))
    for target in ("gmem_emulated_advance", "gmem_emulated_tangent", "gmem_emulated_adjoint"):
        jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(functions, target)), platform="cpu")


def walls(begun: int, lower: Any, upper: Any, speed: float, periodic: PeriodicAxes) -> Box:
    """The next 10 walls of a sheared squeeze, each replica at its own rate."""
    inwards = speed * jnp.asarray([1.0, 0.5, 0.0])[:, None] * jnp.linspace(0.5, 1.0, REPLICAS)
    time = 0.3 * (begun + 1.0 + jnp.arange(10))[:, None, None]
    every = jnp.ones((10, 3, REPLICAS))
    lower, upper = lower[:, None] + time * inwards, upper[:, None] - time * inwards
    return Box(lower, upper, every * inwards, -every * inwards, periodic)


def thrown(
    system: System,
    state: Any,
    lower: Any,
    upper: Any,
    speed: float = 2e-3,
    ago: int = 40,
    periodic: PeriodicAxes = WALLS,
) -> Scene:
    """Grains that fly, spin and touch, some steps after they were thrown; replicas differ in all their numbers."""
    draws = np.random.default_rng(0).normal(size=(2, *state.grains.position.shape[:2], REPLICAS))
    state = replicate(state, REPLICAS)
    grains = replace(state.grains, velocity=jnp.asarray(5e-3 * draws[0]), spin=jnp.asarray(5e-3 * draws[1]))
    spread = jnp.linspace(0.8, 1.0, REPLICAS)
    if not isinstance(system.friction, gm.Frictionless):
        system = replace(system, friction=replace(system.friction, mu=0.3 * spread))
    system = replace(system, clump=replace(system.clump, mass=system.clump.mass * spread))
    numbers = 0.3 * spread, 0.01 * (1.0 - spread)
    call, fixed, cell = call_of(system, periodic), fixed_of(system), state.cell
    histories = state.history, state.wall_history
    fields, history = jax.tree.leaves(grains), jax.tree.leaves(histories)
    for begun in range(0, ago + 1, 10):
        boxes = walls(begun, lower, upper, speed, periodic)
        arrays = arrays_of(system, grains, histories, boxes, numbers, cell)
        arrays = arrays._replace(fields=fields, history=history)
        if begun < ago:
            fields, _, history = emulate(call, fixed, arrays)
            cell = jax.tree.map(lambda leaf: leaf[-1], boxes) if any(periodic) else None
    return call, fixed, arrays, PlainDefinition.of(system, histories, periodic=periodic)


@functools.cache
def at_rest() -> Any:
    """The pack's state before it was thrown; blank histories of any law give the same."""
    system = System(PACK.clump, EVERY_LAW["H"], PACK.pairs)
    return jax.jit(start, compiler_options=QUICKLY)(
        system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box
    )


@functools.cache
def packed(law: str, isotropic: bool = True) -> Scene:
    """A pack of 325 grains, whose list is padded."""
    moments = PACK.clump.inertia * (1.0 if isotropic else jnp.asarray([0.8, 1.0, 1.3]))
    clump = replace(PACK.clump, isotropic=isotropic, inertia=moments)
    system = System(clump, EVERY_LAW[law], PACK.pairs)
    history = system.friction.init(PACK.pairs.capacity, 1, np.dtype(float))
    return thrown(system, replace(at_rest(), history=history), PACK.lower, PACK.upper)


def spheres() -> Scene:
    """A lattice of spheres that overlap, from which the walls are just parting."""
    lattice = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3) * 1.95 + 0.95
    edges = jnp.zeros(3), jnp.full(3, 7.75)
    still = jnp.zeros((3, 1))
    box = Box(edges[0][:, None], edges[1][:, None], still, still)
    system, state, _ = scene(sphere(), lattice, friction=EVERY_LAW["H"], box=box)
    return thrown(system, state, *edges, speed=-1.1e-2, ago=10)


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICKLY)
def emulate(call: Call, fixed: Fixed, arrays: Arrays) -> StepOutput:
    """What a GPU would give."""
    shapes = calls.of_results((fixed, arrays))
    found = cuda.call_kernels("gmem_emulated_advance", call, True, (fixed, arrays), shapes)
    return calls.results_of(arrays, found[: len(shapes)])


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICKLY)
def emulate_tangent(call: Call, fixed: Fixed, arrays: Arrays, along: Arrays) -> StepOutput:
    shapes = calls.of_results((fixed, arrays))
    found = cuda.call_kernels("gmem_emulated_tangent", call, False, (fixed, arrays, along), shapes)
    return calls.results_of(arrays, found[: len(shapes)])


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICKLY)
def emulate_adjoint(call: Call, fixed: Fixed, arrays: Arrays, bars: StepOutput) -> Arrays:
    shapes = calls.of_arrays((fixed, arrays))
    found = cuda.call_kernels("gmem_emulated_adjoint", call, False, (fixed, arrays, bars), shapes)
    return jax.tree.unflatten(jax.tree.structure(arrays), found[: len(shapes)])


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICKLY)
def adjoint_of_the_cpu(call: Call, fixed: Fixed, arrays: Arrays, bars: StepOutput) -> Arrays:
    found = calls.call_library("gmem_adjoint", calls.of_arrays, call, False, (fixed, arrays, bars))
    return jax.tree.unflatten(jax.tree.structure(arrays), list(found))


def few(law: str, file: Path, wall_mu: float | None = None) -> Scene:
    """27 grains of a file; where they differ in size, their spheres do so, too."""
    pack = gm.load_pack(file)
    clump = pack.clump if pack.clump.equal else replace(pack.clump, radii=jnp.asarray([1.0, 0.98, 0.96, 1.0]))
    system = System(clump, EVERY_LAW[law], pack.pairs, wall_mu=wall_mu)
    state = start(system, pack.position[..., None], pack.quaternion[..., None], pack.box)
    return thrown(system, state, pack.lower, pack.upper, periodic=pack.box.periodic)


SCENES = {**{law: functools.partial(packed, law) for law in EVERY_LAW}, "gyroscopic": lambda: packed("H", False)}
SCENES |= {"spheres": spheres}
# Grains between walls along z alone, whose contacts go through the faces of the box; and grains of many sizes.
SCENES |= {f"periodic-{law}": functools.partial(few, law, PERIODIC_XY_27) for law in ("H", "M1")}
SCENES |= {f"spread-{law}": functools.partial(few, law, SPREAD_27) for law in ("H", "M1", "M2-averaged")}
# Between walls with friction.
SCENES |= {f"rough-{law}": functools.partial(few, law, TETRA_27, 0.2) for law in ("M1", "M2-averaged")}
SCENES |= {"rough-periodic": functools.partial(few, "H", PERIODIC_XY_27, 0.2)}
SLOW_SCENES = ("frictionless", "M1", "M2-averaged")  # between others that say as much


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW_SCENES)) for name in SCENES]
)
def test_the_kernels_give_the_values_and_tangents_of_the_definition(name: str) -> None:
    call, fixed, arrays, definition = SCENES[name]()
    draws = np.random.default_rng(1)
    along = jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), arrays)
    # The definition has no derivatives by the material, nor by what is zero and stays so (histories of contacts apart).
    blank = jax.tree.map(lambda slope, leaf: jnp.where(leaf != 0.0, slope, 0.0), along.history, arrays.history)
    along = along._replace(parameters=along.parameters.at[6:9].set(0.0), history=blank)
    both = functools.partial(jax.jvp, functools.partial(definition, fixed))
    value, slope = jax.jit(both, compiler_options=QUICKLY)((arrays,), (along,))
    assert not arrays.history or np.any(np.asarray(arrays.history[0]) != 0.0)
    # Forces are summed in another order: 1e-16 of the largest, which 10 steps of contacts magnify. (Seen: 4e-11 in two
    # numbers of M2-paper, whose sliding is divided by the weights of a contact that begins to have any; 1e-13 else.)
    assert_close(emulate(call, fixed, arrays), value, 1e-10)
    # ... and in the derivative once more where the normal part of a carried force nearly cancels: see
    # test_native_derivatives.py.
    assert_close(emulate_tangent(call, fixed, arrays, along), slope, 1e-9)


def weights_of(fixed: Fixed, arrays: Arrays) -> StepOutput:
    """Random derivatives by all results."""
    draws = np.random.default_rng(2)
    shapes = calls.results_of(arrays, calls.of_results((fixed, arrays)))
    return jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), shapes)


def assert_alike(found: Arrays, expected: Arrays) -> None:
    """Sums are taken in another order; parameters differ in their units."""
    assert_close(found._replace(parameters=()), expected._replace(parameters=()), 1e-11)
    for one, other in zip(found.parameters, expected.parameters, strict=True):
        assert_close(one, other, 1e-11)


REVERSED = {name: SCENES[name] for name in ("frictionless", "H", "M1", "gyroscopic", "spheres")}


@pytest.mark.parametrize("name", REVERSED)
def test_the_adjoint_of_the_kernels_is_that_of_the_cpu_and_the_transpose_of_their_tangent(name: str) -> None:
    call, fixed, arrays, _ = REVERSED[name]()
    weights = weights_of(fixed, arrays)
    bars = emulate_adjoint(call, fixed, arrays, weights)
    assert_alike(bars, adjoint_of_the_cpu(call, fixed, arrays, weights))  # seen: 6e-13
    assert all(np.any(np.asarray(row) != 0.0) for row in (bars.walls, bars.offsets, bars.parameters[6], *bars.history))
    draws = np.random.default_rng(3)
    along = jax.tree.map(lambda leaf: jnp.asarray(draws.normal(size=leaf.shape)), arrays)
    along = along._replace(
        offsets=jnp.broadcast_to(along.offsets[..., :1], along.offsets.shape)
    )  # alike in all replicas
    ahead, back = (
        np.concatenate([np.ravel(one * other) for one, other in zip(*map(jax.tree.leaves, pair), strict=True)])
        for pair in ((weights, emulate_tangent(call, fixed, arrays, along)), (bars, along))
    )
    assert abs(ahead.sum() - back.sum()) <= 1e-11 * np.linalg.norm(ahead)


def test_contacts_and_walls_come_and_go_while_the_adjoint_is_taken() -> None:
    """What the cases above are about, in the scene of law M1."""
    call, fixed, arrays, _ = packed("M1")
    ends = emulate(call, fixed, arrays)
    before, after = (np.asarray(one.history[1]) > 0.0 for one in (arrays, ends))
    assert np.sum(before & after) > 500
    assert np.sum(before & ~after) > 10
    assert np.sum(after & ~before) > 10
    assert np.all(np.asarray(ends.pressure) > 0.0)
    slides = np.linalg.norm(ends.history[0], axis=1) > 0.0
    assert np.sum(slides) > 500


def test_the_adjoint_of_a_replica_has_the_same_bits_alone_in_a_batch_and_in_a_sweep() -> None:
    call, fixed, arrays, _ = packed("M1")
    weights = weights_of(fixed, arrays)
    everyone = emulate_adjoint(call, fixed, arrays, weights)
    for lane in range(REPLICAS):
        one = jax.tree.map(lambda leaf, lane=lane: leaf[..., lane : lane + 1], (arrays, weights))
        for few, many in zip(*map(jax.tree.leaves, (emulate_adjoint(call, fixed, *one), everyone)), strict=True):
            np.testing.assert_array_equal(few[..., 0], many[..., lane])
    # Two leading axes: what points share is given once, the rest for each.
    several = jax.tree.map(lambda leaf: leaf[None, None], (fixed, arrays, weights))
    numbers = jnp.stack([arrays.parameters.at[9].multiply(factor) for factor in (1.0, 0.5)])
    bars = jnp.stack([weights.pressure, -weights.pressure])
    swept = emulate_adjoint(
        call,
        several[0],
        several[1]._replace(parameters=numbers[None]),
        several[2]._replace(pressure=bars[None]),
    )
    for point in range(2):
        alone = emulate_adjoint(
            call, fixed, arrays._replace(parameters=numbers[point]), weights._replace(pressure=bars[point])
        )
        for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(swept), strict=True):
            np.testing.assert_array_equal(one, other[0, point])


def test_the_adjoint_of_no_step_is_what_was_given() -> None:
    call, fixed, arrays, _ = packed("H")
    weights = weights_of(fixed, arrays)
    arrays = arrays._replace(walls=arrays.walls[:0])
    found = emulate_adjoint(call, fixed, arrays, weights)
    for one, other in zip(
        *map(jax.tree.leaves, (found, adjoint_of_the_cpu(call, fixed, arrays, weights))), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found.fields[0], weights.fields[0])


def test_a_replica_has_the_same_bits_alone_in_a_batch_and_in_a_sweep() -> None:
    call, fixed, arrays, _ = packed("H")
    everyone = emulate(call, fixed, arrays)
    for lane in range(REPLICAS):
        alone = emulate(call, fixed, jax.tree.map(lambda leaf, lane=lane: leaf[..., lane : lane + 1], arrays))
        for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(everyone), strict=True):
            np.testing.assert_array_equal(one[..., 0], other[..., lane])
    # Two leading axes: what points share is given once, the rest for each.
    mus = arrays.parameters[9] * jnp.asarray([1.0, 0.5, 2.0])[:, None]
    several = jax.tree.map(lambda leaf: leaf[None, None], (fixed, arrays))
    numbers = jnp.stack([arrays.parameters.at[9].set(mu) for mu in mus])
    swept = emulate(call, several[0], several[1]._replace(parameters=numbers[None]))
    for point in range(len(mus)):
        alone = emulate(call, fixed, arrays._replace(parameters=numbers[point]))
        for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(swept), strict=True):
            np.testing.assert_array_equal(one, other[0, point])


def test_no_step_gives_back_what_there_was() -> None:
    call, fixed, arrays, _ = packed("H")
    found = emulate(call, fixed, arrays._replace(walls=arrays.walls[:0]))
    for one, other in zip([*found.fields, *found.history], [*arrays.fields, *arrays.history], strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.any(found.pressure)


BROKEN = {
    "a row too far": lambda fixed: fixed._replace(incidence=fixed.incidence.at[5, 0].set(10**8)),
    "a negative row": lambda fixed: fixed._replace(incidence=fixed.incidence.at[5, 0].set(-7)),
    "a sphere too many": lambda fixed: fixed._replace(second=fixed.second.at[3].set(10**6)),
    "a contact of others": lambda fixed: fixed._replace(
        incidence=fixed.incidence.at[5, 0].set(fixed.incidence[900, 0])
    ),
    "a contact that one side has not": lambda fixed: fixed._replace(
        incidence=fixed.incidence.at[5, 0].set(2 * len(fixed.first))
    ),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_list_gives_no_numbers(how: str) -> None:
    call, fixed, arrays, _ = packed("H")
    found = emulate(call, BROKEN[how](fixed), arrays)
    assert np.all(np.isnan(np.asarray(found.fields[0])))
    bars = emulate_adjoint(call, BROKEN[how](fixed), arrays, weights_of(fixed, arrays))
    assert all(np.all(np.isnan(leaf)) for leaf in (*bars.fields, bars.parameters, bars.walls, bars.offsets))


def test_arrays_that_do_not_fit_are_refused() -> None:
    call, fixed, arrays, _ = packed("H")
    with pytest.raises(Exception, match=r"walls .* with W = 12"):
        jax.block_until_ready(emulate(call, fixed, arrays._replace(walls=arrays.walls[:, :6])))
    with pytest.raises(Exception, match="no friction law has number 9"):
        jax.block_until_ready(emulate(call._replace(law=9), fixed, arrays))
    with pytest.raises(Exception, match="reverse mode on GPUs is for equal spheres between smooth walls"):
        jax.block_until_ready(emulate_adjoint(call._replace(rubs=1), fixed, arrays, weights_of(fixed, arrays)))


@needs_nvrtc
@pytest.mark.parametrize("law", EVERY_LAW)
@pytest.mark.parametrize("architecture", ["sm_80", "sm_90", "sm_100", "sm_120"])
def test_plain_numbers_fit_into_the_registers(architecture: str, law: str) -> None:
    kernels = native.needs(EVERY_LAW[law], architecture)
    assert set(kernels) == {"enter", "remember", "touch", "move", "move_alone", "collect", "leave"}
    for name, kernel in kernels.items():
        assert kernel.registers < 255
        # Those of every step are held to fewer than they would take, so that more threads run (src/cuda/kernel.cu).
        # Seen: 60 to 176 bytes.
        assert kernel.spilt <= (200 if name in ("touch", "move_alone") else 0)


@needs_nvrtc
@pytest.mark.parametrize("law", ["H", "M2-averaged"])
def test_numbers_with_derivatives_fit_too(law: str) -> None:
    assert all(kernel.spilt == 0 for kernel in native.needs(EVERY_LAW[law], "sm_90", "tangent").values())


@needs_nvrtc
@pytest.mark.parametrize("law", ["frictionless", "H", "M1"])
@pytest.mark.parametrize("architecture", [pytest.param("sm_80", marks=pytest.mark.slow), "sm_90"])
def test_the_kernels_of_reverse_mode_compile(architecture: str, law: str) -> None:
    kernels = native.needs(EVERY_LAW[law], architecture, "adjoint")
    steps = {"enter", "remember", "touch", "move", "move_alone"}
    back = {"take", "touch_back", "gather_back", "move_back", "collect_walls", "sum_up", "leave_back"}
    assert set(kernels) == steps | back
    assert kernels["touch_back"].spilt == kernels["gather_back"].spilt == 0
    assert kernels["move_back"].spilt <= 1000  # it goes through two halves of a step; seen: 742


ALONE = """
import ctypes, sys
path, asked, nvrtc, sources, cache, architecture, *driver = sys.argv[1:]
kept = [ctypes.CDLL(one) for one in driver]
library = ctypes.CDLL(path)
library.gmem_cuda_paths(nvrtc.encode(), sources.encode(), cache.encode())
said = ctypes.create_string_buffer(1 << 16)
law = (1, 0, 0) if asked == "compile" else ()
failed = getattr(library, "gmem_cuda_" + asked)(architecture.encode(), *law, said, len(said))
print(failed, said.value.decode())
"""


def alone(asked: str, nvrtc: str, cache: Path, architecture: str, *driver: Path) -> str:
    """What the library says in a process of its own, beside a driver or none."""
    paths = [str(library.path()), asked, nvrtc, str(build.SOURCES), str(cache), architecture, *map(str, driver)]
    return subprocess.run([sys.executable, "-c", ALONE, *paths], capture_output=True, text=True, check=True).stdout


@needs_nvrtc
def test_compiled_kernels_are_kept_as_whole_files(tmp_path: Path) -> None:
    folder = tmp_path / "not" / "there"
    assert alone("compile", cuda._nvrtc(), folder, "sm_90").startswith("0 ")
    (kept,) = folder.iterdir()
    assert re.fullmatch(rf"{build.source_hash()}-sm_90-nvrtc\d+\.\d+-law10\.cubin", kept.name)
    assert kept.read_bytes().startswith(b"\x7fELF")
    assert kept.stat().st_mode & 0o777 == 0o644


@needs_nvrtc
@pytest.mark.parametrize(
    ("architecture", "said"), [("sm_1", "knows no GPU as old as sm_1; "), ("sm_999", "does not know sm_999\n")]
)
def test_an_unknown_architecture_is_one_line(architecture: str, said: str, tmp_path: Path) -> None:
    found = alone("compile", cuda._nvrtc(), tmp_path, architecture)
    assert re.match(rf"1 NVRTC \d+\.\d+ {said}", found)
    assert found.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_without_nvrtc_what_would_help_is_one_line(tmp_path: Path) -> None:
    said = alone("compile", "no-such-library.so:nor-this.so", tmp_path, "sm_90")
    assert said == f"1 no-such-library.so could not be loaded; {HELP}\n"


HELP = "pip install 'gmem-jax[cuda13]' (or [cuda12] for drivers of CUDA 12)"
NVRTC_CALLS = ("CreateProgram", "CompileProgram", "GetProgramLogSize", "GetProgramLog", "DestroyProgram")
NVRTC_CALLS += ("GetCUBINSize", "GetCUBIN", "GetPTXSize", "GetPTX")


def stub(path: Path, *functions: str) -> Path:
    """A library of a few functions in C, which other libraries find by its name once it is loaded."""
    path.with_suffix(".cc").write_text("\n".join(f'extern "C" int {function}' for function in functions))
    flags = ["-shared", "-fPIC", f"-Wl,-soname,{path.name}"]
    subprocess.run([*build.compiler(), *flags, str(path.with_suffix(".cc")), "-o", str(path)], check=True)
    return path


def nvrtc_stub(folder: Path, version: int, *architectures: int) -> Path:
    """NVRTC of CUDA `version`.3 that knows these architectures and compiles nothing."""
    known = "".join(f"a[{n}] = {number}; " for n, number in enumerate(architectures))
    return stub(
        folder / f"nvrtc-{version}.so",
        f"nvrtcVersion(int* a, int* b) {{ *a = {version}; *b = 3; return 0; }}",
        f"nvrtcGetNumSupportedArchs(int* n) {{ *n = {len(architectures)}; return 0; }}",
        f"nvrtcGetSupportedArchs(int* a) {{ {known}return 0; }}",
        *(f"nvrtc{name}() {{ return 1; }}" for name in NVRTC_CALLS),
    )


@pytest.fixture(scope="module")
def stubs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("stubs")
    found = {"13": nvrtc_stub(folder, 13, 75, 90), "12": nvrtc_stub(folder, 12, 50, 80)}
    for version in (12080, 13000, 13030):
        (folder / str(version)).mkdir()
        driver = folder / str(version) / "libcuda.so.1"
        found[str(version)] = stub(driver, f"cuDriverGetVersion(int* v) {{ *v = {version}; return 0; }}")
    return found


TOO_NEW = f"1 NVRTC 13.3 is too new for the GPU's driver, which is of CUDA 12.8; {HELP}"
PTX_TOO_NEW = "does not know sm_120, and the GPU's driver, of CUDA 13.0, is too old for its PTX"


@pytest.mark.parametrize(
    ("names", "driver", "architecture", "said"),
    [
        ("13 12", "13000", "sm_90", "0 "),
        ("13 12", "13000", "sm_70", f"1 NVRTC 13.3 knows no GPU as old as sm_70; {HELP}"),
        ("13 12", "12080", "sm_70", "0 "),  # by the older one
        ("13", "12080", "sm_90", TOO_NEW),
        ("13", "12080", "", TOO_NEW),
        ("13", "", "", "0 "),
        ("13", "13030", "sm_120", "0 "),  # by the driver's own compiler
        ("13", "13000", "sm_120", f"1 NVRTC 13.3 {PTX_TOO_NEW}; {HELP}"),
    ],
)
def test_nvrtc_is_chosen_by_what_the_driver_loads(
    names: str, driver: str, architecture: str, said: str, stubs: dict[str, Path], tmp_path: Path
) -> None:
    nvrtc = ":".join(str(stubs[name]) for name in names.split())
    assert alone("missing", nvrtc, tmp_path, architecture, *([stubs[driver]] if driver else [])) == f"{said}\n"


@needs_nvrtc
def test_a_gpu_that_is_too_old_is_known_before_a_program_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    for capability, said in (("9.0", ""), ("5.0", "knows no GPU as old as sm_50")):
        gpus = [SimpleNamespace(compute_capability="9.0"), SimpleNamespace(compute_capability=capability)]
        monkeypatch.setattr(jax, "local_devices", lambda backend, gpus=gpus: gpus)
        found = cuda.missing.__wrapped__()
        assert said in found
        assert bool(said) == bool(found)


def test_a_bin_of_an_experiment_on_a_gpu_is_one_call_and_waits_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "missing", lambda: "")
    signals = gm.Bumps(jnp.asarray([[1.0], [-1.0]]), jnp.full((2, 1), 0.5), 0.8)
    experiment = gm.Experiment(PACK, signals, EVERY_LAW["H"], t0=300.0)
    simulation, state = experiment.simulation(sheared=True), replicate(experiment.begin(), REPLICAS)
    program = jax.jit(functools.partial(rollout_chunk, most=4))
    allowed = [export.DisabledSafetyCheck.custom_call(target) for target in cuda.CUDA_TARGETS]
    row = Stage("encode", 0.0, 1.0, 1.0, "write", (Drive("xy", "xy"),)).rows(0)
    text = export.export(program, platforms=["cuda"], disabled_checks=allowed)(simulation, state, row, 4).mlir_module()
    assert text.count("custom_call @gmem_advance") == 1
    assert "stablehlo.case" not in text  # the host would wait for its condition


@pytest.mark.parametrize(
    ("name", "serves"),
    [("H", True), ("M1", True), ("M2-exact", False), ("periodic-H", False), ("spread-H", False), ("rough-M1", False)],
)
def test_reverse_mode_is_the_library_s_where_it_has_kernels_for_it(
    name: str, serves: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cuda, "missing", lambda: "")
    call, fixed, arrays, definition = SCENES[name]()

    def back(arrays: Arrays, weights: StepOutput) -> Arrays:
        return jax.vjp(lambda arrays: primitives.advance(call, definition, fixed, arrays), arrays)[1](weights)[0]

    allowed = [export.DisabledSafetyCheck.custom_call(target) for target in cuda.CUDA_TARGETS]
    lowered = export.export(jax.jit(back), platforms=["cuda"], disabled_checks=allowed)
    text = lowered(arrays, weights_of(fixed, arrays)).mlir_module()
    assert text.count("custom_call @gmem_adjoint") == int(serves)
