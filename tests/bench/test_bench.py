"""The benchmark measures what it says, notices backends that disagree, and prints its ratios."""

import json
from dataclasses import asdict, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import ROOT, TETRA_27

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.bench import gpu, table
from gmem_jax.bench import measure as bench
from gmem_jax.bench.race import Candidate, Row, interleave
from gmem_jax.native.cuda import Needs

PACK = TETRA_27


@pytest.fixture(scope="module")
def pack() -> gm.Pack:
    return gm.load_pack(PACK)


def test_a_row_is_a_measurement_whose_result_backends_share(pack: gm.Pack) -> None:
    rows = [bench.time_rollout(pack, "jax", "H", 2, seconds=0.0)]
    assert rows[0].grains == 27
    assert 0.0 < rows[0].us < 1e3
    assert rows[0].compile_s > 0.0
    if native.available()[0]:
        rows.append(bench.time_rollout(pack, "native", "H", 2, seconds=0.0))
        assert bench.disagreements(rows) == []
    wrong = [*rows[:1], replace(rows[0], engine="native", p_xy=rows[0].p_xy * (1.0 + 1e-3))]
    assert "N = 27, 2 replicas" in bench.disagreements(wrong)[0]


def test_mirrored_copies_are_at_rest_without_the_walls_between_them(pack: gm.Pack) -> None:
    large = bench.tile(pack, (2, 3, 1))
    assert large.grains == 6 * 27
    np.testing.assert_allclose(large.upper, (pack.upper - pack.lower) * jnp.asarray([2.0, 3.0, 1.0]))
    one, many = (bench.encode(p, gm.Hooke(), 1, "jax")[1].grains.acceleration for p in (pack, large))
    # Net forces are those of the pack, to the round-off of a rotation of contacts of some 1e-2 E R^2.
    np.testing.assert_allclose(np.abs(many).max(), np.abs(one).max(), rtol=1e-3, atol=1e-12)
    assert int(np.asarray(large.pairs.valid).sum()) > 6 * int(np.asarray(pack.pairs.valid).sum())


def test_the_table_has_ratios_to_lammps_and_to_the_baseline() -> None:
    rows = [
        Row("native", "H", 325, 8, 0.05, compile_s=1.0),
        Row("native", "H", 325, 1, 0.15, compile_s=1.0),
        Row("lammps", "H", 325, 1, 0.8, note="1 core"),
        Row("lammps", "H", 325, 2, 0.4, note="2 serial runs side by side"),
        Row("lammps", "H", 325, 1, 0.45, note="2 ranks"),
    ]
    rows = [replace(row, median=row.us, worst=1.2 * row.us) for row in rows]
    facts = {
        "repeats": 5,
        "t0": 1.8e3,
        "commit": "0123456789ab",
        "versions": {"jax": "0"},
        "processor": "P",
        "instruction_set": "avx2",
    }
    growth = [asdict(Row("native", "H", n, b, us)) for n, us in ((325, 0.1), (650, 0.13)) for b in (1, 8)]
    result = {
        **facts,
        "repeats": 5,
        "t0": 1.8e3,
        "lammps": "L",
        "rows": [asdict(row) for row in rows],
        "growth": growth,
        "bytes_per_grain_replica": {"H": 1500.0},
        "gradient": {
            "grains": 325,
            "commit": None,
            "t0": 1800.0,
            "forward_s": 5.0,
            "gradient_s": 50.0,
            "forward_bytes": 1e9,
            "gradient_bytes": 2e9,
        },
    }
    before = {"rows": [asdict(replace(row, us=2.0 * row.us)) for row in rows]}
    text = table.markdown(result, before)
    assert "| H | 325 | native | 8 | 0.05 - 0.06 | 8.0 | 1.0 | 2.00 |" in text
    assert "| H | 325 | native | 1 | 0.15 - 0.18 | 3.0 | 1.0 | 2.00 |" in text
    assert "| 650 | 0.13 | 1.30 | 0.13 | 1.30 |" in text
    assert "H 1.50 kB" in text
    assert "ratio 10.0; peak memory of the process 2.00 GB, 1.00 GB before" in text

    line = "| 325 | 0.15 - 0.18 | 0.05 - 0.06 | 0.4 (2 serial runs side by side); 0.45 (2 ranks) | 3.0 / 8.0 |"
    assert line in table.short(result)
    page = table.into("a\n<!-- made by benchmarks/short_table.py -->\nold\n<!-- end -->\nb", table.short(result))
    assert "old" not in page
    assert line in page
    assert page.startswith("a\n")
    assert page.endswith("\nb")


