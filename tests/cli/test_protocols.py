"""Protocols of one's own at the command line: recalls, sweeps, and whatever shows several reads and channels."""

import json
import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import gmem
from test_cli import PACK

import gmem_jax as gm
from gmem_jax.command.classify import _chosen
from gmem_jax.experiment import analysis
from gmem_jax.experiment.cost import steps_of_grains
from gmem_jax.files.sizes import recall_bytes
from gmem_jax.reading.readers import stored_words
from gmem_jax.show import tables
from gmem_jax.show.numbers import summary
from gmem_jax.show.recalls import recall_figure
from gmem_jax.show.summaries import of_recall
from gmem_jax.sweeps.plan import plan, point
from gmem_jax.sweeps.spec import spec_of
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.sweep import SweepRunner
from gmem_jax.sweeps.table import export_table, points_in, rows

ONE = gm.words(1)
SILENT = gm.Bumps(jnp.zeros((2, 1)), jnp.full((2, 1), 0.5), 0.6)
TWO = gm.Protocol(gm.write(), gm.read("one", to=0.5, length=0.5), gm.read("two", length=0.5))
MINE = """
[[stage]]
kind = "write"
xy = "first"
[[stage]]
kind = "hold"
length = 0.1
[[stage]]
kind = "read"
[signals]
first = "words:1"
"""
QUICK = ("--t0", "20", "--gamma0", "0.01", "--no-picture")


@pytest.fixture(scope="module")
def several() -> gm.Recall:
    """A recall of two reads and two channels; nothing was written on z."""
    experiment = gm.Experiment(gm.load_pack(PACK), gm.signals(xy=ONE, z=SILENT), protocol=TWO, t0=20.0, gamma0=0.01)
    return gm.run(experiment, progress=False)


def cells(table: Any) -> list[tuple[str, ...]]:
    return list(zip(*(map(str, column.cells) for column in table.columns), strict=True))


