"""Nothing is removed or replaced that is not ours, and whatever is kept under a name is what the name says."""

import ast
import contextlib
import errno
import os
import re
import stat
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scenes import TETRA_27, gmem

import gmem_jax as gm
from gmem_jax.command.console import check_output
from gmem_jax.files import compilation_cache
from gmem_jax.files.atomic import atomic
from gmem_jax.files.checkpoints import Checkpoints, locked
from gmem_jax.files.ours import Folder, remove_leftovers, temporary
from gmem_jax.files.packs import load_pack
from gmem_jax.home import cache_folder
from gmem_jax.native.cuda import _cache
from gmem_jax.sweeps.cost import cost_of
from gmem_jax.sweeps.spec import spec_of
from gmem_jax.sweeps.store import Store
from gmem_jax.sweeps.sweep import SweepRunner
from gmem_jax.sweeps.table import export_table, rows

PACK = TETRA_27
ROOT = Path(gm.__file__).parent
REMOVING = {"unlink", "rmtree", "rmdir", "rename", "renames", "removedirs", "replace", "remove", "move"}
OF_OTHERS = {"native/build.py"}  # it compiles before anything can be imported, and replaces its own library


def tree(folder: Path) -> dict[str, bytes | None]:
    """All that lies in a folder."""
    found = sorted(folder.rglob("*"))
    return {path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else None for path in found}


