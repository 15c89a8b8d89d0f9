"""Packs and frames in the formats of others: read back by their own programs, and made packs of again."""

import errno
import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TETRA_27, gmem, orientations

import gmem_jax as gm
from gmem_jax.bench import lammps
from gmem_jax.files import exporters
from gmem_jax.files.exporters import format_of, frames_of_pack
from gmem_jax.files.importers import load_spheres
from gmem_jax.files.loads import frame_wall_forces, pressure_tensor
from gmem_jax.physics import grain
from gmem_jax.physics.pairs import sphere_places
from gmem_jax.preparation import imported
from gmem_jax.simulation.frames import Frames

SOURCE = TETRA_27
PACK = gm.load_pack(SOURCE)
MASS, SOLID = float(PACK.clump.mass), gm.Material()
SINGLE = 1e-6  # R, of positions in single precision in a box of some 7 R


@pytest.fixture(scope="module")
def pack_frames() -> Frames:
    return frames_of_pack(PACK)


@pytest.fixture(scope="module")
def run_frames(pack_frames: Frames) -> Frames:
    """Two configurations with a contact each, off the origin."""
    one = pack_frames
    twice = {name: np.repeat(getattr(one, name), 2, axis=0) for name in ("u", "quaternion")}
    shift = np.array([0.1, -0.2, 3.0])
    moved = {name: np.concatenate([getattr(one, name), getattr(one, name) + shift]) for name in ("lower", "upper")}
    return replace(
        one,
        **twice,
        **moved,
        position=np.concatenate([one.position, one.position + shift]),
        time=np.array([0.0, 41.5]),
        start=np.array([0, 1, 3]),
        spheres=np.array([[0, 7], [1, 9], [5, 20]]),
        normal_force=np.array([1.0, 2.0, 3.0]),
        friction_force=np.eye(3),
        stages=("rest", "encode"),
    )


def written(folder: Path, name: str, frames: Frames) -> Path:
    chosen = format_of(name, several=frames.count > 1)
    path = folder / f"out{chosen.suffix}"
    chosen.write(path, frames, MASS, SOLID)
    return path


def grains(frames: Frames) -> np.ndarray:
    return np.repeat(np.arange(frames.position.shape[1]), len(frames.offsets))


def test_gsd_reads_what_was_written(run_frames: Frames, tmp_path: Path) -> None:
    hoomd = pytest.importorskip("gsd.hoomd")
    with hoomd.open(written(tmp_path, "gsd", run_frames), "r") as file:
        assert len(file) == 2
        for number, frame in enumerate(file):
            middle = 0.5 * (run_frames.lower + run_frames.upper)[number]
            np.testing.assert_allclose(frame.particles.position, run_frames.centres(number) - middle, atol=SINGLE)
            np.testing.assert_array_equal(frame.particles.body, grains(run_frames))
            np.testing.assert_array_equal(frame.particles.diameter, 2.0)
            lengths = (run_frames.upper - run_frames.lower)[number]
            np.testing.assert_allclose(frame.configuration.box, [*lengths, 0, 0, 0], rtol=1e-6)
            np.testing.assert_array_equal(frame.log["time"], run_frames.time[number])
            own = slice(*run_frames.start[number : number + 2])
            np.testing.assert_array_equal(frame.bonds.group, run_frames.spheres[own])
            np.testing.assert_array_equal(frame.log["bonds/normal_force"], run_frames.normal_force[own])
            np.testing.assert_array_equal(frame.log["bonds/friction_force"], run_frames.friction_force[own])
            assert frame.log["u"] == run_frames.u[number]
            turned = np.repeat(run_frames.quaternion[number], 4, axis=0)
            np.testing.assert_allclose(frame.particles.orientation, turned, atol=SINGLE)
            walls = frame_wall_forces(run_frames, number, SOLID).sum(axis=1)
            assert np.abs(walls).max() > 0.0
            np.testing.assert_array_equal(frame.log["particles/wall_force"], walls)