def test_an_accuracy_that_is_asked_for_chooses_the_drive(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    usual = gm.Experiment(gm.load_pack(PACK), gm.six_signals())
    wanted = ["recall", PACK, "-o", tmp_path / "a.h5", "--json", "--dry-run"]
    costs = []
    for options in ([], ["--accuracy", 0.1]):
        assert gmem(monkeypatch, *wanted, *options) == 0
        costs.append(json.loads(capsys.readouterr().out)["grain_steps"])
    assert costs == [steps_of_grains(one, 6) for one in (usual, gm.at_accuracy(usual, 0.1))]
    assert costs[0] != costs[1]


def test_a_protocol_in_a_file_is_recalled_and_its_cost_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    mine, target = tmp_path / "mine.toml", tmp_path / "mine.h5"
    mine.write_text(MINE)
    assert gmem(monkeypatch, "recall", PACK, "--protocol", mine, "-o", target, "--json", "--dry-run", *QUICK) == 0
    cost = json.loads(capsys.readouterr().out)
    steps = gm.Experiment(gm.load_pack(PACK), ONE, t0=20.0).timing.steps
    assert cost["grain_steps"] == 27 * steps * 3 * (256 + 26 + 256)  # no prefix: all stages have all replicas
    assert gmem(monkeypatch, "recall", PACK, "--protocol", mine, "-o", target, "--json", *QUICK) == 0
    said, recall = json.loads(capsys.readouterr().out), gm.load_recall(target)
    assert [stage.name for stage in recall.protocol] == ["write", "hold", "read"]
    assert recall.protocol == gm.load_protocol(mine).with_sets(["first"])
    assert said["gain"] == float(recall.gain)
    assert "each" not in said
    assert "published" not in str(cells(tables.recall_table([said], recall.configuration)))
    assert tables.conditions(recall.configuration).endswith("stages write, hold, read")


REFUSED = {
    "--store does nothing with --protocol": ["--protocol", "mine.toml", "--store", "2"],
    "--signals does nothing beside [signals] in mine.toml": ["--protocol", "mine.toml", "--signals", "six"],
    "must be a .toml file": ["--protocol", "mine"],
    "no such file": ["--protocol", "other.toml"],
    "exists; name another": ["--protocol", "mine.toml", "-o", "there.h5"],
    "needs one read, one channel and one set of waveforms; there are reads read, read-2": ["--protocol", "two.toml"],
}


@pytest.mark.parametrize("reason", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, reason: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(MINE)
    Path("two.toml").write_text(MINE.replace("[signals]", '[[stage]]\nkind = "read"\nto = 1.0\n[signals]'))
    Path("there.h5").touch()
    command = "gradient" if "two.toml" in REFUSED[reason] else "recall"
    assert gmem(monkeypatch, command, PACK, *REFUSED[reason]) == 2
    said = capsys.readouterr().err
    assert reason in said
    assert len(said.strip().splitlines()) == 1
    assert len(list(tmp_path.iterdir())) == 3


def test_every_read_and_channel_has_a_row(several: gm.Recall) -> None:
    summary = of_recall(several, "a.h5", each=True)
    table, gains, signals = summary.lines[:3]
    assert [row[1:3] for row in cells(table)] == [("one", "xy"), ("one", "z"), ("two", "xy"), ("two", "z")]
    assert [row[3] for row in cells(table)] == [
        f"{float(several.gain[0, 0, 0]):.3f}",
        "-",
        f"{float(several.gain[1, 0, 0]):.3f}",
        "-",
    ]
    assert [row[0] for row in cells(table)] == ["tetra-27", "", "", ""]
    cross = np.asarray(several.gain)[:, :, 0].ravel()
    assert [row[2:] for row in cells(gains)] == [(f"{value:.3f}", "-") for value in cross]
    assert len(cells(signals)) == 4 * 2
    facts = json.loads(json.dumps(summary.facts))
    assert np.shape(facts["gain"]) == (2, 2, 2)
    assert facts["each"][2]["gains"]["xy"] == float(several.gain[1, 0, 0])
    assert facts["each"][2]["fidelity"] == float(several.at("two", "xy").fidelity)
    assert [len(row) for row in cells(tables.errors_table(several))] == [5] * 8


def test_every_read_and_channel_is_drawn(several: gm.Recall) -> None:
    whole, one = recall_figure(several), recall_figure(several.at("two", "z"))
    assert [panel.title for panel in whole.panels][::2] == [
        f"{place}, signal 1" for place in ("one, xy", "one, z", "two, xy", "two, z")
    ]
    assert [panel.title for panel in one.panels] == ["signal 1", "signal 2"]
    np.testing.assert_array_equal(whole.panels[6].curves[0].y, one.panels[0].curves[0].y)
    assert len(recall_figure(several, "all").panels) == 8
    assert len(recall_figure(several, signals=[2]).panels) == 4
    names = of_recall(several).figures
    assert {"signals/one/xy", "all/two/z"} <= set(names)
    assert names["signals/two/z"]().panels[0].title == "signal 1"
    gm.plot(several)._repr_png_()
    parts = [part.heading for part in of_recall(several).parts() if part.heading.startswith("Recalled")]
    assert parts == [f"Recalled signals, {read}, {channel}" for read in ("one", "two") for channel in ("xy", "z")]


def test_words_of_one_read_and_channel_are_read(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, several: gm.Recall
) -> None:
    with pytest.raises(ValueError, match=r"choose one of each, as recall.at\('two', 'z'\)"):
        stored_words(several)
    whole = gm.Protocol(gm.write(), gm.read(), gm.write("xy", name="again"), gm.read())
    experiment = gm.Experiment(gm.load_pack(PACK), ONE, protocol=whole, t0=20.0, gamma0=0.01)
    recall = gm.run(experiment, progress=False)
    stored = stored_words(recall.at("read"))
    assert (stored.bits, stored.background) == (1, "sub0")  # the second read is none for the background of the first
    np.testing.assert_array_equal(stored.signals, recall.p_sig[0])
    gm.save_recall(tmp_path / "a.h5", recall)
    assert gmem(monkeypatch, "classify", tmp_path / "a.h5", "-o", tmp_path / "out.json") == 2
    assert "say --read, one of read, read-2" in capsys.readouterr().err
    chosen = _chosen(several, tmp_path / "b.h5", "two", "z")
    np.testing.assert_array_equal(chosen.p_sig, several.at("two", "z").p_sig)


def test_backgrounds_are_those_of_the_channel() -> None:
    protocol = gm.Protocol(gm.write(z="xy"), gm.read(), gm.compress(1.0), gm.read())
    experiment = gm.Experiment(gm.load_pack(PACK), ONE, protocol=protocol, background="sub2", t0=20.0, gamma0=0.01)
    recall = gm.run(experiment, progress=False)
    found = summary(recall)["backgrounds"]["sub2"]
    assert found["gain"] == pytest.approx(float(recall.gain), rel=1e-9)
    assert found["fidelity"] == pytest.approx(float(recall.fidelity), rel=1e-9)
    assert recall.channels == ("z",)


SWEEP = {
    "experiment": {"pack": str(PACK), "t0": 20.0, "gamma0": 0.01, "signals": "xy=words:1"},
    "vary": {"protocol.hold.length": [0.1, 0.2], "mu": [0.5, 1.0]},
    "protocol": {"stage": [{"kind": "write"}, {"kind": "hold"}, {"kind": "read"}]},
}


def test_sweeps_vary_what_a_stage_has(tmp_path: Path) -> None:
    runner = SweepRunner(spec_of(SWEEP), tmp_path / "swept", lambda _: None)
    runner.check()
    points = runner.points()
    assert [one.experiment.protocol.stages[1].length for one in points] == [0.1, 0.1, 0.2, 0.2]
    assert len({one.key for one in points}) == 4
    jobs = plan(points, set(), 10**9)
    assert sorted(len(job.points) for job in jobs) == [2, 2]  # what differs in its stages runs by itself
    inside: dict[str, Any] = {**SWEEP["experiment"], "protocol": "mine.toml"}
    with pytest.raises(ValueError, match=r"in \[protocol\] or in \[experiment\], not in both"):
        spec_of({**SWEEP, "experiment": inside})
    for values, reason in (
        ({"protocol.hold.lenght": [1.0]}, "a stage has no 'lenght'"),
        ({"protocol.hold.length": ["long"]}, "length must be a number"),
        ({"store": [1.0]}, "store does nothing: stages of the protocol say that"),
    ):
        with pytest.raises(ValueError, match=reason):
            SweepRunner(spec_of({**SWEEP, "vary": values}), tmp_path / "other", lambda _: None).check()


def test_tables_of_sweeps_have_a_row_for_each_read_and_channel(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, several: gm.Recall
) -> None:
    xarray = pytest.importorskip("xarray")
    experiment = gm.Experiment(gm.load_pack(PACK), gm.signals(xy=ONE, z=SILENT), protocol=TWO, t0=20.0, gamma0=0.01)
    store = Store(tmp_path / "swept")
    points = [point({"mu": mu}, gm.replace(experiment, {"friction.mu": mu})) for mu in (0.5, 1.0, 0.2)]
    store.write_manifest(points, {}, ["mu"])
    for one in points[:2]:
        store.save(one.key, several)
    table = rows(store)
    assert [(row["read"], row["channel"]) for row in table[:4]] == [
        ("one", "xy"),
        ("one", "z"),
        ("two", "xy"),
        ("two", "z"),
    ]
    assert len(table) == 4 + 4 + 1
    assert len(points_in(table)) == 3
    assert table[2]["gain"] == float(several.gain[1, 0, 0])
    assert gmem(monkeypatch, "sweep", "show", store.folder, "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["done"], said["open"], said["points"][1]["gain"]) == (2, 1, None)
    assert gmem(monkeypatch, "sweep", "show", store.folder, "--over", "mu") == 0
    assert len(re.findall(r"│ (?:one|two) +│ (?:xy|z) ", capsys.readouterr().out)) == 4
    export_table(store, tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as data:
        np.testing.assert_array_equal(data.p_sig[2], several.at("two", "xy").p_sig)
        assert list(data.channel.values[:2]) == ["xy", "z"]


def test_the_size_of_a_file_counts_reads_channels_and_what_is_recorded(several: gm.Recall, tmp_path: Path) -> None:
    experiment = gm.Experiment(gm.load_pack(PACK), gm.signals(xy=ONE, z=SILENT), protocol=TWO, t0=20.0, gamma0=0.01)
    gm.save_recall(tmp_path / "a.h5", several)
    assert 0.8 < recall_bytes(experiment) / (tmp_path / "a.h5").stat().st_size < 1.25
    quiet = gm.replace(experiment, {"protocol.write.recorded": False})
    assert recall_bytes(quiet) < 0.8 * recall_bytes(experiment)


def test_the_papers_recall_is_told_as_before(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    row = summary(recalled[1])
    assert list(row)[:6] == ["pack", "grains", *analysis.MEASURES]
    assert not {"each", "reads", "channels"} & set(row)
    assert [str(column.header) for column in tables.recall_table([row], recalled[1].configuration).columns] == [
        "pack",
        "G",
        "F",
        "G over T1",
        "F over T1",
        "T1 (t_c)",
        "status",
    ]
