"""The `gmem` command as a user meets it: results, JSON, and one clear line for every kind of bad input."""

import json
import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import h5py
import jax
import numpy as np
import pytest
from scenes import TETRA_27, gmem

import gmem_jax as gm
from gmem_jax.command import recalls
from gmem_jax.experiment.analysis import MEASURES
from gmem_jax.files.hdf5 import writing

PACK = TETRA_27
SHORT = ["--t0", "75", "--store", "0.1", "--rest", "0.1", "--hold", "0.1"]


def test_help_and_info_work(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    assert gmem(monkeypatch) == 0
    assert "recall" in capsys.readouterr().out
    assert gmem(monkeypatch, "info", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["versions"]["jax"] == jax.__version__
    assert "tetra-325-a" in facts["packs"]
    assert gmem(monkeypatch, "info") == 0
    lines = capsys.readouterr().out.splitlines()  # however narrow the terminal is
    assert {f"backend: {facts['backend']}", "shipped packs: " + ", ".join(facts["packs"])} <= set(lines)


@pytest.mark.parametrize("command", [["-m", "gmem_jax"], ["-c", "from gmem_jax.command.app import main; main()"]])
def test_the_version_is_told(command: list[str]) -> None:
    unknown = {**os.environ, "COLUMNS": "0"}  # as in some terminals and containers
    done = subprocess.run([sys.executable, *command, "--version"], capture_output=True, text=True, env=unknown)
    assert (done.returncode, done.stdout) == (0, f"gmem-jax {metadata.version('gmem-jax')}\n")


COMMANDS = [
    "prepare",
    "recall",
    "classify",
    "gradient",
    "kernel",
    "design",
    "tune",
    "sweep",
    "reproduce",
    "demo",
    "show",
    "report",
    "info",
    "bench",
    "export",
    "import",
]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_that_begins_with_its_line_in_the_list(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, command: str
) -> None:
    assert gmem(monkeypatch, "--help") == 0
    [line] = re.findall(rf"^  {command} +(.*)\.$", capsys.readouterr().out, re.MULTILINE)
    assert gmem(monkeypatch, command, "--help") == 0
    told = capsys.readouterr().out
    assert "--json" in told
    assert " ".join(told.partition("\n\n")[2].split()).startswith(line)


def test_a_recall_writes_data_and_picture_and_prints_json(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    target = tmp_path / "recall.h5"
    assert gmem(monkeypatch, "recall", PACK, "-o", target, "--json", *SHORT) == 0
    said = json.loads(capsys.readouterr().out)
    assert {"gain", "fidelity", "status", "seconds"} <= set(said)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["recall.h5", "recall.png"]
    recall = gm.load_recall(target)
    configuration = recall.configuration
    assert float(recall.fidelity) == said["fidelity"]
    assert configuration["experiment"]["t0"] == 75.0
    assert configuration["backend"] in ("jax", "native")
    assert configuration["pack_record"]["recipe"]["seed"] == 1
    with h5py.File(target) as file:
        assert file["stages/readout/pressure"].shape == (256, 3, 7)
    assert gmem(monkeypatch, "show", target) == 0
    assert f"{said['fidelity']:.3f}" in capsys.readouterr().out


def test_a_users_waveform_is_recalled(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    (tmp_path / "wave.csv").write_text("\n".join(str(x) for x in np.sin(np.linspace(0.1, 3.0, 9))))
    arguments = ["--signals", tmp_path / "wave.csv", "-o", tmp_path / "out.h5", "--no-picture", "--json", *SHORT]
    assert gmem(monkeypatch, "recall", PACK, *arguments) == 0
    assert np.isfinite(json.loads(capsys.readouterr().out)["gain"])
    recall = gm.load_recall(tmp_path / "out.h5")
    assert np.asarray(recall.p_sig).shape == (1, 256)


def test_the_same_command_gives_the_same_numbers_bit_for_bit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    recalls = []
    for name in ("one.h5", "two.h5"):
        assert gmem(monkeypatch, "recall", PACK, "-o", tmp_path / name, "--no-picture", *SHORT) == 0
        recalls.append(gm.load_recall(tmp_path / name))
    np.testing.assert_array_equal(recalls[0].p_sig, recalls[1].p_sig)


def test_a_pack_file_is_shown_with_its_state(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    assert gmem(monkeypatch, "show", PACK) == 0
    shown = capsys.readouterr().out
    for words in ("27 tetra(0.6)", "filling phi", "coordination Z", "p_x, p_y, p_z"):
        assert words in shown


@pytest.fixture(scope="module")
def one_bit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recall of the two words of one bit, with a second readout."""
    file = tmp_path_factory.mktemp("words") / "words.h5"
    run = {"t0": 75.0, "store": 0.1, "rest": 0.1, "hold": 0.1}
    experiment = gm.Experiment(gm.load_pack(PACK), gm.words(1), background="sub2-bl", **run)
    gm.save_recall(file, gm.run(experiment))
    return file


def test_a_second_readout_is_shown_by_every_background(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, one_bit: Path
) -> None:
    assert gmem(monkeypatch, "show", one_bit, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert list(said["backgrounds"]) == ["sub0", "sub2", "sub2-bl"]
    assert said["backgrounds"]["sub2-bl"] == pytest.approx({key: said[key] for key in MEASURES}, rel=1e-9)
    left = said["second_readout"]
    assert set(left) == {"correlation", "correlation_se", "gain", "gain_se"}
    assert all(np.isfinite(value) for value in left.values())
    assert gmem(monkeypatch, "show", one_bit) == 0
    shown = capsys.readouterr().out
    for words in ("SUB0", "SUB2-BL", "second readout: correlation with J"):
        assert words in shown


def test_recalled_words_are_classified_and_the_nets_are_used_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, one_bit: Path
) -> None:
    target, nets = tmp_path / "read.json", tmp_path / "nets"
    arguments = ["classify", one_bit, "-o", target, "--seeds", 2, "--budget", 60, "--nets", nets]
    assert gmem(monkeypatch, *arguments, "--json") == 0
    spoken = capsys.readouterr()
    said = json.loads(spoken.out)
    stored = json.loads(target.read_text())
    assert stored.pop("schema") == "gmem-reading/0.1"
    assert set(stored.pop("about")) == set(said)
    assert stored == said
    assert (said["bits"], said["background"]) == (1, "sub2-bl")
    # A drive as fast as this is doubtful, and so is what is read from it.
    assert said["status"] == np.bitwise_or.reduce(gm.load_recall(one_bit).status) != 0
    assert gm.explain(said["status"]) in " ".join(spoken.err.split())
    assert [net["finished"] for net in said["nets"]] == [True, True]
    assert set(said["readers"]) == {"net", "nearest template", "linear decoder"}
    mean = np.mean([net["accuracy"] for net in said["nets"]])
    assert said["readers"]["net"]["accuracy"] == pytest.approx(mean)
    assert "held-out accuracy" in spoken.err
    assert "SUB2-BL" in spoken.err
    assert sorted(path.name for path in nets.iterdir()) == ["words-1-seed-0.msgpack", "words-1-seed-1.msgpack"]
    assert target.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    stamps = [path.stat().st_mtime_ns for path in sorted(nets.iterdir())]
    assert gmem(monkeypatch, *arguments, "--no-picture", "--force") == 0
    assert [path.stat().st_mtime_ns for path in sorted(nets.iterdir())] == stamps
    assert "nearest template" in capsys.readouterr().out


def test_the_picture_of_a_reading_never_takes_the_place_of_its_recall(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, one_bit: Path
) -> None:
    recall = tmp_path / "read.png"
    shutil.copy(one_bit, recall)
    assert gmem(monkeypatch, "classify", recall, "-o", tmp_path / "read.json", "--force") == 2
    assert "read.png: is an input of this command" in capsys.readouterr().err
    assert recall.read_bytes() == one_bit.read_bytes()


@pytest.mark.parametrize("begun", [False, True])
def test_an_interrupted_training_says_where_it_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, one_bit: Path, begun: bool
) -> None:
    def interrupted(*_: Any, checkpoint: Path, **__: Any) -> None:
        if begun:
            checkpoint.write_bytes(b"a round")
        raise KeyboardInterrupt

    monkeypatch.setattr("gmem_jax.reading.training.train_net", interrupted)
    nets = tmp_path / "nets"
    assert gmem(monkeypatch, "classify", one_bit, "-o", tmp_path / "read.json", "--nets", nets) == 130
    then = f"goes on with the nets in {nets}" if begun else "nothing was kept yet; the same command begins anew"
    assert then in " ".join(capsys.readouterr().err.split())


def test_a_recall_that_holds_no_words_cannot_be_classified(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    file = tmp_path / "six.h5"
    assert gmem(monkeypatch, "recall", PACK, "-o", file, "--no-picture", *SHORT) == 0
    capsys.readouterr()
    assert gmem(monkeypatch, "classify", file, "-o", tmp_path / "out.json") == 2
    said = capsys.readouterr()
    assert "holds 6 signals, not the words of one length; make one with gmem recall --signals words:L" in said.err
    assert len(said.err.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["six.h5"]


def bad_files(folder: Path) -> dict[str, Path]:
    """Files with one thing wrong each."""
    files = {name: folder / name for name in ("truncated.h5", "schema.h5", "nan.csv", "ragged.csv", "short.csv")}
    files["truncated.h5"].write_bytes(PACK.read_bytes()[:2000])
    with writing(files["schema.h5"], "gmem-pack/99"):
        pass
    files["nan.csv"].write_text("0\nnan\n0\n")
    files["ragged.csv"].write_text("0,1\n1\n")
    files["short.csv"].write_text("1\n")
    return files


BAD = [
    (
        ["prepare", "--shape", "cube", "-o", "{out}"],
        "must be tetra or sphere, or a file of spheres, got 'cube'",
    ),
    (["prepare", "p", "--grains", "27"], "p: a standard pack is called tetra-N-x, N grains and a letter for the seed"),
    (["prepare", "--grains", "0", "-o", "{out}"], "grains must be at least 12 to jam, got 0"),
    (["prepare", "--grains", "27", "--t0", "1e308", "-o", "{out}"], "a number is too large"),
    (["recall", "{pack}", "--store", "1e308", "-o", "{out}"], "stage 'store': its length may be up to 1e+09 t0"),
    (["prepare", "--overlap", "1.0", "-o", "{out}"], "overlap must be in [0, 1), got 1"),
    (
        ["prepare", "--shape", "sphere", "--overlap", "0.3", "-o", "{out}"],
        "--overlap does nothing with --shape sphere: it is that of a tetra grain",
    ),
    (["prepare", "--shape", "nowhere.txt", "-o", "{out}"], "nowhere.txt: no such file"),
    (["prepare", "--pressure", "-2", "-o", "{out}"], "pressure must be in (0, inf) E, got -2"),
    (["prepare", "--grains", "12", "--filling", "0.05", "-o", "{out}"], "flatter than a grain (3.0 R)"),
    (["prepare", "--dt", "0.6", "-o", "{out}"], "dt must be in (0, 0.5] t_c, got 0.6"),
    (["prepare", "--seed", "-1", "-o", "{out}"], "seed must be in [0, 9007199254740991], got -1"),
    (["prepare", "--seed", "9223372036854775808", "-o", "{out}"], "seed must be in [0, 9007199254740991]"),
    (["prepare", "--backend", "foo", "-o", "{out}"], "backend must be one of auto, jax, native; got 'foo'"),
    (["prepare", "--name", "x" * 201, "-o", "{out}"], "--name: must be a line of at most 200 printable characters"),
    (["prepare", "-o", "/proc/nowhere/pack.h5"], "folder /proc/nowhere does not exist"),
    (["prepare", "-o", "/proc/pack.h5"], "cannot write there"),
    (["prepare", "--grains", "many", "-o", "{out}"], "'--grains': Input should be a valid integer"),
    (["prepare"], "--output is missing: name a file, or a standard pack like tetra-31680-a"),
    (["prepare", "sphere-64-a"], "sphere-64-a: a standard pack is called tetra-N-x"),
    (["prepare", "tetra-325-a"], "tetra-325-a: is shipped, and need not be made"),
    (["prepare", "tetra-64-a", "--seed", "2"], "the name of a standard pack says all about it"),
    (["recall", "tetra-64-a", "-o", "{out}"], "`gmem prepare tetra-64-a` makes it"),
    (["recall", "{pack}", "--mu", "-0.5", "-o", "{out}"], "mu must be in [0, inf), got -0.5"),
    (
        ["recall", "{pack}", "--accuracy", "0.01", "--t0", "900", "-o", "{out}"],
        "--t0 does nothing with --accuracy, which chooses t0 and dt",
    ),
    (["recall", "{pack}", "--accuracy", "0.5", "-o", "{out}"], "accuracy must be a number from 0.002 to 0.1, got 0.5"),
    (
        ["recall", "{pack}", "--dt", "0.9", "--stiffness", "0.93", "-o", "{out}"],
        "t_c exceeds the largest stable step of this pack, law and",
    ),
    (["recall", "{pack}", "--stiffness", "2", "-o", "{out}"], "dt = 0.586 t_c exceeds the largest stable step"),
    (["recall", "{pack}", "--dt", "2.2", "-o", "{out}"], "dt must be in (0, 2.0], got 2.2"),
    (["recall", "{pack}", "--signals", "seven", "-o", "{out}"], "--signals"),
    (["recall", "{pack}", "--signals", "{nan.csv}", "-o", "{out}"], "sample 2 of signal 1 is not a finite number"),
    (["recall", "{pack}", "--signals", "{ragged.csv}", "-o", "{out}"], "not a readable table of numbers"),
    (["recall", "{pack}", "--signals", "{short.csv}", "-o", "{out}"], "at least 2 samples"),
    (["recall", "{pack}", "--friction", "glue", "-o", "{out}"], "friction must be one of frictionless, hooke, m1, m2"),
    (["recall", "{truncated.h5}", "-o", "{out}"], "its checksum does not fit its content"),
    (
        ["recall", "{schema.h5}", "-o", "{out}"],
        "its schema is 'gmem-pack/99', of another version; this one reads gmem-pack/0.1",
    ),
    (["recall", "no-such-pack", "-o", "{out}"], "neither a file nor a shipped pack"),
    (["recall", "{pack}", "-o", "/proc/recall.h5"], "cannot write there"),
    (["demo", "--packs", "tetra-7"], "no such shipped pack"),
    (["show", "nothing.h5"], "no such file"),
    (
        ["recall", "{pack}", "--signals", "words:13", "-o", "{out}"],
        "--signals words:13: words need a length from 1 to 12",
    ),
    (["recall", "{pack}", "--signals", "words:x", "-o", "{out}"], "--signals words:x: words need a length"),  # no emoji
    (["recall", "{pack}", "--signals", "words", "-o", "{out}"], "words need a length from 1 to 12, as in words:3"),
    (["design", "{pack}", "--by", "kernel", "--start", "six"], "--start six: is no file of waveforms"),
    (["tune", "{pack},", "-o", "{json}"], "no pack is named beside a comma"),
    (["reproduce", "fig08", "-o", "/proc/rep"], "--output /proc/rep: cannot write there"),
    (["reproduce", "fig08", "-o", "x" * 252], "cannot write there (File name too long)"),
    (["reproduce", "fig05", "-o", "{pack}"], "is a file, and a folder is needed; name another"),
    (["reproduce", "fig05", "-o", "{pack}", "--dry-run"], "is a file, and a folder is needed; name another"),
    (["classify", "{pack}", "-o", "{json}"], "this is a pack; a recall is needed"),
    (["classify", "{truncated.h5}", "-o", "{json}"], "its checksum does not fit its content"),
    (["classify", "nothing.h5", "-o", "{json}"], "nothing.h5: no such file"),
    (["classify", "nothing.h5", "--seeds", "0", "-o", "{out}"], "'--seeds'"),
    (["recall", "{pack}", "--friction", "M2", "--points", "9223372036854775808", "-o", "{out}"], "points must be 2 to"),
    (["zzz"], "No such command 'zzz'; there are info, prepare, recall"),
    (["recal"], "No such command 'recal'. Did you mean 'recall'?"),
    (["view"], "gm.view shows a pack or a recall in a notebook, gmem report FILE as a page"),
    (["recall", "{pack}", "--loud"], "No such option"),
]


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=[" ".join(arguments[:4]) for arguments, _ in BAD])
def test_bad_input_gets_one_clear_line_exit_code_2_and_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    tmp_path: Path,
    arguments: list[str],
    words: str,
) -> None:
    inputs = tmp_path / "inputs"
    outputs = tmp_path / "outputs"
    inputs.mkdir()
    outputs.mkdir()
    names = {"{pack}": PACK, "{out}": outputs / "out.h5", "{json}": outputs / "out.json"}
    names |= {f"{{{name}}}": path for name, path in bad_files(inputs).items()}
    monkeypatch.chdir(outputs)
    assert gmem(monkeypatch, *(str(names.get(word, word)) for word in arguments)) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.strip().splitlines()) == 1
    assert words in said.err
    assert list(outputs.iterdir()) == []


def test_reproduce_replaces_its_own_pictures_and_no_others(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    picture, nets = tmp_path / "fig05.png", tmp_path / "nets"
    for taken, told in ((picture, "is not of this command"), (nets, "is a file, and a folder is needed; move it away")):
        taken.write_text("mine")
        assert gmem(monkeypatch, "reproduce", "fig05", "-o", tmp_path) == 2
        assert f"{taken}: {told}" in capsys.readouterr().err
        assert taken.read_text() == "mine"
        taken.unlink()
    for _ in range(2):
        assert gmem(monkeypatch, "reproduce", "fig05", "-o", tmp_path) == 0
        assert picture.is_file()


def test_a_run_that_breaks_down_exits_with_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    def outside(*_: Any, **__: Any) -> None:
        raise gm.RunFailedError("a grain left the box")

    monkeypatch.setattr(recalls, "run", outside)
    assert gmem(monkeypatch, "recall", PACK, "-o", tmp_path / "out.h5", *SHORT) == 1
    assert "the run failed" in capsys.readouterr().err
    assert not (tmp_path / "out.h5").exists()
