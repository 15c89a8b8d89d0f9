"""Writing configurations for other programs: GSD, VTK, extended XYZ, LAMMPS. Lengths are in R, times in t_c.

Files hold spheres, each with the number of its grain; docs/exchange.md lists the formats and their fields.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TextIO
from xml.sax.saxutils import quoteattr

import numpy as np

from gmem_jax.experiment.pack import Pack
from gmem_jax.files.atomic import atomic
from gmem_jax.files.loads import frame_wall_forces, pressure_tensor
from gmem_jax.files.ours import place
from gmem_jax.files.validation import optional
from gmem_jax.physics.grain import radii_of_spheres
from gmem_jax.physics.material import Material
from gmem_jax.physics.pairs import listed_candidates, sphere_places
from gmem_jax.simulation.frames import Frames, images_met


def frames_of_pack(pack: Pack, material: Material = Material()) -> Frames:
    """A pack as a single configuration: normal forces follow from the overlaps; friction is 0, as a pack keeps none."""
    position, quaternion, offsets = (np.asarray(x) for x in (pack.position, pack.quaternion, pack.clump.offsets))
    own, sizes = (None if x is None else np.asarray(x) for x in (pack.clump.radii, pack.clump.sizes))
    spheres = listed_candidates(pack.pairs).T
    centres = sphere_places(position, quaternion, offsets, sizes)
    radii = radii_of_spheres(len(position), len(offsets), own, sizes)[spheres]
    apart = centres[spheres[:, 1]] - centres[spheres[:, 0]]
    if pack.pairs.image is not None:
        apart += np.asarray(pack.pairs.image)[np.asarray(pack.pairs.valid)] * np.asarray(pack.upper - pack.lower)
    overlap = radii.sum(axis=1) - np.linalg.norm(apart, axis=1)
    touching = overlap > 0.0
    stiffness = float(material.normal_stiffness) * np.sqrt(2.0 * radii.prod(axis=1) / radii.sum(axis=1))
    return Frames(
        time=np.zeros(1),
        u=np.zeros(1),
        position=position[None],
        quaternion=quaternion[None],
        lower=np.asarray(pack.lower)[None],
        upper=np.asarray(pack.upper)[None],
        start=np.array([0, touching.sum()]),
        spheres=spheres[touching],
        normal_force=stiffness[touching] * overlap[touching] ** 1.5,
        friction_force=np.zeros((int(touching.sum()), 3)),
        offsets=offsets,
        stages=("at rest",),
        periodic=pack.periodic,
        radii=own,
        sizes=sizes,
    )


def _grain_numbers(frames: Frames) -> np.ndarray:
    """The number of every sphere's grain, from 1, [N K]."""
    return np.repeat(np.arange(1, frames.position.shape[1] + 1, dtype=np.int32), len(frames.offsets))


def _contacts(frames: Frames, number: int) -> slice:
    """The rows of the contacts of a frame."""
    return slice(*frames.start[number : number + 2])


def write_gsd(path: Path, frames: Frames, mass: float, material: Material) -> None:
    """Write GSD, for HOOMD-blue and OVITO: particles are spheres, bonds are contacts, `body` is the grain from 0.

    Bonds have a `normal_force` and a `friction_force`, particles the `wall_force` on them.

    Raises:
        ValueError: if the package gsd is not there.
        OSError: if the path cannot be written.
    """
    hoomd, grain = optional("gsd.hoomd", "export"), _grain_numbers(frames) - 1
    each = len(frames.offsets)
    with atomic(path) as temporary, hoomd.open(temporary, "w") as file:
        for number in range(frames.count):
            frame = hoomd.Frame()
            lower, upper = frames.lower[number], frames.upper[number]
            frame.configuration.step = number
            frame.configuration.box = [*(upper - lower), 0.0, 0.0, 0.0]  # its origin is the centre
            frame.particles.N, frame.particles.types = len(grain), ["sphere"]
            frame.particles.position = frames.centres(number) - 0.5 * (lower + upper)
            if any(frames.periodic):
                image = np.where(frames.periodic, np.rint(frame.particles.position / (upper - lower)), 0.0)
                frame.particles.position -= image * (upper - lower)
                frame.particles.image = image.astype(np.int32)
            frame.particles.orientation = np.repeat(frames.quaternion[number], each, axis=0)
            frame.particles.diameter = 2.0 * frames.sphere_radii
            frame.particles.mass = _density(frames, mass) * 4.0 * np.pi / 3.0 * frames.sphere_radii**3
            frame.particles.body = grain
            own, walls = _contacts(frames, number), frame_wall_forces(frames, number, material)
            frame.bonds.N, frame.bonds.types = len(frames.spheres[own]), ["contact"]
            frame.bonds.typeid, frame.bonds.group = np.zeros(frame.bonds.N, np.uint32), frames.spheres[own]
            frame.log = {
                "time": frames.time[[number]],
                "u": frames.u[[number]],
                "periodic": np.asarray(frames.periodic, np.uint8),
                "pressure_tensor": pressure_tensor(frames, number, walls).ravel(),
                "particles/wall_force": walls.sum(axis=1),
                "bonds/normal_force": frames.normal_force[own],
                "bonds/friction_force": frames.friction_force[own],
            }
            file.append(frame)


