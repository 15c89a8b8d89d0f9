"""What a user puts in the wrong place is answered in one line that says what is right; types say it before it runs."""

import dataclasses
import functools
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TESTS, TETRA_27

import gmem_jax as gm

PACK = gm.load_pack(TETRA_27)
SIX: Any = gm.six_signals()
EXPERIMENT = gm.Experiment(PACK, gm.words(1), t0=60.0)
MIXED = gm.Experiment(PACK, gm.words(1), t0=60.0)
object.__setattr__(MIXED, "precision", "mixed")  # which asks for the native library


def test_a_wrong_part_of_an_experiment_is_refused_with_what_makes_a_right_one() -> None:
    wrong: list[tuple[Callable[[], Any], str]] = [
        (
            lambda: gm.Experiment("tetra-325-a", SIX),
            "pack must be a pack, got 'tetra-325-a'; gm.load_pack('tetra-325-a') reads one",
        ),
        (lambda: gm.Experiment(None, SIX), "pack must be a pack, got None; see gm.load_pack and gm.prepare"),
        (
            lambda: gm.Experiment(PACK, np.ones((2, 8))),
            "signals must be waveforms, got an array of shape (2, 8); gm.waveform makes waveforms of samples",
        ),
        (
            lambda: gm.Experiment(PACK, [0.1, 0.2]),
            "signals must be waveforms, got a list; gm.waveform makes waveforms of samples",
        ),
        (
            lambda: gm.Experiment(PACK, gm.six_signals),
            "signals must be waveforms, got a function; as gm.six_signals(), gm.words(3)",
        ),
        (
            lambda: gm.Experiment(PACK, SIX, gm.Mindlin),
            "friction must be a friction law, got the class Mindlin; make one with its parameters, as Mindlin(mu=1.0)",
        ),
        (lambda: gm.Experiment(PACK, SIX, 0.5), "friction must be a friction law, got 0.5; gm.Hooke(mu=0.5)"),
        (
            lambda: gm.replace(EXPERIMENT, pack="tetra-325-a"),
            "pack must be a pack, got 'tetra-325-a'; gm.load_pack('tetra-325-a') reads one",
        ),
    ]
    for make, words in wrong:
        with pytest.raises(ValueError) as refused:  # noqa: PT011
            make()
        assert str(refused.value) == words


def test_names_values_and_batches_in_the_wrong_form_are_refused_with_the_right_one() -> None:
    wrong: list[tuple[Callable[[], Any], str]] = [
        (lambda: gm.value_and_grad(EXPERIMENT, "gamma0"), r'write \["gamma0"\] for "gamma0"'),
        (lambda: gm.value_and_grad(EXPERIMENT, ["steps"]), "steps is fixed when a program is compiled"),
        (lambda: gm.value_and_grad(EXPERIMENT, ["dt"]), "dt is fixed when a program is compiled"),
        (lambda: gm.value_and_grad(EXPERIMENT, ["background"]), "background is fixed .*; numbers like gamma0"),
        (lambda: gm.value_and_grad(EXPERIMENT, ["pack.name"]), "pack.name is fixed"),
        (lambda: gm.run(EXPERIMENT, batch=0), "batch must be a whole number from 1, got 0"),
        (lambda: gm.replace(EXPERIMENT, {"gamma0": 1e-3}, gamma0=2e-3), "gamma0 is given twice"),
        (
            lambda: gm.replace(EXPERIMENT, {"friction.mu": 0.5, "friction": gm.Hooke()}),
            "friction is given twice; leave one away",
        ),
        (lambda: gm.sweep(EXPERIMENT, {"gamma0": 1e-3}), r"gamma0 takes several, in a list: write \[0.001\]"),
        (lambda: gm.sweep(EXPERIMENT, {"pack": "tetra-325-a"}), r'write \["tetra-325-a"\] for "tetra-325-a"'),
    ]
    for make, words in wrong:
        with pytest.raises(ValueError, match=words) as refused:
            make()
        assert "\n" not in str(refused.value)
    with_part = gm.replace(EXPERIMENT, {"friction": gm.Hooke(), "friction.mu": 0.5})
    assert with_part.friction == gm.Hooke(mu=0.5)


