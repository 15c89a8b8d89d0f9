"""A periodic pack in a file, in the formats of others, and in a memory experiment."""

from dataclasses import replace
from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import PERIODIC_27, PERIODIC_XY_27, TETRA_27

import gmem_jax as gm
from gmem_jax import native
from gmem_jax.experiment.pack import stack
from gmem_jax.experiment.record import pack_fingerprint
from gmem_jax.files.exporters import EXPORT_FORMATS, format_of, frames_of_pack
from gmem_jax.files.frames import load_frames
from gmem_jax.files.importers import load_spheres
from gmem_jax.files.loads import frame_wall_forces, pressure_tensor
from gmem_jax.files.seal import seal
from gmem_jax.simulation import observables
from gmem_jax.simulation.loop import at_rest

PACK = gm.load_pack(PERIODIC_27)
EDGES = np.asarray(PACK.upper - PACK.lower)


def test_a_periodic_pack_comes_back_from_its_file_with_its_images(tmp_path: Path) -> None:
    gm.save_pack(tmp_path / "again.h5", PACK)
    again = gm.load_pack(tmp_path / "again.h5")
    assert again.periodic == PACK.periodic == (True, True, True)
    assert "boundary = periodic" in repr(again)
    np.testing.assert_array_equal(again.pairs.image, PACK.pairs.image)
    assert np.ptp(np.asarray(PACK.pairs.image)) > 0
    walls = replace(PACK, periodic=(False, False, False))
    assert len({pack_fingerprint(pack) for pack in (PACK, again, walls)}) == 2


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"periodic": (False, False, False)}, "a grain lies outside the box"),
        ({"position": PACK.position + jnp.asarray(EDGES)}, "a grain's centre lies outside the box"),
        ({"delta0": jnp.asarray(0.6)}, "delta0 must be in"),
    ],
)
def test_a_periodic_pack_that_is_none_is_not_written(change: dict, why: str, tmp_path: Path) -> None:
    with pytest.raises(gm.FileFormatError, match=why):
        gm.save_pack(tmp_path / "wrong.h5", replace(PACK, **change))
    assert not list(tmp_path.iterdir())


def test_a_list_that_misses_a_pair_through_an_image_is_refused(tmp_path: Path) -> None:
    through = np.flatnonzero(np.any(np.asarray(PACK.pairs.image) != 0, axis=1))
    valid = np.asarray(PACK.pairs.valid).copy()
    valid[through[3]] = False
    with pytest.raises(gm.FileFormatError, match="its list misses spheres"):
        gm.save_pack(tmp_path / "gap.h5", replace(PACK, pairs=replace(PACK.pairs, valid=jnp.asarray(valid))))


