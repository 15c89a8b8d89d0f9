"""What a sweep file may say, how its points become runs, and what is refused in one line."""

import csv
import os
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.experiment.changes import value_at
from gmem_jax.experiment.pack_warnings import OtherCompressionWarning, warn_of_another_compression
from gmem_jax.files.atomic import atomic
from gmem_jax.show.numbers import status_words
from gmem_jax.show.sweeps import points_table
from gmem_jax.simulation.progress import silent
from gmem_jax.sweeps.executors import Executor, Submitted, executor
from gmem_jax.sweeps.plan import digest, plan, point
from gmem_jax.sweeps.spec import read_spec, spec_of
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.sweep import SweepRunner, _labels
from gmem_jax.sweeps.table import export_table, means, rows, warnings_of
from gmem_jax.sweeps.work import parts_of_job, run_group

PACK = TETRA_27
MEMORY = 1 << 33


def runner(folder: Path, **tables: object) -> SweepRunner:
    return SweepRunner(spec_of(tables), folder / "store", lambda _: None)


def run_job(name: str, points: list[str]) -> dict[str, Any]:
    """A job as it lies in a store, of experiments that are never made."""
    sizes = {"work": 1.0, "replicas": 1, "batch": 1}
    return {"kind": "run", "name": name, "points": points, "configurations": [{}] * len(points), **sizes}


def test_combinations_are_products_of_axes_and_single_points() -> None:
    spec = spec_of(
        {
            "experiment": {"t0": 360.0},
            "vary": {"mu": [0.1, 0.2], "gamma0": {"from": 1e-3, "to": 1e-1, "count": 3, "factors": True}},
            "zip": [{"delta0": [0.04, 0.05], "store": [1.0, 2.0]}],
            "points": [{"mu": 7.0}],
            "prepare": {"grains": 64},
        }
    )
    points = list(spec.combinations())
    assert len(points) == 2 * 3 * 2 + 1
    assert points[0] == {"mu": 0.1, "gamma0": 1e-3, "delta0": 0.04, "store": 1.0}
    assert points[1] == {"mu": 0.1, "gamma0": 1e-3, "delta0": 0.05, "store": 2.0}
    assert points[2]["gamma0"] == pytest.approx(1e-2)
    assert points[-1] == {"mu": 7.0}
    assert spec.shared == {"t0": 360.0, "prepare.grains": 64}
    assert spec.names == ["mu", "gamma0", "delta0", "store"]
    even = spec_of({"vary": {"mu": {"from": 0.0, "to": 1.0, "count": 5}}})
    assert [one["mu"] for one in even.combinations()] == [0.0, 0.25, 0.5, 0.75, 1.0]


@pytest.mark.parametrize(
    ("axis", "values"),
    [
        ({"from": 0.2, "to": 1.0, "count": 5}, [0.2, 0.4, 0.6, 0.8, 1.0]),
        ({"from": -0.1, "to": 0.2, "count": 4}, [-0.1, 0.0, 0.1, 0.2]),
        ({"from": 1, "to": 1000, "count": 4, "factors": True}, [1.0, 10.0, 100.0, 1000.0]),
        ({"from": 1e-4, "to": 1.6e-3, "count": 5, "factors": True}, [1e-4, 2e-4, 4e-4, 8e-4, 1.6e-3]),
    ],
)
def test_values_of_a_grid_are_those_that_were_asked_for_and_no_neighbours(axis: dict, values: list[float]) -> None:
    spec = spec_of({"vary": {"mu": axis}})
    assert [one["mu"] for one in spec.combinations()] == values


