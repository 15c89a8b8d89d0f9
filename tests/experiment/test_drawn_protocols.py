"""Protocols drawn at random: each runs to finite numbers, or is refused in one line."""

import functools
import os
from typing import Any

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from scenes import TETRA_27

import gmem_jax as gm
from gmem_jax.errors import RunFailedError
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stage import Stage

PACK = gm.load_pack(TETRA_27)
BUMP = gm.Bumps(jnp.asarray([[1.0]]), jnp.asarray([[0.5]]), 0.6)
EARLY = gm.Bumps(jnp.asarray([[-1.0]]), jnp.asarray([[0.4]]), 0.6)
SETS = gm.signals(xy=BUMP, z=EARLY)

U = st.sampled_from([None, 0.0, 0.25, 0.5, 1.0, 1.5])
LENGTH = st.sampled_from([0.0, 0.003, 0.01, 0.03, -1.0])
AMPLITUDE = st.sampled_from([0.0, 0.5, 1.0, -1.0])
CHANNEL = st.sampled_from(["xy", "z", "compression"])
MORE = st.fixed_dictionaries(
    {},
    optional={
        "drag": st.sampled_from([0.0, 0.1]),
        "friction": st.booleans(),
        "pressure": st.sampled_from([(None, None, 3e-3), (3e-3, 3e-3, None)]),
        "recorded": st.booleans(),
        "mark": st.booleans(),
    },
)


def _written(channels: dict[str, str], **more: Any) -> Stage:
    return gm.write(**channels, **more)


WRITE = st.builds(
    _written,
    st.sampled_from([{}, {"xy": "xy"}, {"z": "xy"}, {"xy": "sine:2"}, {"z": "z", "xy": "xy"}]),
    to=U,
    length=LENGTH,
    amplitude=AMPLITUDE,
    along=st.sampled_from([None, "time"]),
)
STAGES = st.one_of(
    st.builds(gm.cycle, LENGTH, LENGTH, to=st.sampled_from([0.5, 1.0])),
    st.builds(lambda length, more: gm.hold(length, **more), LENGTH, MORE),
    st.builds(lambda to, length, more: gm.compress(to, length, **more), st.sampled_from([0.0, 0.5, 1.0]), LENGTH, MORE),
    WRITE,
    st.builds(gm.shake, AMPLITUDE, st.integers(0, 3), length=LENGTH, channel=CHANNEL),
    st.builds(gm.train, st.integers(0, 2), amplitude=AMPLITUDE, length=LENGTH),
    st.builds(gm.read, to=U, length=LENGTH),
)


def drawn(draw: st.DrawFn) -> tuple[Any, str]:
    """A protocol, or why it is none."""
    try:
        parts = [draw(STAGES) for _ in range(draw(st.integers(1, 5)))]
        return Protocol(*parts, _written({}, length=0.02), gm.read(length=0.02)), ""
    except ValueError as error:
        return None, str(error)


PROTOCOLS = st.composite(drawn)()


def runs_or_is_refused(found: tuple[Protocol | None, str], background: str = "sub0") -> str:
    """What became of it: "ran", or the line that refused it."""
    protocol, refused = found
    if protocol is not None:
        try:
            experiment = gm.Experiment(PACK, SETS, protocol=protocol, t0=60.0, gamma0=0.01, background=background)
            recall = gm.run(experiment, progress=False)
            for name, stage in recall.stages.items():
                assert np.all(np.isfinite(np.asarray(stage.pressure))), name
            assert np.all(np.isfinite(np.asarray(recall.p_sig)))
            return "ran"
        except (ValueError, RunFailedError) as error:
            refused = str(error)
    assert 10 < len(refused) < 400
    assert "\n" not in refused
    return refused


QUIET = functools.partial(
    settings, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True, database=None
)
PLAIN = (Protocol(gm.write(length=0.02), gm.read(length=0.02)), "")


@example(PLAIN)
@QUIET(max_examples=12)
@given(PROTOCOLS)
def test_a_few_protocols_run_or_are_refused(found: tuple[Protocol | None, str]) -> None:
    said = runs_or_is_refused(found)
    assert found != PLAIN or said == "ran"


@pytest.mark.slow
def test_many_protocols_run_or_are_refused() -> None:
    """A hundred, or as many as GMEM_DRAWN says: 1,000 were run by hand, in 12 minutes of one core."""
    outcomes: list[str] = []
    count = int(os.environ.get("GMEM_DRAWN", "100"))

    @QUIET(max_examples=count)
    @given(PROTOCOLS)
    def each(found: tuple[Protocol | None, str]) -> None:
        outcomes.append(runs_or_is_refused(found))
        if len(outcomes) % 50 == 0:
            jax.clear_caches()  # each protocol has a program; some hundreds fill what a process may map

    each()
    assert len(outcomes) >= 0.9 * count
    assert outcomes.count("ran") > 0.2 * len(outcomes)
