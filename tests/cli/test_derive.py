"""`gmem gradient`, `gmem kernel` and `gmem design` as a user meets them, on shortened runs of 27 grains."""

import json
from pathlib import Path

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import gmem
from test_cli import PACK, SHORT

import gmem_jax as gm
from gmem_jax.command.derive import _of_waveforms, _waveform_of
from gmem_jax.files.schemas import KERNEL


@pytest.mark.slow
def test_kernel_and_design_write_what_they_say(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    target = tmp_path / "kernel.h5"
    assert gmem(monkeypatch, "kernel", PACK, "-o", target, "--bumps", 5, "--width", 0.3, "--json", *SHORT) == 0
    said = json.loads(capsys.readouterr().out)
    assert len(said["singular_values_pa"]) == said["n"] == 5
    with h5py.File(target) as file:
        assert file["kernel"].shape == (256, 5)
        assert file.attrs["schema"] == KERNEL.name
    waves = tmp_path / "designed.csv"
    assert gmem(monkeypatch, "design", PACK, "-o", waves, "--iterations", 1, "--json", *SHORT) == 0
    said = json.loads(capsys.readouterr().out)
    assert gm.load_waveforms(waves).shape[0] == 6
    assert said["history"][0] == said["before"]
    names = {"kernel.h5", "kernel.png", "designed.csv", "designed.png", "designed-history.png"}
    assert {path.name for path in tmp_path.iterdir()} == names


def test_a_design_goes_on_from_a_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    waves, few, samples = tmp_path / "earlier.csv", tmp_path / "few.csv", 0.3 * np.sin(np.linspace(0.2, 3.0, 8))
    gm.save_waveforms(few, gm.waveform(samples))
    gm.save_waveforms(waves, gm.waveform(np.outer(np.ones(6), samples)))
    assert gmem(monkeypatch, "design", PACK, "--start", waves, *SHORT) == 2
    assert "--start: designs by Jacobians have no use for it" in capsys.readouterr().err
    taken = tmp_path / "next-history.png"  # the name of a picture that the command would draw
    taken.write_bytes(waves.read_bytes())
    assert gmem(monkeypatch, "design", PACK, "--start", taken, "-o", tmp_path / "next.csv", "--force", *SHORT) == 2
    assert "next-history.png: is an input of this command" in capsys.readouterr().err
    taken.unlink()
    on = ["design", PACK, "--by", "kernel", "--bumps", 5, "--width", 0.4, "--iterations", 1, "--no-picture", *SHORT]
    assert gmem(monkeypatch, *on, "--start", few) == 2
    assert "1 waveform to start from, for 6 signals; give one for each" in capsys.readouterr().err
    assert gmem(monkeypatch, *on, "--start", waves, "-o", waves, "--force") == 2
    assert "is an input of this command" in capsys.readouterr().err
    assert gmem(monkeypatch, *on, "--start", waves, "--json") == 0
    assert len(json.loads(capsys.readouterr().out)["history"]) == 2
    # Five bumps come near the earlier waveforms, all alike, and nothing was corrected.
    np.testing.assert_allclose(gm.load_waveforms(tmp_path / "designed.csv")[0].max(), samples.max(), rtol=0.1)


def test_gradient_prints_the_slopes_of_the_library(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    waves = tmp_path / "one.csv"
    gm.save_waveforms(waves, gm.waveform(np.sin(np.linspace(0.2, 3.0, 8))))
    target = tmp_path / "gradient.json"
    assert gmem(monkeypatch, "gradient", PACK, "-o", target, "--signals", waves, "--json", *SHORT) == 0
    said = json.loads(capsys.readouterr().out)
    assert np.shape(said["gradient"]["waveform"]) == np.shape(said["places"]) == (1, 8)
    experiment = gm.from_dict(said["configuration"]["experiment"], gm.load_pack(PACK))
    paths = {"gamma0": "gamma0", "mu": "friction.mu", "stiffness": "friction.stiffness"}
    found = gm.value_and_grad(experiment, ["signals.nodes", *paths.values()])
    np.testing.assert_allclose(said["fidelity"], found.value, rtol=1e-12)
    np.testing.assert_allclose(said["gradient"]["waveform"], found.slope["signals.nodes"][:, 1:-1], rtol=1e-9)
    for name, path in paths.items():
        np.testing.assert_allclose(said["gradient"][name], found.slope[path], rtol=1e-9)
    assert json.loads(target.read_text())["fidelity"] == said["fidelity"]
    assert (tmp_path / "gradient.png").exists()


def test_slopes_of_bumps_are_in_the_order_of_their_places() -> None:
    bumps = gm.Bumps(jnp.asarray([[1.0, 0.0, 0.5]]), jnp.asarray([[0.7, 0.5, 0.3]]), 0.2)
    experiment = gm.Experiment(gm.load_pack(PACK), bumps, t0=75.0)
    ((places, slopes),) = _of_waveforms(experiment, *_waveform_of(experiment), np.asarray([[10.0, 30.0, 20.0]]))
    np.testing.assert_array_equal(places, [0.3, 0.7])
    np.testing.assert_array_equal(slopes, [20.0, 10.0])


def test_tune_stays_within_bounds_and_says_what_it_found(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    target = tmp_path / "tuned.json"
    options = ["--bounds", "gamma0=5e-4:2e-3", "--iterations", 1, "-o", target, "--json", *SHORT]
    assert gmem(monkeypatch, "tune", f"{PACK},{PACK}", *options) == 0
    said = json.loads(capsys.readouterr().out)
    assert 5e-4 <= said["values"]["gamma0"] <= 2e-3
    assert said["fidelity"] >= said["before"] == said["history"][0]["fidelity"]
    assert said["each"][0] == said["each"][1]
    assert json.loads(target.read_text())["values"] == said["values"]
    assert (tmp_path / "tuned.png").exists()


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ("mu", "should read like mu=0.5:2"),
        ("mu=1", "should read like mu=0.5:2"),
        ("mu=a:b", "should read like mu=0.5:2"),
        ("colour=1:2", "'colour' cannot be tuned"),
        ("mu=2:3", "hold the first value 1, got 2 to 3"),
        ("mu=0.5:2,mu=0.9:1", "mu is given twice"),
        ("stiffness=0.1:40", "with the highest values of the bounds: dt = "),
    ],
)
def test_bounds_that_make_no_sense_are_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, bounds: str, words: str
) -> None:
    assert gmem(monkeypatch, "tune", PACK, "--bounds", bounds, "-o", tmp_path / "t.json", *SHORT) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert words in said