def test_the_frames_of_a_recall_are_exported_with_its_own_material(
    monkeypatch: pytest.MonkeyPatch, recalled: tuple[gm.Experiment, gm.Recall], run_frames: Frames, tmp_path: Path
) -> None:
    hoomd = pytest.importorskip("gsd.hoomd")
    soft = gm.replace(recalled[0], material=gm.Material(wall_rigidity=0.5))
    gm.save_recall(tmp_path / "a.h5", replace(recalled[1], frames=run_frames).described(gm.describe(soft)))
    assert gmem(monkeypatch, "export", tmp_path / "a.h5", "--to", "gsd", "-o", tmp_path / "a.gsd") == 0
    with hoomd.open(tmp_path / "a.gsd", "r") as file:
        assert len(file) == 2
        walls = frame_wall_forces(run_frames, 1, soft.material).sum(axis=1)
        np.testing.assert_array_equal(file[1].log["particles/wall_force"], walls)
        np.testing.assert_allclose(np.sum(file[1].particles.mass), MASS * PACK.grains, rtol=1e-6)


def without_contacts(frames: Frames) -> Frames:
    """Two configurations, of which the first has none, as the lattice that a preparation begins with."""
    kept = {name: getattr(frames, name)[1:] for name in ("spheres", "normal_force", "friction_force")}
    return replace(frames, start=np.array([0, 0, 2]), **kept)


def test_a_frame_without_contacts_is_written_like_any_other(run_frames: Frames, tmp_path: Path) -> None:
    frames = without_contacts(run_frames)
    pyvista, hoomd = pytest.importorskip("pyvista"), pytest.importorskip("gsd.hoomd")
    reader = pyvista.get_reader(written(tmp_path, "vtk", frames).as_posix())
    for number, lines in ((0, 0), (1, 2)):
        reader.set_active_time_point(number)
        spheres, contacts = reader.read()
        assert (spheres.n_points, contacts.n_lines) == (108, lines)
        assert b'NumberOfVerts="0"' in (tmp_path / "out" / f"contacts-{number:04d}.vtp").read_bytes()
        np.testing.assert_array_equal(contacts.cell_data["normal_force"], [2.0, 3.0][:lines])
        assert contacts.GetCellData().GetArray("friction_force").GetNumberOfComponents() == 3
    with hoomd.open(written(tmp_path, "gsd", frames), "r") as file:
        assert [frame.bonds.N for frame in file] == [0, 2]
        assert [len(frame.log["bonds/normal_force"]) for frame in file] == [0, 2]


@pytest.mark.parametrize("name", ["R & D", "a < b", 'say "so"', "it's", "Körner", "two  spaces"])
def test_a_series_of_any_name_is_xml(run_frames: Frames, tmp_path: Path, name: str) -> None:
    pyvista = pytest.importorskip("pyvista")
    path = tmp_path / f"{name}.pvd"
    format_of("vtk", several=True).write(path, run_frames, MASS, SOLID)
    files = [entry.get("file") for entry in ElementTree.parse(path).iter("DataSet")]
    assert len(files) == 4
    assert all((tmp_path / str(file)).is_file() for file in files)
    assert pyvista.get_reader(path.as_posix()).time_values == [0.0, 41.5]


def test_a_series_that_cannot_be_written_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, run_frames: Frames, tmp_path: Path
) -> None:
    pytest.importorskip("pyvista")
    with pytest.raises(ValueError, match="characters that XML cannot hold"):
        format_of("vtk", several=True).write(tmp_path / "a\x01.pvd", run_frames, MASS, SOLID)
    real, meshes = exporters._vtp, []

    def full(mesh: object) -> str:
        meshes.append(mesh)
        if len(meshes) == 4:
            raise OSError(errno.ENOSPC, "no space left")
        return real(mesh)

    monkeypatch.setattr(exporters, "_vtp", full)
    with pytest.raises(OSError, match=r"/a\.pvd: cannot be written \(No space left on device\)"):
        format_of("vtk", several=True).write(tmp_path / "a.pvd", run_frames, MASS, SOLID)
    assert not list(tmp_path.iterdir())