@pytest.mark.parametrize(
    "given", ["1", b"1", np.array("1"), np.array(["1", "2"]), [1.0, "2"], True, 1.0 + 1.0j, None, {}]
)
@pytest.mark.parametrize("made", [gm.Hooke, gm.Mindlin, gm.MindlinRescaled, gm.Material])
def test_a_parameter_of_a_law_or_a_material_is_a_number_and_no_text_of_one(made: Any, given: Any) -> None:
    for field in dataclasses.fields(made):
        if "interval" in field.metadata:
            with pytest.raises(
                ValueError, match=f"^{field.name} must be a number or an array of numbers, got "
            ) as refused:
                made(**{field.name: given})
            assert repr(given) in str(refused.value)


def test_numbers_may_be_written_in_any_way_that_is_one() -> None:
    for one in (1, 1.0, np.float32(1), np.array(1.0), jnp.asarray(1.0), Fraction(1)):
        assert gm.Hooke(mu=one) == gm.Hooke(mu=1.0)
    assert gm.Hooke(mu=[1, 2]) == gm.Hooke(mu=np.array([1.0, 2.0]))
    assert gm.Bumps([[1, -1]], [[0.3, 0.7]], 0.2).count == 1
    assert gm.Mindlin(points=np.int64(9)) == gm.Mindlin(points=9)
    # Libraries that differentiate by arrays find one where one was given, and nowhere else.
    assert isinstance(gm.Hooke(mu=jnp.asarray(1.0)).mu, jax.Array)
    assert type(gm.Hooke(mu=np.array(1.0)).mu) is float


