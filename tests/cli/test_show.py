"""`gmem show` prints and draws every kind of file that a command writes."""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import matplotlib as mpl
import numpy as np
import pytest
from scenes import gmem

import gmem_jax as gm
from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.design.stored import save_kernel
from gmem_jax.files import schemas
from gmem_jax.files.results import save_result
from gmem_jax.files.waveforms import save_waveforms
from gmem_jax.show import recalls
from gmem_jax.show.render_matplotlib import to_matplotlib
from gmem_jax.show.summaries import PLOTS
from gmem_jax.sweeps.plan import point
from gmem_jax.sweeps.store import Store

RUN = {"seconds": 1.0, "status": 0, "configuration": {}}


@pytest.fixture(scope="module")
def folder(recalled: tuple[gm.Experiment, gm.Recall], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of every kind."""
    folder, (experiment, found) = tmp_path_factory.mktemp("files"), recalled
    configuration = gm.describe(experiment, 1.0)
    gm.save_recall(folder / "recall.h5", found)
    gm.save_pack(folder / "pack.h5", experiment.pack, {"cycle 1: compress": found.stages["compress"]})
    bumps = np.random.default_rng(0).normal(size=(2, 5, 256))
    kernel = MemoryKernel(np.asarray(found.u), np.linspace(0.1, 0.9, 5), 0.2, *bumps, 1e-3, 0.05)
    save_kernel(folder / "kernel.h5", kernel, configuration)
    slopes = {"waveform": [[1.0], [2.0, 3.0]], "gamma0": 3.0}
    gradient = {"pack": "a", "fidelity": 0.5, "places": [[0.1], [0.2, 0.3]], "gradient": slopes, **RUN}
    save_result(folder / "gradient.json", schemas.GRADIENT, gradient)
    way = [{"mu": 1.0, "fidelity": 0.8}, {"mu": 1.2, "fidelity": 0.9}]
    tuned = {
        "packs": ["a"],
        "before": 0.8,
        "fidelity": 0.9,
        "each": [0.9],
        "values": {"mu": 1.2},
        "history": way,
        **RUN,
    }
    save_result(folder / "tuned.json", schemas.TUNED, tuned)
    known = {"plug_in": 1.0, "bitwise": 1.0, "fano": 1.0}
    reader = {
        "accuracy": 0.75,
        "accuracy_sd": None,
        "bit_errors": [0.25],
        "information": known,
        "read": [[0, 1], [0, 0]],
    }
    reading = {"recall": "r.h5", "pack": "a", "bits": 1, "words": 2, "background": "sub0", "seconds": 1.0, "status": 0}
    save_result(folder / "read.json", schemas.READING, {**reading, "readers": {"net": reader}, "nets": [{}, {}]})
    design = {"pack": "a", "before": 0.5, "fidelity": 0.9, "gain": 0.1, "history": [0.5, 0.9]}
    save_waveforms(folder / "designed.csv", gm.waveform(np.ones((6, 4))), gm.six_signals(), design=design)
    store = Store(folder / "swept")
    points = [point({"mu": mu}, gm.replace(experiment, {"friction.mu": mu})) for mu in (0.5, 1.0)]
    store.write_manifest(points, {}, ["mu"])
    for one in points:
        store.save(one.key, found)
    return folder


@pytest.fixture(scope="module")
def net(folder: Path) -> Path:
    from gmem_jax.reading import net, training
    from gmem_jax.reading.lessons import TrainingConfig

    path = folder / "net.msgpack"
    training.save(path, training.Training(net.initial(TrainingConfig(bits=1, hidden=(4,)), 0), 0, loss=0.5))
    return path


KINDS = {
    "recall.h5": (
        ["mu = 1, gamma0 = 0.001, delta0 = 0.05, t0 = 75 t_c", "all 2 words"],
        ["signals", "all", "Z", "p_x"],
    ),
    "pack.h5": (["27 tetra(0.6)"], ["grains", "phi"]),
    "kernel.h5": (
        ["5 bumps of width 0.2", "resolution: ", "(width in v of a point of the waveform that is read back)"],
        ["kernel", "recalls"],
    ),
    "gradient.json": (["dF/dgamma0 = 3", "signal 2: 2 3"], ["waveforms"]),
    "tuned.json": (["mean F 0.8000 -> 0.9000 with mu = 1.2"], ["history", "values"]),
    "read.json": (["0.750", "plug-in, the most; bitwise, bit by bit; Fano, the least"], ["confusion", "bits"]),
    "designed.csv": (["6 waveforms of 4 samples, designed", "F 0.5000 -> 0.9000"], ["waveforms", "history"]),
    "swept": (["mu", "0.5"], ["fidelity", "gain"]),
}


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_file_is_printed_and_drawn(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, folder: Path, name: str
) -> None:
    words, drawn = KINDS[name]
    assert gmem(monkeypatch, "show", folder / name) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert all(word in said for word in words), said
    assert gmem(monkeypatch, "show", folder / name, "--json") == 0
    json.loads(capsys.readouterr().out)
    assert gmem(monkeypatch, "show", folder / name, "--plot", "list") == 0
    assert set(drawn) <= set(capsys.readouterr().out.split())
    assert set(PLOTS) >= set(drawn)  # each in words
    for what in drawn:
        picture = tmp_path / f"{what}.png"
        assert gmem(monkeypatch, "show", folder / name, "--plot", what.upper(), "-o", picture) == 0
        assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_command_by_itself_reports_what_depends_on_its_rules(folder: Path, tmp_path: Path) -> None:
    """Other tests have imported JAX and set its precision before the command does."""
    command, files = [sys.executable, "-m", "gmem_jax", "report"], [folder / "recall.h5", folder / "kernel.h5"]
    subprocess.run([*command, *files, "-o", tmp_path / "r.html"], check=True)
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "save picture" in page  # of the pack in 3D, whose fingerprint is that of double precision
    assert "is not shown" not in page


def test_a_net_is_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, net: Path
) -> None:
    assert gmem(monkeypatch, "show", net) == 0
    assert "words of 1 bit, seed 0: not finished" in capsys.readouterr().out
    assert gmem(monkeypatch, "show", net, "--plot", "weights", "-o", tmp_path / "w.svg") == 0
    assert "<svg" in (tmp_path / "w.svg").read_text()


def test_recalled_signals_are_given_as_csv(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, folder: Path
) -> None:
    assert gmem(monkeypatch, "show", folder / "recall.h5", "--csv") == 0
    lines = capsys.readouterr().out.splitlines()
    assert (lines[0], len(lines)) == ("u,p_sig of 0 (E),p_sig of 1 (E)", 257)


def test_each_signal_is_told_of_in_the_table_and_as_csv(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, folder: Path
) -> None:
    assert gmem(monkeypatch, "show", folder / "recall.h5") == 0  # two signals fit
    assert "correlation with J" in capsys.readouterr().out
    monkeypatch.setattr("gmem_jax.show.tables.FEW", 1)
    assert gmem(monkeypatch, "show", folder / "recall.h5") == 0
    assert "correlation with J" not in capsys.readouterr().out
    assert gmem(monkeypatch, "show", folder / "recall.h5", "--each") == 0
    assert "correlation with J" in capsys.readouterr().out
    assert gmem(monkeypatch, "show", folder / "recall.h5", "--each", "--csv") == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head == "signal,gain,fidelity,windowed_fidelity,correlation"
    with h5py.File(folder / "recall.h5") as file:
        assert [float(row.split(",")[2]) for row in rows] == file["signal_fidelity"][:].tolist()


def test_what_lies_along_the_axis_of_a_sweep_can_be_chosen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, folder: Path
) -> None:
    picture = tmp_path / "f.svg"
    assert gmem(monkeypatch, "show", folder / "swept", "--plot", "fidelity", "--x", "mu", "-o", picture) == 0
    assert "<svg" in picture.read_text()
    assert gmem(monkeypatch, "show", folder / "swept", "--over", "mu", "--json") == 0
    assert [row["done"] for row in json.loads(capsys.readouterr().out)["means"]] == [2]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["swept", "--plot", "gain", "--x", "colour", "-o", "x.png"], "colour: does not vary here; mu do"),
        (["recall.h5", "--x", "mu"], "--x is for the folder of a sweep"),
        (["pack.h5", "--each"], "name the file of a recall"),
        (["recall.h5", "--plot", "colour", "-o", "x.png"], "there are signals, waveforms, all, pressure"),
        (["recall.h5", "--plot", "Z"], "name the picture with -o, as in -o Z.png"),
        (["recall.h5", "--plot", "Z", "-o", "x.h5"], "must end in one of .png, .svg, .pdf"),
        (["recall.h5", "--against", "v"], "must be one of time, u"),
        (["recall.h5", "-o", "x.png"], "say what to draw with --plot"),
        (["pack.h5", "--csv"], "name the file of a recall"),
        (["nothing.json"], "no such file"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, folder: Path, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(folder)
    assert gmem(monkeypatch, "show", *arguments) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert not (folder / "x.png").exists()


def test_pictures_that_are_there_are_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, folder: Path
) -> None:
    (tmp_path / "x.png").write_text("precious")
    assert gmem(monkeypatch, "show", folder / "recall.h5", "--plot", "Z", "-o", tmp_path / "x.png") == 2
    assert "exists" in capsys.readouterr().err
    assert (tmp_path / "x.png").read_text() == "precious"


def test_a_picture_of_a_stage_shows_the_chosen_signals(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, folder: Path
) -> None:
    drawn = tmp_path / "p.svg"
    monkeypatch.setitem(mpl.rcParams, "svg.fonttype", "none")
    assert gmem(monkeypatch, "show", folder / "recall.h5", "--plot", "p_xy", "--signal", "0,2", "-o", drawn) == 0
    text = drawn.read_text()
    assert ">zero signal<" in text
    assert ">1<" in text  # the second word
    assert "band: lowest to highest" not in text


@pytest.mark.parametrize(("at", "words"), [("0.5,x", "numbers from 0 to 1"), ("0.5,1.5", "frames at u = 1.5")])
def test_frames_at_no_compression_are_refused_before_anything_is_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, folder: Path, at: str, words: str
) -> None:
    assert gmem(monkeypatch, "recall", folder / "pack.h5", "--frames-at", at, "-o", tmp_path / "r.h5") != 0
    assert words in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.iterdir())


def test_frames_at_chosen_compressions_are_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, folder: Path) -> None:
    quick = ["--t0", "75", "--rest", "0.1", "--hold", "0.1", "--store", "0.1", "--no-picture", "--frames-at", "0.5"]
    assert gmem(monkeypatch, "recall", folder / "pack.h5", *quick, "-o", tmp_path / "r.h5") == 0
    frames = gm.load_recall(tmp_path / "r.h5").frames
    assert frames is not None
    assert frames.stages == ("compress", "decompress", "encode", "readout")
    np.testing.assert_allclose(frames.u, 0.5)


def test_chosen_signals_are_the_columns_of_their_replicas(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    recall = recalled[1]
    (axis,) = gm.plot(recall, "p_xy", signals=[2]).figure.axes
    pressure = np.asarray(recall.stages["readout"].pressure)[:, :, 2]
    lines = [line for line in axis.lines if len(line.get_xdata()) > 2]
    np.testing.assert_allclose(lines[-1].get_ydata() / (pressure[:, 0] - pressure[:, 1]), gm.Material().modulus)
    figure = gm.plot(recall, "signals", signals=[2]).figure
    assert [axis.get_title() for axis in figure.axes if axis.get_title()] == ["1"]
    np.testing.assert_allclose(figure.axes[0].lines[1].get_ydata(), gm.Material().modulus * recall.p_sig[1])
    assert "of all 2 signals" in " ".join(figure._suptitle.get_text().split())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["recall.h5", "--plot", "Z", "--signal", "3", "-o", "x.png"], "can show 1 to 2, and 0, the zero signal"),
        (["recall.h5", "--plot", "signals", "--signal", "0", "-o", "x.png"], "signal 0: this picture can show 1 to 2"),
        (["recall.h5", "--plot", "Z", "--signal", "one", "-o", "x.png"], "numbers with commas between"),
        (["recall.h5", "--signal", "1"], "does nothing unless something is drawn with --plot"),
        (["pack.h5", "--plot", "phi", "--signal", "1", "-o", "x.png"], "holds no recall"),
        (["swept", "--plot", "gain", "--signal", "1", "-o", "x.png"], "name the file of a point"),
    ],
)
def test_a_choice_of_signals_that_cannot_be_is_refused_in_a_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
    tmp_path: Path,
    folder: Path,
    arguments: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert gmem(monkeypatch, "show", folder / arguments[0], *arguments[1:]) != 0
    said = capsys.readouterr().err
    assert words in " ".join(said.split())
    assert not (tmp_path / "x.png").exists()


def test_where_a_drive_rings_the_mean_over_the_ringing_is_drawn(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    experiment, recall = recalled
    labels = [text.get_text() for text in gm.plot(recall).figure.legends[0].get_texts()]
    assert recalls.MEAN in labels
    slow = recall.described(gm.describe(gm.replace(experiment, t0=1.8e4)))
    labels = [text.get_text() for text in gm.plot(slow).figure.legends[0].get_texts()]
    assert recalls.MEAN not in labels


def test_more_signals_than_fit_are_said_to_be_more(
    monkeypatch: pytest.MonkeyPatch, recalled: tuple[gm.Experiment, gm.Recall]
) -> None:
    monkeypatch.setattr(recalls, "MOST_PANELS", 4)
    many = {name: np.tile(getattr(recalled[1], name), (40, 1)) for name in ("J", "shear", "p_sig")}
    recall = type(recalled[1])(**{**vars(recalled[1]), **many})
    figure = to_matplotlib(recalls.signals_figure(recall, [f"{number:07b}" for number in range(80)], "a pack")).figure
    assert "the first 4 of 80 signals are shown" in " ".join(figure._suptitle.get_text().split())
    assert [axis.get_title() for axis in figure.axes[:3]] == ["0000000", "0000001", "0000010"]


@pytest.mark.parametrize(("words", "completed"), [("gmem sh", "show"), ("gmem show --pl", "--plot")])
def test_commands_and_options_are_completed_in_a_shell(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, words: str, completed: str
) -> None:
    last = str(len(words.split()) - 1)
    for name, value in (("_GMEM_COMPLETE", "complete_bash"), ("COMP_WORDS", words), ("COMP_CWORD", last)):
        monkeypatch.setenv(name, value)
    assert gmem(monkeypatch) == 0
    assert capsys.readouterr().out.split() == [completed]
