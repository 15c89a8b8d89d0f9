"""What a picture of a sweep shows: nothing is averaged that was not asked for, and errors are those of the samples."""

from typing import Any

import numpy as np
import pytest

from gmem_jax.show import render_plotly
from gmem_jax.show.render_matplotlib import to_matplotlib
from gmem_jax.show.sweeps import against, sweep_figure
from gmem_jax.sweeps.curves import Axes, axes_of, lines_of
from gmem_jax.sweeps.table import means

NAMES = ["prepare.seed", "mu", "gamma0", "pack"]
ROWS: list[dict[str, Any]] = [
    {"prepare.seed": seed, "mu": mu, "gamma0": gamma0, "pack": "", "fidelity": mu + gamma0 + 0.1 * seed, "gain": mu}
    for seed in (1, 2, 3)
    for mu in (0.2, 1.0)
    for gamma0 in (1e-3, 2e-3)
]
for number, row in enumerate(ROWS):
    row |= {"state": "done", "key": str(number)}


def test_a_parameter_has_a_line_and_samples_have_a_mean_unless_it_is_said_otherwise() -> None:
    assert axes_of(ROWS, NAMES) == Axes("mu", ("gamma0",), ("prepare.seed",))
    assert axes_of(ROWS, NAMES, x="gamma0") == Axes("gamma0", ("mu",), ("prepare.seed",))
    assert axes_of(ROWS, NAMES, over=["gamma0"]) == Axes("mu", ("prepare.seed",), ("gamma0",))
    assert axes_of(ROWS, NAMES, by=["prepare.seed"], over=["gamma0"]) == Axes("mu", ("prepare.seed",), ("gamma0",))
    assert axes_of(ROWS, ["prepare.seed"]).x == "prepare.seed"  # nothing else varies


def test_what_goes_together_with_the_axis_makes_no_lines() -> None:
    zipped = [{**row, "delta0": 50 * row["gamma0"]} for row in ROWS]
    assert axes_of(zipped, [*NAMES, "delta0"], x="gamma0").by == ("mu",)


@pytest.mark.parametrize(
    ("chosen", "problem"),
    [
        ({"x": "colour"}, "colour: does not vary here; prepare.seed, mu, gamma0, pack do"),
        ({"x": "mu", "over": ["mu"]}, "mu: is named twice in --x, --by and --over"),
        ({"x": "mu", "by": ["prepare.seed"]}, "gamma0: varies too"),
    ],
)
def test_a_choice_that_leaves_something_open_is_refused(chosen: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        axes_of(ROWS, NAMES, **chosen)


def test_errors_are_standard_errors_over_the_samples() -> None:
    first, second = lines_of(ROWS, axes_of(ROWS, NAMES), "fidelity")
    assert (first.values, second.values) == ({"gamma0": 1e-3}, {"gamma0": 2e-3})
    assert first.x == [0.2, 1.0]
    np.testing.assert_allclose(second.mean, [0.402, 1.202])
    np.testing.assert_allclose(second.error, 0.1 / np.sqrt(3.0))
    (alone,) = lines_of([row for row in ROWS if row["gamma0"] == 1e-3], Axes("mu", (), ()), "fidelity")
    assert alone.most == 3


def test_a_result_that_is_asked_for_twice_counts_once() -> None:
    keyed = [{**row, "status": 0, "warnings": ""} for row in ROWS]
    twice = [*keyed, {**keyed[0], "mu": 0.2}]
    for some in (keyed, twice):
        first, _ = lines_of(some, axes_of(some, NAMES), "fidelity")
        assert first.most == 3
        measured = [{**row, "windowed_gain": 0.0, "windowed_fidelity": 0.0} for row in some]
        means_ = means(measured, ["prepare.seed", "mu", "gamma0"], ["prepare.seed"])
        assert [one["points"] for one in means_] == [3] * 4


def test_a_picture_has_a_line_with_bars_for_each_value_and_says_over_what() -> None:
    figure = to_matplotlib(sweep_figure(ROWS, NAMES, "fidelity", "swept")).figure
    (axis,) = figure.axes
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["gamma0 = 0.001", "gamma0 = 0.002"]
    bars = [bar.get_segments() for bar in axis.collections]
    np.testing.assert_allclose([np.ptp(bar[0][:, 1]) for bar in bars], 0.2 / np.sqrt(3.0))
    assert "mean ± SE over prepare.seed, n = 3" in figure.get_suptitle()
    with pytest.raises(ValueError, match="no point is done"):
        sweep_figure([{**ROWS[0], "state": "open"}], NAMES, "fidelity", "swept")


def test_names_stand_on_the_axis_as_words_and_make_no_line() -> None:
    rows = [{**row, "friction": law, "hold_drag": drag} for row in ROWS for law in "HM" for drag in (0.1, "none")]
    for x, ticks in {"friction": ["H", "M"], "hold_drag": ["0.1", "none"]}.items():
        (axis,) = to_matplotlib(sweep_figure(rows, [*NAMES, "friction", "hold_drag"], "fidelity", "s", x=x)).figure.axes
        assert [label.get_text() for label in axis.get_xticklabels()] == ticks


def test_a_report_draws_no_seed_as_an_axis() -> None:
    pytest.importorskip("plotly")
    assert against("prepare.seed", ROWS, NAMES) is None
    found = against("mu", ROWS, NAMES)
    assert found is not None
    drawn = render_plotly.to_plotly(found)
    assert [trace.name for trace in drawn.data][:2] == ["F gamma0 = 0.001", "F gamma0 = 0.002"]
    np.testing.assert_allclose(drawn.data[0].error_y.array, 0.1 / np.sqrt(3.0), rtol=1e-6)
    assert "mean ± SE over prepare.seed" in drawn.layout.yaxis.title.text