def test_every_number_that_is_asked_for_is_a_number_and_no_text_of_one() -> None:
    t, x = [0, 1, 2, 3, 4], [0.0, 0.5, 1.0, 0.5, 0.0]
    wrong: list[tuple[Callable[[], Any], str]] = [
        *(
            (functools.partial(gm.replace, EXPERIMENT, {name: "0.2"}), f"{name.rpartition('.')[2]} must be a number")
            for name in (
                "t0",
                "gamma0",
                "delta0",
                "hold_drag",
                "friction.mu",
                "material.poisson",
                "rest",
                "dt",
                "store",
            )
        ),
        (lambda: gm.replace(EXPERIMENT, gamma0=None), "gamma0 must be a number or an array of numbers, got None"),
        (lambda: gm.replace(EXPERIMENT, rest=True), "rest must be a number, got True"),
        (lambda: gm.replace(EXPERIMENT, steps="9"), "steps must be a whole number from 1, got '9'"),
        (lambda: gm.replace(EXPERIMENT, steps=True), "steps must be a whole number from 1, got True"),
        (lambda: gm.Mindlin(points="100"), "points must be a whole number from 0, got '100'"),  # type: ignore[arg-type]
        (lambda: gm.Mindlin(points=9.5), "points must be a whole number from 0, got 9.5"),  # type: ignore[arg-type]
        (lambda: gm.tetra("0.5"), "tetra overlap must be a number, got '0.5'"),  # type: ignore[arg-type]
        (lambda: gm.clump(np.eye(3).astype(str)), r"clump offsets must be numbers, \[K, 3\], got array"),
        (lambda: gm.words(3, pad="2"), "pad must be a number, got '2'"),  # type: ignore[arg-type]
        (lambda: gm.words(3, width="1"), "width must be a number, got '1'"),  # type: ignore[arg-type]
        (lambda: gm.Bumps([["1"]], [[0.5]], 0.2), r"amplitudes must be numbers, got \[\['1'\]\]"),  # type: ignore[arg-type]
        (lambda: gm.Spline("01"), "nodes must be numbers, got '01'"),  # type: ignore[arg-type]
        (lambda: gm.waveform(["0", "1"]), r"a waveform is made of real samples, got \['0', '1'\]"),  # type: ignore[arg-type]
        (lambda: gm.waveform([None, 1.0]), "a waveform is made of real samples"),  # type: ignore[arg-type]
        (lambda: gm.waveform_from(t, list(map(str, x))), "x must be real numbers, got"),  # type: ignore[arg-type]
        (lambda: gm.waveform_from(t, [0, 1j, 0, 0, 0]), "x must be real numbers, got"),  # type: ignore[arg-type]
        (lambda: gm.waveform_from(t, x, smooth="0.1"), "smooth must be a number, got '0.1'"),  # type: ignore[arg-type]
        (lambda: gm.waveform_from(t, x, span=("0", "4")), "span must be two times"),  # type: ignore[arg-type]
        (lambda: gm.run(EXPERIMENT, batch="2"), "batch must be a whole number from 1, got '2'"),  # type: ignore[arg-type]
        (lambda: gm.run(EXPERIMENT, batch=2.0), "batch must be a whole number from 1, got 2.0"),  # type: ignore[arg-type]
        (lambda: gm.run(EXPERIMENT, frames=2.5), "frames must be a whole number from 0, got 2.5"),  # type: ignore[arg-type]
        (lambda: gm.run(EXPERIMENT, frames_of="1"), "frames_of must be a whole number from 0"),  # type: ignore[arg-type]
        (lambda: gm.run(EXPERIMENT, frames_at=["1"]), "u of a frame must be a number, got '1'"),  # type: ignore[list-item]
        (lambda: gm.Recipe(delta0=b"0.05"), r"delta0 must be a number in \[1e-9, 0.5\), got b'0.05'"),  # type: ignore[arg-type]
        (lambda: gm.Recipe(hold=np.array("0.1")), r"hold must be a number in \[0, inf\), got array"),  # type: ignore[arg-type]
        (lambda: gm.memory_kernel(EXPERIMENT, "3"), "n must be a whole number from 0, got '3'"),  # type: ignore[arg-type]
        (lambda: gm.memory_kernel(EXPERIMENT, 3, "0.2"), "width must be a number, got '0.2'"),  # type: ignore[arg-type]
        (lambda: gm.design_waveforms(EXPERIMENT, iterations="1"), "iterations must be a whole number from 0, got '1'"),
        (lambda: gm.design_by_kernel(EXPERIMENT, gain="1"), "gain must be a number, got '1'"),
        (lambda: gm.design_drive([EXPERIMENT], {"t0": ("1", 99.0)}), r"t0 \(lowest\) must be a number, got '1'"),
        (
            lambda: gm.design_drive([EXPERIMENT], {"mu": (0.5, 2.0), "friction.mu": (0.9, 1.1)}),
            "one parameter is named twice",
        ),
        (lambda: gm.design_drive([EXPERIMENT], {"dt": (0.1, 0.6)}), "dt is fixed when a program is compiled"),
        (
            lambda: gm.design_drive([EXPERIMENT], {"mu": (0.5, 2.0)}, spread=-0.2),
            r"spread must be in \(0, 1\), got -0.2",
        ),
        (
            lambda: gm.design_drive([EXPERIMENT, gm.replace(EXPERIMENT, {"friction.mu": 0.6})], {"mu": (0.5, 2.0)}),
            "mu must be one number, the same in all experiments",
        ),
        (lambda: gm.value_and_grad(MIXED), "there are no derivatives in mixed precision"),
        (lambda: gm.design_waveforms(MIXED), "there are no derivatives in mixed precision"),
        (lambda: gm.prepare(grains=40, gravity=1e-3), "by the weight of the grains alone .* and 0.002 is wanted"),
        (lambda: gm.prepare(frames=5, film=()), r"frames go into film: give a list for them; got \(\)"),  # type: ignore[arg-type]
        (lambda: gm.prepare(friction=gm.Hooke(mu=jnp.ones(2))), "mu of a pack must be one number, got Array"),
        (lambda: gm.prepare(name="a\nb"), "name must be a line of text"),
        (lambda: gm.classify.TrainingConfig(2, held_out=1.0), "held_out = 1 of 17325 .* leaves none to train on"),
        (lambda: gm.classify.TrainingConfig(2, batch=0), "batch must be a whole number from 1, got 0"),
        (lambda: gm.classify.TrainingConfig(2, rate=0.0), "rate must be above 0"),
        (lambda: gm.classify.TrainingConfig(2, hidden=(0,)), "a width of hidden must be a whole number from 1, got 0"),
        (lambda: gm.classify.TrainingConfig(2, noise=np.nan), "noise must be a number from 0, got nan"),
        (lambda: gm.classify.train(gm.classify.TrainingConfig(2), -1), "seed must be a whole number from 0, got -1"),
        (lambda: gm.capacity.greedy_alphabet(np.full((4, 256), np.nan), 2), "recalls must be finite numbers"),
        (lambda: gm.capacity.decoded_bits(np.full((4, 256), np.nan), 0.1), "recalls must be finite numbers"),
        (lambda: gm.design_drive([EXPERIMENT], {}), r"bounds must name what is tuned, as in \{'gamma0'"),
        (lambda: gm.hold("2"), "stage 'hold': its length must be a number, got '2'"),  # type: ignore[arg-type]
        (lambda: gm.Stage("a", length=None), r"its length must be in \[0, inf\), got None"),  # type: ignore[arg-type]
        (lambda: gm.Stage("a", start=[0.1]), r"its start must be a number, got \[0.1\]"),  # type: ignore[arg-type]
        (lambda: gm.Stage("a", drag="x"), "its drag must be a number, got 'x'"),  # type: ignore[arg-type]
        (lambda: gm.Stage("a", pressure=2e-3), "its pressure is three numbers .* got 0.002"),  # type: ignore[arg-type]
        (lambda: gm.Stage("a", pressure=("x", None, None)), "its pressure along x must be a number, got 'x'"),  # type: ignore[arg-type]
        (lambda: gm.Drive("xy", 3), "a waveform is a name, or samples; got 3"),  # type: ignore[arg-type]
        (lambda: gm.Drive("xy", ("a", "b")), "sample 1 of a waveform must be a number, got 'a'"),  # type: ignore[arg-type]
        (lambda: gm.Drive(amplitude="1"), "the amplitude of a drive must be a number, got '1'"),  # type: ignore[arg-type]
    ]
    for make, words in wrong:
        with pytest.raises(ValueError, match=words) as refused:
            make()
        assert "\n" not in str(refused.value)