BAD = {
    "[vary]\nmu = []": "mu: the list is empty",
    "[vary]\nmu = 0.3": "mu: give a list",
    "[vary]\nmu = {from = 0, to = 1}": "from, to and count",
    "[vary]\nmu = {from = 0, to = 1, count = 3, factors = true}": "positive",
    "[[zip]]\nmu = [1, 2]\ngamma0 = [1e-3]": "differ in length",
    "[vary]\nmu = [1.0]\n[[zip]]\nmu = [1.0]": "varies twice",
    "[varied]\nmu = [1.0]": "no table 'varied'",
    "[experiment]\nmu = 1.0": "nothing varies",
    "mu = [": "not TOML",
    "[vary]\nmu = {from = 0, to = 1, count = 100000000}": "must be a whole number from 2 to 100000, got 100000000",
    "[vary]\nmu = {from = 0, to = 1, count = 1}": "count must be a whole number from 2 to 100000, got 1",
    "[vary]\nmu = {from = true, to = 1, count = 2}": "mu: from and to must be numbers, got True and 1",
    "[vary]\nmu = {from = 0, to = '1', count = 2}": "mu: from and to must be numbers",
    "[vary]\nmu = {from = 1, to = 2, count = 3, factors = 1}": "factors must be true or false",
    "[experiment]\nmu = 1.0\n[vary]\nmu = [0.5, 1.0]": "mu varies, so that its value in [experiment]",
    "[experiment]\nt0 = 60\n[[zip]]\nmu = [1, 2]\nt0 = [60, 90]": "t0 varies",
    "[experiment]\nmu = 1.0\n[[points]]\nmu = 2.0": "mu varies",
    "[prepare]\nseed = 1\n[vary]\n'prepare.seed' = [1, 2]": "prepare.seed varies",
    "[experiment]\n'prepare.seed' = 1\n[prepare]\nseed = 2\n[vary]\nmu = [1]": "in [prepare] or in [experiment]",
    "vary = 3": "must be a table",
    "points = 3": "must be tables",
}


