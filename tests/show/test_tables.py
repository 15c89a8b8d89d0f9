"""What tables say a recall was made with, and which published points they put beside it."""

import math
from typing import Any

import pytest
from scenes import PERIODIC_27, TETRA_27

import gmem_jax as gm
from gmem_jax.experiment.record import describe
from gmem_jax.show import tables


def described(pack: Any = TETRA_27, **more: Any) -> dict[str, Any]:
    found = describe(gm.Experiment(gm.load_pack(pack), gm.six_signals(), t0=1.8e4, **more))
    return {**found, "grains": 325}  # so many have a published point


def test_a_slow_recall_of_the_paper_stands_beside_its_published_point() -> None:
    assert tables._comparable(described())
    assert "t0 = 18000 t_c, the six signals" in tables.conditions(described())


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"gravity": 1e-5}, "t0 = 18000 t_c, gravity = 1e-05 R/t_c^2, the six signals"),
        ({"wall_mu": 0.3}, "t0 = 18000 t_c, wall_mu = 0.3, the six signals"),
        ({"creep": 1e-6, "creep_fades": 10.0}, "creep = 1e-06 1/t_c, creep_fades = 10 t_c"),
    ],
)
def test_what_the_paper_has_not_is_said_and_has_no_published_point(more: dict[str, Any], words: str) -> None:
    assert words in tables.conditions(described(**more))
    assert not tables._comparable(described(**more))


def test_a_periodic_pack_has_no_published_point() -> None:
    periodic = described(PERIODIC_27)
    assert periodic["pack_record"]["recipe"]["boundary"] != "walls"
    assert not tables._comparable(periodic)


def test_where_there_is_no_error_none_is_printed() -> None:
    assert [tables.decimal(0.25, error) for error in (0.125, math.nan)] == ["0.250 ± 0.125", "0.250"]
    assert tables.decimal(math.nan, 0.1) == "-"
    left = {"correlation": -0.5, "correlation_se": math.nan, "gain": 0.25, "gain_se": math.nan}
    said = tables.second_readout_lines({"second_readout": left})
    assert said == "second readout: correlation with J -0.500,\ngain 0.2500 (mean over signals)"
    sure = tables.second_readout_lines({"second_readout": left | {"correlation_se": 0.1, "gain_se": 0.125}})
    assert sure.endswith("-0.500 ± 0.100,\ngain 0.2500 ± 0.1250 (mean ± SE over signals)")
