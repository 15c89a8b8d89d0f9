"""Packs of grains and spheres of unequal size: in their own file, in the formats of others, and in pictures."""

from dataclasses import replace
from pathlib import Path

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SPREAD_27, TETRA_27

import gmem_jax as gm
from gmem_jax.experiment.pack import stack
from gmem_jax.experiment.record import pack_fingerprint
from gmem_jax.files.exporters import EXPORT_FORMATS, format_of, frames_of_pack
from gmem_jax.files.frames import load_frames
from gmem_jax.files.importers import load_spheres
from gmem_jax.files.loads import frame_wall_forces, pressure_tensor
from gmem_jax.files.seal import seal
from gmem_jax.physics.grain import clump, sized
from gmem_jax.physics.step import start
from gmem_jax.preparation import imported
from gmem_jax.show.render import pack_image
from gmem_jax.simulation import observables

EQUAL = gm.load_pack(TETRA_27)
SIZES = np.random.default_rng(0).uniform(0.93, 1.04, 27)


def unequal(**other) -> gm.Pack:
    """The test pack with grains of many sizes, one sphere of which is smaller; at rest it is not."""
    bent = clump(EQUAL.clump.offsets, "bent", radii=[1.0, 1.0, 0.9, 1.0])
    pack = replace(EQUAL, clump=sized(replace(bent, offsets=EQUAL.clump.offsets), SIZES), **other)
    diameter = 2.0 * (1.0 + np.linalg.norm(EQUAL.clump.offsets, axis=1).max())
    pack = replace(pack, clump=replace(pack.clump, diameter=jnp.asarray(diameter)))
    return gm.pack_from(pack, position=EQUAL.position, quaternion=EQUAL.quaternion)


PACK = unequal()
RADII = np.asarray(PACK.clump.sphere_radii(108))


def test_a_pack_of_unequal_spheres_comes_back_from_its_file(tmp_path: Path) -> None:
    gm.save_pack(tmp_path / "again.h5", PACK, frames=frames_of_pack(PACK))
    again = gm.load_pack(tmp_path / "again.h5")
    np.testing.assert_array_equal(again.clump.sizes, SIZES)
    np.testing.assert_array_equal(again.clump.radii, [1.0, 1.0, 0.9, 1.0])
    assert again.pairs == PACK.pairs
    assert "unequal = sizes 0.93" in repr(again)
    assert "spheres of radii 0.9 to 1 R" in repr(again)
    frames = load_frames(tmp_path / "again.h5")
    np.testing.assert_array_equal(frames.sphere_radii, RADII)
    np.testing.assert_array_equal(frames.centres(0), frames_of_pack(PACK).centres(0))
    other = replace(PACK, clump=replace(PACK.clump, sizes=PACK.clump.sizes[::-1]))
    assert len({pack_fingerprint(pack) for pack in (PACK, again, other)}) == 2


def test_a_pack_of_equal_spheres_has_no_sizes_in_its_file(tmp_path: Path) -> None:
    gm.save_pack(tmp_path / "equal.h5", EQUAL)
    with h5py.File(tmp_path / "equal.h5") as file:
        assert sorted(file["clump"]) == ["diameter", "inertia", "mass", "offsets"]
    assert gm.load_pack(tmp_path / "equal.h5").clump.equal


def changed(**clump_changes) -> gm.Pack:
    return replace(PACK, clump=replace(PACK.clump, **clump_changes))


@pytest.mark.parametrize(
    ("pack", "why"),
    [
        (changed(sizes=jnp.asarray(SIZES).at[3].set(0.0)), r"radii of spheres must be in \[0.1, 10\] R, got 0 to"),
        (changed(sizes=jnp.asarray(SIZES).at[3].set(-1.0)), r"radii of spheres must be in \[0.1, 10\] R, got -1 to"),
        (changed(sizes=jnp.asarray(SIZES).at[3].set(jnp.nan)), "clump/sizes holds numbers that are not finite"),
        (changed(radii=jnp.asarray([1.0, 1.0, 0.9, 2.0])), "the grain's diameter is"),
        (changed(sizes=jnp.asarray(SIZES).at[3].set(0.1)), r"radii of spheres must be in \[0.1, 10\] R, got 0.09 to"),
        (changed(sizes=jnp.ones(26)), r"'clump/sizes' has shape \[26\], must be \[grain\] with grain = 27"),
        (changed(radii=jnp.ones(3)), r"'clump/radii' has shape \[3\], must be \[part\] with part = 4"),
        (changed(sizes=1.1 * jnp.asarray(SIZES)), "its list is stale"),
    ],
)
def test_a_pack_of_impossible_sizes_is_not_written(pack: gm.Pack, why: str, tmp_path: Path) -> None:
    with pytest.raises(gm.FileFormatError, match=why) as error:
        gm.save_pack(tmp_path / "wrong.h5", pack)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_list_that_misses_a_pair_of_unequal_spheres_is_refused(tmp_path: Path) -> None:
    valid = np.asarray(PACK.pairs.valid).copy()
    valid[7] = False
    with pytest.raises(gm.FileFormatError, match="its list misses spheres"):
        gm.save_pack(tmp_path / "gap.h5", replace(PACK, pairs=replace(PACK.pairs, valid=jnp.asarray(valid))))