def test_the_pressure_tensor_of_a_pack_at_rest_is_what_its_walls_measured(
    pack_frames: Frames, run_frames: Frames, tmp_path: Path
) -> None:
    measured = PACK.info["at_rest"]["pressure"]
    walls = frame_wall_forces(pack_frames, 0, SOLID)
    tensor = pressure_tensor(pack_frames, 0, walls)
    np.testing.assert_allclose(np.diag(tensor), measured, rtol=1e-5)
    np.testing.assert_allclose(tensor, tensor.T, atol=1e-5 * max(measured))
    assert np.all(np.diag(pressure_tensor(pack_frames, 0, 0.0 * walls)) < 0.8 * np.array(measured))
    moved = replace(run_frames, start=np.array([0, 0, 0]), spheres=np.zeros((0, 2), int), normal_force=np.zeros(0))
    moved = replace(moved, friction_force=np.zeros((0, 3)))
    one, other = (pressure_tensor(moved, number, frame_wall_forces(moved, number, SOLID)) for number in (0, 1))
    np.testing.assert_allclose(one, other, rtol=1e-9)  # wherever the box lies
    told = written(tmp_path, "xyz", pack_frames).read_text().splitlines()[1]
    found = np.array(told.split('pressure_tensor="')[1].split('"')[0].split(), float)
    np.testing.assert_array_equal(found.reshape(3, 3), tensor)


def test_friction_shears_the_pressure_tensor() -> None:
    """Two spheres along x that touch; the friction on the first is along +y, so the second is dragged to -y."""
    two = Frames(
        time=np.zeros(1),
        u=np.zeros(1),
        position=np.array([[[2.0, 5.0, 5.0], [3.9, 5.0, 5.0]]]),
        quaternion=np.array([[[1.0, 0.0, 0.0, 0.0]] * 2]),
        lower=np.zeros((1, 3)),
        upper=np.full((1, 3), 10.0),
        start=np.array([0, 1]),
        spheres=np.array([[0, 1]]),
        normal_force=np.array([3.0]),
        friction_force=np.array([[0.0, 2.0, 0.0]]),
        offsets=np.zeros((1, 3)),
        stages=("rest",),
    )
    tensor = pressure_tensor(two, 0, frame_wall_forces(two, 0, SOLID))
    wanted = np.zeros((3, 3))
    wanted[:2, 0] = 3.0 * 1.9 / 1000.0, -2.0 * 1.9 / 1000.0
    np.testing.assert_allclose(tensor, wanted, atol=1e-15)


