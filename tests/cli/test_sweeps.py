"""Sweeps on the command line: done by workers that may die, shown, exported, resumed, and grown."""

import contextlib
import csv
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from scenes import TETRA_27, gmem

import gmem_jax as gm

PACK = TETRA_27
ENTRY = "from gmem_jax.command.app import main; main()"
SWEEP = f"""[experiment]
pack = "{PACK}"
t0 = 150
store = 0.2
[vary]
mu = [0.2, 1.0]
background = ["sub0", "sub2"]
"""
BROKEN = """[[points]]
friction = "M2"
p_max = 1e-4
points = 8
"""


def said(capsys: pytest.CaptureFixture) -> dict:
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of four points and one that breaks down."""
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "mu.toml").write_text(SWEEP + BROKEN)
    done = subprocess.run(
        [sys.executable, "-c", ENTRY, "sweep", str(folder / "mu.toml"), "--json"], capture_output=True, text=True
    )
    assert done.returncode == 1, done.stderr
    assert "failed: mu = None, background = None" in done.stderr
    assert "1 of 5 points failed; try them again with --retry" in done.stderr
    assert re.search(r"grain-steps, some \d+ s of two free cores once compiled", done.stderr)
    table = json.loads(done.stdout)
    assert (table["done"], table["failed"], table["open"]) == (4, 1, 0)
    return folder / "mu"


@pytest.mark.slow
def test_points_are_what_recalls_of_them_are(swept: Path) -> None:
    card = json.loads((swept / "sweep.json").read_text())
    pack = gm.load_pack(PACK)
    for row in card["points"][:4]:
        values = {"friction.mu": row["values"]["mu"], "background": row["values"]["background"]}
        alone = gm.run(gm.replace(gm.Experiment(pack, gm.six_signals(), t0=150.0, store=0.2), values))
        kept = gm.load_recall(swept / "points" / f"{row['key']}.h5")
        configuration = kept.configuration
        np.testing.assert_array_equal(kept.p_sig, alone.p_sig)
        again = gm.from_dict(configuration["experiment"])
        assert (again.friction.mu, again.background) == tuple(values.values())


def test_status_show_and_export_tell_the_same(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, swept: Path, tmp_path: Path
) -> None:
    assert gmem(monkeypatch, "sweep", "status", swept, "--json") == 0
    status = said(capsys)
    assert (status["done"], status["failed"]) == (4, 1)
    failed = next(row for row in status["points"] if row["state"] == "failed")
    assert "p_max" in failed["why"]
    assert gmem(monkeypatch, "sweep", "show", swept, "--over", "background", "--json") == 0
    means = said(capsys)["means"]
    assert [row["done"] for row in means] == [2, 2, 0]
    two = [row["fidelity"] for row in status["points"][:2]]
    assert means[0]["fidelity"] == pytest.approx(np.mean(two))
    assert means[0]["fidelity_se"] == pytest.approx(np.std(two, ddof=1) / np.sqrt(2.0))
    for suffix in (".csv", ".parquet", ".nc"):
        assert gmem(monkeypatch, "sweep", "export", swept, "-o", tmp_path / f"table{suffix}") == 0
    with (tmp_path / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [row["mu"] for row in table] == ["0.2", "0.2", "1.0", "1.0", ""]
    assert float(table[0]["fidelity"]) == two[0]
    import pyarrow.parquet
    import xarray

    assert pyarrow.parquet.read_table(tmp_path / "table.parquet").column("fidelity").to_pylist()[0] == two[0]
    with xarray.open_dataset(tmp_path / "table.nc", engine="h5netcdf") as data:
        assert dict(data.sizes) == {"point": 5, "signal": 6, "u": 256}
        kept = gm.load_recall(swept / "points" / f"{data.key.values[0]}.h5")
        np.testing.assert_array_equal(data.p_sig[0], kept.p_sig)
        assert float(data.fidelity[0]) == two[0]
    assert gmem(monkeypatch, "sweep", "export", swept, "-o", tmp_path / "table.csv") == 2
    assert "--force" in capsys.readouterr().err


@pytest.mark.slow
def test_a_longer_sweep_computes_only_what_is_new_and_retries_what_failed(swept: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in (swept / "points").iterdir()}
    (swept.parent / "more.toml").write_text(SWEEP.replace("1.0]", "0.6, 1.0]") + BROKEN)
    command = [sys.executable, "-c", ENTRY, "sweep", str(swept.parent / "more.toml"), "-o", str(swept)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert "2 of 7 points in 2 runs" in done.stderr, done.stderr
    assert before.items() < {path: path.stat().st_mtime_ns for path in (swept / "points").iterdir()}.items()
    again = subprocess.run([*command, "--retry"], capture_output=True, text=True)
    assert "trying 1 failed point again" in again.stderr
    assert again.returncode == 1


def test_workers_that_are_killed_are_replaced_and_change_no_bit(swept: Path, tmp_path: Path) -> None:
    (tmp_path / "mu.toml").write_text(SWEEP)
    command = [sys.executable, "-c", ENTRY, "sweep", str(tmp_path / "mu.toml"), "--executor", "local"]
    with (tmp_path / "log").open("w") as log:
        sweep = subprocess.Popen(command, stdout=log, stderr=log)
    killed = 0
    deadline = time.monotonic() + 240.0
    while sweep.poll() is None:
        assert time.monotonic() < deadline, (tmp_path / "log").read_text()
        # The first worker of submitit, once it has a job: the sweep must go on with another.
        if not killed and list((tmp_path / "mu" / "parts").glob("*")):
            for process in psutil.Process(sweep.pid).children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    if "submitit" in " ".join(process.cmdline()):
                        process.kill()
                        killed += 1
        time.sleep(0.05)
    assert killed
    assert sweep.returncode == 0, (tmp_path / "log").read_text()
    assert "Traceback" not in (tmp_path / "log").read_text()
    for path in (tmp_path / "mu" / "points").iterdir():
        one, other = (gm.load_recall(folder / "points" / path.name) for folder in (tmp_path / "mu", swept))
        np.testing.assert_array_equal(one.p_sig, other.p_sig)
    assert len(list((tmp_path / "mu" / "points").iterdir())) == 4


@pytest.mark.parametrize(
    ("command", "known"),
    [
        (["sweep", "mu.toml"], {"points": 4, "packs": 2, "there": 0, "runs": 4}),
        (["recall", PACK, "--t0", "75", "-o", "r.h5"], {}),
        (["prepare", "--grains", "27", "-o", "p.h5"], {}),
        (["reproduce", "fig09"], {"points": 8, "packs": 0, "there": 0}),
        (["reproduce", "fig03", "--scale", "workstation"], {"points": 0, "packs": 4, "runs": 0}),
        (["reproduce", "fig07"], {"training_seconds": 0.0}),
    ],
    ids=["sweep", "recall", "prepare", "figure", "packs", "drawing"],
)
def test_a_dry_run_tells_the_cost_and_does_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, command: list, known: dict
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mu.toml").write_text('[prepare]\ngrains = 27\n[vary]\nmu = [0.5, 1.0]\n"prepare.seed" = [1, 2]\n')
    assert gmem(monkeypatch, *command, "--dry-run", "--json") == 0
    cost = said(capsys)
    assert known.items() <= cost.items()
    assert ("recall" in command) == (cost.get("stable_step", 0.0) == 2.0)
    if "fig07" not in command:
        assert cost["seconds"] > 0.0
        assert cost["disk_bytes"] > 1e5
        assert gmem(monkeypatch, *command, "--dry-run") == 0
        assert "nothing was run or written" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["mu.toml"]


def test_a_dry_run_makes_nothing_in_a_folder_that_is_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mu.toml").write_text(f'[experiment]\npack = "{TETRA_27}"\n[vary]\nmu = [0.5, 1.0]\n')
    Path("empty").mkdir()
    assert gmem(monkeypatch, "sweep", "mu.toml", "-o", "empty", "--dry-run") == 0
    assert not list(Path("empty").iterdir())
    Path("empty/notes.txt").write_text("mine")
    assert gmem(monkeypatch, "sweep", "mu.toml", "-o", "empty", "--dry-run") != 0
    assert "but holds notes.txt; its files may be" in capsys.readouterr().err


REFUSED = {
    "no such file": ["sweep", "nowhere.toml"],
    "no sweep": ["sweep", "status", "."],
    "no such folder": ["sweep", "show", "nowhere"],
    "name the folder": ["sweep", "status"],
    "neither a sweep file": ["sweep", "recall.h5"],
    "no such figure": ["reproduce", "fig99"],
    "a scale has no field to set by": ["reproduce", "fig06", "--scale", "paper,size=3"],
    "t0 is given twice": ["reproduce", "fig06", "--scale", "laptop,t0=50,t0=60"],
    "should read like timeout_min=240": ["reproduce", "fig06", "--option", "timeout_min"],
    "no option 'mem_gb'": ["reproduce", "fig06", "--option", "mem_gb=1.5"],
    "no option 'timeout_min'": ["reproduce", "fig06", "--dry-run", "--option", "timeout_min=240"],
    "executor must be processes, slurm or local, got 'pbs'": ["reproduce", "fig06", "--dry-run", "--executor", "pbs"],
    "is given twice": ["reproduce", "fig06", "--executor", "slurm", "--option", "a=1", "--option", "a=2"],
}


@pytest.mark.parametrize("problem", REFUSED)
def test_bad_commands_are_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, problem: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert gmem(monkeypatch, *REFUSED[problem]) == 2
    told = capsys.readouterr()
    assert problem in told.err
    assert told.err.count("\n") == 1
    assert told.out == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_packs_are_made_once_for_all_points(tmp_path: Path) -> None:
    (tmp_path / "made.toml").write_text(
        "[prepare]\ngrains = 16\nt0 = 75\n[experiment]\nt0 = 75\n[vary]\nmu = [0.3, 1.0]\n"
        '"prepare.seed" = [1, 2]\n"prepare.shape" = ["sphere"]\n'
    )
    command = [sys.executable, "-c", ENTRY, "sweep", str(tmp_path / "made.toml"), "--json"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "2 packs to be made" in done.stderr
    assert "then 4 points on them, 7 replicas side by side" in done.stderr
    assert "4 of 4 points in 2 runs" in done.stderr
    assert len(list((tmp_path / "made" / "packs").iterdir())) == 2
    again = subprocess.run(command, capture_output=True, text=True)
    assert "nothing to do: 4 of 4 points there" in again.stderr


@pytest.mark.parametrize(
    ("scontrol", "said"),
    [(None, "sbatch is not on the path"), ("echo 'Slurmctld(primary) at n is DOWN'; exit 1", "at n is DOWN")],
)
def test_a_scheduler_that_cannot_be_reached_is_said_before_anything_is_written(
    tmp_path: Path, scontrol: str | None, said: str
) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("sbatch", "scontrol") if scontrol else ():
        (programs / name).write_text(f"#!/bin/sh\n{scontrol}\n")
        (programs / name).chmod(0o755)
    (tmp_path / "mu.toml").write_text(SWEEP)
    command = [sys.executable, "-c", ENTRY, "sweep", str(tmp_path / "mu.toml"), "--executor", "slurm"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PATH": str(programs)})
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "mu").exists()
