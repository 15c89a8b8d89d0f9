"""Pictures that need no experiments: two grains, packs, single contacts."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import gmem_jax as gm
from gmem_jax.experiment.analysis import compare
from gmem_jax.experiment.signals import bin_average, part
from gmem_jax.reproduce.run import Reproduction
from gmem_jax.reproduce.two_grains import tell
from gmem_jax.show.render import camera, rendered
from gmem_jax.show.render_matplotlib import to_matplotlib
from gmem_jax.show.sweeps import sweep_figure
from gmem_jax.show.tables import cell


def test_a_contact_keeps_the_shear_at_which_it_formed_until_it_breaks() -> None:
    signal, law = part(gm.six_signals(), 0, 1), gm.Hooke()
    story = tell(np.array([0.2, 0.3, 0.5]), signal, law, gamma0=1e-6)
    stored = story.force[story.time == 1.0][0]
    # Formed before the bump, at its top, and after it; a shear this small hardly slides.
    np.testing.assert_allclose(stored, [0.0, -law.stiffness * 1e-6, 0.0], atol=0.02 * law.stiffness * 1e-6)
    after = story.time > 1.5
    assert np.all(story.force[after & (story.u < 0.29), 1] == 0.0)
    np.testing.assert_allclose(story.force[after & (story.u > 0.32), 1], stored[1], rtol=1e-9)


def test_contacts_of_all_u_read_the_integral_out_reversed() -> None:
    signal = part(gm.six_signals(), 4, 5)
    story = tell((np.arange(32) + 0.5) / 32, signal, gamma0=1e-5)
    match = compare(jnp.asarray(story.recalled)[None], bin_average(signal), 1.0)
    assert match.gain > 0.0
    assert match.fidelity > 0.9


def test_a_rendered_sphere_is_a_disc_and_the_nearer_hides_the_farther() -> None:
    red, blue = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    alone = rendered(np.zeros((1, 3)), red, pixels=210)
    assert alone[..., 3].sum() == pytest.approx(np.pi * 100.0**2, rel=0.01)
    towards_the_eye = camera(np.deg2rad(-35.0), np.deg2rad(25.0))[2]
    pair = np.stack([0.5 * towards_the_eye, -0.5 * towards_the_eye])
    for order in ([0, 1], [1, 0]):
        image = rendered(pair[order], np.concatenate([red, blue])[order], pixels=210)
        assert image[105, 105, 0] > 0.0
        assert image[105, 105, 2] == 0.0


def test_a_picture_is_written(tmp_path: Path) -> None:
    said: list[str] = []
    files = Reproduction(tmp_path, say=said.append).picture("fig05")
    assert [path.name for path in files] == ["fig05.png", "fig05.svg"]
    assert all(path.stat().st_size > 200 for path in files)
    assert said[0].startswith("fig05")


def test_packs_are_called_by_their_files_and_else_by_their_whole_names() -> None:
    assert [cell(name) for name in ("here/pack.b.h5", "tetra(0.6)-64-seed1")] == ["pack.b", "tetra(0.6)-64-seed1"]


def test_a_sweep_is_drawn_over_what_can_be_counted() -> None:
    points = [(pack, mu) for pack in ("a.h5", "b.h5") for mu in (0.2, 1.0)]
    rows = [{"pack": pack, "mu": mu, "gain": mu, "state": "done", "key": f"{pack} {mu}"} for pack, mu in points]
    (axis,) = to_matplotlib(sweep_figure(rows, ["pack", "mu"], "gain", "mu")).figure.axes
    assert axis.get_xlabel() == "mu"
    np.testing.assert_allclose(axis.lines[1].get_xydata(), [[0.2, 0.2], [1.0, 1.0]])