def write_xyz(path: Path, frames: Frames, mass: float, material: Material) -> None:
    """Write extended XYZ, for OVITO and ASE: `molecule` is the grain's number from 1.

    Raises:
        OSError: if the path cannot be written.
    """
    grain = _grain_numbers(frames)
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for number in range(frames.count):
            lower, lengths = frames.lower[number], frames.upper[number] - frames.lower[number]
            tensor = pressure_tensor(frames, number, frame_wall_forces(frames, number, material))
            facts = {
                "Lattice": " ".join(f"{edge:.17g}" for edge in np.diag(lengths).ravel()),
                "Origin": " ".join(f"{plane:.17g}" for plane in lower),
                "Properties": "species:S:1:pos:R:3:radius:R:1:molecule:I:1",
                "pbc": " ".join("FT"[axis] for axis in frames.periodic),
                "Time": f"{frames.time[number]:.17g}",
                "u": f"{frames.u[number]:.17g}",
                "stage": frames.stages[number].replace("\\", "\\\\").replace('"', '\\"'),
                "pressure_tensor": " ".join(f"{part:.17g}" for part in tensor.ravel()),
            }
            file.write(f"{len(grain)}\n" + " ".join(f'{name}="{value}"' for name, value in facts.items()) + "\n")
            _rows(file, "S %.17g %.17g %.17g %.17g %d", frames.centres(number), frames.sphere_radii, grain)


def write_lammps(path: Path, frames: Frames, mass: float, material: Material) -> None:
    """Write the first configuration as a LAMMPS data file (`atom_style hybrid sphere molecular`): molecules are grains.

    The density is such that the masses of a grain's spheres add up to the mass of the grain.

    Raises:
        OSError: if the path cannot be written.
    """
    grain, each, density = _grain_numbers(frames), len(frames.offsets), _density(frames, mass)
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        bounds = f", boundary {' '.join('fp'[axis] for axis in frames.periodic)}" if any(frames.periodic) else ""
        file.write(f"gmem: {frames.position.shape[1]} grains of {each} spheres, lengths in R{bounds}\n\n")
        file.write(f"{len(grain)} atoms\n1 atom types\n\n")
        for axis, lower, upper in zip("xyz", frames.lower[0], frames.upper[0], strict=True):
            file.write(f"{lower:.17g} {upper:.17g} {axis}lo {axis}hi\n")
        file.write("\nAtoms # hybrid sphere molecular\n\n")
        row = f"%d 1 %.17g %.17g %.17g %.17g {density:.17g} %d"
        _rows(file, row, np.arange(1, len(grain) + 1), frames.centres(0), 2.0 * frames.sphere_radii, grain)


