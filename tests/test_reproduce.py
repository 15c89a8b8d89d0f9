"""Figures of the paper: their points, how they stand beside the published ones, and that none is computed twice."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import gmem_jax as gm
from gmem_jax.reproduce import claims, draw, figures
from gmem_jax.reproduce import run as reproducing
from gmem_jax.reproduce.compare import Conditions, Estimate, Point, compare, compared
from gmem_jax.reproduce.draw import power
from gmem_jax.reproduce.figures import FIGURES, SCALES, Figure, packs, scale_of, spec_of
from gmem_jax.simulation.progress import silent
from gmem_jax.sweeps.executors import Executor
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.work import work

PACK = str(Path(__file__).parent / "data" / "tetra-27.h5")
STANDARD = Conditions("H", "tetra", 0.6, 10_240, 1.0, 0.05, 1e-3, 0, "sub0")
TINY = figures.Scale(150.0, 27, 1, 1, (27,), (1,), 1, 5.0)


class Here(Executor):
    """Works in this process."""

    workers = 1

    def start(self, store: Store, name: str) -> None:
        work(store.folder, name)

    def alive(self) -> set[str]:
        return set()

    def stop(self) -> None:
        pass


def test_published_points_are_found_by_their_conditions() -> None:
    there = compared(STANDARD, "F", [0.9], 0)
    assert there.theirs == Estimate(0.8996, 0.0066, 11)
    smaller = compared(replace(STANDARD, grains=3267, mu=1.0), "G", [0.3, 0.32], 0)
    assert smaller.theirs == Estimate(0.3236, 0.0092, 7)
    other_size = compared(replace(STANDARD, grains=1024, mu=0.4), "F", [0.5], 0)
    assert other_size.theirs is not None
    assert (other_size.theirs.mean, other_size.grains) == (0.5295, 10_240)
    assert math.isnan(other_size.errors_apart)  # another N is no comparison
    assert compared(replace(STANDARD, mu=0.3), "F", [0.5], 0).theirs is None
    assert compared(replace(STANDARD, law="M2, paper"), "F", [0.9], 0).theirs.mean == 0.891
    assert compared(replace(STANDARD, law="M2", gamma0=3e-3), "F", [0.9], 0).theirs is None
    word = replace(STANDARD, bits=10, background="sub2-bl")
    assert compared(word, "F", [0.6], 0).theirs.mean == 0.606
    assert compared(word, "accuracy net", [0.8], 0).theirs.mean == 0.829
    assert compared(word, "G", [0.6], 0).theirs is None


def test_a_scale_with_changes() -> None:
    assert scale_of("paper") == SCALES["paper"]
    changed = scale_of("paper,t0=5.4e3,packs=1,lengths=3+4")
    assert changed == replace(SCALES["paper"], t0=5400.0, packs=1, lengths=(3, 4))
    for text, wrong in {
        "poster": "no scale 'poster'; there are laptop, workstation, paper",
        "laptop,t=5": "'t=5' changes nothing of a scale",
        "laptop,packs=1.5": "must be like packs=5",
        "laptop,lengths=3,4": "'4' changes nothing",
        "laptop,lengths=": r"must be like lengths=3\+4\+5",
        "laptop,t0=-1": "must be positive",
        "laptop,t0=nan": "must be positive",
    }.items():
        with pytest.raises(ValueError, match=wrong):
            scale_of(text)


def test_differences_are_in_units_of_the_combined_error() -> None:
    # Two packs: standard error 0.01 / sqrt(2); published: 0.0066 / sqrt(11).
    row = compared(STANDARD, "F", [0.91, 0.92], 0)
    assert row.errors_apart == pytest.approx((0.915 - 0.8996) / math.hypot(0.01 / 2.0, 0.0066 / math.sqrt(11.0)))
    # One pack scatters as the published packs do.
    alone = compared(STANDARD, "F", [0.91], 0)
    assert alone.errors_apart == pytest.approx((0.91 - 0.8996) / math.hypot(0.0066, 0.0066 / math.sqrt(11.0)))


def test_fast_drives_count_after_averaging_over_the_ringing() -> None:
    numbers = {"gain": 0.3, "fidelity": 0.8, "windowed_gain": 0.31, "windowed_fidelity": 0.9, "status": 4}
    found = [{row.measure: row for row in compare([Point(STANDARD, numbers, "k")], t0)} for t0 in (1.8e3, 1.8e4)]
    assert [rows["F"].ours.mean for rows in found] == [0.9, 0.8]
    assert [rows["G"].ours.mean for rows in found] == [0.31, 0.3]
    assert found[0]["F"].status == 4


def test_so_do_words_by_every_background() -> None:
    of = {"gain": 0.3, "fidelity": 0.72, "windowed_gain": 0.31, "windowed_fidelity": 0.78}
    numbers = {**of, "status": 0, "backgrounds": {"sub0": {**of, "windowed_fidelity": 0.77}, "sub2-bl": of}}
    words = replace(STANDARD, bits=3, background="sub2-bl")
    for t0, expected in ((5.4e3, {"sub0": 0.77, "sub2-bl": 0.78}), (1.8e4, {"sub0": 0.72, "sub2-bl": 0.72})):
        rows = [row for row in compare([Point(words, numbers, "k")], t0) if row.measure == "F"]
        assert {row.conditions.background: row.ours.mean for row in rows} == expected


def test_the_exponent_of_a_power_law() -> None:
    exact = {n: Estimate(0.2 * n**0.08, math.nan, 1) for n in (325, 1024, 3267)}
    exponent, error = power(exact)
    assert exponent == pytest.approx(0.08)
    assert math.isnan(error)
    assert all(map(math.isnan, power({325: Estimate(0.2, 0.1, 4)})))
    # Two sizes: the difference of two logarithms, with their relative errors 0.03 and 0.04 in quadrature.
    exponent, error = power({100: Estimate(0.2, 0.012, 4), 10000: Estimate(0.3, 0.024, 4)})
    assert exponent == pytest.approx(math.log(1.5) / math.log(100.0))
    assert error == pytest.approx(0.05 / math.log(100.0))
    # What is known badly hardly counts.
    exponent, _ = power(
        {**exact, 10240: Estimate(0.8, 8.0, 4)} | {n: e._replace(sd=1e-4, packs=4) for n, e in exact.items()}
    )
    assert exponent == pytest.approx(0.08, abs=1e-6)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_has_points_and_no_point_twice(name: str, scale: str) -> None:
    points = spec_of(FIGURES[name], SCALES[scale]).extra
    rows = [tuple(sorted(values.items())) for values in points]
    assert rows
    assert len(set(rows)) == len(rows)


def test_shipped_packs_come_first_and_only_where_they_fit() -> None:
    laptop = SCALES["laptop"]
    assert [row["pack"] for row in packs(laptop, 325, 5)] == [f"tetra-325-{letter}" for letter in "abcde"]
    more = packs(laptop, 3267, 5)
    assert more[3] == {"pack": "tetra-3267-d"}
    assert [row["prepare.seed"] for row in more[4:]] == [101]
    large = packs(laptop, 10240, 3)
    assert large[:2] == [{"pack": "tetra-10240-d"}, {"pack": "tetra-10240-e"}]  # k_H was calibrated on a, b and c
    assert "pack" not in large[2]
    assert "pack" not in packs(laptop, 325, 1, delta0=0.02)[0]
    assert packs(laptop, 325, 1, shape="sphere")[0]["prepare.shape"] == "sphere"


def test_single_precision_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with jax.enable_x64(False), pytest.raises(ValueError, match="float64 is needed"):
        reproducing.reproduce("fig06", tmp_path / "out")
    assert not any(tmp_path.iterdir())


def test_a_figure_is_run_drawn_tabled_and_not_run_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def points(scale: figures.Scale) -> list[figures.Values]:
        return [{"pack": PACK, "mu": mu} for mu in (0.5, 1.0)]

    monkeypatch.setitem(FIGURES, "fig08", Figure("friction", points, ("mu",)))
    monkeypatch.setitem(FIGURES, "fig06", Figure("one", lambda scale: points(scale)[1:]))
    monkeypatch.setitem(SCALES, "tiny", TINY)
    monkeypatch.setattr(reproducing, "quick_cost", lambda points: 1e-7)
    said: list[str] = []
    outcome = reproducing.reproduce("fig08", tmp_path, "tiny", Here(), silent, said.append)
    assert [path.name for path in outcome.files] == ["fig08-tiny.png", "fig08-tiny.svg", "fig08-tiny.csv"]
    assert all(path.stat().st_size > 200 for path in outcome.files)
    with (tmp_path / "fig08-tiny.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [(row["mu"], row["measure"]) for row in table] == [(mu, m) for mu in ("0.5", "1") for m in "FG"]
    recall = gm.run(gm.Experiment(gm.load_pack(PACK), gm.six_signals(), gm.Hooke(mu=0.5), t0=150.0))
    np.testing.assert_allclose(float(table[0]["mean"]), float(recall.windowed_fidelity), rtol=1e-5)
    assert float(table[2]["published_mean"]) == 0.8996
    assert "2 of 2 points" in said[0]
    reproducing.reproduce("fig06", tmp_path, "tiny", Here(), silent, said.append)
    assert said[1:] == ["all 1 points are there"]
    assert (tmp_path / "fig06-tiny.svg").is_file()


def test_each_condition_that_is_varied_has_its_line_of_panels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    at = [replace(STANDARD, delta0=delta0, gamma0=gamma0) for delta0 in (0.02, 0.05) for gamma0 in (3e-4, 1e-3)]
    at += [replace(STANDARD, overlap=0.8), replace(STANDARD, shape="sphere", overlap=1.0)]
    rows = [compared(each, measure, [0.3, 0.4], 0) for each in at for measure in "FG"]
    drawn: list[Any] = []
    monkeypatch.setattr(draw, "save", lambda path, figure, also: drawn.append(figure))
    draw.against(tmp_path / "fig11.png", rows, ("gamma0", "overlap"), "title")
    panels = [
        {tuple(line.get_xdata()) for line in axis.get_lines() if line.get_linestyle() == "-"} for axis in drawn[0].axes
    ]
    assert panels == [{(3e-4, 1e-3)}, {(3e-4, 1e-3)}, {(0.6, 0.8, 1.0)}, {(0.6, 0.8, 1.0)}]
    assert [len(axis.get_legend().get_texts()) for axis in drawn[0].axes] == [3, 3, 2, 2]  # and the published points
    draw.against(tmp_path / "fig08.png", rows[:2], ("mu",), "one point")
    assert len(drawn[1].axes) == 2


@pytest.mark.parametrize("name", ["fig04", "fig13", "fig14"])
def test_pictures_of_recalls_and_words(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str) -> None:
    values = {"pack": PACK, "signals": "words:1", "background": "sub2-bl"} if name != "fig04" else {"pack": PACK}
    monkeypatch.setitem(FIGURES, name, FIGURES[name]._replace(points=lambda scale: [values]))
    monkeypatch.setitem(SCALES, "tiny", TINY)
    monkeypatch.setattr(reproducing, "quick_cost", lambda points: 1e-7)
    outcome = reproducing.reproduce(name, tmp_path, "tiny", Here(), silent, lambda line: None)
    assert all(path.stat().st_size > 200 for path in outcome.files)
    if name == "fig14":
        read = {row.measure: row.ours.mean for row in outcome.rows if row.measure.startswith("accuracy")}
        assert read.keys() == {"accuracy net", "accuracy nearest template", "accuracy linear decoder"}
        assert set(read.values()) <= {0.0, 0.5, 1.0}


def test_the_physics_gives_the_stored_numbers() -> None:
    """As when k_H was calibrated. Compilers and instruction sets move p_sig by 1e-9 of itself."""
    recall = gm.run(gm.Experiment(gm.load_pack("tetra-325-a"), gm.six_signals()))
    stored = (0.261164, 0.657920, 0.659413)
    found = (recall.gain, recall.fidelity, recall.windowed_fidelity)
    np.testing.assert_allclose([float(number) for number in found], stored, atol=1e-6)


@pytest.mark.slow
def test_claims_are_judged_by_their_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(SCALES, "tiny", TINY)
    monkeypatch.setattr(reproducing, "packs", lambda *_, **__: [{"pack": PACK}])
    monkeypatch.setattr(reproducing, "quick_cost", lambda points: 1e-7)
    found = reproducing.judge(tmp_path, "tiny", Here(), silent, lambda line: None)
    assert [row["claim"] for row in json.loads((tmp_path / "claims-tiny.json").read_text())] == [v.claim for v in found]
    assert len(found) == 8
    by_claim = {verdict.claim: verdict for verdict in found}
    order = by_claim["shear before the compression leaves no waveform"]
    before = gm.run(gm.Experiment(gm.load_pack(PACK), gm.six_signals(), t0=150.0, shear="before"))
    assert order.values["G"] == float(before.windowed_gain)
    moved = by_claim["tetra grains rearrange less than spheres, and less than without friction"].values
    assert 0.0 < moved["tetra"] == moved["sphere"] < moved["tetra without friction"]


def test_a_claim_that_fails_is_said_to() -> None:
    pack = gm.load_pack(PACK)
    experiment = gm.Experiment(pack, gm.six_signals(), t0=150.0)
    recall, scale = gm.run(experiment), float(experiment.scale)
    assert not claims.order_matters(recall, recall, scale).holds
    assert claims.order_matters(recall, replace(recall, p_sig=0.0 * recall.p_sig), scale).holds
    offset = replace(recall, p_sig=0.0 * recall.p_sig + 1e-6)  # the same at every u: no waveform
    assert claims.order_matters(recall, offset, scale).holds
    louder = replace(recall, windowed_gain=1.2 * recall.windowed_gain)
    assert not claims.proportional({1e-3: recall, 3e-3: louder}).holds
    assert claims.proportional({1e-3: recall, 3e-3: recall}).holds
    worse = replace(recall, windowed_fidelity=recall.windowed_fidelity - 0.03)
    assert not claims.storage_costs_nothing({0.5: recall, 2.0: worse}).holds
