"""Could it be seen in a laboratory? What a memory loses by walls, sizes, weight, creep and an unclean beginning.

python experiments/laboratory.py [-o laboratory] [--grains 3267] [--seeds 101,102,103] [--words 1024] [--only ...]

Words of three bits at t0 = 1,800 with SUB2-BL, for which an experimenter needs one pack that is read twice. One thing
at a time is as in a laboratory, and then all together (docs/laboratory.md says what they are). Words of six bits in a
pack of --words grains say how many bits are read at a gauge's noise. Packs are prepared once and kept in the folder.
Every condition of a pack adds its rows to laboratory.csv and is done once, so that it goes on where it was killed. At
the end the table is printed, mean and standard error over packs.
"""

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rows import done, note

import gmem_jax as gm
from gmem_jax.experiment.analysis import spread
from gmem_jax.reading.capacity import decoded_bits

FEW, MANY = 3, 6  # bits of the words whose F is measured, and of those that are read
NOISES = (1.0, 5.0, 20.0)  # Pa, in each of 256 bins
PASCAL = float(gm.Material().modulus)
DT = 0.8  # t_c
WEIGHT = 1e-5  # R / t_c^2: silicone grains of R = 1 mm and E = 1 MPa (docs/physics.md, "Gravity")
CREEP = {"creep": 1e-3, "creep_fades": 10.0}  # 1 % of a force with each e-fold of time in a stage: 2.3 % a decade
COLUMNS = ("pack", "N", "condition", "quantity", "value", "seconds")


class Condition(NamedTuple):
    """One way in which a laboratory differs.

    Attributes:
        prepare: numbers of the recipe.
        run: numbers of the experiment.
        cycles: with friction, before anything is written.
    """

    prepare: dict[str, Any]
    run: dict[str, Any]
    cycles: int = 0


WALLS, SPREAD, GRAVITY = {"wall_mu": 0.3}, {"size_spread": 0.1}, {"gravity": WEIGHT}
CONDITIONS = {
    "as-the-paper": Condition({}, {}),
    "sizes": Condition(SPREAD, {}),
    "gravity": Condition(GRAVITY, GRAVITY),
    "cycles-with-friction": Condition({}, {}, 2),
    "creep": Condition({}, CREEP),
    "rough-walls": Condition({}, WALLS),
    "all": Condition(SPREAD | GRAVITY, WALLS | GRAVITY | CREEP, 2),
}


def prepared(folder: Path, grains: int, seed: int, numbers: dict[str, Any]) -> gm.Pack:
    """A pack of the folder, made if it is not there."""
    name = "-".join([f"tetra-{grains}-{seed}", *(f"{key}={value:g}" for key, value in numbers.items())])
    path = folder / f"{name}.h5"
    if not path.exists():
        gm.save_pack(path, gm.prepare(grains=grains, seed=seed, dt=0.5, name=name, progress=False, **numbers))
    return gm.load_pack(path)


def experiment(pack: gm.Pack, signals: Any, condition: Condition) -> gm.Experiment:
    """Written once and read twice, after cycles with friction if there are any."""
    common: dict[str, Any] = {"t0": 1.8e3, "dt": DT, "background": "sub2-bl", **condition.run}
    plain = gm.Experiment(pack, signals, store=0.5, **common)
    if not condition.cycles:
        return plain
    first, *stages = plain.protocol
    before = (stage for _ in range(condition.cycles) for stage in gm.cycle())
    return gm.Experiment(pack, signals, protocol=gm.Protocol(first, *before, *stages), **common)


def measures(recall: gm.Recall) -> dict[str, float]:
    """G, F, and the size of what is to be measured."""
    size = float(np.sqrt(np.mean(np.asarray(recall.p_sig) ** 2))) * PASCAL
    return {"G": float(recall.gain), "F": float(recall.fidelity), "rms of p_sig (Pa)": size}


def bits(recall: gm.Recall) -> dict[str, float]:
    """Of a word, that the linear decoder reads."""
    return {f"bits read of {MANY} at {noise:g} Pa": decoded_bits(recall.p_sig, noise / PASCAL).bits for noise in NOISES}


def main() -> None:
    """Run what is not done, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("laboratory"), help="folder to write to")
    parser.add_argument("--grains", type=int, default=3267)
    parser.add_argument("--seeds", default="101,102,103")
    parser.add_argument("--words", type=int, default=1024, help="grains of the pack that words are stored in, seed 101")
    parser.add_argument("--only", default=",".join(CONDITIONS))
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    path = arguments.output / "laboratory.csv"
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    jobs = [(arguments.grains, seed, gm.words(FEW), measures) for seed in seeds]
    jobs += [(arguments.words, 101, gm.words(MANY), bits)] if arguments.words else []
    for name in arguments.only.split(","):
        for grains, seed, signals, what in jobs:
            pack = f"tetra-{grains}-{seed}"
            if any((row["pack"], row["condition"]) == (pack, name) for row in done(path)):
                continue
            began, condition = time.process_time(), CONDITIONS[name]
            made = prepared(arguments.output, grains, seed, condition.prepare)
            recall = gm.run(experiment(made, signals, condition), progress=False)
            own = {"pack": pack, "N": grains, "condition": name, "seconds": f"{time.process_time() - began:.0f}"}
            found = what(recall)
            note(path, COLUMNS, [own | {"quantity": key, "value": f"{value:.5g}"} for key, value in found.items()])
            print(pack, name, gm.explain(recall.status), f"{own['seconds']} CPU s", flush=True)
    rows = done(path)
    for name, quantity in dict.fromkeys((row["condition"], row["quantity"]) for row in rows):
        values = [float(row["value"]) for row in rows if (row["condition"], row["quantity"]) == (name, quantity)]
        mean, _, error = spread(values)
        print(f"{name:22} {quantity:28} {mean:9.4g} ± {error:.2g} ({len(values)})")


if __name__ == "__main__":
    main()