def test_rivals_take_turns_and_the_best_counts() -> None:
    turns: list[str] = []

    def rival(name: str, times: list[float]) -> Candidate:
        left = iter(times)

        def once() -> float:
            turns.append(name)
            return next(left)

        return Candidate(Row(name, "H", 1, 1), once)

    rows = interleave([rival("a", [3.0, 1.0, 2.0]), rival("b", [5.0, 6.0, 4.0])], repeats=3)
    assert turns == list("ababab")
    assert [(row.us, row.median, row.worst) for row in rows] == [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]


@pytest.mark.slow
def test_what_was_measured_is_kept_at_once(pack: gm.Pack) -> None:
    kept: list[int] = []
    result = bench.run_benchmark(
        lambda _: pack,
        ["p"],
        laws=["H", "M1"],
        replicas=[2],
        with_lammps=False,
        with_jax=False,
        scaling=False,
        keep=lambda so_far: kept.append(len(so_far["rows"])),
    )
    assert kept == [1, 2]
    assert "| H | 27 |" in table.markdown(result)


def test_the_page_on_speed_holds_the_table_that_was_measured() -> None:
    page = (ROOT / "docs" / "speed.md").read_text()
    stored = json.loads((ROOT / "benchmarks" / "bench.json").read_text())
    assert page == table.into(page, table.short(stored))


@pytest.mark.slow
def test_a_gradient_is_timed_in_a_process_of_its_own() -> None:
    cost = bench.gradient_cost(gm.load_pack, str(PACK), "auto", values=2, t0=75.0)
    assert 0.0 < cost["forward_s"] < cost["gradient_s"]
    assert 1e7 < cost["forward_bytes"] <= cost["gradient_bytes"] < 1e10


def test_large_histories_are_left_out(pack: gm.Pack) -> None:
    assert bench.fits(pack, "H", 32)
    assert not bench.fits(pack, "M2", 1_000_000)


def test_the_table_of_a_gpu_has_what_was_timed_or_says_that_nothing_was() -> None:
    needs = {"H": {name: (Needs(64, 60), Needs(96, 0)) for name in gpu.ARCHITECTURES}}
    facts = {"registers": needs, "bytes": {"tetra-27": gpu.bytes_per_grain_step(gm.load_pack(PACK))}}
    text = gpu.gpu_markdown(facts, None)
    assert "| H | 64, 60; 96, 0 | 64, 60; 96, 0 | 64, 60; 96, 0 | 64, 60; 96, 0 |" in text
    assert "Not timed: no GPU was at hand." in text
    row = {
        "pack": "tetra-27",
        "engine": "native",
        "law": "H",
        "grains": 27,
        "replicas": 8,
        "us": 2e-3,
        "compile_s": 1.0,
    }
    times = {"device": "G", "versions": {"jax": "0.0"}, "copied_bytes_per_s": 2e12}
    text = gpu.gpu_markdown(facts, {**times, "rows": [row, {**row, "engine": "jax"}]})
    assert "G, JAX 0.0; a copy moves 2000 GB/s" in text
    assert f"| 27 | 8 | H, native | 2.000 | 0.4 | {facts['bytes']['tetra-27']['memory'] / 2.0:.0f} | 1.0 |" in text
    assert "| 27 | 8 | H, jax | 2.000 | 0.4 |  | 1.0 |" in text


def test_bytes_of_a_grain_step_are_those_counted_by_hand() -> None:
    pack = gm.load_pack(PACK)
    count = gpu.bytes_per_grain_step(pack)
    rows = int(np.asarray(pack.pairs.valid).sum()) / 27
    # `touch` reads 12 + 9 numbers and a byte a candidate; `move` reads and writes 9 + 4, writes 12 and reads the bytes.
    # Of a contact three numbers are read and written and six are; half of the candidates touch at most.
    assert 8 * 59 + 2 * rows < count["memory"] < 8 * (59 + 18 * rows / 2) + 2 * rows
    assert count["gathered"] > 8 * 3 * (2 * rows - 4)
    assert count["held"] > count["memory"] / 2


def test_without_a_gpu_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(platform: str) -> None:
        raise RuntimeError(f"no {platform}")

    monkeypatch.setattr(jax, "devices", none)
    with pytest.raises(ValueError, match=r"no CUDA GPU here .with one: pip install 'gmem-jax.cuda13.', or .cuda12. "):
        gpu.device()
