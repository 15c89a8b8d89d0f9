"""An option that would do nothing is refused: what was asked for is done, or it is said why not."""

from pathlib import Path

import pytest
from scenes import gmem
from test_cli import PACK, SHORT

import gmem_jax as gm

IDLE = {
    "--overlap": ["prepare", "--shape", "sphere", "--overlap", "0.3", "-o", "out.h5"],
    "--seed": ["prepare", "tetra-64-a", "--seed", "1"],
    "--output": ["prepare", "tetra-64-a", "-o", "out.h5"],
    "--frames-of": ["recall", PACK, "--frames-of", "1", "-o", "out.h5"],
    "--mu": ["recall", PACK, "--friction", "frictionless", "--mu", "1.0", "-o", "out.h5"],
    "--signals": ["design", PACK, "--words", "3", "--signals", "six", "-o", "out.csv"],
    "--executor": ["sweep", "status", ".", "--executor", "local"],
    "--workers": ["sweep", "show", ".", "--workers", "2"],
    "--retry": ["sweep", "export", ".", "--retry", "-o", "x.csv"],
    "--over": ["sweep", "status", ".", "--over", "mu"],
    "--force": ["sweep", "show", ".", "--force"],
    "--force does nothing when": ["sweep", "some.toml", "--force"],
    "--over does nothing when": ["sweep", "some.toml", "--over", "mu"],
    "folder: does nothing": ["sweep", "some.toml", "folder"],
    "--laws": ["bench", "--device", "gpu", "--laws", "H"],
    "--lammps/--no-lammps": ["bench", "--device", "gpu", "--no-lammps"],
    "--against": ["show", PACK, "--against", "time"],
    "--against does nothing with": ["show", PACK, "--plot", "grains", "--against", "u", "-o", "x.png"],
    "--csv": ["show", PACK, "--csv", "--plot", "grains", "-o", "x.png"],
    "--json": ["show", PACK, "--csv", "--json"],
    "--output does nothing with": ["show", PACK, "--plot", "list", "-o", "x.png"],
}


@pytest.mark.parametrize("words", IDLE)
def test_an_option_that_would_do_nothing_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert gmem(monkeypatch, *IDLE[words]) == 2
    said = capsys.readouterr().err
    assert f"{words} does nothing" in said or words in said.removeprefix("gmem: ")
    assert "does nothing" in said
    assert len(said.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_picture_is_told_as_json(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    assert gmem(monkeypatch, "show", PACK, "--plot", "grains", "-o", tmp_path / "x.png", "--json") == 0
    assert "x.png" in capsys.readouterr().out
    assert gmem(monkeypatch, "show", PACK, "--plot", "list", "--json") == 0
    assert '"grains"' in capsys.readouterr().out


def test_samples_of_an_instrument_are_recalled_on_request_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    rows = [f"{0.01 * k:.4f},{0.3 + 0.2 * (k % 2) * 0.05 + 0.004 * k:.4f}" for k in range(100)]
    (tmp_path / "lab.csv").write_text("time (s),voltage (V)\n" + "\n".join(rows) + "\n")
    own = ["--signals", tmp_path / "lab.csv", "-o", tmp_path / "x.h5", "--no-picture", *SHORT]
    assert gmem(monkeypatch, "recall", PACK, *own) == 2
    assert "--taper" in capsys.readouterr().err
    assert gmem(monkeypatch, "recall", PACK, *own, "--smooth", "0.1", "--taper", "0.2", "--scale") == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "lab.csv" in line]
    assert len(told) == 1
    for words in ("time (s) from 0 to 0.99 is u from 0 to 1", "smoothed", "brought to zero", "divided by"):
        assert words in told[0]
    kept = gm.load_recall(tmp_path / "x.h5")
    assert float(abs(kept.shear).max()) == pytest.approx(1.0, abs=1e-3)
