"""The native library is what its sources say, and refuses what would lead it astray."""

import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.native import build, calls, cuda, library
from gmem_jax.native.calls import Arrays, Call, Fixed, StepOutput
from gmem_jax.native.march import arrays_of, call_of, fixed_of
from gmem_jax.physics.state import replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System

BUILT, REASON = native.available()
needs_library = pytest.mark.skipif(not BUILT, reason=REASON)
PACK = gm.load_pack(TETRA_27)

Arguments = dict[str, Any]


@functools.cache
def arguments(law: Any) -> Arguments:
    """What the library takes for two steps of two replicas, by name."""
    system = System(PACK.clump, law, PACK.pairs)
    state = replicate(start(system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box), 2)
    boxes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2, 3, 2)), PACK.box)
    numbers = (jnp.asarray(0.3), jnp.asarray(0.0))
    fixed = fixed_of(system)
    arrays = arrays_of(system, state.grains, (state.history, None), boxes, numbers)
    return {"call": call_of(system), **fixed._asdict(), **arrays._asdict()}


def parts(given: Arguments) -> tuple[Call, Fixed, Arrays]:
    fixed, arrays = ({name: given[name] for name in kind._fields} for kind in (Fixed, Arrays))
    return given["call"], Fixed(**fixed), Arrays(**arrays)


def run(given: Arguments) -> Any:
    """Past JAX's own look at the shapes: the library must not depend on it."""
    call, fixed, arrays = parts(given)
    return jax.block_until_ready(calls.call_library("gmem_advance", calls.of_results, call, False, (fixed, arrays)))


def changed(name: str, change: Callable[[Any], Any]) -> Callable[[Arguments], Arguments]:
    return lambda given: {**given, name: change(given[name])}


def called(**numbers: int) -> Callable[[Arguments], Arguments]:
    return changed("call", lambda call: call._replace(**numbers))


HOSTILE = {
    "a negative sphere": (changed("first", lambda a: a.at[3].set(-1)), "candidate 3 joins spheres -1 and"),
    "a sphere too many": (changed("second", lambda a: a.at[3].set(10**6)), "1000000; wanted are two"),
    "a grain with itself": (changed("second", lambda a: a.at[0].set(1)), "candidate 0 joins"),
    "the wrong order": (lambda g: {**g, "first": g["second"], "second": g["first"]}, "in order"),
    "fewer second spheres": (changed("second", lambda a: a[:-1]), "second spheres .* should be .P. with P"),
    "other numbers": (changed("first", lambda a: a.astype(float)), "first spheres .* wrong type"),
    "a missing grain": (changed("fields", lambda a: [a[0][:-1], *a[1:]]), "quaternions .* with N = 26"),
    "a flat quaternion": (changed("fields", lambda a: [a[0], a[1][:, :3], *a[2:]]), "quaternions .* with 4 = 4"),
    "an axis less": (changed("walls", lambda a: a[:, 0]), "walls .* should be .TWB."),
    "fewer walls": (changed("walls", lambda a: a[:, :6]), "walls .* with W = 12"),
    "fewer parameters": (changed("parameters", lambda a: a[:-1]), "parameters .* with R = "),
    "walls of one replica": (changed("walls", lambda a: a[..., :1]), "walls .* with B = 2"),
    "half a centre": (changed("reference", lambda a: a[:, :2]), "reference centres .* with 3 = 3"),
    "a sphere less": (changed("reference", lambda a: a[:-1]), "as many spheres"),
    "no sphere in a grain": (lambda g: {**g, "offsets": g["offsets"][:0], "radii": g["radii"][:0]}, "no grain"),
    "spheres without radii": (called(unequal=1), "radii .* with U = 1"),
    "a short history": (changed("history", lambda a: [a[0][:-1], *a[1:]]), "should be .P.*[23]B. with P"),
    "no history": (lambda g: {**called(leaves=0)(g), "history": []}, "not that of the friction law"),
    "an unknown law": (called(law=4), "no friction law has number 4"),
    "an unknown variant": (called(variant=-1), "no variant of the Mindlin law has number -1"),
    "the history of another law": (called(law=2), "not that of the friction law|forces .* should be"),
}


@needs_library
@pytest.mark.parametrize("law", [gm.Hooke(), gm.Mindlin(points=4)], ids=lambda law: type(law).__name__)
@pytest.mark.parametrize("name", HOSTILE)
def test_arrays_that_do_not_fit_are_refused_in_a_sentence(law: Any, name: str) -> None:
    spoil, sentence = HOSTILE[name]
    given = arguments(law)
    with pytest.raises(jax.errors.JaxRuntimeError, match=f"gmem_jax native: .*({sentence})"):
        run(spoil(given))


@needs_library
@pytest.mark.parametrize("law", [gm.Hooke(), gm.Mindlin(points=4)], ids=lambda law: type(law).__name__)
def test_arrays_that_fit_are_not_refused(law: Any) -> None:
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(run(arguments(law))))


@needs_library
@pytest.mark.parametrize("points", [1, 5])
def test_points_that_are_not_those_of_the_layers_are_refused(points: int) -> None:
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"two points or more|with Q = 5"):
        run(called(points=points)(arguments(gm.Mindlin(points=4))))


@needs_library
def test_want_of_memory_is_an_error_and_leaves_the_library_working() -> None:
    steps, points = 600_000, 1_500_000  # whose derivatives would take more than any address space has
    given = arguments(gm.Mindlin(points=4))
    alone = {
        "first": given["first"][:1],
        "second": given["second"][:1],
        "valid": given["valid"][:1],
        "images": given["images"][:1],
        "fields": [leaf[..., :1] for leaf in given["fields"]],
        "parameters": given["parameters"][:, :1],
        "walls": jnp.zeros((steps, 12, 1)),
        "offsets": given["offsets"][..., :1],
        "history": [jnp.zeros((1, points, 2, 1)), jnp.zeros((1, 3, 1)), jnp.zeros((1, 1, 1))],
    }
    call, fixed, arrays = parts({**called(points=points)(given), **alone})
    bars = StepOutput(arrays.fields, jnp.zeros((3, 1)), arrays.history)
    with pytest.raises(jax.errors.JaxRuntimeError, match="gmem_jax native: out of memory"):
        jax.block_until_ready(calls.call_library("gmem_adjoint", calls.of_arrays, call, False, (fixed, arrays, bars)))
    run(given)


@needs_library
def test_a_library_older_than_its_sources_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    shutil.copytree(build.SOURCES, tmp_path / "src")
    monkeypatch.setattr(build, "SOURCES", tmp_path / "src")
    monkeypatch.setattr(cuda, "register", lambda *_: None)  # the process keeps the sources that it has
    assert library.load_library.__wrapped__()[1] == ""
    with (tmp_path / "src" / "physics" / "laws.h").open("a") as file:
        file.write("// new\n")
    assert (
        "older than its sources; rebuild it: python -m gmem_jax.native.build" in library.load_library.__wrapped__()[1]
    )
    shutil.rmtree(tmp_path / "src")  # a library alone is what it is
    assert library.load_library.__wrapped__()[1] == ""