def test_paraview_reads_what_was_written(run_frames: Frames, pack_frames: Frames, tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    spheres = pyvista.read(written(tmp_path, "vtk", pack_frames).as_posix())
    np.testing.assert_array_equal(spheres.points, pack_frames.centres(0))
    np.testing.assert_array_equal(spheres["grain"], grains(pack_frames) + 1)
    np.testing.assert_array_equal(spheres["radius"], 1.0)
    walls = frame_wall_forces(pack_frames, 0, SOLID)
    np.testing.assert_array_equal(spheres["wall_force"], walls.sum(axis=1))
    np.testing.assert_array_equal(
        spheres.field_data["pressure_tensor"].reshape(3, 3), pressure_tensor(pack_frames, 0, walls)
    )
    reader = pyvista.get_reader(written(tmp_path, "vtk", run_frames).as_posix())
    assert reader.time_values == [0.0, 41.5]
    reader.set_active_time_value(41.5)
    spheres, contacts = reader.read()
    np.testing.assert_array_equal(spheres.points, run_frames.centres(1))
    np.testing.assert_array_equal(contacts.lines.reshape(-1, 3)[:, 1:], [[1, 9], [5, 20]])
    np.testing.assert_array_equal(contacts.cell_data["normal_force"], [2.0, 3.0])
    np.testing.assert_array_equal(contacts.cell_data["friction_force"], np.eye(3)[1:])


def test_extended_xyz_has_a_line_for_every_sphere(run_frames: Frames, tmp_path: Path) -> None:
    lines = written(tmp_path, "xyz", run_frames).read_text().splitlines()
    count = len(grains(run_frames))
    assert lines[0] == lines[count + 2] == str(count)
    assert 'Properties="species:S:1:pos:R:3:radius:R:1:molecule:I:1"' in lines[count + 3]
    assert 'stage="encode"' in lines[count + 3]
    said = dict(re.findall(r'(\w+)="([^"]*)"', lines[count + 3]))
    numbers = {name: np.fromstring(said[name], sep=" ") for name in ("Lattice", "Origin", "Time", "u")}
    np.testing.assert_array_equal(numbers["Lattice"].reshape(3, 3), np.diag((run_frames.upper - run_frames.lower)[1]))
    np.testing.assert_array_equal(numbers["Origin"], run_frames.lower[1])
    assert (numbers["Time"], numbers["u"]) == (41.5, run_frames.u[1])
    table = np.loadtxt(lines[count + 4 :], usecols=range(1, 6))
    np.testing.assert_array_equal(table[:, :3], run_frames.centres(1))
    np.testing.assert_array_equal(table[:, 3], 1.0)
    np.testing.assert_array_equal(table[:, 4], grains(run_frames) + 1)


@pytest.mark.skipif(lammps.missing_lammps() is not None, reason="LAMMPS does not start")
def test_lammps_reads_what_was_written(pack_frames: Frames, run_frames: Frames, tmp_path: Path) -> None:
    data, dump = written(tmp_path, "lammps", pack_frames), written(tmp_path, "lammps", run_frames)
    seen = 'write_dump all custom {} id mol x y z radius modify sort id format float "%20.15g"'
    script = ["units lj", "atom_style hybrid sphere molecular", "boundary f f f", f"read_data {data.name}"]
    script += ["variable total equal mass(all)", 'print "total ${total}"', "pair_style zero 2.0", "pair_coeff * *"]
    script += ["run 0", seen.format("one"), f"read_dump {dump.name} 1 x y z box yes", seen.format("two")]
    told = lammps.execute(script, tmp_path)
    total = float(next(line.split()[1] for line in told.splitlines() if line.startswith("total ")))
    np.testing.assert_allclose(total, MASS * PACK.grains, rtol=1e-6)
    for name, centres in (("one", pack_frames.centres(0)), ("two", run_frames.centres(1))):
        table = np.loadtxt(tmp_path / name, skiprows=9)
        np.testing.assert_allclose(table[:, 2:5], centres, atol=1e-13)
        np.testing.assert_array_equal(table[:, [1, 5]], np.column_stack([grains(pack_frames) + 1, np.ones(len(table))]))


# ---------------------------------------------------------------- import


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(("name", "within"), [("lammps", 1e-13), ("gsd", SINGLE)])
def test_a_pack_comes_back(pack_frames: Frames, tmp_path: Path, name: str, within: float) -> None:
    if name == "gsd":
        pytest.importorskip("gsd.hoomd")
    back = imported.import_pack(written(tmp_path, name, pack_frames))
    assert back.clump.shape == "tetra(0.6)"
    np.testing.assert_allclose(back.position, PACK.position, atol=within)
    np.testing.assert_allclose(np.abs(jnp.sum(back.quaternion * PACK.quaternion, axis=1)), 1.0, atol=within)
    np.testing.assert_allclose(back.lower, PACK.lower, atol=within)
    gm.save_pack(tmp_path / "back.h5", back)
    assert gm.load_pack(tmp_path / "back.h5").grains == PACK.grains


@pytest.mark.usefixtures("quick")
def test_the_last_frame_of_a_gsd_file_is_taken(pack_frames: Frames, tmp_path: Path) -> None:
    pytest.importorskip("gsd.hoomd")
    one, count = pack_frames, len(pack_frames.spheres)
    of_contacts = ("spheres", "normal_force", "friction_force")
    same = ("u", "time", "quaternion", "lower", "upper", *of_contacts)
    twice = {name: np.concatenate([getattr(one, name)] * 2) for name in same}
    before = one.position + np.array([0.02, 0.0, 0.0])
    places = np.concatenate([before, one.position])
    start = np.array([0, count, 2 * count])
    frames = replace(one, **twice, position=places, start=start, stages=("before", "after"))
    back = imported.import_pack(written(tmp_path, "gsd", frames))
    np.testing.assert_allclose(back.position, PACK.position, atol=SINGLE)


def test_grains_of_any_shape_are_found_in_any_order_of_their_spheres() -> None:
    shape = grain.clump([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.2, 1.3, 0.4]])
    offsets = np.asarray(shape.offsets)
    turned = orientations(5, seed=3)
    at = np.arange(15.0).reshape(5, 3)
    centres = sphere_places(at, turned, offsets).reshape(5, 3, 3)
    centres[2] = centres[2][[2, 0, 1]]
    position, quaternion = imported.lay(centres, offsets)
    np.testing.assert_allclose(position, at, atol=1e-13)
    np.testing.assert_allclose(np.abs(np.sum(quaternion * turned, axis=1)), 1.0, atol=1e-13)
    centres[3, 1] += 0.01
    with pytest.raises(gm.FileFormatError, match="grain 4 has another shape"):
        imported.lay(centres, offsets)