@pytest.mark.parametrize("command", ["design", "tune"])
def test_designs_are_made_with_sub0(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert gmem(monkeypatch, command, PACK, "--background", "SUB2", *SHORT) == 2
    assert "designs are made with sub0" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["recall", "gradient", "kernel", "design", "tune"])
def test_every_command_takes_the_whole_experiment(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, command: str
) -> None:
    assert gmem(monkeypatch, command, "--help") == 0
    said = capsys.readouterr().out
    for option in ("--stiffness", "--delta0", "--dt", "--backend", "--hold-drag", "--points", "--variant", "--force"):
        assert option in said


def test_a_recall_of_designed_waveforms_is_compared_with_their_target_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    waves, out = tmp_path / "designed.csv", tmp_path / "out.h5"
    own = gm.waveform(np.outer(np.ones(6), np.sin(np.linspace(0.2, 3.0, 8))))
    gm.save_waveforms(waves, own, gm.six_signals())
    assert gmem(monkeypatch, "recall", PACK, "-o", out, "--signals", waves, "--no-picture", "--json", *SHORT) == 0
    said = json.loads(capsys.readouterr().out)
    recall = gm.load_recall(out)
    configuration = recall.configuration
    experiment = gm.Experiment(gm.load_pack(PACK), gm.six_signals())
    match = experiment.compare(recall.p_sig)
    assert said["target_fidelity"] == pytest.approx(float(match.fidelity), rel=1e-12)
    assert said["target_gain"] == pytest.approx(float(match.gain), rel=1e-12)
    assert said["target_fidelity"] != said["fidelity"]
    assert configuration["target"] == {"kind": "six"}
    assert configuration["hold_drag"] == 0.05
    np.testing.assert_allclose(recall.shear, np.asarray(own.shear(recall.u)).T, atol=1e-15)
    assert gmem(monkeypatch, "show", out) == 0
    assert "target of their design" in capsys.readouterr().out
    # All else compares with their own J, and says so; a design of them would be of a J that nobody wants.
    capsys.readouterr()
    assert (
        gmem(monkeypatch, "gradient", PACK, "--signals", waves, "-o", tmp_path / "g.json", *SHORT, "--no-picture") == 0
    )
    assert "holds designed waveforms and their target" in capsys.readouterr().err
    assert gmem(monkeypatch, "design", PACK, "--signals", waves, "-o", tmp_path / "d.csv", *SHORT) == 2
    assert "these as --start to go on" in capsys.readouterr().err
    gm.save_waveforms(waves, own, gm.words(1))
    assert gmem(monkeypatch, "recall", PACK, "-o", tmp_path / "no.h5", "--signals", waves, *SHORT) == 2
    assert "its target has 2 signals, must have 6" in capsys.readouterr().err
