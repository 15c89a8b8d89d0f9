"""What LAMMPS computes, step by step."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gmem_jax.bench import lammps

OUTPUT = "id x y z vx vy vz omegax omegay omegaz fx fy fz"


@dataclass(frozen=True)
class Trajectory:
    """The T frames of a run, the first at step 0.

    Attributes:
        position: grain centres (means over their spheres), [T, N, 3].
        velocity: velocities of the grain centres, [T, N, 3].
        spin: angular velocities, [T, N, 3].
        force: forces on the spheres from other spheres and walls, [T, N K, 3].
        walls: force on the grains by each of the F finite planes, along its axis, [T, F].
    """

    position: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray
    force: np.ndarray
    walls: np.ndarray


def run_lammps(script: list[str], folder: Path, *, steps: int, every: int, per_grain: int) -> Trajectory:
    """Run a prepared script and read its frames, one every `every` steps."""
    walls = re.findall(r"^compute (wall\d)", "\n".join(script), flags=re.MULTILINE)
    script = [
        *script,
        f"dump out all custom {every} out.dump {OUTPUT}",
        "dump_modify out sort id format float %.17g",
        "thermo_style custom step",
        "thermo 1000000",
    ]
    if walls:
        columns = " ".join(f"c_{wall}" for wall in walls)
        script.append(f'fix walls all ave/time 1 1 {every} {columns} format " %.17g" file out.walls')
    lammps.execute([*script, f"run {steps}"], folder)
    columns_per_frame = len(OUTPUT.split())
    text = (folder / "out.dump").read_text(encoding="utf-8")
    frames = [
        np.array(block.split("\n", 1)[1].split(), dtype=float).reshape(-1, columns_per_frame)
        for block in re.split(r"ITEM: TIMESTEP", text.replace("ITEM: ATOMS", "\0"))[1:]
        for block in [block.split("\0")[1]]
    ]
    table = np.stack(frames)
    grains = table.reshape(table.shape[0], -1, per_grain, columns_per_frame)
    mean = grains.mean(axis=2)
    forces = np.loadtxt(folder / "out.walls", ndmin=2)[:, 1:] if walls else np.zeros((len(table), 0))
    return Trajectory(mean[..., 1:4], mean[..., 4:7], mean[..., 7:10], table[..., 10:13], forces)
