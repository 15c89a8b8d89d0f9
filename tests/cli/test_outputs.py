"""What a command may write to, and what it never destroys."""

import json
import os
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from scenes import PERIODIC_27, ROOT, SPREAD_27, gmem
from test_cli import PACK, SHORT

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.command import packs, recalls
from gmem_jax.files.ours import temporary
from gmem_jax.files.results import finite
from gmem_jax.files.waveforms import load_target
from gmem_jax.show import tables
from gmem_jax.show.numbers import note_on_size


@pytest.fixture
def own_pack(tmp_path: Path) -> Path:
    copy = tmp_path / "own.h5"
    copy.write_bytes(PACK.read_bytes())
    return copy


@pytest.mark.parametrize(
    ("output", "words"),
    [
        ("own.h5", "is an input of this command"),
        ("there.h5", "exists; name another file, or allow its replacement with --force"),
        ("recall.png", "this is a .h5 file; name it recall.h5"),
        ("/dev/null", "this is a .h5 file"),
        ("device.h5", "is neither a file nor free"),
    ],
)
def test_nothing_is_overwritten_unasked(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    tmp_path: Path,
    own_pack: Path,
    output: str,
    words: str,
) -> None:
    (tmp_path / "there.h5").write_text("precious")
    (tmp_path / "device.h5").symlink_to("/dev/null")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    assert gmem(monkeypatch, "recall", own_pack, "-o", tmp_path / output, *SHORT) == 2
    assert words in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before
    assert Path("/dev/null").is_char_device()


def test_not_even_by_force_is_an_input_overwritten(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, own_pack: Path
) -> None:
    assert gmem(monkeypatch, "recall", own_pack, "-o", own_pack, "--force", *SHORT) == 2
    assert "is an input" in capsys.readouterr().err
    assert own_pack.read_bytes() == PACK.read_bytes()


def test_what_a_killed_writer_of_an_output_left_is_removed_by_the_next(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    output = tmp_path / "a.xyz"
    old, young, other = temporary(output), temporary(output), temporary(tmp_path / "b.xyz")
    for left in (old, other):
        os.utime(left, (0.0, 0.0))
    assert gmem(monkeypatch, "export", PACK, "--to", "xyz", "-o", output) == 0
    assert set(tmp_path.iterdir()) == {output, young, other}


def test_another_user_s_file_in_a_sticky_folder_is_refused_before_the_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    output = tmp_path / "x.h5"
    output.touch()
    tmp_path.chmod(0o1777)
    monkeypatch.setattr(os, "geteuid", lambda: 65534)
    assert gmem(monkeypatch, "recall", PACK, "-o", output, "--force", *SHORT) == 2
    assert "belongs to another user, and in" in capsys.readouterr().err
    assert output.stat().st_size == 0


def test_a_picture_that_is_there_counts_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    (tmp_path / "out.png").write_text("precious")
    assert gmem(monkeypatch, "recall", PACK, "-o", tmp_path / "out.h5", *SHORT) == 2
    assert "out.png: exists" in capsys.readouterr().err
    assert (tmp_path / "out.png").read_text() == "precious"


def test_a_periodic_pack_is_asked_for_in_words_and_a_box_without_room_is_refused_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    for words in ("periodic", "periodic,periodic,walls"):
        asked = ["--grains", 27, "--boundary", words, "-o", tmp_path / "bulk.h5"]
        assert gmem(monkeypatch, "prepare", *asked, "--dry-run") == 0
    capsys.readouterr()
    for words, grains, refusal in (
        ("open", 27, "boundary must be walls or periodic"),
        ("periodic", 12, "is too small: its periodic edges must be 6.0 R at least"),
    ):
        asked = ["--grains", grains, "--boundary", words, "-o", tmp_path / "bulk.h5"]
        assert gmem(monkeypatch, "prepare", *asked) == 2
        said = capsys.readouterr().err
        assert refusal in said
    assert not list(tmp_path.iterdir())
    assert gmem(monkeypatch, "show", PERIODIC_27) == 0
    assert "periodic" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0.1,x\n0.2,0.3\n0.1,0.2\n", "its first line mixes numbers and words"),
        ("0.25,1\n0.5,2\n0.75,1\n", "column 1 rises by equal steps, as times and row numbers do"),
        ("0\n0\n0\n", "every waveform is zero"),
    ],
)
def test_waveforms_that_are_not_what_they_seem_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, text: str, words: str
) -> None:
    (tmp_path / "wave.csv").write_text(text)
    arguments = ["--signals", tmp_path / "wave.csv", "-o", tmp_path / "out.h5"]
    assert gmem(monkeypatch, "recall", PACK, *arguments, *SHORT) == 2
    said = capsys.readouterr().err
    assert words in said
    assert len(said.strip().splitlines()) == 1