EXPERIMENT_MADE = r"gm\.Experiment\(pack, gm\.six_signals\(\)\) makes one"
TAKES_EXPERIMENT: dict[str, Callable[[Any], Any]] = {
    "run": gm.run,
    "prefix_of": gm.prefix_of,
    "recall": gm.fidelity,
    "replace": functools.partial(gm.replace, gamma0=1e-3),
    "to_dict": gm.to_dict,
    "stable_step": gm.stable_step,
    "value_and_grad": gm.value_and_grad,
    "jacobian": gm.jacobian,
    "memory_kernel": gm.memory_kernel,
    "kernel_matrix": gm.kernel_matrix,
    "design_waveforms": gm.design_waveforms,
    "design_by_kernel": gm.design_by_kernel,
    "design_drive": lambda wrong: gm.design_drive([wrong], {"gamma0": (1e-4, 1e-2)}),
    "sweep": lambda wrong: gm.sweep(wrong, {"gamma0": [1e-3]}),
}


@pytest.mark.parametrize("function", TAKES_EXPERIMENT)
def test_what_is_no_experiment_is_not_run(function: str) -> None:
    with pytest.raises(TypeError, match=rf"^gm\.{function} takes a gm\.Experiment, got a Pack; {EXPERIMENT_MADE}$"):
        TAKES_EXPERIMENT[function](PACK)


def test_what_is_not_of_the_kind_that_is_kept_or_drawn_is_refused(tmp_path: Path) -> None:
    path = str(tmp_path / "a.h5")
    wrong: list[tuple[Callable[..., Any], tuple[Any, ...], str]] = [
        (gm.save_pack, (PACK, path), r"save_pack\(path, pack\) takes a gm\.Pack, got '.*a\.h5'; see gm\.load_pack"),
        (
            gm.save_recall,
            (path, EXPERIMENT),
            r"save_recall\(path, recall\) takes a gm\.Recall, got an Experiment",
        ),
        (gm.plot, (path,), r"plot takes a gm\.Recall, got '.*a\.h5'; .*gm\.load_recall\(path\) reads one"),
        (gm.to_csv, (PACK,), r"to_csv takes a gm\.Recall, got a Pack"),
        (gm.to_xarray, (PACK,), r"to_xarray takes a gm\.Recall, got a Pack"),
        (gm.save_waveforms, (gm.six_signals(), path), r"takes a gm\.Signals, got '.*a\.h5'; as gm\.six_signals\(\)"),
        (gm.view, (EXPERIMENT,), r"view takes a gm\.Pack or frames, got Experiment; .*recall\.frames"),
        (gm.prepare, (325,), r"prepare takes a gm\.Recipe, got 325; gm\.prepare\(grains=325\)"),
    ]
    for function, given, words in wrong:
        with pytest.raises(TypeError, match=words):
            function(*given)
    assert not list(tmp_path.iterdir())


