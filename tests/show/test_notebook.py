"""What a notebook shows: short tables in the place of objects, pictures, progress."""

import inspect
import io
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gmem_jax as gm
from gmem_jax.derivatives.gradient import Gradient
from gmem_jax.experiment.html import listing
from gmem_jax.files.exporters import frames_of_pack
from gmem_jax.show import recalls
from gmem_jax.show.render_matplotlib import to_matplotlib
from gmem_jax.simulation.progress import ProgressChoice, callback, no_further_bar, shows_progress
from gmem_jax.sweeps.sweep import Result, Results


def test_objects_are_shown_as_short_tables(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    experiment, recall = recalled
    for shown, words in (
        (experiment.pack, ("27 tetra(0.6)", "T1 (t_c)", "coordination Z")),
        (experiment, ("2, bumps", "Hooke, mu = 1", "<td>75</td>")),
        (recall, ("Recall of 2 signals", f"<td>{float(recall.gain):.4g}</td>", "F over T1")),
        (
            Results([Result({"friction.mu": 0.5}, recall)]),
            ("Sweep of 1 point<", "<th>friction.mu</th>", "<td>0.5</td>"),
        ),
    ):
        table = shown._repr_html_()
        assert table.startswith("<table>")
        assert table.count("<tr>") < 15
        assert all(word in table for word in words), table


def test_objects_are_one_line_in_a_terminal(recalled: tuple[gm.Experiment, gm.Recall], tmp_path: Path) -> None:
    experiment, recall = recalled
    gm.save_recall(tmp_path / "r.h5", recall)
    for shown, words in (
        (experiment.pack, "<Pack tetra-27: grains = 27 tetra(0.6), "),
        (experiment, "27 grains, signals = 2, bumps, friction = Hooke, mu = 1, gamma0 = 0.001, "),
        (recall, f"<Recall of 2 signals: G = {float(recall.gain):.4g}, "),
        (gm.load_recall(tmp_path / "r.h5"), "<Recall of 2 signals: "),
        (gm.six_signals(), "<6 signals: bumps = 3, width = 0.2>"),
        (gm.waveform([0.1, 0.2]), "<1 signal: nodes = 4>"),
        (jax.tree.map(lambda _: None, experiment), "<Experiment>"),
        (recall.stages["encode"], "Sample(u=float64[256, 3], pressure=float64[256, 3, 3], "),
        (frames_of_pack(experiment.pack), "Frames(time=float64[1], u=float64[1], position=float64[1, 27, 3], "),
        (gm.view(experiment.pack), "View(html='<!DOCTYPE html>"),
        (
            Gradient(jnp.asarray(0.5), {"mu": jnp.ones(2)}, jnp.ones((1, 4))),
            "Gradient(value=0.5, slope={'mu': float64[2]}, p_sig=",
        ),
    ):
        assert words in repr(shown)
        assert len(repr(shown)) < 400
        assert "\n" not in repr(shown)
    jax.jit(lambda each: repr(each) and each.gamma0)(experiment)
    jax.jit(lambda each: repr(each) and each.u)(recall.stages["encode"])


def test_objects_are_shown_inside_transformations_too(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    said: list[str] = []

    def show(recall: gm.Recall) -> jax.Array:
        said.append(recall._repr_html_())
        return recall.gain

    jax.eval_shape(show, recalled[1])
    assert "traced" in said[0]


def test_a_long_table_says_how_much_is_left_out_and_names_cannot_break_it() -> None:
    table = listing("many", ["<b>"], [[f"row {number}"] for number in range(25)])
    assert "... 5 more" in table
    assert "row 19" in table
    assert "row 20" not in table
    assert "<b>" not in table


def test_a_recall_draws_itself(recalled: tuple[gm.Experiment, gm.Recall], tmp_path: Path) -> None:
    experiment, recall = recalled
    drawn = gm.plot(recall, "signals")
    assert drawn._repr_png_().startswith(b"\x89PNG")
    title = " ".join(drawn.figure._suptitle.get_text().split())
    assert all(word in title for word in ("mu = 1", "gamma0 = 0.001", "t0 = 75 t_c", "all 2 words"))
    stress, wave = drawn.figure.axes[0], drawn.figure.axes[2]
    assert (stress.get_title(), wave.get_ylabel(), stress.get_ylabel()) == ("0", "", "stress (Pa)")
    np.testing.assert_allclose(stress.lines[1].get_ydata() * 1e-10, 0.0, atol=1e-3)
    (axis,) = gm.plot(recall, "z").figure.axes
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("time ($t_c$)", "coordination Z")
    total = sum(len(line.get_xdata()) for line in axis.lines if len(line.get_xdata()) > 2)
    assert total == experiment.protocol.bins
    (axis,) = gm.plot(recall, "p_x", against="u").figure.axes
    assert axis.get_xlabel() == "compression variable u"
    assert [label.get_text() for label in axis.figure.legends[0].get_texts()][-1].startswith("readout")
    with pytest.raises(ValueError, match="pictures of a recall are signals, waveforms"):
        gm.plot(recall, "colour")


def test_the_scaled_integral_without_an_experiment_is_that_with_it(
    recalled: tuple[gm.Experiment, gm.Recall],
) -> None:
    experiment, recall = recalled
    one, other = (
        to_matplotlib(recalls.signals_figure(recall, ["0", "1"], "", scale)).figure.axes[0].lines[2].get_ydata()
        for scale in (None, experiment.scale)
    )
    np.testing.assert_allclose(one, other, rtol=1e-12)


def test_progress_is_shown_in_a_terminal_and_in_a_notebook(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    bar = gm.ProgressBar()
    for fraction in (0.1, 0.2, 1.0):
        bar("encode", 7.0, fraction)
    said = capsys.readouterr().err
    assert "10% encode, t = 7 t_c" in said
    assert "20%" not in said  # too soon after the first
    assert said.endswith("100% encode, t = 7 t_c\n")
    shown: list[Any] = []
    handle = SimpleNamespace(update=lambda content, raw: shown.append(content))
    shell = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=None))
    monkeypatch.setitem(sys.modules, "IPython", shell)
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=lambda *_, **__: handle))
    gm.ProgressBar()("<rest>", 0.0, 0.25)
    assert shown[0]["text/html"] == '<progress value="0.2500" max="1"></progress> 25% &lt;rest&gt;'
    assert capsys.readouterr().err == ""