@pytest.mark.parametrize(("text", "problem"), BAD.items(), ids=range(len(BAD)))
def test_bad_files_are_refused_with_what_is_wrong(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(gm.FileFormatError, match=r"bad\.toml: ") as refused:
        read_spec(tmp_path / "bad.toml")
    assert problem in str(refused.value)


UNKNOWN = {
    "colour": ({"vary": {"colour": [1]}}, "no 'colour'"),
    "preparation": ({"vary": {"prepare.colour": [1]}}, "no 'colour'"),
    "both": ({"experiment": {"pack": "tetra-325-a"}, "vary": {"prepare.seed": [1]}}, "give one of them"),
    "law": ({"experiment": {"pack": str(PACK), "friction": "H3"}, "vary": {"mu": [1.0]}}, "friction must be one of"),
    "range": ({"experiment": {"pack": str(PACK)}, "vary": {"mu": [1.0, -1.0]}}, "mu must be"),
    "shape": ({"vary": {"prepare.shape": ["cube"]}}, "tetra or sphere"),
    "grains": ({"vary": {"prepare.grains": [2]}}, "at least 12"),
    "true": ({"experiment": {"pack": str(PACK)}, "vary": {"mu": [True]}}, "mu must be a number, got true"),
    "text": ({"experiment": {"pack": str(PACK)}, "vary": {"mu": ["0.5"]}}, 'mu must be a number, got "0.5"'),
    "word": ({"experiment": {"pack": str(PACK)}, "vary": {"background": [1]}}, "background must be a text, got 1"),
    "pack": ({"vary": {"pack": [1]}}, "pack must be a text, got 1"),
    "part": ({"experiment": {"pack": str(PACK)}, "vary": {"steps": [2.5]}}, "steps must be a whole number, got 2.5"),
    "flag": (
        {"experiment": {"pack": str(PACK), "scale": 1}, "vary": {"mu": [1]}},
        "scale must be true or false, got 1",
    ),
    "recipe": ({"vary": {"prepare.delta0": ["0.05"]}}, 'prepare.delta0 must be a number, got "0.05"'),
    "seeds": ({"vary": {"prepare.seed": [True]}}, "prepare.seed must be a whole number, got true"),
    "large seeds": ({"vary": {"prepare.seed": [1 << 63]}}, r"seed must be in \[0, 9007199254740991\], got 92233"),
    "spheres": ({"prepare": {"shape": "sphere", "overlap": 0.3}, "vary": {"mu": [1]}}, "overlap does nothing"),
    "dt": ({"experiment": {"pack": str(PACK), "dt": 0.2, "steps": 30}, "vary": {"mu": [1]}}, "dt does nothing"),
    "two names": (
        {"experiment": {"pack": str(PACK), "mu": 0.2}, "vary": {"friction.mu": [1]}},
        "mu and friction.mu are one",
    ),
    "samples": ({"experiment": {"pack": str(PACK), "smooth": 0.1}, "vary": {"mu": [1]}}, "for samples in a file only"),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_impossible_points_are_refused_before_anything_is_computed(tmp_path: Path, name: str) -> None:
    tables, problem = UNKNOWN[name]
    with pytest.raises(ValueError, match=problem):
        runner(tmp_path, **tables).check()


def test_a_sweep_is_utf_8_with_or_without_a_byte_order_mark(tmp_path: Path) -> None:
    text = '# größe\n[experiment]\nt0 = 60\n[vary]\npack = ["tetra-325-a"]\nmu = [0.5, 1.0]\n'
    for encoding in ("utf-8", "utf-8-sig"):
        (tmp_path / "bom.toml").write_text(text, encoding=encoding)
        assert read_spec(tmp_path / "bom.toml").names == ["pack", "mu"]


def test_a_value_shared_by_the_grid_and_used_by_single_points_is_no_contradiction() -> None:
    spec = spec_of({"experiment": {"mu": 1.0}, "vary": {"gamma0": [1e-3]}, "points": [{"mu": 2.0}]})
    assert [{**spec.shared, **one} for one in spec.combinations()] == [{"mu": 1.0, "gamma0": 1e-3}, {"mu": 2.0}]


@pytest.mark.parametrize(
    ("part", "name", "value"),
    [
        ("", "gamma0", True),
        ("", "gamma0", "1e-3"),
        ("", "t0", [True]),
        ("", "backend", 1),
        ("friction", "mu", "0.5"),
        ("material", "wall_rigidity", True),
        ("signals", "width", "0.2"),
        ("words", "pad", "2"),
    ],
)
def test_what_is_no_number_is_refused_in_a_written_experiment(part: str, name: str, value: object) -> None:
    pack = gm.load_pack(PACK)
    form = gm.to_dict(gm.Experiment(pack, gm.Bumps(np.ones((1, 1)), np.full((1, 1), 0.4), 0.2)))
    if part == "words":
        form["signals"], part = {"kind": "words", "bits": 2}, "signals"
    (form[part] if part else form)[name] = value
    with pytest.raises(ValueError, match=rf"^{name} must be a (number|text), got "):
        gm.from_dict(form, pack)


def recipes(folder: Path, **tables: object) -> list[tuple[float, float]]:
    """delta0 and rigidity of the walls of the packs that a sweep makes."""
    made = runner(folder, **tables)
    made.check()
    return [(job["recipe"]["delta0"], job["material"]["wall_rigidity"]) for job in made.pack_jobs()]


def test_what_belongs_to_the_preparation_follows_into_it(tmp_path: Path) -> None:
    prepare, both = {"grains": 16}, {"delta0": [0.03, 0.05], "mu": [0.5, 1.0]}
    assert recipes(tmp_path, prepare=prepare, vary=both) == [(0.03, 1.0), (0.05, 1.0)]
    assert recipes(tmp_path, prepare=prepare, experiment={"delta0": 0.04}, vary={"mu": [1.0]}) == [(0.04, 1.0)]
    assert recipes(tmp_path, prepare=prepare, vary={"wall_rigidity": [0.5, 2.0]}) == [(0.05, 0.5), (0.05, 2.0)]
    # Asked for by itself, a number of the preparation is what it is; and t0 and dt say how a pack is driven.
    assert recipes(tmp_path, prepare={**prepare, "delta0": 0.05}, vary=both) == [(0.05, 1.0)]
    assert recipes(tmp_path, prepare=prepare, vary={"t0": [900.0, 1800.0], "dt": [0.2, 0.3]}) == [(0.05, 1.0)]
    assert recipes(tmp_path, prepare=prepare, vary=both, run={"packs_as_they_are": True}) == [(0.05, 1.0)]


@pytest.mark.parametrize(("name", "was"), [("delta0", "0.05"), ("wall_rigidity", "1")])
def test_a_pack_that_was_prepared_for_another_experiment_is_refused_unless_wanted(
    tmp_path: Path, name: str, was: str
) -> None:
    tables = {"experiment": {"pack": "tetra-325-a"}, "vary": {name: [float(was), 0.12]}}
    with pytest.raises(ValueError, match=rf"{name} = 0.12, and tetra-325-a was prepared with {was}: .*\[prepare\]"):
        runner(tmp_path, **tables).check()
    wanted = runner(tmp_path, **tables, run={"packs_as_they_are": True})
    wanted.check()
    assert [value_at(one.experiment, PATHS[name]) for one in wanted.points()] == [float(was), 0.12]
    with pytest.raises(gm.FileFormatError, match=r"packs_as_they_are in \[run\] must be true or false, got 1"):
        runner(tmp_path, **tables, run={"packs_as_they_are": 1})


PATHS = {"delta0": "delta0", "wall_rigidity": "material.wall_rigidity"}


def test_what_is_warned_of_in_a_run_stands_in_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recalled: tuple[gm.Experiment, gm.Recall]
) -> None:
    experiment, recall = recalled
    other = gm.replace(experiment, delta0=0.04)

    def doubtful(*_: object, **__: object) -> gm.Recall:
        warn_of_another_compression(other)  # a bit of the status says so
        warnings.warn("something is odd", stacklevel=1)
        return replace(recall, status=recall.status | int(gm.Status.OTHER_COMPRESSION))

    monkeypatch.setattr("gmem_jax.sweeps.work.run", doubtful)
    store, here = Store(tmp_path), point({"delta0": 0.04}, other)
    store.write_manifest([here], {}, ["delta0"])
    with pytest.warns(OtherCompressionWarning), pytest.warns(UserWarning, match="something is odd"):
        run_group([here.key], [other], store=store)
    (row,) = rows(store)
    assert row["status"] & int(gm.Status.OTHER_COMPRESSION)
    assert "cycled with another delta0" in row["why"]
    assert row["warnings"] == "something is odd"
    assert warnings_of(row) == f"{row['why']}; something is odd"
    explained = [line.partition(": ")[0] for line in str(points_table([row], ["delta0"]).caption).splitlines()]
    assert explained == ["F(T1)", *status_words(row["status"]), "warned"]
    (mean,) = means([row, row], ["delta0"], ["delta0"])
    assert (mean["status"], mean["warnings"]) == (row["status"], row["warnings"])


def test_signals_of_points_that_have_fewer_are_filled_up_and_counted(
    tmp_path: Path, recalled: tuple[gm.Experiment, gm.Recall]
) -> None:
    xarray = pytest.importorskip("xarray")
    _, two = recalled
    one = replace(two, **{name: getattr(two, name)[1:] for name in ("p_sig", "J", "shear")})
    kept = {"a": two, "b": one.described({**two.configuration, "signals": ["alone"]})}

    class Kept(Store):
        def load(self, key: str) -> Any:
            return kept[key]

    store = Kept(tmp_path / "store")
    store.write_manifest([], {}, ["signals"], [("a", {"signals": "two"}), ("b", {"signals": "one"}), ("c", {})])
    for key in kept:
        store.at(key).write_text("")
    about = export_table(store, tmp_path / "table.nc")
    assert about == "points have 1 to 2 signals, see `signal_count`; what lies beyond them is NaN"
    with xarray.open_dataset(tmp_path / "table.nc", engine="h5netcdf") as data:
        assert data.signal_count.values.tolist() == [2, 1, 0]
        assert data.signals.values.tolist() == ["two", "one", ""]
        assert data.signal_name.values.tolist() == [["0", "1"], ["alone", ""], ["", ""]]
        np.testing.assert_array_equal(data.p_sig[0], two.p_sig)
        np.testing.assert_array_equal(data.p_sig[1, 0], two.p_sig[1])
        assert np.isnan(data.p_sig[1, 1]).all()
        assert np.isnan(data.p_sig[2]).all()
        np.testing.assert_allclose(data.signal_fidelity[1, 0], data.signal_fidelity[0, 1])


def test_points_that_differ_in_replica_parameters_become_one_run(tmp_path: Path) -> None:
    made = runner(
        tmp_path,
        experiment={"t0": 150.0},
        vary={"pack": [str(PACK), "tetra-325-a"], "mu": [0.1, 0.2, 0.4, 0.6, 0.8, 1.0], "background": ["sub0", "sub2"]},
    )
    points = made.points()
    jobs = plan(points, set(), MEMORY)
    assert sorted(len(job.points) for job in jobs) == [6, 6, 6, 6]
    assert {job.replicas for job in jobs} == {42}
    assert [job.work for job in jobs] == sorted((job.work for job in jobs), reverse=True)
    assert len({key for job in jobs for key in job.points}) == 24
    # Small enough for every worker to have one; what is done is not done again, in whatever order it is asked for.
    assert len(plan(points, set(), MEMORY, workers=16)) >= 16
    assert len(plan(points[::-1], {one.key for one in points[1:]}, MEMORY)[0].points) == 1
    assert plan(points, {one.key for one in points}, MEMORY) == []
    # Little memory: fewer side by side.
    assert max(job.replicas for job in plan(points, set(), 1 << 20)) < 42


def test_a_key_stands_for_all_that_numbers_depend_on(tmp_path: Path) -> None:
    base = gm.Experiment(gm.load_pack(PACK), gm.six_signals(), t0=150.0)
    pack = gm.load_pack(PACK)
    moved = gm.pack_from(pack, position=pack.position * (1.0 + 1e-12), quaternion=pack.quaternion)
    changes = [
        {},
        {"friction.mu": 0.5},
        {"friction": gm.MindlinRescaled()},
        {"gamma0": 2e-3},
        {"t0": 151.0},
        {"dt": 0.2},
        {"store": 1.0},
        {"signals": gm.words(2)},
        {"background": "sub2"},
        {"backend": "jax"},
        {"hold_drag": 0.01},
        {"delta0": 0.04},
        {"material.poisson": 0.4},
        {"pack": moved},
    ]
    keys = [point({}, gm.replace(base, change)).key for change in changes]
    assert len(set(keys)) == len(changes)
    assert point({"named": "otherwise"}, gm.Experiment(pack, gm.six_signals(), t0=150.0)).key == keys[0]


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(gm.FileFormatError, match=r"has no sweep\.json of .* but holds thesis\.tex"):
        Store(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_executors_that_cannot_be_had_say_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ValueError, match="no SLURM here"):
        executor("slurm", 1, {})
    with pytest.raises(ValueError, match="must be processes, slurm or local"):
        executor("cloud", 1, {})
    with pytest.raises(ValueError, match=r"workers need \d+ CPUs"):
        executor("processes", 10_000, {})
    with pytest.raises(ValueError, match="no option 'queue'"):
        executor("processes", 1, {"queue": "long"})
    with pytest.raises(ValueError, match=r"options of submitit: .*'queue'"):
        executor("local", 1, {"queue": "long"})
    with pytest.raises(ValueError, match=r"options of submitit: .*timeout_min"):
        executor("local", 1, {"timeout_min": "long"})


def test_the_last_words_of_a_scheduler_s_workers_are_found(tmp_path: Path) -> None:
    chosen = executor("local", 1, {})
    assert isinstance(chosen, Submitted)
    job = SimpleNamespace(stdout=lambda: None, stderr=lambda: "slurmstepd: error: out of memory\n")
    chosen._jobs = {"worker-0": job}
    assert chosen.said(Store(tmp_path)).strip() == "slurmstepd: error: out of memory"


@pytest.mark.parametrize(("told", "threads"), [("1", "1"), ("64", "all"), (None, "all")])
def test_a_worker_has_no_more_threads_than_it_is_told_or_has_cpus(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: str | None, threads: str
) -> None:
    started: list[dict[str, str]] = []

    def start(*_: Any, env: dict[str, str], **__: Any) -> Any:
        started.append(env)
        return SimpleNamespace(pid=os.getpid())

    monkeypatch.setattr("gmem_jax.sweeps.executors.subprocess.Popen", start)
    monkeypatch.setattr("gmem_jax.sweeps.executors.cores", lambda: [0, 1, 2, 3])
    if told is None:
        monkeypatch.delenv("GMEM_THREADS", raising=False)
    else:
        monkeypatch.setenv("GMEM_THREADS", told)
    executor("processes", 2, {}).start(Store(tmp_path), "worker-1")
    assert started[0]["GMEM_THREADS"] == threads.replace("all", "2")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"cpus_per_task": 2}, ["--cpus-per-task=2"]),
        ({}, ["--cpus-per-task=1"]),
        ({"slurm_cpus_per_task": 3, "slurm_srun_args": ["--exact"]}, ["--exact", "--cpus-per-task=3"]),
        ({"cpus_per_task": 2, "slurm_srun_args": "--cpus-per-task=4"}, ["--cpus-per-task=4"]),
    ],
)
def test_a_worker_of_slurm_gets_the_cpus_that_its_job_asks_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], told: list[str]
) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, answer in {"sbatch": "Submitted batch job 7", "scontrol": "UP", "srun": ""}.items():
        (programs / name).write_text(f"#!/bin/sh\necho {answer}\n")
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:/usr/bin:/bin")
    store = Store(tmp_path / "sweep")
    executor("slurm", 1, options).start(store, "worker-0")
    script = next((store.folder / "workers" / "submitit").glob("*.sh"))
    (line,) = (line for line in script.read_text().splitlines() if line.startswith("srun "))
    assert [word for word in line.split() if word in told or "cpus" in word] == told


