"""`gmem show` prints and draws every kind of file that a command writes."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_cli import gmem

import gmem_jax as gm
from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.design.stored import save_kernel
from gmem_jax.files import schemas
from gmem_jax.files.results import save_result
from gmem_jax.files.waveforms import save_waveforms
from gmem_jax.show import recalls
from gmem_jax.sweeps.plan import point
from gmem_jax.sweeps.store import Store

RUN = {"seconds": 1.0, "status": 0, "configuration": {}}


@pytest.fixture(scope="module")
def folder(recalled: tuple[gm.Experiment, gm.Recall], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of every kind."""
    folder, (experiment, found) = tmp_path_factory.mktemp("files"), recalled
    configuration = gm.resolved(experiment, 1.0)
    gm.save_recall(folder / "recall.h5", found, configuration)
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
    store.remember(points, {}, ["mu"])
    for one in points:
        store.save(one.key, found, configuration)
    return folder


@pytest.fixture(scope="module")
def net(folder: Path) -> Path:
    from gmem_jax.reading import net, training
    from gmem_jax.reading.lessons import Lessons

    path = folder / "net.msgpack"
    training.save(path, training.Training(net.initial(Lessons(bits=1, hidden=(4,)), 0), 0, loss=0.5))
    return path


KINDS = {
    "recall.h5": (
        ["mu = 1, gamma0 = 0.001, delta0 = 0.05, t0 = 75 t_c", "all 2 words"],
        ["signals", "all", "Z", "p_x"],
    ),
    "pack.h5": (["27 tetra(0.6)"], ["grains", "phi"]),
    "kernel.h5": (["5 bumps of width 0.2", "resolution"], ["kernel", "recalls"]),
    "gradient.json": (["dF/dgamma0 = 3", "signal 2: 2 3"], ["waveforms"]),
    "tuned.json": (["mean F 0.8000 -> 0.9000 with mu = 1.2"], ["history", "values"]),
    "read.json": (["0.750"], ["confusion", "bits"]),
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
    for what in drawn:
        picture = tmp_path / f"{what}.png"
        assert gmem(monkeypatch, "show", folder / name, "--plot", what.upper(), "-o", picture) == 0
        assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_net_is_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path, net: Path
) -> None:
    assert gmem(monkeypatch, "show", net) == 0
    assert "words of 1 bits, seed 0: not finished" in capsys.readouterr().out
    assert gmem(monkeypatch, "show", net, "--plot", "weights", "-o", tmp_path / "w.svg") == 0
    assert "<svg" in (tmp_path / "w.svg").read_text()


def test_recalled_signals_are_given_as_csv(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, folder: Path
) -> None:
    assert gmem(monkeypatch, "show", folder / "recall.h5", "--csv") == 0
    lines = capsys.readouterr().out.splitlines()
    assert (lines[0], len(lines)) == ("u,p_sig of 0 (E),p_sig of 1 (E)", 257)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["recall.h5", "--plot", "colour", "-o", "x.png"], "there are signals, waveforms, all, pressure"),
        (["recall.h5", "--plot", "Z"], "name the picture with -o, as in -o Z.png"),
        (["recall.h5", "--plot", "Z", "-o", "x.h5"], "must end in one of .png, .svg, .pdf"),
        (["recall.h5", "--against", "v"], "must be one of time, u"),
        (["recall.h5", "-o", "x.png"], "say what to draw with --plot"),
        (["pack.h5", "--csv"], "this is no recall"),
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


def test_more_signals_than_fit_are_said_to_be_more(
    monkeypatch: pytest.MonkeyPatch, recalled: tuple[gm.Experiment, gm.Recall]
) -> None:
    monkeypatch.setattr(recalls, "MOST", 4)
    many = {name: np.tile(getattr(recalled[1], name), (40, 1)) for name in ("J", "shear", "p_sig")}
    recall = type(recalled[1])(**{**vars(recalled[1]), **many})
    figure = recalls.signals_drawing(recall, [f"{number:07b}" for number in range(80)], "a pack").figure
    assert "the first 4 of 80 signals are shown" in " ".join(figure._suptitle.get_text().split())
    assert [axis.get_title() for axis in figure.axes[:3]] == ["0000000", "0000001", "0000010"]


def test_commands_are_completed_in_a_shell(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    for name, value in (("_GMEM_COMPLETE", "complete_bash"), ("COMP_WORDS", "gmem sh"), ("COMP_CWORD", "1")):
        monkeypatch.setenv(name, value)
    assert gmem(monkeypatch) == 0
    assert capsys.readouterr().out.split() == ["show"]