def test_a_file_whose_sizes_were_changed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "changed.h5"
    gm.save_pack(path, PACK)
    with h5py.File(path, "r+") as file:
        file["clump/sizes"][3] = 0.0
    seal(path)
    with pytest.raises(gm.FileFormatError, match="radii of spheres must be in"):
        gm.load_pack(path)


def test_packs_with_and_without_sizes_are_not_stacked() -> None:
    with pytest.raises(ValueError, match="either all packs of a stack have sizes, or none"):
        stack([replace(PACK, clump=replace(PACK.clump, shape=EQUAL.clump.shape)), EQUAL])
    assert stack([PACK, PACK]).clump.sizes.shape == (2, 27)


def test_loads_of_a_frame_are_those_of_the_contacts() -> None:
    """Elastic forces of spheres and walls, and the stress that they make, against the observers' of the same state."""
    experiment = gm.Experiment(PACK, gm.six_signals(), gm.Frictionless(), t0=20.0, material=gm.Material())
    simulation, frames = experiment.simulation(sheared=False), frames_of_pack(PACK)
    state = start(simulation.system, PACK.position[..., None], PACK.quaternion[..., None], PACK.box)
    stress = observables.stress()(replace(simulation, box=PACK.box), state)[..., 0]
    walls = frame_wall_forces(frames, 0, gm.Material())
    assert np.abs(walls).max() > 1e-4
    np.testing.assert_allclose(pressure_tensor(frames, 0, walls), stress, rtol=1e-11, atol=1e-16)