def removals(path: Path) -> list[str]:
    """The calls in a module that remove, rename or replace a file."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in REMOVING):
            continue
        of = ast.unparse(node.func.value)
        if node.func.attr == "replace" and (of != "os") and (len(node.args) != 1 or node.keywords):
            continue  # of texts, trees and arrays
        if node.func.attr in ("remove", "move") and of not in ("os", "shutil"):
            continue
        found.append(f"{path.name}:{node.lineno} {of}.{node.func.attr}")
    return found


def test_one_module_removes_and_replaces() -> None:
    assert len(removals(ROOT / "files" / "ours.py")) > 5
    modules = [path for path in ROOT.rglob("*.py") if path.relative_to(ROOT).as_posix() not in OF_OTHERS]
    others = [call for path in modules if path.name != "ours.py" for call in removals(path)]
    assert others == []


def test_processes_of_ours_take_no_module_from_the_working_folder() -> None:
    """Where a Python is started, -P or -I is beside it."""
    starts = 0
    for path in ROOT.rglob("*.py"):
        for line in path.read_text().splitlines():
            if "sys.executable" in line:
                starts += 1
                assert re.search(r'sys\.executable, "-[PI]"', line), f"{path}: {line.strip()}"
    assert starts >= 1


@pytest.mark.parametrize("more", [[], ["--restart"]])
def test_a_user_s_folder_with_the_name_of_parts_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, more: list[str]
) -> None:
    (tmp_path / "o.h5.parts" / "deep").mkdir(parents=True)
    (tmp_path / "o.h5.parts" / "thesis.tex").write_text("all of it")
    before = tree(tmp_path)
    assert gmem(monkeypatch, "recall", PACK, "-o", tmp_path / "o.h5", "--t0", "75", *more) == 2
    assert "has no run.json of gmem-parts/0.1 but holds deep; its files may be" in capsys.readouterr().err
    assert tree(tmp_path) == before


def test_parts_behind_a_link_are_left_alone(tmp_path: Path) -> None:
    Checkpoints(tmp_path / "real", {"seed": 1})("one", lambda _: np.zeros(1))
    (tmp_path / "o.parts").symlink_to(tmp_path / "real")
    before = tree(tmp_path)
    for restart in (False, True):
        with pytest.raises(gm.FileFormatError, match="is a link, which is not followed"):
            Checkpoints(tmp_path / "o.parts", {"seed": 1}, restart=restart)
    assert tree(tmp_path) == before


def test_what_a_user_put_among_our_parts_outlives_them(tmp_path: Path) -> None:
    parts = Checkpoints(tmp_path / "parts", {"seed": 1})
    parts("one", lambda _: np.zeros(1))
    (tmp_path / "parts" / "notes.txt").write_text("mine")
    (tmp_path / "far.npz").write_text("elsewhere")
    (tmp_path / "parts" / "two.npz").symlink_to(tmp_path / "far.npz")
    assert parts.finished() == 1
    with pytest.warns(UserWarning, match=r"holds notes\.txt, which was not written"):
        parts.discard()
    assert sorted(tree(tmp_path)) == ["far.npz", "parts", "parts/notes.txt", "parts/run.json", "parts/two.npz"]


def test_a_folder_that_looks_like_a_sweep_is_not_taken_for_one(tmp_path: Path) -> None:
    for name in ("jobs", "parts/work", "points"):
        (tmp_path / "own" / name).mkdir(parents=True)
    (tmp_path / "own" / "jobs" / "letter.json").write_text("{}")
    before = tree(tmp_path)
    with pytest.raises(gm.FileFormatError, match=r"has no sweep\.json of .* but holds jobs"):
        Store(tmp_path / "own")
    assert tree(tmp_path) == before


def test_a_link_in_a_sweep_s_folder_is_not_followed(tmp_path: Path) -> None:
    Store(tmp_path / "swept")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "abc").mkdir()
    (tmp_path / "mine" / "abc" / "data.npz").write_text("mine")
    (tmp_path / "swept" / "parts").rmdir()
    (tmp_path / "swept" / "parts").symlink_to(tmp_path / "mine")
    before = tree(tmp_path)
    with pytest.raises(gm.FileFormatError, match="a link"):
        Store(tmp_path / "swept").order([])
    assert tree(tmp_path) == before


JOB = '{"kind": "run", "name": "NAME", "points": ["KEY"], "configurations": [{}], "work": 1, "replicas": 1, "batch": 1}'


def test_names_in_a_foreign_sweep_lead_nowhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    """Names of jobs and points with ways out, records that are none, files of others: nothing opened, no traceback."""
    swept = tmp_path / "swept"
    store = Store(swept)
    (tmp_path / ".victim.lock").write_text("")
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "data.npz").write_text("mine")
    for number, (name, key) in enumerate([("../../victim", "a"), ("abc", "../../victim"), ("abc", 3)]):
        content = JOB.replace("NAME", name).replace('"KEY"', f'"{key}"' if isinstance(key, str) else "3")
        (swept / "jobs" / f"{number:05d}-abc.json").write_text(content)
    for name, text in {"worker-0.json": '{"job": 3}', "worker-1.json": "[]", "worker-2.run": '{"pid": "x"}'}.items():
        (swept / "workers" / name).write_text(text)
    (swept / "jobs" / "notes.json").write_text("mine")
    (swept / "jobs" / "00007-ab.json").write_text("{}")
    before = tree(tmp_path)
    assert (store.jobs(), store.progress()) == ([], [])
    assert gmem(monkeypatch, "sweep", "status", swept) == 0
    assert tree(tmp_path) == before
    store.order([])
    assert (swept / "jobs" / "notes.json").is_file()
    assert (tmp_path / "victim" / "data.npz").is_file()
    assert gmem(monkeypatch, "sweep", "stop", swept) == 0
    assert "nobody is at work here" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("card", "words"),
    [
        ('"names": ["mu"], "points": [{"key": "../../x", "values": {"mu": 1}}]', "is no key of a point"),
        ('"names": ["\\u001b]0;x\\u0007"], "points": []', "no line of text"),
        ('"names": ["mu"], "points": [{"key": "x", "values": {"mu": "\\u001b[2J"}}]', "is no name with a value"),
    ],
)
def test_a_sweep_s_file_from_elsewhere_neither_leads_out_nor_acts_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, card: str, words: str
) -> None:
    (tmp_path / "sweep.json").write_text(f'{{"schema": "gmem-sweep/0.1", "shared": {{}}, {card}}}')
    for verb in ("status", "show"):
        assert gmem(monkeypatch, "sweep", verb, tmp_path) == 2
        said = "".join(capsys.readouterr())
        assert words in said
        assert "\x1b" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.json"]  # to look is to change nothing


def test_a_refused_sweep_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    (tmp_path / "mu.toml").write_text(f'[experiment]\npack = "{PACK}"\n[vary]\nmu = [-1.0]\n')
    assert gmem(monkeypatch, "sweep", tmp_path / "mu.toml") == 2
    assert [path.name for path in tmp_path.iterdir()] == ["mu.toml"]


def test_an_output_that_appears_during_a_run_survives(tmp_path: Path) -> None:
    output = tmp_path / "o.txt"
    check_output(output, ".txt", force=False)
    output.write_text("somebody else's")
    with pytest.raises(FileExistsError, match="made by somebody else since this command began"):
        _write(output, "ours")
    assert tree(tmp_path) == {"o.txt": b"somebody else's"}
    check_output(output, ".txt", force=True)
    _write(output, "ours")
    assert tree(tmp_path) == {"o.txt": b"ours"}


def test_an_output_where_nothing_came_is_written_also_without_hard_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    for link in (os.link, refuse):
        monkeypatch.setattr(os, "link", link)
        output = check_output(tmp_path / f"{link.__name__}.txt", ".txt", force=False)
        _write(output, "ours")
        assert output.read_text() == "ours"
        check_output(other := tmp_path / f"{link.__name__}-other.txt", ".txt", force=False)
        other.write_text("else's")
        with pytest.raises(FileExistsError):
            _write(other, "ours")
    assert len(list(tmp_path.iterdir())) == 4


def _write(path: Path, text: str) -> None:
    with atomic(path) as made:
        made.write_text(text)


def test_any_name_that_a_file_may_have_can_be_written_and_longer_ones_are_refused_first(tmp_path: Path) -> None:
    for length in (200, 242, 249, 255):
        path = tmp_path / ("x" * (length - 5) + ".json")
        _write(check_output(path, ".json", force=False), "ours")
        assert path.read_text() == "ours"
    with pytest.raises(ValueError, match="too long"):
        check_output(tmp_path / ("x" * 251 + ".json"), ".json", force=False)
    assert len(list(tmp_path.iterdir())) == 4


def test_a_name_that_leaves_no_room_for_parts_is_refused_before_the_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    name = "x" * 247 + ".h5"
    assert gmem(monkeypatch, "recall", PACK, "-o", tmp_path / name, "--t0", "75", "--no-picture") == 2
    assert "leaves no room for that of its parts" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_the_umask_holds(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        _write(tmp_path / "o.txt", "ours")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "o.txt").stat().st_mode) == 0o666 & ~mask


def test_only_leftovers_of_ours_are_swept(tmp_path: Path) -> None:
    left = temporary(tmp_path / "o.h5")
    other = temporary(tmp_path / "p.h5")
    for name in (".o.h5.notes.tmp", ".gmem-mine.tmp"):
        (tmp_path / name).write_text("mine")
    remove_leftovers(tmp_path, "o.h5")
    assert not left.exists()
    assert other.exists()
    remove_leftovers(tmp_path)
    assert sorted(tree(tmp_path)) == [".gmem-mine.tmp", ".o.h5.notes.tmp"]


def test_a_file_or_link_in_the_place_of_a_lock_survives(tmp_path: Path) -> None:
    lock = tmp_path / ".o.h5.lock"
    lock.write_text("mine")
    with pytest.raises(gm.FileFormatError, match="is not a lock file of gmem"), locked(tmp_path / "o.h5"):
        pass
    assert lock.read_text() == "mine"
    lock.unlink()
    lock.symlink_to(tmp_path / "far")
    with pytest.raises(gm.FileFormatError, match="is a link or a folder"), locked(tmp_path / "o.h5"):
        pass
    lock.unlink()
    lock.mkdir()
    with pytest.raises(gm.FileFormatError, match="is a link or a folder"), locked(tmp_path / "o.h5"):
        pass
    assert not (tmp_path / "far").exists()


def test_a_folder_of_another_kind_is_not_ours(tmp_path: Path) -> None:
    Checkpoints(tmp_path / "parts", {"seed": 1})
    with pytest.raises(gm.FileFormatError, match=r"no sweep\.json"):
        Store(tmp_path / "parts")
    folder = Folder(tmp_path / "own", "mark.json", "own/1", re.compile(r"mark\.json|a\.txt"), {})
    for name in ("b.txt", "../a.txt", "/etc/passwd", "a.txt/../../x"):
        with pytest.raises(gm.FileFormatError, match="no file that is written there is named"):
            folder.remove(name)


# What a file says that it is.


def exchange(one: Path, other: Path) -> None:
    """Give two files each other's names."""
    contents = one.read_bytes(), other.read_bytes()
    other.write_bytes(contents[0])
    one.write_bytes(contents[1])


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two points."""
    folder = tmp_path_factory.mktemp("identity") / "mu"
    experiment = gm.Experiment(gm.load_pack(PACK), gm.six_signals(), t0=60.0, store=0.1, rest=0.05, hold=0.05)
    gm.sweep(experiment, {"friction.mu": [0.2, 1.0]}, folder)
    return folder


def test_points_that_were_exchanged_give_no_numbers(swept: Path, tmp_path: Path) -> None:
    assert [row["state"] for row in rows(Store(swept))] == ["done", "done"]
    one, other = sorted((swept / "points").iterdir())
    exchange(one, other)
    try:
        store = Store(swept, make=False)
        for read in (lambda: rows(store), lambda: export_table(store, tmp_path / "o.csv")):
            with pytest.raises(gm.FileFormatError, match="files were exchanged") as refused:
                read()
            key = {row["values"]["friction.mu"]: row["key"] for row in store.card()["points"]}
            there, wanted = (f"point {key[mu]} (friction.mu = {mu})" for mu in (1.0, 0.2))
            assert f"{key[0.2]}.h5: holds {there}, not {wanted}" in str(refused.value)
        assert set(store.unreadable({one.stem, other.stem})) == {one.stem, other.stem}  # so a sweep runs them again
    finally:
        exchange(one, other)


def test_parts_that_were_exchanged_or_are_of_another_run_are_refused(tmp_path: Path) -> None:
    for seed in (1, 2):
        parts = Checkpoints(tmp_path / f"{seed}", {"seed": seed})
        for name in ("one", "two"):
            parts(name, lambda _: np.full(3, float(seed)))  # noqa: B023
    exchange(tmp_path / "1" / "one.npz", tmp_path / "1" / "two.npz")
    with pytest.raises(gm.FileFormatError, match=r"part two of run .*, not 'part one of run .*exchanged"):
        Checkpoints(tmp_path / "1", {"seed": 1})("one", lambda _: np.zeros(3))
    exchange(tmp_path / "1" / "one.npz", tmp_path / "1" / "two.npz")
    exchange(tmp_path / "1" / "one.npz", tmp_path / "2" / "one.npz")
    with pytest.raises(gm.FileFormatError, match="exchanged"):
        Checkpoints(tmp_path / "2", {"seed": 2})("one", lambda _: np.zeros(3))


def test_a_dry_run_says_what_lies_in_the_folder_of_a_sweep(swept: Path) -> None:
    shared = {"pack": str(PACK), "t0": 60.0, "store": 0.1, "rest": 0.05, "hold": 0.05}
    spec = spec_of({"experiment": shared, "vary": {"mu": [0.2, 0.3]}})
    found = cost_of(spec, swept)
    assert (found.points, found.there, found.damaged, found.others, found.runs) == (2, 1, 0, 1, 1)
    assert "in the folder: 1 result of points that are not asked for, which stay" in found.lines
    assert "1 run at most" in found.lines[0]
    one, other = sorted((swept / "points").iterdir())
    exchange(one, other)
    try:
        found = cost_of(spec, swept)
        assert (found.there, found.damaged) == (0, 1)
        assert "in the folder: 1 file damaged, or another point's: to be computed again" in found.lines
    finally:
        exchange(one, other)


def test_a_damaged_part_is_refused_with_the_way_out(tmp_path: Path) -> None:
    for more, advice in (({}, "remove it, or begin anew with --restart"), ({"advice": "do so"}, "do so")):
        parts = Checkpoints(tmp_path / "parts", {"seed": 1}, restart=True, **more)
        parts("one", lambda _: np.zeros(3))
        part = tmp_path / "parts" / "one.npz"
        part.write_bytes(part.read_bytes()[:-9])
        with pytest.raises(gm.FileFormatError, match=f"one.npz: damaged, .* its content; {advice}$"):
            parts("one", lambda _: np.zeros(3))
        part.unlink()
        assert parts("one", lambda _: np.ones(3)).sum() == 3.0  # so the advice is right


def test_parts_of_another_run_are_told_by_the_name_of_what_differs(tmp_path: Path) -> None:
    laws = [{"friction": {"law": "H", "mu": mu, "stiffness": 0.13}, "batch": 6} for mu in (0.5, 1.0)]
    Checkpoints(tmp_path / "parts", laws[0])("one", lambda _: np.zeros(3))
    with pytest.raises(gm.FileFormatError, match=r"run with another friction\.mu \(0\.5, now 1\.0\); begin anew"):
        Checkpoints(tmp_path / "parts", laws[1])


def test_a_checkpoint_of_another_part_is_not_gone_on_from(tmp_path: Path) -> None:
    class KilledError(Exception):
        pass

    def die(checkpoint: Any) -> None:
        checkpoint._wait = 0.0
        checkpoint.maybe_save(lambda: np.full(3, 7.0))
        raise KilledError

    parts, begun = Checkpoints(tmp_path, {"seed": 1}), []
    with contextlib.suppress(KilledError):
        parts("one", die)
    (tmp_path / "two.now").write_bytes((tmp_path / "one.now").read_bytes())

    def look(checkpoint: Any) -> np.ndarray:
        begun.append(checkpoint.restore())
        return np.zeros(1)

    parts("one", look)
    parts("two", look)
    assert begun[1] is None
    np.testing.assert_array_equal(begun[0], np.full(3, 7.0))


def test_a_pack_under_another_s_name_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    named = tmp_path / "gmem_jax" / "packs" / "tetra-28-a.h5"
    named.parent.mkdir(parents=True)
    named.write_bytes(PACK.read_bytes())
    with pytest.raises(gm.FileFormatError, match=r"it is the pack tetra-27, not tetra-28-a"):
        load_pack("tetra-28-a")
    made = SweepRunner(spec_of({"prepare": {"grains": 16}, "vary": {"mu": [0.1]}}), tmp_path / "mu", lambda _: None)
    (job,) = made.pack_jobs()
    made.store.pack_at(job["name"]).write_bytes(PACK.read_bytes())
    with pytest.raises(gm.FileFormatError, match="files were exchanged"):
        made.pack_of({"mu": 0.1, "prepare.grains": 16})


def test_programs_that_a_full_disk_left_empty_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, held in {"a-cache": b"", "b-cache": b"some", "b-atime": b""}.items():
        (tmp_path / name).write_bytes(held)
    monkeypatch.setenv("GMEM_COMPILE_CACHE", str(tmp_path))
    monkeypatch.setattr(compilation_cache, "jax", SimpleNamespace(config=SimpleNamespace(update=lambda *_: None)))
    compilation_cache.keep_programs()
    assert {path.name for path in tmp_path.iterdir()} == {"b-cache", "b-atime"}


def test_a_folder_that_cannot_be_marked_is_not_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Folder, "mark", full)
    (tmp_path / "there").mkdir()
    for name in ("new", "there"):
        with pytest.raises(OSError, match="No space left"):
            Folder(tmp_path / name, "mark.json", "own/1", re.compile("x"), {})
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_a_cache_of_a_relative_path_is_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would be another one in every folder; the XDG Base Directory Specification says so."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("GMEM_COMPILE_CACHE")
    for chosen, folder in {"here": tmp_path / ".cache", "": tmp_path / ".cache", "/some": Path("/some")}.items():
        monkeypatch.setenv("XDG_CACHE_HOME", chosen)
        assert cache_folder() == folder / "gmem_jax"
        assert Path(_cache()) == folder / "gmem_jax" / "kernels"
