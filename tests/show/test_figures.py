"""Figures are described once: both renderers draw the same of them, and what is recorded stands in one table."""

import matplotlib as mpl
import numpy as np
import pytest

import gmem_jax as gm
from gmem_jax.files.schemas import STAGE
from gmem_jax.show import render_matplotlib, render_plotly
from gmem_jax.show.figure import Curve, Figure, Image, Panel
from gmem_jax.show.recalls import recall_figure
from gmem_jax.show.stages import PAGE, QUANTITIES
from gmem_jax.show.summaries import of_gradient
from gmem_jax.simulation.sample import MEASURED

X = np.linspace(0.0, 1.0, 5)
LEFT = Panel((Curve(X, X**2, "square", errors=0.1 * X), Curve(X, X, "line", "0.5", "--")), "left", r"$\delta_0$", "y")
RIGHT = Panel((Image(np.outer(X, X), X, X, "values"),), "right", down=True, spans=((0.0, 0.5, "a"), (0.5, 1.0, "b")))
FIGURE = Figure((LEFT, RIGHT), 2, (8.0, 3.0), legend="panel")


def test_both_renderers_draw_the_same_numbers() -> None:
    pytest.importorskip("plotly")
    picture, page = render_matplotlib.to_matplotlib(FIGURE).figure, render_plotly.to_plotly(FIGURE)
    left, right = picture.axes[:2]
    for line, trace in zip((left.containers[0].lines[0], left.lines[-1]), page.data, strict=False):
        np.testing.assert_allclose(line.get_ydata(), trace.y, rtol=1e-6)  # single precision in a page
    np.testing.assert_allclose(right.images[0].get_array(), page.data[2].z, rtol=1e-6)
    np.testing.assert_allclose(page.data[0].error_y.array, 0.1 * X, rtol=1e-6)
    assert [axis.get_title() for axis in (left, right)] == [one.text for one in page.layout.annotations]
    assert right.yaxis_inverted()
    assert page.layout.yaxis2.autorange == "reversed"
    assert [(shape.x0, shape.x1) for shape in page.layout.shapes] == [(0.5, 1.0)]  # every second span
    assert page.data[1].line.color == "#808080"
    assert mpl.colors.to_rgba(left.lines[-1].get_color()) == (0.5, 0.5, 0.5, 1.0)


@pytest.mark.parametrize(
    ("text", "html"),
    [
        (r"$G E \delta_0 J$ and $p_{sig}$ (Pa)", "G E δ<sub>0</sub> J and p<sub>sig</sub> (Pa)"),
        (r"energy ($E\,R^3$)", "energy (E R<sup>3</sup>)"),
        ("a_b", "a_b"),
    ],
)
def test_formulas_of_labels_become_html(text: str, html: str) -> None:
    assert render_plotly._text(text) == html


def test_what_is_recorded_stands_in_files_and_can_be_drawn(recalled: tuple[gm.Experiment, gm.Recall]) -> None:
    recall = recalled[1]
    assert set(STAGE) - {"time"} == set(MEASURED)
    assert set(PAGE) <= set(QUANTITIES)
    for name, each in MEASURED.items():
        assert (STAGE[name].units, STAGE[name].words) == (each.unit, each.description)
        if not each.plot:
            continue
        (panel,) = recall_figure(recall, each.plot).panels
        first = {"E": 1e4}.get(each.unit, 1.0) * np.asarray(getattr(recall.stages["readout"], name))[..., 0].reshape(
            256, -1
        )[:, 0]
        count = first.shape[0]
        assert any(curve.y.shape == (count,) and np.array_equal(curve.y, first) for curve in panel.curves), name


def test_a_recall_is_drawn_with_the_names_of_its_configuration(
    recalled: tuple[gm.Experiment, gm.Recall],
) -> None:
    experiment, recall = recalled
    for known, names in (({}, ["signal 1", "signal 2"]), (gm.describe(experiment), ["0", "1"])):
        drawn = gm.plot(recall.described(known))
        assert [axis.get_title() for axis in drawn.figure.axes[:2]] == names


def test_the_unit_of_a_derivative_is_that_of_the_law_and_none_where_the_law_is_not_known() -> None:
    slopes = {"stiffness": 2.0, "waveform": [[1.0]]}
    result = {"pack": "a", "fidelity": 0.5, "places": [[0.5]], "gradient": slopes}
    for law, unit in (("hooke", " per E R"), ("mindlin", " per E R^0.5"), ("", "")):
        known = {"configuration": {"friction": law}} if law else {}
        assert f"dF/dstiffness = 2{unit}\n" in str(of_gradient({**result, **known}).lines[0])


@pytest.mark.parametrize("count", [1, 4])
def test_a_legend_below_lies_within_the_picture(count: int) -> None:
    u, words = np.linspace(0.0, 1.0, 5), "its mean over the ringing period"
    curves = tuple(Curve(u, u * (1 + number), f"{words} {number}") for number in range(count))
    drawn = render_matplotlib.to_matplotlib(Figure((Panel(curves),), legend="below")).figure
    drawn.canvas.draw()
    box = drawn.legends[0].get_window_extent()
    assert 0.0 <= box.x0 < box.x1 <= drawn.bbox.width