def test_one_thing_in_the_place_of_several_is_refused(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    several = "takes several(?: packs)?, in a list:"
    wrong: list[tuple[Callable[[], Any], str]] = [
        (lambda: gm.run(EXPERIMENT, frames_at=0.5), rf"frames_at {several} write \[0.5\] for 0.5"),  # type: ignore[arg-type]
        (lambda: gm.plot(recalled[1], "p_xy", signals=3), rf"signals {several} write \[3\] for 3"),  # type: ignore[arg-type]
        (lambda: gm.value_and_grad(EXPERIMENT, "gamma0"), rf'by {several} write \["gamma0"\] for "gamma0"'),
        (lambda: gm.design_drive(EXPERIMENT, {"gamma0": (1e-4, 1e-2)}), f"experiments {several} got an Experiment"),
        (lambda: gm.stack(PACK), f"stack {several} got tetra-27"),  # type: ignore[arg-type]
    ]
    for call, words in wrong:
        with pytest.raises(ValueError, match=words):
            call()


def test_any_waveforms_can_be_written_and_read_back(tmp_path: Path) -> None:
    six, u = gm.six_signals(), jnp.linspace(0.0, 1.0, 41)
    gm.save_waveforms(tmp_path / "six.csv", six)
    again = gm.waveform(gm.load_waveforms(tmp_path / "six.csv"))
    np.testing.assert_allclose(again.shear(u), six.shear(u), atol=0.02)  # kinks between two samples are rounded


def test_files_are_named_by_paths_or_texts(tmp_path: Path) -> None:
    gm.save_pack(str(tmp_path / "pack.h5"), PACK)
    assert gm.load_pack(str(tmp_path / "pack.h5")).grains == 27
    samples = jnp.asarray([[0.1, 0.2, 0.1]])
    gm.save_waveforms(str(tmp_path / "waves.csv"), gm.waveform(samples))
    np.testing.assert_allclose(gm.load_waveforms(str(tmp_path / "waves.csv")), samples)


def test_the_package_lists_its_own_names_those_loaded_later_too_and_nothing_foreign() -> None:
    listed = [name for name in dir(gm) if not name.startswith("__")]
    assert listed == sorted(gm.__all__)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("mypy") is None, reason="needs mypy")
def test_a_program_of_a_user_is_typed_throughout_and_its_mistakes_are_found(tmp_path: Path) -> None:
    root = Path(gm.__file__).parent.parent
    good = (TESTS / "data" / "program.py").read_text()
    (tmp_path / "good.py").write_text(good)
    (tmp_path / "bad.py").write_text(
        good.replace('backend="native"', 'backend="nativ"').replace("pack, gm.", '"a", gm.')
    )
    settings = tmp_path / "mypy.ini"
    settings.write_text(
        "[mypy]\nstrict = True\nuntyped_calls_exclude = jax\n[mypy-gmem_jax.*]\nfollow_imports = silent\n"
    )
    command = [sys.executable, "-m", "mypy", "--config-file", str(settings), "--cache-dir", str(tmp_path / "cache")]
    done = subprocess.run(
        [*command, "good.py", "bad.py"],
        cwd=tmp_path,
        env={**os.environ, "MYPYPATH": str(root)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    errors = [line for line in done.stdout.splitlines() if ": error:" in line]
    assert [line.split(":")[0] for line in errors] == ["bad.py"] * 2, done.stdout + done.stderr
    assert all(any(words in line for line in errors) for words in ("auto", 'expected "Pack"')), errors