def test_a_byte_order_mark_is_no_part_of_the_numbers(tmp_path: Path) -> None:
    (tmp_path / "plain.csv").write_text("0.1\n0.5\n0.9\n")
    (tmp_path / "marked.csv").write_text("0.1\n0.5\n0.9\n", encoding="utf-8-sig")
    gm.save_waveforms(tmp_path / "designed.csv", gm.waveform(np.array([0.1, 0.5])), gm.waveform(np.array([0.2, 0.4])))
    text = (tmp_path / "designed.csv").read_text()
    (tmp_path / "again.csv").write_text(text, encoding="utf-8-sig")
    for plain, marked in (("plain.csv", "marked.csv"), ("designed.csv", "again.csv")):
        np.testing.assert_array_equal(*(gm.load_waveforms(tmp_path / name) for name in (plain, marked)))
    assert load_target(tmp_path / "again.csv") is not None


def test_complex_samples_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    np.save(tmp_path / "wave.npy", np.asarray([0.0, 1.0j, 0.5]))
    arguments = ["--signals", tmp_path / "wave.npy", "-o", tmp_path / "out.h5"]
    assert gmem(monkeypatch, "recall", PACK, *arguments, *SHORT) == 2
    assert "samples must be real numbers, found complex128" in capsys.readouterr().err


