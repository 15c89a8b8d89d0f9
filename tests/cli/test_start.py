"""How the command starts, and what it says where JAX, the environment or the user's settings do not let it."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import matplotlib
import numpy as np
import pytest
from scenes import ROOT, gmem, without_settings_of_jax
from test_cli import PACK, SHORT

import gmem_jax as gm
from gmem_jax.errors import FileFormatError
from gmem_jax.files.cache import kept_pack
from gmem_jax.home import cache_folder
from gmem_jax.physics.rules import StartError
from gmem_jax.show import summaries
from gmem_jax.show.figure import Curve, Figure, Panel
from gmem_jax.show.render_matplotlib import pyplot, save_picture, to_matplotlib

ENTRY = [sys.executable, "-c", "import sys; sys.argv[0] = 'gmem'; from gmem_start import main; main()"]


def said(*arguments: object, code: int, **environment: str | None) -> str:
    """What the command says on stderr, in a process of its own; None takes a variable away."""
    own = {name: value for name, value in {**os.environ, **environment}.items() if value is not None}
    done = subprocess.run([*ENTRY, *map(str, arguments)], env=own, capture_output=True, text=True, timeout=300)
    assert done.returncode == code, done.stderr
    return done.stderr


def test_letters_that_a_terminal_cannot_write_cut_no_result_off() -> None:
    command = [*ENTRY, "show", "tetra-325-a"]
    own = {**os.environ, "PYTHONIOENCODING": "ascii"}
    plain, ours = (subprocess.run(command, env=env, capture_output=True, timeout=300) for env in (own, None))
    assert (plain.returncode, plain.stderr) == (0, b"")
    assert len(plain.stdout.splitlines()) == len(ours.stdout.splitlines()) > 3


@pytest.mark.parametrize("platform", ["cuda", "nonsense"])
def test_a_jax_that_does_not_start_is_told_in_one_line_and_no_fault_of_the_pack(tmp_path: Path, platform: str) -> None:
    line = said("recall", PACK, "-o", tmp_path / "x.h5", *SHORT, code=2, JAX_PLATFORMS=platform)
    assert line.startswith(f"gmem: JAX does not start with JAX_PLATFORMS={platform}: ")
    assert line.count("\n") == 1
    assert line.endswith("unset JAX_PLATFORMS, or set it to cpu\n")
    assert "pack" not in line


def test_a_setting_that_jax_refuses_when_it_is_imported_is_told_in_one_line() -> None:
    line = said("info", code=2, JAX_ENABLE_X64="perhaps")
    assert line.startswith("gmem: cannot start: ")
    assert "perhaps" in line
    assert line.count("\n") == 1


def test_the_devices_are_told_without_jax_where_it_could_have_no_others() -> None:
    code = "import sys, gmem_start; gmem_start.alone = True; from gmem_jax.experiment.provenance import devices"
    told = [sys.executable, "-c", f"{code}; print(devices()); print('jax' in sys.modules)"]
    quiet = without_settings_of_jax()
    for environment, loaded, count in ((quiet, False, 1), ({**quiet, "JAX_NUM_CPU_DEVICES": "2"}, True, 2)):
        done = subprocess.run(told, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.split("\n")[:2] == [str(["cpu: cpu"] * count), str(loaded)]


def test_flags_of_jax_do_not_stop_a_command_and_one_that_slows_it_is_told(tmp_path: Path) -> None:
    strict = {"JAX_TRANSFER_GUARD": "disallow", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    said("show", PACK, "--plot", "grains", "-o", tmp_path / "x.png", code=0, **strict)
    line = said("info", code=0, JAX_DISABLE_JIT="1")
    assert line.splitlines()[0].startswith("warning: JAX_DISABLE_JIT is set: nothing is compiled")


@pytest.mark.parametrize("threads", ["0", "abc"])
def test_a_wrong_number_of_threads_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, threads: str
) -> None:
    monkeypatch.setenv("GMEM_THREADS", threads)
    (tmp_path / "mu.toml").write_text(f'[experiment]\npack = "{PACK}"\n[vary]\nmu = [0.5]\n')
    for command in (["recall", PACK, "-o", tmp_path / "x.h5", *SHORT], ["sweep", tmp_path / "mu.toml"]):
        assert gmem(monkeypatch, *command) == 2
        expected = f'gmem: GMEM_THREADS should be a number of threads from 1 to 4096; it is "{threads}"'
        assert capsys.readouterr().err.splitlines() == [expected]  # before its cost is told
    assert [path.name for path in tmp_path.iterdir()] == ["mu.toml"]


def test_a_chosen_folder_of_programs_that_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    folder = tmp_path / "file" / "programs"
    first, *others = said("sweep", "status", tmp_path, code=2, GMEM_COMPILE_CACHE=str(folder)).splitlines()
    why = f"GMEM_COMPILE_CACHE={folder}: cannot write there (Not a directory)"
    assert first == f"warning: {why}; compiled programs are not kept"
    assert len(others) == 1


SLOW = """import sys, time
class Slow:
    def find_spec(name, *_):
        if name == "jax":
            print(flush=True)
        time.sleep(0.05 * name.startswith("jax"))