def spheres_of(path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Centres and radii of the spheres in a file of another format, [S, 3] and [S]."""
    if name == "gsd":
        with pytest.importorskip("gsd.hoomd").open(path) as file:
            frame = file[0]
        middle = 0.5 * np.asarray(PACK.lower + PACK.upper)
        return frame.particles.position + middle, 0.5 * frame.particles.diameter
    if name == "vtk":
        mesh = pytest.importorskip("pyvista").read(path)
        return np.asarray(mesh.points), np.asarray(mesh["radius"])
    lines = path.read_text().splitlines()
    rows = np.array([line.split()[1:] for line in lines[2:] if line.startswith("S ")] or [[0.0]], float)
    if name == "lammps":
        start = next(n for n, line in enumerate(lines) if line.startswith("Atoms")) + 2
        rows = np.array([line.split() for line in lines[start : start + 108]], float)
        return rows[:, 2:5], 0.5 * rows[:, 5]
    return rows[:, :3], rows[:, 3]


@pytest.mark.parametrize("name", EXPORT_FORMATS)
def test_every_format_has_the_radii(name: str, tmp_path: Path) -> None:
    if name == "vtk":
        pytest.importorskip("vtkmodules")
    chosen = format_of(name, several=False)
    path = tmp_path / f"pack{chosen.suffix}"
    frames = frames_of_pack(PACK)
    chosen.write(path, frames, float(PACK.clump.mass), gm.Material())
    centres, radii = spheres_of(path, name)
    np.testing.assert_allclose(radii, RADII, rtol=1e-6)
    np.testing.assert_allclose(centres, frames.centres(0), atol=2e-6)


def test_a_picture_shows_large_spheres_larger() -> None:
    """Of a lone sphere of twice the size in the same box of pixels: four times as many pixels, cut by none."""
    ball = replace(EQUAL, position=jnp.zeros((2, 3)).at[1, 0].set(20.0), quaternion=EQUAL.quaternion[:2])
    covered = []
    for sizes in ([2.0, 2.0], [2.0, 1.0]):
        drawn = pack_image(replace(ball, clump=sized(gm.sphere(), sizes)), 400)[..., 3] > 0.0
        half = drawn.shape[1] // 2
        covered.append([drawn[:, :half].sum(), drawn[:, half:].sum()])
    small, large = sorted(covered[1])
    assert large / small == pytest.approx(4.0, rel=0.1)
    assert covered[0][0] == pytest.approx(covered[0][1], rel=0.05)


# ---------------------------------------------------------------- read from others, and run


@pytest.mark.parametrize("name", ["lammps", "gsd"])
@pytest.mark.parametrize("pack", [gm.load_pack(SPREAD_27), PACK], ids=["sizes", "sizes and radii"])
def test_a_pack_of_unequal_grains_comes_back_from_others(
    pack: gm.Pack, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "gsd":
        pytest.importorskip("gsd.hoomd")
    monkeypatch.setattr(imported, "ringing_period", lambda *_: 20.0)
    path = tmp_path / f"pack{format_of(name, several=False).suffix}"
    frames = frames_of_pack(pack)
    format_of(name, several=False).write(path, frames, float(pack.clump.mass), gm.Material())
    back = imported.import_pack(path)
    within = 2e-6 if name == "gsd" else 1e-12  # GSD is in single precision
    there, middle = frames_of_pack(back), 0.5 * np.asarray(back.lower + back.upper - pack.lower - pack.upper)
    np.testing.assert_allclose(there.sphere_radii, frames.sphere_radii, rtol=within)
    np.testing.assert_allclose(there.centres(0) - middle, frames.centres(0), atol=within)
    volumes = [float(one.clump.volume(27)) for one in (back, pack)]
    if pack is not PACK:  # whose offsets were moved after they had been those of its centre of mass
        assert back.clump.shape == "tetra(0.6)"
        np.testing.assert_allclose(back.clump.sizes, pack.clump.sizes, rtol=within)
        np.testing.assert_allclose(*volumes, rtol=10.0 * within)
    gm.save_pack(tmp_path / "back.h5", back)
    assert back.info["imported"]["notes"] == []


def test_grains_that_are_alike_but_for_one_radius_are_not_of_one_shape() -> None:
    radii = np.array([[1.0, 0.6], [0.6, 1.0], [2.0, 1.2], [1.0, 0.7]])
    sizes, own = imported.sizes_of(radii)
    np.testing.assert_allclose(sizes, [1.0, 1.0, 2.0, 1.7 / 1.6])
    offsets = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    centres = np.stack([offsets, offsets[::-1], offsets, offsets]) + np.arange(4.0)[:, None, None]
    alike = radii / sizes[:, None]
    position, _ = imported.lay(centres[:3], offsets, alike[:3], own)
    np.testing.assert_allclose(position, np.arange(3.0)[:, None] * np.ones(3), atol=1e-12)
    with pytest.raises(gm.FileFormatError, match=r"grain 4 has another shape than the first: .* or has another radius"):
        imported.lay(centres, offsets, alike, own)


def test_lammps_own_hybrid_is_read_by_its_densities_where_radii_differ(tmp_path: Path) -> None:
    """Columns in the order sphere, molecular, under the bare word that LAMMPS writes."""
    path = tmp_path / "pack.data"
    chosen = format_of("lammps", several=False)
    chosen.write(path, frames_of_pack(PACK), float(PACK.clump.mass), gm.Material())
    path.write_text(path.read_text().replace("hybrid sphere molecular", "hybrid"))
    np.testing.assert_allclose(load_spheres(path).radii.ravel(), RADII, rtol=1e-14)
    with pytest.raises(gm.FileFormatError, match=r"radii of spheres must be in .* is given by --radius"):
        load_spheres(path, 0.01)


def test_a_prepared_pack_of_many_sizes_is_at_rest_and_remembers() -> None:
    pack = gm.load_pack(SPREAD_27)
    rest, sizes = pack.info["at_rest"], np.asarray(pack.clump.sizes)
    assert sizes.std() / sizes.mean() == pytest.approx(0.1, rel=0.05)
    expected = gm.lognormal(27, 0.1, seed=1)
    np.testing.assert_allclose(sizes, expected, rtol=1e-15)  # NumPy's exp and mean differ by CPU in the last bit
    assert rest["largest_speed"] < 1e-6
    assert rest["pressure"][2] == pytest.approx(2e-3, rel=0.1)
    frames = frames_of_pack(pack)
    tensor = pressure_tensor(frames, 0, frame_wall_forces(frames, 0, gm.Material()))
    np.testing.assert_allclose(np.diag(tensor), rest["pressure"], rtol=1e-4)  # contacts and walls balance
    recall = gm.run(gm.Experiment(pack, gm.six_signals(), t0=60.0), progress=False)
    assert recall.frames is None
    assert recall.configuration["grain"]["sizes"].startswith("sizes 0.81")
    assert float(recall.gain) > 0.02
    assert float(recall.fidelity) > 0.05