def test_names_of_the_paper_are_accepted_in_any_case(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    options = ["--friction", "M1", "--background", "SUB2", "--no-picture", "--json", "-o", tmp_path / "out.h5"]
    assert gmem(monkeypatch, "recall", PACK, *options, *SHORT) == 0
    capsys.readouterr()
    configuration = gm.load_recall(tmp_path / "out.h5").configuration
    assert (configuration["friction"], configuration["experiment"]["background"]) == ("m1", "sub2")
    again = gm.from_dict(configuration["experiment"])
    assert isinstance(again.friction, gm.MindlinRescaled)


def test_published_points_stand_only_beside_what_they_were_measured_on() -> None:
    pack = gm.load_pack("tetra-325-a")

    def points(**changes: object) -> int:
        experiment = gm.replace(gm.Experiment(pack, gm.six_signals()), changes)
        return len(tables._comparable(gm.describe(experiment, 1.0)))

    assert points() == 1
    assert points(signals=gm.words(3)) == 0
    assert points(signals=gm.waveform(np.ones(9))) == 0
    assert points(t0=100.0) == 0
    assert points(background="sub2") == 0
    assert points(friction=gm.Mindlin()) == 0
    assert points(**{"friction.mu": 0.5}) == 0
    assert points(shear="before") == 0
    assert points(store=8.0) == 0
    assert points(**{"friction.stiffness": 0.2}) == 1  # the paper leaves it open


def test_json_has_null_where_there_is_no_number() -> None:
    odd = {"a": float("nan"), "b": [float("inf"), 1.0], "c": {"d": (-float("inf"), "x")}}
    assert json.dumps(finite(odd), allow_nan=False) == '{"a": null, "b": [null, 1.0], "c": {"d": [null, "x"]}}'


def test_a_standard_pack_is_made_once_and_found_by_its_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert packs.standard_recipe("tetra-31680-c") == packs.Recipe(grains=31680, seed=3, t0=1.8e4)
    monkeypatch.setattr(packs, "PAPER_T0", 75.0)
    assert gmem(monkeypatch, "prepare", "tetra-16-b", "--json") == 0
    made = json.loads(capsys.readouterr().out)
    assert made["output"] == str(tmp_path / "gmem_jax" / "packs" / "tetra-16-b.h5")
    pack = gm.load_pack("tetra-16-b")
    assert (pack.name, pack.grains, pack.info["recipe"]["seed"]) == ("tetra-16-b", 16, 2)
    assert gmem(monkeypatch, "show", "tetra-16-b") == 0
    assert gmem(monkeypatch, "export", "tetra-16-b", "--to", "xyz", "-o", tmp_path / "pack.xyz") == 0
    assert gmem(monkeypatch, "report", "tetra-16-b", "-o", tmp_path / "pack.html") == 0
    capsys.readouterr()
    assert gmem(monkeypatch, "prepare", "tetra-16-b") == 2
    assert "exists" in capsys.readouterr().err
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc")
    assert gmem(monkeypatch, "prepare", "tetra-16-b") == 2
    assert "cannot make this folder" in capsys.readouterr().err


def test_every_number_of_a_recipe_is_an_option_of_prepare(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    numbers = {
        **{"grains": 13, "seed": 5, "delta0": 0.04, "t0": 70.0, "dt": 0.2, "filling": 0.25, "gas_speed": 0.03},
        **{
            "gas_time": 300.0,
            "pressure": 3e-3,
            "piston_speed": 0.03,
            "piston_gain": 0.006,
            "cycles": 1,
            "rest": 0.3,
            "gravity": 1e-6,
        },
        **{"hold": 0.1, "drag": 0.02, "settled_speed": 2e-5, "quiet": 2e-6, "pressure_error": 0.02, "patience": 1e5},
        **{"size_spread": 0.0, "sizes": "", "shares": "", "boundary": "walls"},
    }
    assert set(numbers) == {entry.name for entry in fields(gm.Recipe)}
    options = [word for name, value in numbers.items() for word in (f"--{name.replace('_', '-')}", value)]
    (tmp_path / "rod.txt").write_text("# three\n-0.5 0 0 1\n0,0,0,1\n\n0.5 0 0 1.0\n")
    shape = ["--shape", tmp_path / "rod.txt"]
    assert gmem(monkeypatch, "prepare", *shape, *options, "-o", tmp_path / "rods.h5", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    pack = gm.load_pack(tmp_path / "rods.h5")
    assert pack.info["recipe"] == numbers
    assert (pack.name, pack.clump.spheres) == ("rod-13-seed5", 3)
    assert said["pressure_over_wanted"] == pack.info["at_rest"]["pressure"][2] / 3e-3
    assert gmem(monkeypatch, "show", tmp_path / "rods.h5") == 0
    assert f"{said['pressure_over_wanted']:.2f}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0 0 0 1\n1 0 0 0\n", "line 2: r is 0, must be positive"),
        ("0 0 0 1\n1 0 0 0.05\n", "radii of spheres must be in [0.1, 10] R, got 0.05 to 1"),
        ("0 0 0\n", "line 1: must be four numbers x y z r, got '0 0 0'"),
        ("x y z r\n0 0 0 1\n", "line 1: must be four numbers"),
        ("0 0 nan 1\n", "line 1: must be four numbers"),
        ("# nothing\n", "it lists 0 spheres, must be 1 to 256"),
        ("0 0 0 1\n" * 257, "it lists 257 spheres"),
    ],
)
def test_a_file_of_spheres_that_is_none_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, text: str, words: str
) -> None:
    path = tmp_path / "grain.txt"
    path.write_text(text)
    assert gmem(monkeypatch, "prepare", "--shape", path, "-o", tmp_path / "out.h5") == 2
    said = capsys.readouterr().err
    assert words in said
    assert str(path) in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--sizes", "1,0"], "sizes must be positive numbers"),
        (["--sizes", "1,nan"], "sizes must be positive numbers"),
        (["--sizes", "0.2,3"], "cannot be listed together: the largest may be 10 times the smallest"),
        (["--size-spread", "0.6"], "size_spread must be in [0, 0.35]"),
        (["--sizes", "1,1.4", "--shares", "0.9"], "shares must be one for each of 2 sizes and sum to 1"),
    ],
)
def test_sizes_that_no_pack_can_have_are_refused_in_one_line_and_nothing_is_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, options: list[str], words: str
) -> None:
    out = tmp_path / "out.h5"
    assert gmem(monkeypatch, "prepare", "--shape", "sphere", "--grains", 40, *options, "-o", out) == 2
    assert words in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_pack_of_several_sizes_is_foreseen_and_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    (tmp_path / "bent.txt").write_text("0 0 0 1\n1 0 0 0.6\n1.4 0.5 0 0.4\n")
    shape = ["--shape", tmp_path / "bent.txt", "--grains", 40, "--sizes", "0.8,1.2", "--shares", "0.7,0.3"]
    assert gmem(monkeypatch, "prepare", *shape, "-o", tmp_path / "out.h5", "--dry-run") == 0
    assert ("plain JAX" in capsys.readouterr().err) == (not native.available()[0])
    assert gmem(monkeypatch, "show", SPREAD_27) == 0
    assert "sizes 0.811 to 1.22, SD 0.097" in capsys.readouterr().out
    assert gmem(monkeypatch, "export", SPREAD_27, "--to", "lammps", "-o", tmp_path / "pack.data") == 0
    assert gmem(monkeypatch, "report", SPREAD_27, "-o", tmp_path / "pack.html") == 0


