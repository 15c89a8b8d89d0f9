"""Walls stiffer than rigid ones with a smaller k_H: which published points come nearer?

python experiments/stiff_walls.py [-o stiff_walls] [--grains 1024] [--seeds 101,102] [--pairs 1:0.13,4:0.115]

A pair is the stiffness of walls over that of rigid ones, and k_H. Packs are prepared between the same walls, once for
each compression, and kept in the folder. Every point adds a row to stiff_walls.csv and is done once. At the end the
script prints mean and standard error over packs of G and F after a mean over the ringing period.
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from console import in_one_line
from rows import done, note

import gmem_jax as gm
from gmem_jax.experiment.analysis import spread

# delta0, mu and gamma0: the standard point, and those whose G or F differ from the published ones
POINTS = (
    (0.05, 1.0, 1e-3),
    (0.05, 0.2, 1e-3),
    (0.01, 1.0, 1e-3),
    (0.05, 1.0, 1e-2),
    (0.05, 1.0, 3e-2),
    (0.05, 1.0, 1e-1),
    (0.01, 1.0, 3e-4),
)
COLUMNS = ("N", "seed", "walls", "k_H", "delta0", "mu", "gamma0", "gain", "fidelity", "status")
PLACE = COLUMNS[:7]


def prepared(folder: Path, grains: int, seed: int, material: gm.Material, delta0: float) -> gm.Pack:
    """A pack of the folder; it is made if it does not exist."""
    name = f"tetra-{grains}-{seed}-walls={material.wall_rigidity:g}-delta0={delta0:g}"
    path = folder / f"{name}.h5"
    if not path.exists():
        recipe = gm.Recipe(grains=grains, seed=seed, delta0=delta0, dt=0.4)
        gm.save_pack(path, gm.prepare(recipe, material=material, name=name, progress=False))
    return gm.load_pack(path)


def main() -> None:
    """Run the missing points, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("stiff_walls"), help="folder to write to")
    parser.add_argument("--grains", type=int, default=1024)
    parser.add_argument("--seeds", default="101,102,103,104,105")
    parser.add_argument("--pairs", default="1:0.13,2:0.12,4:0.115", help="stiffness of walls : k_H")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    path = arguments.output / "stiff_walls.csv"
    for seed in map(int, arguments.seeds.split(",")):
        for walls, stiffness in (tuple(map(float, pair.split(":"))) for pair in arguments.pairs.split(",")):
            material = gm.Material(wall_rigidity=walls)
            for delta0, mu, gamma0 in POINTS:
                place = (arguments.grains, seed, walls, stiffness, delta0, mu, gamma0)
                own = dict(zip(PLACE, (f"{value:g}" for value in place), strict=True))
                if any(all(row[key] == value for key, value in own.items()) for row in done(path)):
                    continue
                pack = prepared(arguments.output, arguments.grains, seed, material, delta0)
                law = gm.Hooke(mu=mu, stiffness=stiffness)
                experiment = gm.Experiment(
                    pack, gm.six_signals(), law, material, gamma0=gamma0, delta0=delta0, t0=1.8e3, dt=0.6
                )
                recall = gm.run(experiment, progress=False)
                measures = {"gain": recall.windowed_gain, "fidelity": recall.windowed_fidelity}
                found = {name: f"{float(value):.5g}" for name, value in measures.items()}
                note(path, COLUMNS, [own | found | {"status": int(np.bitwise_or.reduce(np.ravel(recall.status)))}])
                print(*own.values(), *found.values(), gm.explain(recall.status), flush=True)
    rows = done(path)
    where = [name for name in PLACE if name != "seed"]
    for point in dict.fromkeys(tuple(row[name] for name in where) for row in rows):
        same = [row for row in rows if tuple(row[name] for name in where) == point]
        told = [spread([float(row[name]) for row in same]) for name in ("gain", "fidelity")]
        values = (f"{name} {mean:.3f} ± {error:.3f}" for name, (mean, _, error) in zip("GF", told, strict=True))
        print(
            ", ".join(f"{name} = {value}" for name, value in zip(where, point, strict=True)), *values, f"({len(same)})"
        )


if __name__ == "__main__":
    in_one_line(main)
