"""Files of other programs: what a number in them means is honoured, or refused in one line that names its line."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from scenes import TETRA_27, gmem

import gmem_jax as gm
from gmem_jax.bench import lammps
from gmem_jax.files.exporters import format_of, frames_of_pack
from gmem_jax.files.importers import load_spheres
from gmem_jax.preparation import imported
from gmem_jax.preparation.ringing import spectrum_peak

SOURCE = TETRA_27
PACK = gm.load_pack(SOURCE)
BOX = "-2 2 xlo xhi\n-0.99 0.99 ylo yhi\n-0.99 0.99 zlo zhi\n"
ROWS = ("1 1 1 -1.0 0 0", "2 2 1 0.99 0 0")


def data(*rows: str, hint: str = "molecular", title: str = "two spheres", box: str = BOX, more: str = "") -> str:
    """A LAMMPS data file, whose atoms begin in line 12 if the box has three lines and nothing more is there."""
    return f"{title}\n\n{len(rows)} atoms\n1 atom types\n\n{box}{more}\nAtoms # {hint}\n\n" + "\n".join(rows) + "\n"


def put(folder: Path, content: str | bytes, name: str = "a.data") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# ---------------------------------------------------------------- read


@pytest.mark.usefixtures("quick")
def test_atoms_of_molecule_0_are_grains_of_their_own_and_it_is_said(tmp_path: Path) -> None:
    path = put(tmp_path, data("1 0 1 -1.01 0 0", "2 0 1 1.01 0 0", title="two loose spheres"))
    with pytest.warns(UserWarning, match="2 of its atoms belong to no molecule: each is a grain of one sphere"):
        pack = imported.import_pack(path)
    assert (pack.grains, pack.clump.shape) == (2, "sphere")
    np.testing.assert_array_equal(pack.position[:, 0], [-1.01, 1.01])
    assert pack.info["imported"]["notes"] == ["2 of its atoms belong to no molecule: each is a grain of one sphere"]


def test_loose_atoms_among_grains_of_several_spheres_are_named_as_the_reason(tmp_path: Path) -> None:
    path = put(tmp_path, data("1 5 1 -1 0 0", "2 5 1 -0.5 0 0", "3 0 1 1 0 0"))
    with pytest.raises(gm.FileFormatError, match=r"grains have 1 to 2 spheres.*1 of its atoms belong to no molecule"):
        load_spheres(path)


def test_spheres_without_a_section_of_molecules_are_grains(tmp_path: Path) -> None:
    path = put(tmp_path, data("1 1 2 1 -1 0 0", "2 1 2 1 1 0 0", hint="sphere"))
    assert load_spheres(path).centres.shape == (2, 1, 3)


@pytest.mark.parametrize(
    "content",
    [
        data(*ROWS, box=BOX + "0 0 0 xy xz yz\n"),
        data(*(row.replace(" 1 ", " grainlet ", 1) if row[0] == "2" else row for row in ROWS)).replace(
            "\nAtoms", "\nAtom Type Labels\n\n1 grainlet\n\nAtoms"
        ),
        data(*(f"{row} 0 0 0" for row in ROWS)),
        data(*ROWS, title="Körner").encode("latin-1"),
        data(*ROWS).replace("\n", "\r\n"),
        data("1 1 -1.0 0 0 2 0.7 1", "2 1 0.99 0 0 2 0.7 2", hint="hybrid"),
        data("1 1 -1.0 0 0 1 2 0.7", "2 1 0.99 0 0 2 2 0.7", hint="hybrid"),
    ],
    ids=["tilts of zero", "labels", "image flags of zero", "Latin-1", "CRLF", "sphere first", "molecular first"],
)
def test_what_lammps_writes_is_read(tmp_path: Path, content: str | bytes) -> None:
    found = load_spheres(put(tmp_path, content))
    np.testing.assert_array_equal(found.centres[:, 0], [[-1.0, 0.0, 0.0], [0.99, 0.0, 0.0]])
    np.testing.assert_array_equal(found.upper, [2.0, 0.99, 0.99])


@pytest.mark.skipif(lammps.missing_lammps() is not None, reason="LAMMPS does not start")
@pytest.mark.parametrize("labels", ["", "types labels"])
def test_what_lammps_writes_back_of_an_exported_pack_is_that_pack(tmp_path: Path, labels: str) -> None:
    frames = frames_of_pack(PACK)
    format_of("lammps", several=False).write(tmp_path / "a.data", frames, float(PACK.clump.mass), gm.Material())
    script = ["units lj", "atom_style hybrid sphere molecular", "boundary f f f", "read_data a.data"]
    script += ["labelmap atom 1 grainlet"] * bool(labels)
    script += ["pair_style zero 2.0", "pair_coeff * *", "run 0", f"write_data b.data {labels}"]
    lammps.execute(script, tmp_path)
    assert "Atoms # hybrid\n" in (tmp_path / "b.data").read_text()
    found = load_spheres(tmp_path / "b.data")
    np.testing.assert_allclose(found.centres.reshape(-1, 3), frames.centres(0), atol=1e-13)
    assert found.notes == ("its sections Pair Coeffs, Velocities are left out",)


@pytest.mark.usefixtures("quick")
def test_another_density_than_ours_is_said(tmp_path: Path) -> None:
    path = put(tmp_path, data("1 1 -1.0 0 0 2 2650 1", "2 1 0.99 0 0 2 2650 2", hint="hybrid sphere molecular"))
    with pytest.warns(UserWarning, match="density 2650 of its spheres is left out"):
        imported.import_pack(path)


@pytest.mark.usefixtures("quick")
def test_a_pack_of_spheres_comes_back_from_gsd(tmp_path: Path) -> None:
    pytest.importorskip("gsd.hoomd")
    path = put(tmp_path, data("1 1 1 -1.01 0 0", "2 2 1 1.01 0 0"))
    pack = imported.import_pack(path)
    format_of("gsd", several=False).write(
        tmp_path / "a.gsd", frames_of_pack(pack), float(pack.clump.mass), gm.Material()
    )
    back = imported.import_pack(tmp_path / "a.gsd")
    assert (back.grains, back.clump.shape) == (2, "sphere")
    np.testing.assert_allclose(back.position, pack.position, atol=1e-6)


@pytest.mark.parametrize(("mass", "density"), [(2.65 * np.pi / 6.0, 2.65), (1.0, None)])
def test_free_particles_are_grains_of_their_own_of_the_density_they_have(
    tmp_path: Path, mass: float, density: float | None
) -> None:
    hoomd = pytest.importorskip("gsd.hoomd")
    frame = hoomd.Frame()
    frame.configuration.box = [2.0, 0.99, 0.99, 0.0, 0.0, 0.0]
    frame.particles.N, frame.particles.types = 2, ["sphere"]
    frame.particles.position, frame.particles.mass = [[-0.505, 0, 0], [0.505, 0, 0]], [mass, mass]
    with hoomd.open(tmp_path / "a.gsd", "w") as file:
        file.append(frame)
    found = load_spheres(tmp_path / "a.gsd", radius=0.5)
    assert found.centres.shape == (2, 1, 3)
    assert found.notes == ("2 of its particles belong to no body: each is a grain of one sphere",)
    assert found.density == (density if density is None else pytest.approx(density, rel=1e-6))


@pytest.mark.parametrize(("mass", "density"), [("1.0", None), (f"{8.0 * np.pi:.15g}", 6.0)])
def test_masses_of_types_are_densities(tmp_path: Path, mass: str, density: float | None) -> None:
    found = load_spheres(put(tmp_path, data(*ROWS).replace("\nAtoms", f"\nMasses\n\n1 {mass}\n\nAtoms")))
    assert found.density == (density if density is None else pytest.approx(density, rel=1e-12))


def test_particles_that_stand_for_a_rigid_body_are_left_out(tmp_path: Path) -> None:
    hoomd = pytest.importorskip("gsd.hoomd")
    frame = hoomd.Frame()
    frame.configuration.box = [8.0, 8.0, 8.0, 0.0, 0.0, 0.0]
    frame.particles.N, frame.particles.types = 6, ["body", "sphere"]
    frame.particles.typeid, frame.particles.body = [0, 0, 1, 1, 1, 1], [0, 1, 0, 0, 1, 1]
    frame.particles.position = [[0, 0, 0], [0, 0, 3], [-0.5, 0, 0], [0.5, 0, 0], [-0.5, 0, 3], [0.5, 0, 3]]
    frame.particles.diameter, frame.particles.mass = [1, 1, 2, 2, 2, 2], [9, 9, 1, 1, 1, 1]
    with hoomd.open(tmp_path / "a.gsd", "w") as file:
        file.append(frame)
    found = load_spheres(tmp_path / "a.gsd")
    np.testing.assert_array_equal(found.centres, np.asarray(frame.particles.position)[2:].reshape(2, 2, 3))
    frame.particles.mass = [9, 9, 1, 1, 1, 2]
    with hoomd.open(tmp_path / "b.gsd", "w") as file:
        file.append(frame)
    with pytest.raises(gm.FileFormatError, match="mass of 1 to 2"):
        load_spheres(tmp_path / "b.gsd")
    frame.particles.mass, frame.particles.image = [9, 9, 1, 1, 1, 1], [[0, 0, 0]] * 5 + [[1, 0, 0]]
    with hoomd.open(tmp_path / "c.gsd", "w") as file:
        file.append(frame)
    with pytest.raises(gm.FileFormatError, match="images"):
        load_spheres(tmp_path / "c.gsd")


# ---------------------------------------------------------------- refused


def sized(*values: str) -> str:
    """Two atoms of `hybrid sphere molecular`, the second with these diameter, density and molecule."""
    return data("1 1 -1 0 0 2 1 1", f"2 1 1 0 0 {' '.join(values)}", hint="hybrid sphere molecular")


@pytest.mark.parametrize(
    ("content", "refusal"),
    [
        *(
            (data(ROWS[0], f"{word} 2 1 0.99 0 0"), f"line 13: id is '{word}', must be a whole number from 1")
            for word in ("nan", "-inf", "1.5", "-2", "0")
        ),
        *(
            (data(ROWS[0], f"2 {word} 1 0.99 0 0"), f"line 13: mol is '{word}', must be a whole number from 0")
            for word in ("1.5", "1e300", "-1", "nan", "9" * 30)
        ),
        (data(ROWS[0], "2 2 99 0.99 0 0"), "line 13: type is '99', must be a label, or a whole number from 1 to 1"),
        (data(ROWS[0], "2 2 gravel 0.99 0 0"), "line 13: type is 'gravel', must be"),
        (data(ROWS[0], "1 2 1 0.99 0 0"), "line 13: atom 1 stands in line 12, too"),
        (data(ROWS[0], "2 2 1 nan 0 0"), "line 13: x is 'nan', must be a finite number"),
        (data(ROWS[0], "2 2 1 0.99 1e999 0"), "line 13: y is '1e999', must be a finite number"),
        (data(ROWS[0], "2 2 1 0.99 0 1_0"), "line 13: z is '1_0', must be a finite number"),
        (
            data(*(f"{row} {flags}" for row, flags in zip(ROWS, ("0 0 0", "0 -1 0"), strict=True))),
            "line 13: image flag",
        ),
        (data(ROWS[0], f"{ROWS[1]} 0 0 0"), "line 13: 9 columns, must be 6"),
        (sized("2", "-5", "2"), "line 13: density is '-5', must be a positive number"),
        (sized("2", "nan", "2"), "line 13: density is 'nan', must be a positive number"),
        (sized("0", "1", "2"), "line 13: diameter is '0', must be a positive number"),
        (sized("2", "3", "2"), "density of 1 to 3, all must have the same"),
        (sized("40", "1", "2"), "radii of spheres must be in [0.1, 10] R, got 1 to 20; the radius in the file"),
        (data("1 1 1 0 -1 0 0", "2 2 1 0.5 0.99 0 0", hint="full"), "line 13: q is '0.5', must be 0"),
        (data("1 1 -1 0 0 2 2 1", "2 1 1 0 0 2 2 2", hint="hybrid"), "does not tell its columns"),
        (data(*ROWS, box=BOX + "0 0.1 0 xy xz yz\n"), "line 9: tilt is '0.1', must be 0"),
        (data(*ROWS, box=BOX.replace("-2 2", "2 -2")), "line 6: must be xlo xhi, the first the smaller"),
        (data(*ROWS, box=BOX.replace("-2 2", "-2 2nm")), "line 6: xlo xhi is '2nm'"),
        (data(*ROWS, box=BOX * 2), "line 9: '-2 2 xlo xhi' is no line of a header, or one that was there before"),
        (data(*ROWS) + "\nAtoms # molecular\n\n" + "\n".join(ROWS), "line 15: a second section 'Atoms'"),
        (data(*ROWS).replace("2 atoms", "2.5 atoms"), "line 3: must be 'N atoms' with a whole number"),
        (data(*ROWS).replace("1 atom types\n", "\n"), "no line 'N atom types'"),
        (data("1 1 2 1 -1 0 0", hint="sphere") + "\nMolecules\n\n7 1\n", "line 16: there is no atom 7"),
        (
            data("1 1 2 1 -1 0 0", "2 1 2 1 1 0 0", hint="sphere") + "\nMolecules\n\n1 1\n",
            "atom 2 is not in its section Molecules",
        ),
        (
            data(ROWS[0], "2 2 2 0.99 0 0").replace("1 atom types", "2 atom types") + "\nMasses\n\n1 1.0\n2 3.0\n",
            "mass of 1 to 3, all must have the same",
        ),
    ],
)
def test_a_number_that_no_pack_has_is_refused_with_its_line(tmp_path: Path, content: str, refusal: str) -> None:
    with pytest.raises(gm.FileFormatError) as refused:
        load_spheres(put(tmp_path, content))
    assert refusal in str(refused.value)
    assert str(tmp_path / "a.data") in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ('2\nLattice="4 0 0 0 4 0 0 0 4" Properties=species:S:1:pos:R:3\nS 0 0 1\nS 0 0 3\n', "an extended XYZ file"),
        ("2\nspheres\nS 0 0 1\nS 0 0 3\n", "an XYZ file"),
        ("ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n2\n", "a LAMMPS dump"),
        (gzip.compress(data(*ROWS).encode()), "a compressed file; unpack it first"),
        (SOURCE.read_bytes(), "an HDF5 file; packs of gmem are used as they are"),
        (SOURCE.read_bytes()[512:], "an HDF5 file"),
        ('<?xml version="1.0"?>\n<VTKFile type="PolyData">', "a VTK file"),
        (b"LammpS RestartT\0\0", "a LAMMPS restart file"),
        (bytes(64), "a file that is no text"),
        ("time,voltage\n0,1\n", "no LAMMPS data file"),
    ],
)
@pytest.mark.parametrize("name", ["a.data", "a.gsd"])
def test_another_kind_of_file_is_named(tmp_path: Path, content: str | bytes, named: str, name: str) -> None:
    if named.startswith("no") and name == "a.gsd":
        named = "not a readable GSD file"
    with pytest.raises(gm.FileFormatError, match=named):
        load_spheres(put(tmp_path, content, name))


def test_gsd_is_known_by_how_it_begins(tmp_path: Path) -> None:
    pytest.importorskip("gsd.hoomd")
    path = tmp_path / "a.dat"
    format_of("gsd", several=False).write(path, frames_of_pack(PACK), float(PACK.clump.mass), gm.Material())
    assert load_spheres(path).centres.shape == (27, 4, 3)


def test_grains_that_press_on_no_wall_are_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    box = "".join(f"-1.5 1.5 {axis}lo {axis}hi\n" for axis in "xyz")
    loose = put(tmp_path, data("1 1 1 0 0 0", title="one loose grain", box=box))
    assert gmem(monkeypatch, "import", loose, "-o", tmp_path / "a.h5") == 2
    assert "grains do not press on the walls" in capsys.readouterr().err
    assert not (tmp_path / "a.h5").exists()


def test_walls_that_do_not_ring_have_no_period() -> None:
    with pytest.raises(gm.RunFailedError, match="grains do not press"):
        spectrum_peak(np.zeros(64), 1.0)