def test_a_boundary_that_a_file_does_not_mean_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.h5"
    path.write_bytes(PERIODIC_27.read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["boundary"] = "open"
    seal(path)
    with pytest.raises(gm.FileFormatError, match="boundary must be walls or periodic"):
        gm.load_pack(path)


def test_packs_of_two_boundaries_are_not_stacked() -> None:
    with pytest.raises(ValueError, match=r"must have one boundary: .* has periodic, .* has walls"):
        stack([PACK, gm.load_pack(TETRA_27)])
    assert stack([PACK, PACK]).pairs.image.shape[0] == 2


@pytest.mark.parametrize("name", EXPORT_FORMATS)
def test_exports_say_that_the_box_is_periodic(name: str, tmp_path: Path) -> None:
    pytest.importorskip({"gsd": "gsd.hoomd", "vtk": "pyvista"}.get(name, "numpy"))
    frames = frames_of_pack(PACK)
    chosen = format_of(name, several=False)
    path = tmp_path / f"out{chosen.suffix}"
    chosen.write(path, frames, float(PACK.clump.mass), gm.Material())
    if name == "gsd":
        import gsd.hoomd

        with gsd.hoomd.open(path, "r") as file:
            own, lengths = file[0].particles, np.asarray(file[0].configuration.box[:3], float)
        assert np.all(np.abs(own.position) <= 0.5 * lengths + 1e-5)
        np.testing.assert_allclose(own.position + own.image * lengths, frames.centres(0), atol=1e-5)
    elif name == "xyz":
        assert 'pbc="T T T"' in path.read_text(encoding="utf-8").splitlines()[1]
    elif name == "lammps":
        assert path.read_text(encoding="utf-8").splitlines()[0].endswith("boundary p p p")
        series = format_of(name, several=True)
        series.write(tmp_path / "out.lammpstrj", frames, 1.0, gm.Material())
        assert "BOX BOUNDS pp pp pp" in (tmp_path / "out.lammpstrj").read_text(encoding="utf-8")


def test_lines_between_contacts_end_at_the_images_that_they_reach(tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    chosen = format_of("vtk", several=True)
    chosen.write(tmp_path / "out.pvd", frames_of_pack(PACK), float(PACK.clump.mass), gm.Material())
    mesh = pyvista.read(next((tmp_path / "out").glob("contacts*")))
    ends = np.asarray(mesh.points)[np.asarray(mesh.lines).reshape(-1, 3)[:, 1:]]
    assert len(ends) == len(frames_of_pack(PACK).spheres)
    assert np.all(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) < 2.0)


def test_the_pressure_tensor_of_a_frame_is_what_was_measured_at_rest() -> None:
    frames = frames_of_pack(PACK)
    walls = frame_wall_forces(frames, 0, gm.Material())
    assert not np.any(walls)
    rest = PACK.info["at_rest"]
    np.testing.assert_allclose(np.diag(pressure_tensor(frames, 0, walls)), rest["pressure"], rtol=1e-5)
    assert rest["wall_contacts"] == 0.0


@pytest.mark.parametrize("source", [TETRA_27, PERIODIC_27, PERIODIC_XY_27], ids=["walls", "periodic", "both"])
def test_at_rest_walls_and_virial_say_one_stress(source: Path) -> None:
    experiment = gm.Experiment(gm.load_pack(source), gm.six_signals(), backend="jax")
    state, simulation = experiment.begin(), experiment.simulation(sheared=False)
    measured = np.asarray(at_rest(simulation, state, experiment.pack.box).pressure)[:, 0]
    seen = replace(simulation, box=experiment.pack.box)
    tensor = np.asarray(jax.jit(gm.observables.stress().reduce)(seen, state))[..., 0]
    np.testing.assert_allclose(np.diag(tensor), measured, rtol=1e-4)
    np.testing.assert_allclose(tensor, tensor.T, atol=1e-4 * measured.max())
    assert np.abs(tensor - np.diag(np.diag(tensor))).max() > 1e-3 * measured.max()


@pytest.mark.skipif(not native.available()[0], reason="the library was not built")
@pytest.mark.parametrize(
    "source",
    [pytest.param(PERIODIC_27, id="periodic"), pytest.param(PERIODIC_XY_27, id="both", marks=pytest.mark.slow)],
)
def test_a_recall_is_the_same_on_either_backend(source: Path) -> None:
    pack = gm.load_pack(source)
    found, expected = (
        gm.run(gm.Experiment(pack, gm.six_signals(), t0=20.0, backend=backend), progress=False)
        for backend in ("native", "jax")
    )
    # Round-off grows with every contact that opens or slides. Seen: 2e-12.
    np.testing.assert_allclose(found.p_sig, expected.p_sig, rtol=0.0, atol=1e-9 * np.abs(expected.p_sig).max())


def test_there_is_no_mixed_precision_in_a_periodic_box() -> None:
    if native.available()[0]:
        with pytest.raises(ValueError, match="precision='mixed' is not for periodic boxes; use 'double'"):
            gm.Experiment(PACK, gm.six_signals(), precision="mixed")


def test_a_rigidity_of_walls_is_refused_where_there_are_none() -> None:
    soft, where = gm.Material(wall_rigidity=0.5), "periodic along all axes has no walls"
    with pytest.raises(ValueError, match=where):
        gm.Experiment(PACK, gm.six_signals(), material=soft)
    with pytest.raises(ValueError, match=where):
        gm.prepare(gm.Recipe(grains=27, boundary="periodic"), material=soft)
    gm.Experiment(gm.load_pack(PERIODIC_XY_27), gm.six_signals(), material=soft)


def test_a_periodic_pack_recalls_what_was_written() -> None:
    recall = gm.run(gm.Experiment(PACK, gm.six_signals(), t0=20.0), progress=False)
    assert not gm.Status(int(np.bitwise_or.reduce(recall.status))).fatal
    assert recall.gain > 0.2
    # The walls that there are not carry nothing, and the pressure of the cell rises with its compression.
    rest, read = recall.stages["rest"], recall.stages["readout"]
    np.testing.assert_allclose(rest.pressure[0, :, 0], PACK.info["at_rest"]["pressure"], rtol=1e-3)
    assert np.all(read.pressure[0, :2, 0] > 3.0 * rest.pressure[0, :2, 0])


@pytest.mark.slow
def test_the_gradient_through_a_recall_of_a_periodic_pack_is_its_differences() -> None:
    bumps = gm.Bumps(jnp.asarray([[1.0, -0.6]]), jnp.asarray([[0.3, 0.7]]), 0.2)
    short = {"t0": 75.0, "dt": 0.3, "rest": 0.1, "hold": 0.1, "store": 0.2}
    experiment = gm.Experiment(PACK, bumps, gm.Hooke(mu=0.8), **short)

    def moment(_: gm.Experiment, p_sig: jnp.ndarray) -> jnp.ndarray:
        return 1e6 * jnp.sum(p_sig * jnp.linspace(0.0, 1.0, p_sig.shape[-1]))

    def value(**changes: float) -> float:
        return float(moment(experiment, gm.run(gm.replace(experiment, changes), progress=False).p_sig))

    found = gm.value_and_grad(experiment, ("gamma0", "friction.stiffness"), loss=moment, progress=False).slope
    for name, at, by, within in (("gamma0", 1e-3, 1e-8, 1e-5), ("friction.stiffness", 0.13, 1e-6, 1e-4)):
        difference = (value(**{name: at + by}) - value(**{name: at - by})) / (2.0 * by)
        assert float(found[name]) == pytest.approx(difference, rel=within)


@pytest.mark.parametrize("source", [TETRA_27, PERIODIC_XY_27], ids=["walls", "both"])
def test_stress_in_frames_has_the_friction_of_walls_in_it(source: Path, tmp_path: Path) -> None:
    """As the observers' of the same moment, but for the damping of walls, of which frames know nothing."""
    short = {"rest": 0.05, "hold": 0.05, "store": 0.5}
    experiment = gm.Experiment(gm.load_pack(source), gm.words(1), t0=300.0, gamma0=5e-3, wall_mu=1.0, **short)
    recall = gm.run(replace(experiment, observe={"stress": observables.stress()}), frames=5, frames_at=(0.0, 1.0))
    frames, number = recall.frames, recall.frames.stages.index("store")  # its end, where grains have come to rest
    gm.save_recall(tmp_path / "rough.h5", recall)
    np.testing.assert_array_equal(load_frames(tmp_path / "rough.h5").wall_friction, frames.wall_friction)
    stress = recall.stages["store"].observed["stress"][-1, ..., frames.signal]
    walls = frame_wall_forces(frames, number, experiment.material)
    tensor = pressure_tensor(frames, number, walls)
    smooth = pressure_tensor(frames, number, walls - frames.wall_friction[number])
    off = ~np.eye(3, dtype=bool)
    assert np.abs((smooth - stress)[off]).max() > 1e-3 * stress.max()
    np.testing.assert_allclose(tensor, stress, atol=1e-6 * stress.max())


@pytest.mark.parametrize("name", ["gsd", "lammps"])
def test_an_export_of_a_periodic_box_is_not_taken_for_a_pack_between_walls(name: str, tmp_path: Path) -> None:
    """Also where no sphere has crossed a face, so that no image tells of it."""
    inside = replace(frames_of_pack(PACK), position=0.5 * np.asarray(PACK.position)[None])
    form = format_of(name, several=False)
    path = tmp_path / f"a{form.suffix}"
    form.write(path, inside, 1.0, gm.Material())
    with pytest.raises(gm.FileFormatError, match="its box is periodic"):
        load_spheres(path)
