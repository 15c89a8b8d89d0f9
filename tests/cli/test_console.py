"""What is said while a command runs."""

from collections.abc import Iterator

import pytest
from rich.console import Console
from rich.table import Table

from gmem_jax.command import console
from gmem_jax.show import tables


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """The time that the console reads, to be set."""
    now = [0.0]
    monkeypatch.setattr(console.time, "perf_counter", lambda: now[0])
    return now


def test_a_second_pass_has_a_time_left_of_its_own(clock: list[float], capsys: pytest.CaptureFixture) -> None:
    """A sweep counts its packs from 0 to 1, and then its points: the hours of the one are none of the other's."""
    with console.reporting() as progress:
        for pass_, seconds in (("packs", 1000.0), ("points", 10.0)):
            for hundredth in range(101):
                progress(pass_, 0.0, hundredth / 100)
                clock[0] += seconds
    said = [line for line in capsys.readouterr().err.splitlines() if "left" in line]
    packs, points = ([line for line in said if name in line] for name in ("packs", "points"))
    assert "  50%  packs, 50000 s left" in packs
    assert "  51%  points, 490 s left" in points


def test_a_guess_that_was_mended_keeps_the_time_so_far(clock: list[float], capsys: pytest.CaptureFixture) -> None:
    """Where a pack has come to rest it is known what is left: a little more than was thought, at the same pace."""
    with console.reporting() as progress:
        for stage, fractions in (("settle", range(65)), ("cycle", range(62, 101))):
            for hundredth in fractions:
                progress(stage, 0.0, hundredth / 100)
                clock[0] += 10.0
    said = [line for line in capsys.readouterr().err.splitlines() if "cycle" in line]
    assert said[0] == "  62%  cycle, 398 s left"  # 650 s for 62 %


def test_a_pause_is_no_work(clock: list[float], capsys: pytest.CaptureFixture) -> None:
    """A run that was stopped for a day, and goes on."""
    with console.reporting() as progress:
        for hundredth in range(101):
            progress("encode", 0.0, hundredth / 100)
            clock[0] += 86400.0 if hundredth == 50 else 10.0
    said = [line for line in capsys.readouterr().err.splitlines() if "left" in line]
    assert "  48%  encode, 520 s left" in said
    assert "  51%  encode, 480 s left" in said  # 500 s of work for 51 %


ROW = {
    "pack": "tetra-325-a",
    "gain": 0.2591,
    "fidelity": 0.6581,
    "windowed_gain": 0.2612,
    "windowed_fidelity": 0.9013,
    "ringing_period": 39.7,
    "status_names": "not at rest, ringing",
}
CONDITIONS = {"mu": 1.0, "gamma0": 1e-3, "delta0": 0.05, "t0": 1800.0, "friction": "hooke"}


@pytest.mark.parametrize("columns", ["", "1"])
@pytest.mark.parametrize("width", [1, 20, 40, 80, 200])
def test_no_number_of_a_table_is_cut_however_narrow_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, width: int, columns: str
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr(console, "out", Console(highlight=False, markup=False, width=width))
    other = Table("name", "value")
    other.add_row("a long name", "123456789.25")
    console.print_result(False, {}, tables.recall_table([ROW, ROW], CONDITIONS), other)
    said = capsys.readouterr().out
    for number in ("0.259", "0.658", "0.261", "0.901", "40", "123456789.25"):
        assert f" {number} " in said


@pytest.mark.parametrize("width", [40, 60, 80])
def test_a_table_is_no_wider_than_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, width: int
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(console, "out", Console(highlight=False, markup=False))
    console.print_result(False, {}, tables.recall_table([ROW, {**ROW, "gain": 0.1234}], CONDITIONS))
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= width
    assert said.count("Recall of the waveforms") == 1
    assert " ".join(said.split()).count("t0 = 1800") == 1  # the caption
    for number in ("0.259", "0.123", "0.658", "0.261", "0.901", "40"):
        assert f" {number} " in said
