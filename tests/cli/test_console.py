"""What is said while a command runs."""

from collections.abc import Iterator

import pytest

from gmem_jax.command import console


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