def write_dump(path: Path, frames: Frames, mass: float, material: Material) -> None:
    """Write a LAMMPS text dump of all configurations: id, mol, type, x, y, z, radius.

    Raises:
        OSError: if the path cannot be written.
    """
    grain = _grain_numbers(frames)
    with atomic(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        for number in range(frames.count):
            bounds = " ".join(("ff", "pp")[axis] for axis in frames.periodic)
            file.write(f"ITEM: TIMESTEP\n{number}\nITEM: NUMBER OF ATOMS\n{len(grain)}\nITEM: BOX BOUNDS {bounds}\n")
            for lower, upper in zip(frames.lower[number], frames.upper[number], strict=True):
                file.write(f"{lower:.17g} {upper:.17g}\n")
            file.write("ITEM: ATOMS id mol type x y z radius\n")
            columns = np.arange(1, len(grain) + 1), grain, frames.centres(number), frames.sphere_radii
            _rows(file, "%d %d 1 %.17g %.17g %.17g %.17g", *columns)


def _density(frames: Frames, mass: float) -> float:
    """Density with which the masses of a grain's spheres add up to the grain's; `mass` is that of a grain of size 1."""
    radii = np.ones(len(frames.offsets)) if frames.radii is None else frames.radii
    return mass / (float(np.sum(radii**3)) * 4.0 * np.pi / 3.0)


def _rows(file: TextIO, form: str, *columns: np.ndarray) -> None:
    """Write a line in this format for every row of the columns; whole numbers of this size are exact as floats."""
    np.savetxt(file, np.column_stack(columns), fmt=form, encoding="utf-8")


def write_vtp(path: Path, frames: Frames, mass: float, material: Material) -> None:
    """Write VTK polygonal data, for ParaView: a point for every sphere, with `radius`, `grain` and `wall_force`.

    Raises:
        ValueError: if the package pyvista is not there.
        OSError: if the path cannot be written.
    """
    with atomic(path) as temporary:
        temporary.write_text(_vtp(_points(frames, 0, material)), encoding="utf-8")


def write_pvd(path: Path, frames: Frames, mass: float, material: Material) -> None:
    """Write a ParaView series: a .pvd file, and beside it a folder with the spheres and contacts of every frame.

    A contact is a line between two centres with a `normal_force` and a `friction_force`. Either all files are written,
    or none.

    Raises:
        ValueError: if the package pyvista is not there, or the file's name cannot stand in XML.
        OSError: if the path cannot be written.
    """
    folder = path.with_suffix("")
    if not folder.name.isprintable():
        raise ValueError(f"{str(path)!r}: its name has characters that XML cannot hold; name another file")
    with atomic(path) as temporary, tempfile.TemporaryDirectory(".tmp", f".{folder.name}.", path.parent) as made:
        rows = []
        for number in range(frames.count):
            meshes = {"spheres": _points(frames, number, material), "contacts": _lines(frames, number)}
            for part, (name, mesh) in enumerate(meshes.items()):
                file = f"{name}-{number:04d}.vtp"
                Path(made, file).write_text(_vtp(mesh), encoding="utf-8")
                rows.append(
                    f'<DataSet timestep="{frames.time[number]:.17g}" part="{part}" '
                    f"file={quoteattr(f'{folder.name}/{file}')}/>"
                )
        head = '<?xml version="1.0" encoding="utf-8"?>\n<VTKFile type="Collection" version="0.1"><Collection>\n'
        temporary.write_text(head + "\n".join(rows) + "\n</Collection></VTKFile>\n", encoding="utf-8")
        folder.mkdir(exist_ok=True)
        for whole in Path(made).iterdir():
            place(whole, folder / whole.name)


def _points(frames: Frames, number: int, material: Material) -> Any:
    grain, walls = _grain_numbers(frames), frame_wall_forces(frames, number, material)
    mesh = optional("pyvista", "vtk").PolyData(frames.centres(number))
    mesh["radius"], mesh["grain"], mesh["wall_force"] = frames.sphere_radii, grain, walls.sum(axis=1)
    facts = {
        "lower": frames.lower[number],
        "upper": frames.upper[number],
        "u": frames.u[[number]],
        "time": frames.time[[number]],
        "pressure_tensor": pressure_tensor(frames, number, walls).ravel(),
    }
    for name, values in facts.items():
        mesh.field_data[name] = values
    return mesh


def _lines(frames: Frames, number: int) -> Any:
    own = _contacts(frames, number)
    pairs = frames.spheres[own]
    mesh = optional("pyvista", "vtk").PolyData()
    mesh.points = frames.centres(number)
    if any(frames.periodic):  # a line to a periodic image ends in a point of its own
        centres = frames.centres(number)
        mesh.points = np.concatenate([centres, centres[pairs[:, 1]] + images_met(frames, number)])
        pairs = np.column_stack([pairs[:, 0], len(centres) + np.arange(len(pairs))])
    mesh.lines = np.column_stack([np.full(len(pairs), 2), pairs]).ravel()  # a mesh made without lines gets vertices
    for name in ("normal_force", "friction_force"):  # by VTK itself: pyvista refuses empty arrays of vectors
        array = optional("vtkmodules.util.numpy_support", "vtk").numpy_to_vtk(getattr(frames, name)[own], deep=True)
        array.SetName(name)
        mesh.GetCellData().AddArray(array)
    return mesh


def _vtp(mesh: Any) -> str:
    """The text of a mesh's file. VTK could write the file itself, but gives no reason if it fails."""
    writer = optional("vtkmodules.vtkIOXML", "vtk").vtkXMLPolyDataWriter()
    writer.SetInputData(mesh)
    writer.WriteToOutputStringOn()
    writer.Write()
    return str(writer.GetOutputString())


class Format(NamedTuple):
    """A format for export.

    Attributes:
        suffix: suffix of its files.
        write: writes a file from a path, frames, the mass of a grain of size 1, and the material.
        series: the format for several configurations, if that is another kind of file.
        folder: whether it also writes a folder, named like the file without its suffix.
    """

    suffix: str
    write: Callable[[Path, Frames, float, Material], None]
    series: "Format | None" = None
    folder: bool = False


EXPORT_FORMATS = {
    "gsd": Format(".gsd", write_gsd),
    "vtk": Format(".vtp", write_vtp, Format(".pvd", write_pvd, folder=True)),
    "xyz": Format(".xyz", write_xyz),
    "lammps": Format(".data", write_lammps, Format(".lammpstrj", write_dump)),
}


def format_of(name: str, *, several: bool, suffix: str = "") -> Format:
    """A format by its name.

    Args:
        name: one of `EXPORT_FORMATS`.
        several: whether there are several configurations.
        suffix: suffix of the file; the suffix of a series makes a series even of a single configuration.

    Raises:
        ValueError: if there is no format of that name.
    """
    if name not in EXPORT_FORMATS:
        raise ValueError(f"--to must be one of {', '.join(EXPORT_FORMATS)}; got {name!r}")
    found = EXPORT_FORMATS[name]
    return found.series if found.series and (several or suffix.lower() == found.series.suffix) else found