def test_a_recall_of_few_spheres_says_that_they_hold_little() -> None:
    few = {"grains": 325, "grain": {"shape": "sphere"}}
    assert "325 spheres hold little: G = 0.04 ± 0.03 and F = 0.3 ± 0.2 were measured" in note_on_size(few)
    assert note_on_size({**few, "grains": 3267}) == ""
    assert note_on_size({**few, "grain": {"shape": "tetra(0.6)"}}) == ""


def test_the_demo_stores_in_the_pack_of_the_middle_and_says_what_packs_differ_by(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    measured = (ROOT / "docs" / "measured.md").read_text()
    row = next(line for line in measured.splitlines() if line.startswith("| a / b / c / d / e |"))
    fidelities = [float(value) for value in row.split("|")[3].split("/")]
    assert "abcde"[fidelities.index(sorted(fidelities)[2])] == recalls.TYPICAL[-1]
    (gain, gain_sd), (fidelity, fidelity_sd) = recalls.SHIPPED["gain"], recalls.SHIPPED["fidelity"]
    assert f"| mean ± SD | {gain:.3f} ± {gain_sd:.3f} | {fidelity:.3f} ± {fidelity_sd:.3f} |" in measured
    small, experiment, asked = gm.load_pack(PACK), gm.Experiment, []
    monkeypatch.setattr(recalls, "load_pack", lambda name: asked.append(name) or small)
    monkeypatch.setattr(recalls, "Experiment", lambda *parts: experiment(*parts, t0=60.0))
    assert gmem(monkeypatch, "demo", "-o", tmp_path) == 0
    said = capsys.readouterr().out
    assert asked == [recalls.TYPICAL]
    assert f"G = {gain:.3f} ± {gain_sd:.3f}" in said
    assert f"F = {fidelity:.3f} ± {fidelity_sd:.3f} (mean ± SD)" in said
    readme = (ROOT / "README.md").read_text()
    assert f'gm.load_pack("{recalls.TYPICAL}")' in readme
    gains = [float(value) for value in row.split("|")[2].split("/")]
    place = "abcde".index(recalls.TYPICAL[-1])
    assert f"G = {gains[place]:.3f}: how large it is; F = {fidelities[place]:.3f}: how well its shape fits" in readme


def test_what_cannot_fit_is_refused_before_it_begins(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    assert gmem(monkeypatch, "prepare", "--grains", 10**9, "-o", tmp_path / "out.h5") == 2
    said = capsys.readouterr().err
    assert "GB of memory, and" in said
    assert "are free" in said
    assert list(tmp_path.iterdir()) == []


def test_the_gradient_is_that_of_the_bumps_there_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    target = tmp_path / "gradient.json"
    assert gmem(monkeypatch, "gradient", PACK, "-o", target, "--no-picture", "--json", *SHORT) == 0
    said = json.loads(capsys.readouterr().out)
    assert [len(row) for row in said["places"]] == [1, 1, 2, 2, 2, 3]
    assert [len(row) for row in said["gradient"]["waveform"]] == [1, 1, 2, 2, 2, 3]
    assert all(row == sorted(row) for row in said["places"])