sys.meta_path.insert(0, Slow)
"""


@pytest.mark.parametrize("entry", [["-c", "from gmem_start import main; main()"], ["-m", "gmem_jax"]])
def test_ctrl_c_while_it_is_imported_is_one_line(tmp_path: Path, entry: list[str]) -> None:
    # Imports as slow as on a cold disk, so that the signal comes while they run; the setting is one of JAX's.
    (tmp_path / "sitecustomize.py").write_text(SLOW)
    paths = os.pathsep.join([str(tmp_path), str(ROOT)])
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(
        [sys.executable, *entry, "info"],
        **pipes,
        text=True,
        env={**os.environ, "PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"},
    ) as process:
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    assert error == "gmem: interrupted; nothing was begun\n"
    assert process.returncode == 130


@pytest.mark.parametrize("moment", ["keep_programs", "app", "atexit"])
def test_ctrl_c_at_either_end_of_a_command_leaves_no_traceback(moment: str) -> None:
    stop = "lambda *_, **__: os.kill(os.getpid(), signal.SIGINT)"
    where = {
        "keep_programs": f"compilation_cache.keep_programs = {stop}",
        "app": f"app.app = {stop}",
        "atexit": f"atexit.register({stop})",
    }[moment]
    modules = "from gmem_jax.command import app; from gmem_jax.files import compilation_cache"
    code = f"import atexit, os, signal, gmem_start; {modules}; {where}; gmem_start.main()"
    own = {**os.environ, "JAX_PLATFORMS": "cpu"}  # a setting of JAX's, so that it is imported
    done = subprocess.run([sys.executable, "-c", code, "info"], env=own, capture_output=True, text=True, timeout=60)
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) <= 1


def no_home() -> Path:
    raise RuntimeError("Could not determine home directory.")


@pytest.fixture
def no_programs() -> Iterator[None]:
    """JAX keeps no programs yet, as in a process that has just begun."""
    folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", folder)


@pytest.mark.usefixtures("no_programs")
def test_a_user_without_a_home_keeps_nothing_and_is_told_where_a_home_is_needed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.delenv("GMEM_COMPILE_CACHE")
    monkeypatch.setattr(Path, "home", no_home)
    assert cache_folder() is None
    assert kept_pack("tetra-31680-a") is None
    assert gmem(monkeypatch, "--help") == 0
    assert gmem(monkeypatch, "show", "tetra-325-a") == 0
    assert jax.config.jax_compilation_cache_dir is None
    capsys.readouterr()
    assert gmem(monkeypatch, "prepare", "tetra-31680-a") == 2
    assert "there is no home folder to keep it in; set XDG_CACHE_HOME" in capsys.readouterr().err


def test_a_fault_of_jax_is_not_called_one_of_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("jax.devices", no_home)
    (tmp_path / "broken.h5").write_bytes(b"no pack")
    with pytest.raises(FileFormatError, match="not a readable"):
        gm.load_pack(tmp_path / "broken.h5")
    monkeypatch.setattr("gmem_jax.files.packs.tabulate", no_home)
    with pytest.raises(StartError, match="JAX does not start"):
        gm.load_pack(PACK)


def test_pictures_need_no_latex_whatever_the_settings_of_matplotlib(tmp_path: Path) -> None:
    with matplotlib.rc_context({"text.usetex": True}):
        curve = Curve(np.arange(2.0), np.arange(2.0), "50 % & more")
        to_matplotlib(Figure((Panel((curve,)),), legend="panel")).save(tmp_path / "drawing.png")
    with matplotlib.rc_context({"text.usetex": True}):
        figure, axis = pyplot().subplots()
        axis.plot([0.0, 1.0])
        axis.set_title("a_b")
        save_picture(tmp_path / "pyplot.png", figure)
    assert {path.name for path in tmp_path.iterdir()} == {"drawing.png", "pyplot.png"}


def test_a_picture_that_cannot_be_drawn_loses_no_table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("latex could not be found")

    monkeypatch.setattr(summaries, "recall_figure", broken)
    assert gmem(monkeypatch, "recall", PACK, "-o", tmp_path / "x.h5", *SHORT) == 0
    captured = capsys.readouterr()
    assert f"warning: {tmp_path / 'x.png'}: could not be drawn (latex could not be found)" in captured.err
    assert "F" in captured.out
    assert (tmp_path / "x.h5").is_file()