class Terminal(io.StringIO):
    """What a person looks at."""

    def isatty(self) -> bool:
        return True


def test_a_run_is_watched_in_a_terminal_unless_it_is_told_not_to(
    recalled: tuple[gm.Experiment, gm.Recall], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    experiment, told = recalled[0], []

    def said(**options: Any) -> str:
        monkeypatch.setattr(sys, "stderr", shown := Terminal())
        gm.run(experiment, **options)
        return shown.getvalue()

    assert said().endswith("\n")
    assert "encode" in said() or "readout" in said()
    assert said(progress=False) == ""
    assert said(progress=lambda *now: told.append(now)) == ""
    assert told[-1][-1] == 1.0
    with no_further_bar():
        assert said() == ""
    monkeypatch.setattr(sys, "stderr", nobody := io.StringIO())
    gm.run(experiment)
    assert nobody.getvalue() == ""


def test_a_run_in_another_shows_no_bar_of_its_own_and_a_broken_one_ends_its_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "IPython", raising=False)
    monkeypatch.setattr(sys, "stderr", shown := Terminal())

    @shows_progress
    def inner(progress: ProgressChoice = None) -> None:
        callback(progress)("inner", 0.0, 0.5)

    @shows_progress
    def outer(progress: ProgressChoice = None) -> None:
        callback(progress)("outer", 0.0, 0.5)
        inner()
        raise RuntimeError

    with pytest.raises(RuntimeError):
        outer()
    assert "outer" in shown.getvalue()
    assert "inner" not in shown.getvalue()
    assert shown.getvalue().endswith("\n")


def test_everything_that_runs_for_long_tells_how_far_it_is() -> None:
    for one in (
        gm.run,
        gm.prepare,
        gm.sweep,
        gm.value_and_grad,
        gm.jacobian,
        gm.memory_kernel,
        gm.design_waveforms,
        gm.design_by_kernel,
        gm.design_drive,
    ):
        assert inspect.signature(one).parameters["progress"].default is None