class Mortal(Executor):
    """Its workers get as far as they are told, one after the other, and die; the last finishes."""

    workers = 1

    def __init__(self, reach: list[float]) -> None:
        self.reach, self.started = reach, 0

    def start(self, store: Store, name: str) -> None:
        if self.started == len(self.reach):
            store.fail("key", "finished, as far as an executor can tell")
        else:
            store.tell(name, "job", self.reach[self.started], "points")
        self.started += 1

    def alive(self) -> set[str]:
        return set()

    def stop(self) -> None:
        pass


def test_workers_may_die_as_often_as_each_gets_farther(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gmem_jax.sweeps.executors.POLL", 0.0)
    job = {"kind": "points", "name": "job", "points": ["key"], "work": 1.0}
    steps = Mortal([0.1 * number for number in range(9)])
    steps.finish(Store(tmp_path / "steps"), [job], lambda _: None)
    assert steps.started == 10
    stuck = Mortal([0.3, 0.2, 0.3, 0.1, 0.3, 0.3])
    with pytest.raises(gm.RunFailedError, match="end without doing their jobs"):
        stuck.finish(Store(tmp_path / "stuck"), [job], lambda _: None)
    assert stuck.started <= 5


class Killed(Executor):
    """Two workers: the first job is done, of the second there are parts, and there it ends."""

    workers = 2

    def __init__(self) -> None:
        self.jobs: list[dict[str, Any]] = []

    def start(self, store: Store, name: str) -> None:
        pass

    def alive(self) -> set[str]:
        return set()

    def stop(self) -> None:
        pass

    def finish(self, store: Store, jobs: list[dict[str, Any]], told: Callable[[float], None]) -> None:
        self.jobs = jobs
        for key in jobs[0]["points"]:
            store.fail(key, "done, as far as a plan can tell")
        store.parts(jobs[-1]).mkdir(exist_ok=True)


def test_runs_that_were_begun_go_on_as_they_were(tmp_path: Path) -> None:
    values = {"experiment": {"pack": str(PACK), "t0": 150.0}, "vary": {"mu": [0.1 * n for n in range(1, 9)]}}
    first, again = Killed(), Killed()
    runner(tmp_path, **values).run(first, silent)
    assert [len(job["points"]) for job in first.jobs] == [4, 4]
    runner(tmp_path, **values).run(again, silent)
    assert [job["name"] for job in again.jobs] == [
        first.jobs[1]["name"]
    ]  # not two runs of two, which two workers would be given anew


def test_parts_that_a_worker_left_do_not_stop_a_sweep_of_the_library(tmp_path: Path) -> None:
    base = gm.Experiment(gm.load_pack(PACK), gm.six_signals(), t0=60.0, rest=0.02, hold=0.02, store=0.02)
    store = Store(tmp_path / "store")
    key = point({"friction.mu": 0.5}, gm.replace(base, {"friction.mu": 0.5})).key
    parts = parts_of_job(store, run_job(digest([key]), [key]) | {"batch": 6})
    parts("prefix", lambda _: np.zeros(1))
    with store.lock({"name": digest([key])}), pytest.raises(gm.FileFormatError, match="call again when it is done"):
        gm.sweep(base, {"friction.mu": [0.5]}, tmp_path / "store")  # another process has it
    assert len(gm.sweep(base, {"friction.mu": [0.5]}, tmp_path / "store")) == 1


def test_what_was_begun_outlives_another_figure_s_jobs(tmp_path: Path) -> None:
    first = run_job("abc", ["one", "two"])
    other = {"kind": "pack", "name": "def", "work": 1.0, "replicas": 1, "recipe": {}, "grain": {}}
    store = Store(tmp_path)
    store.order([first])
    store.parts(first).mkdir()
    store.order([other])
    assert store.jobs() == [other]
    assert store.begun({"one", "two", "three"}) == [first]
    assert store.begun({"one"}) == []
    for key in first["points"]:
        store.fail(key, "done otherwise")
    store.order([])
    assert not list((tmp_path / "parts").iterdir())


def test_why_a_pack_could_not_be_made_is_said_of_its_points(tmp_path: Path) -> None:
    made = runner(tmp_path, prepare={"grains": 16}, vary={"mu": [0.1, 0.2]})
    (job,) = made.pack_jobs()
    made.store.fail(job["name"], "settle: not at rest")
    made.run(Killed(), silent)
    assert {row["why"] for row in rows(made.store)} == {"its pack could not be made: settle: not at rest"}
    with pytest.raises(gm.RunFailedError, match="settle: not at rest"):
        made.packs(Killed(), silent)


def test_jobs_say_where_a_pack_is_whoever_reads_them_where(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(PACK.parent)
    near = gm.Experiment(gm.load_pack(PACK.name), gm.six_signals(), t0=150.0)
    (one,) = plan([point({}, near)], set(), MEMORY)
    assert one.configurations[0]["pack"]["source"] == str(PACK)
    shipped = gm.replace(near, pack=gm.load_pack("tetra-325-a"))
    assert plan([point({}, shipped)], set(), MEMORY)[0].configurations[0]["pack"]["source"] == "tetra-325-a"


def test_values_of_any_kind_have_a_label() -> None:
    values = [gm.Mindlin(), 0.5, np.float64(2.0), None, "tetra-325-a"]
    assert _labels(values) == ["Mindlin", 0.5, 2.0, None, "tetra-325-a"]


def test_values_of_one_name_are_told_apart(tmp_path: Path) -> None:
    base = gm.Experiment(gm.load_pack(PACK), gm.six_signals(), t0=60.0, rest=0.02, hold=0.02, store=0.02)
    weak, strong = gm.Hooke(mu=0.2), gm.Hooke(mu=1.0)
    assert _labels([weak, strong, weak, gm.Hooke(mu=1.0)]) == ["Hooke (1)", "Hooke (2)", "Hooke (1)", "Hooke (2)"]
    assert _labels([weak, gm.Hooke(mu=0.2)]) == ["Hooke", "Hooke"]
    assert _labels([*np.arange(4.0).reshape(2, 2)]) == ["ndarray (1)", "ndarray (2)"]
    found = gm.sweep(base, {"friction": iter([weak, strong])}, tmp_path / "laws")
    table = rows(Store(tmp_path / "laws"))
    assert [row["friction"] for row in table] == ["Hooke (1)", "Hooke (2)"]
    assert [row["gain"] for row in table] == [float(one.recall.gain) for one in found]
    assert "Hooke (2)" in found._repr_html_()


def test_what_a_living_worker_has_is_left_to_it(tmp_path: Path) -> None:
    store, job = Store(tmp_path), run_job("abc", ["key"])
    store.order([job])
    for name in ("abc-0", "old"):
        (tmp_path / "parts" / name).mkdir()
    with store.lock(job), atomic(store.at("key")) as temporary:
        Store(tmp_path).order([])  # another sweep is asked for meanwhile, or somebody looks
        assert temporary.is_file()
        assert [path.name for path in (tmp_path / "parts").iterdir()] == ["abc-0"]
    store.order([])
    assert not list((tmp_path / "parts").iterdir())


def test_no_cell_of_a_table_is_a_formula(tmp_path: Path) -> None:
    store = Store(tmp_path / "mu")
    values = ["=HYPERLINK(1)", "+1+1", "-2", "@x", "tetra-325-a", -2.0]
    store.write_manifest([], {}, ["pack"], [(f"key{number}", {"pack": value}) for number, value in enumerate(values)])
    export_table(store, tmp_path / "o.csv")
    with (tmp_path / "o.csv").open() as file:
        told = [row["pack"] for row in csv.DictReader(file)]
    assert told == ["'=HYPERLINK(1)", "'+1+1", "'-2", "'@x", "tetra-325-a", "-2.0"]


def test_a_sweep_that_has_no_points_yet_is_shown_and_not_exported(tmp_path: Path) -> None:
    store = Store(tmp_path / "mu")
    assert rows(store) == []
    with pytest.raises(ValueError, match="has no points yet"):
        export_table(store, tmp_path / "o.csv")
