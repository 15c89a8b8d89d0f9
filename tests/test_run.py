"""The host loop: lists that go stale are rebuilt and the chunk redone, broken runs stop, progress is told."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import gmem_jax as gm
from gmem_jax.experiment.drive import Drive
from gmem_jax.experiment.host import Walker
from gmem_jax.experiment.protocol import Stage
from gmem_jax.experiment.walk import Course
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Status
from gmem_jax.physics.step import System, start

PACK = gm.load_pack(Path(__file__).parent / "data" / "tetra-27.h5")
AT, TURNED = PACK.position[..., None], PACK.quaternion[..., None]


COMPRESS = Stage("compress", 0.0, 1.0, 64 / 256)


def compress(skin: float, **settings: object) -> tuple[Walker, np.ndarray]:
    """A frictional compression of the 27-grain pack on lists of this skin; the walk and the wall pressures."""
    box = PACK.box
    still = start(System(PACK.clump, gm.Hooke(), PACK.pairs), AT, TURNED, box)
    finder = PairFinder(PACK.clump, np.asarray(box.lengths)[:, 0], skin)
    system = System(PACK.clump, gm.Hooke(), finder(still.grains, PACK.clump, box))
    course = Course(system, Drive(box.lower, box.upper, 0.05), 0.3, steps=2)
    walker = Walker(course, start(system, AT, TURNED, box), finder=finder, skin=skin, **settings)
    return walker, np.asarray(walker.play(COMPRESS)["compress"].pressure)


def test_a_list_that_goes_stale_is_rebuilt_and_its_chunk_redone_with_the_same_result() -> None:
    wide, expected = compress(0.8)
    # 0.12 R beyond the contacts of an uncompressed box does not survive the affine strain of 2.5 %.
    narrow, found = compress(0.12)
    assert wide.rebuilds == 0
    assert narrow.rebuilds >= 1
    # The same contacts in the same order; only sums over a wider padded table may round differently.
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_result_does_not_depend_on_the_length_of_a_chunk() -> None:
    _, expected = compress(0.8)
    for chunk in (1, 5):
        _, found = compress(0.8, chunk=chunk)
        np.testing.assert_array_equal(found, expected)


def test_a_broken_run_stops_and_names_the_stage() -> None:
    walker, _ = compress(0.8)
    position = walker.state.grains.position.at[0, 0, 0].set(jnp.nan)
    walker.state = replace(walker.state, grains=replace(walker.state.grains, position=position))
    with pytest.raises(gm.RunFailedError, match=r"doomed: .*not a finite number"):
        walker.play(Stage("doomed", 0.0, 0.0, 1 / 256))


def test_progress_rises_to_one_and_names_the_stage() -> None:
    calls: list[tuple[str, float, float]] = []
    compress(0.8, progress=lambda *told: calls.append(told), total_work=64.0, chunk=16)
    assert [name for name, _, _ in calls] == ["compress"] * 4
    np.testing.assert_allclose([fraction for _, _, fraction in calls], [0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(calls[-1][1], 64 * 2 * 0.3)


def test_every_status_bit_has_a_sentence() -> None:
    assert gm.explain(0) == "ok"
    for bit in Status:
        assert ";" in gm.explain(int(bit))
        assert "use" in gm.explain(int(bit)) or "allocate" in gm.explain(int(bit))
    assert not Status.NOT_AT_REST.fatal
    assert (Status.NOT_AT_REST | Status.STALE_PAIRS).fatal