def test_other_lengths_become_radii(pack_frames: Frames, tmp_path: Path) -> None:
    lines = written(tmp_path, "lammps", pack_frames).read_text().splitlines()
    start = lines.index("Atoms # hybrid sphere molecular") + 2
    rows = [row.split() for row in lines[start:]]
    scaled = [[*row[:2], *(repr(0.5 * float(x)) for x in row[2:5]), "1", row[6], row[7]] for row in rows]
    box = [
        " ".join([*(repr(0.5 * float(plane)) for plane in line.split()[:2]), *line.split()[2:]]) for line in lines[5:8]
    ]
    path = tmp_path / "half.data"
    path.write_text("\n".join([*lines[:5], *box, *lines[8:start], *map(" ".join, scaled)]))
    np.testing.assert_allclose(
        load_spheres(path, 0.5).centres.reshape(-1, 3), pack_frames.centres(0), rtol=1e-12, atol=1e-13
    )
    with pytest.raises(gm.FileFormatError, match=r"must have radius 1, found 0.5.*--radius"):
        load_spheres(path)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("old", "new", "refusal"),
    [
        (" 27\n", " 26\n", "grains have 3 to 5 spheres"),
        ("# hybrid sphere molecular", "# atomic", "must be .* one of molecular"),
        ("xlo xhi", "xlo", "no rectangular box"),
        ("Atoms", "Velocities", "must be .* one of"),
        ("\n1 1 -", "\n1 1 -9", "outside the box"),
        ("\n1 1 ", "\n1 1 x", "line 12: x is 'x-.*finite number"),
        ("108 atoms", "107 atoms", "declares 107 atoms"),
    ],
)
def test_what_is_no_pack_is_refused(pack_frames: Frames, tmp_path: Path, old: str, new: str, refusal: str) -> None:
    path = written(tmp_path, "lammps", pack_frames)
    text = path.read_text() + "\n"
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(gm.FileFormatError, match=refusal) as refused:
        imported.import_pack(path)
    assert "\n" not in str(refused.value)
    assert str(path) in str(refused.value)


@pytest.mark.usefixtures("quick")
def test_a_heap_is_refused(pack_frames: Frames, tmp_path: Path) -> None:
    heap = replace(pack_frames, position=0.05 * pack_frames.position)
    with pytest.raises(gm.FileFormatError, match=r"heap|no pack at rest"):
        imported.import_pack(written(tmp_path, "lammps", heap))


# ---------------------------------------------------------------- command line


def test_a_folder_beside_a_series_is_filled_by_force_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, run_frames: Frames, tmp_path: Path
) -> None:
    pytest.importorskip("pyvista")
    monkeypatch.setattr("gmem_jax.command.exchange.load_frames", lambda _: run_frames)
    (tmp_path / "run").mkdir()
    command = ["export", SOURCE, "--frames", "--to", "vtk", "-o", tmp_path / "run.pvd"]
    assert gmem(monkeypatch, *command) == 2
    assert "run beside it exists" in capsys.readouterr().err
    assert not list((tmp_path / "run").iterdir())
    assert gmem(monkeypatch, *command, "--force") == 0
    assert len(list((tmp_path / "run").iterdir())) == 4
    (tmp_path / "linked").symlink_to(tmp_path / "run", target_is_directory=True)
    assert gmem(monkeypatch, *command[:-1], tmp_path / "linked.pvd", "--force") == 2
    assert "linked beside it exists" in capsys.readouterr().err


def test_an_exported_pack_has_its_contacts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    hoomd, pyvista = pytest.importorskip("gsd.hoomd"), pytest.importorskip("pyvista")
    touching = round(0.5 * PACK.info["at_rest"]["contacts"] * PACK.grains)
    assert gmem(monkeypatch, "export", SOURCE, "--to", "gsd", "-o", tmp_path / "a.gsd") == 0
    with hoomd.open(tmp_path / "a.gsd", "r") as file:
        assert len(file[0].bonds.group) == touching
        overlap = PACK.info["at_rest"]["largest_overlap"]
        force = float(SOLID.normal_stiffness) * overlap**1.5
        np.testing.assert_allclose(file[0].log["bonds/normal_force"].max(), force, rtol=1e-9)
    assert gmem(monkeypatch, "export", SOURCE, "--to", "vtk", "-o", tmp_path / "a.pvd") == 0
    spheres, contacts = pyvista.get_reader((tmp_path / "a.pvd").as_posix()).read()
    assert (spheres.n_points, contacts.n_lines) == (108, touching)


@pytest.mark.usefixtures("quick")
def test_the_commands_there_and_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    data, pack = tmp_path / "pack.data", tmp_path / "pack.h5"
    assert gmem(monkeypatch, "export", SOURCE, "--to", "lammps", "-o", data, "--json") == 0
    assert json.loads(capsys.readouterr().out)["spheres"] == 108
    assert gmem(monkeypatch, "import", data, "-o", pack, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["grain"], told["notes"]) == ("tetra(0.6)", [])
    assert gmem(monkeypatch, "import", data, "-o", tmp_path / "mine.h5", "--delta0", 0.04, "--name", "mine") == 0
    mine = gm.load_pack(tmp_path / "mine.h5")
    assert (mine.name, float(mine.delta0)) == ("mine", 0.04)
    for file, words in ((SOURCE, "cycled with delta0"), (pack, "meant for delta0")):
        assert gmem(monkeypatch, "show", file) == 0
        assert words in capsys.readouterr().out
    assert gmem(monkeypatch, "export", pack, "--to", "pdb", "-o", data) == 2
    assert "must be one of gsd, vtk, xyz, lammps" in capsys.readouterr().err
    assert gmem(monkeypatch, "export", pack, "--to", "xyz", "--frames", "-o", tmp_path / "a.xyz") == 2
    assert "gmem prepare --frames" in capsys.readouterr().err
    assert gmem(monkeypatch, "export", pack, "--to", "xyz", "-o", data) == 2
    assert "this is a .xyz file" in capsys.readouterr().err
