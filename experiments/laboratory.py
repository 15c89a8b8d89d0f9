"""Could it be seen in a laboratory? What a memory loses by walls, sizes, weight, creep and an unclean beginning.

python experiments/laboratory.py [-o laboratory] [--grains 3267] [--seeds 101,102,103] [--words 1024] [--only ...]

Words of three bits are recalled at t0 = 1,800 with SUB2-BL, for which an experimenter needs one pack, read twice.
One condition at a time is as in a laboratory, and then all together (docs/laboratory.md lists them). Words of six bits
in a pack of --words grains show how many bits are read at the noise of a gauge. Then one parameter at a time differs
from the paper's, and slopes give the effect of a small change of gamma0 and of delta0. Packs are prepared once and kept
in the folder. Every condition of a pack adds its rows to laboratory.csv and is done once, so that a killed script goes
on. At the end it prints the table, with mean and standard error over packs.
"""

import argparse
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from console import in_one_line
from rows import done, note

import gmem_jax as gm
from gmem_jax.experiment.analysis import spread
from gmem_jax.reading.capacity import decoded_bits

FEW, MANY = 3, 6  # bits of the words whose F is measured, and of those that are read
NOISES = (1.0, 5.0, 20.0)  # Pa, in each of 256 bins
PASCAL = float(gm.Material().modulus)
DT = 0.8  # t_c
OVERLAP = 0.6  # overlap of the paper's grain
WEIGHT = 1e-5  # R / t_c^2: silicone grains of R = 1 mm and E = 1 MPa (docs/physics.md, "Gravity")
CREEP = {"creep": 1e-3, "creep_fades": 10.0}  # 1 % of a force with each e-fold of time in a stage: 2.3 % a decade
COLUMNS = ("pack", "N", "condition", "quantity", "value", "seconds")


class Condition(NamedTuple):
    """One way in which an experiment differs from the paper's.

    Attributes:
        prepare: numbers of the recipe.
        run: numbers of the experiment.
        cycles: number of cycles with friction before the write.
        overlap: overlap of the grain's spheres.
    """

    prepare: dict[str, Any]
    run: dict[str, Any]
    cycles: int = 0
    overlap: float = OVERLAP


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
STRONGER = {"gamma0": 3e-3}
CHOICES = {
    "gamma0 = 3e-3": Condition({}, STRONGER),
    "gamma0 = 1e-2": Condition({}, {"gamma0": 1e-2}),
    "delta0 = 0.02": Condition({"delta0": 0.02}, {}),
    "delta0 = 0.08": Condition({"delta0": 0.08}, {}),
    "O = 0.8": Condition({}, {}, overlap=0.8),
    "O = 0.9": Condition({}, {}, overlap=0.9),
    "gamma0 = 3e-3 and O = 0.9": Condition({}, STRONGER, overlap=0.9),
    "all with gamma0 = 3e-3 and O = 0.9": CONDITIONS["all"]._replace(run=CONDITIONS["all"].run | STRONGER, overlap=0.9),
}
SLOPES = "slopes"
ALL = CONDITIONS | CHOICES | {SLOPES: Condition({}, {})}


def prepared(folder: Path, grains: int, seed: int, condition: Condition) -> gm.Pack:
    """A pack of the folder; it is made if it does not exist."""
    shape = {} if condition.overlap == OVERLAP else {"O": condition.overlap}
    numbers = {"grains": grains, "seed": seed, "dt": 0.5, **condition.prepare}
    told = (f"{key}={value:g}" for key, value in (condition.prepare | shape).items())
    name = "-".join([f"tetra-{grains}-{seed}", *told])
    path = folder / f"{name}.h5"
    if not path.exists():
        gm.save_pack(path, gm.prepare(grain=gm.tetra(condition.overlap), name=name, progress=False, **numbers))
    return gm.load_pack(path)


def experiment(pack: gm.Pack, signals: Any, condition: Condition) -> gm.Experiment:
    """An experiment with one write and two reads, after cycles with friction, if there are any."""
    common: dict[str, Any] = {"t0": 1.8e3, "dt": DT, "background": "sub2-bl", **condition.run}
    plain = gm.Experiment(pack, signals, store=0.5, **common)
    if not condition.cycles:
        return plain
    first, *stages = plain.protocol
    before = (stage for _ in range(condition.cycles) for stage in gm.cycle())
    return gm.Experiment(pack, signals, protocol=gm.Protocol(first, *before, *stages), **common)


def rms(p_sig: jax.Array) -> jax.Array:
    """Root mean square of recalled signals, in Pa."""
    return jnp.sqrt(jnp.mean(p_sig**2)) * PASCAL


Measured = tuple[dict[str, float], Any]
"""Values by name, and the status of the replicas."""


def measures(experiment: gm.Experiment) -> Measured:
    """G, F, and the size of the recall."""
    recall = gm.run(experiment, progress=False)
    found = {"G": float(recall.gain), "F": float(recall.fidelity), "rms of p_sig (Pa)": float(rms(recall.p_sig))}
    return found, recall.status


def bits(experiment: gm.Experiment) -> Measured:
    """Bits of a word that the linear decoder reads."""
    recall = gm.run(experiment, progress=False)
    read = {noise: decoded_bits(recall.p_sig, noise / PASCAL).bits for noise in NOISES}
    return {f"bits read of {MANY} at {noise:g} Pa": value for noise, value in read.items()}, recall.status


def slopes(experiment: gm.Experiment) -> Measured:
    """Derivatives of F and of ln(rms of p_sig) by ln(gamma0) and by ln(delta0)."""
    found: dict[str, float] = {}
    status: Any = 0
    for name, value in {"gamma0": experiment.gamma0, "delta0": experiment.compression}.items():

        def both(value: jax.Array, name: str = name) -> tuple[jax.Array, jax.Array, jax.Array]:
            recall = gm.recall(gm.replace(experiment, {name: value}))
            return recall.fidelity, jnp.log(rms(recall.p_sig)), jnp.asarray(recall.status)

        at = jnp.asarray(float(value))
        (_, _, ended), (fidelity, size, _) = jax.jvp(both, (at,), (at,))
        found |= {f"dF/dln({name})": float(fidelity), f"dln(rms)/dln({name})": float(size)}
        status = status | np.asarray(ended)
    return found, status


def main() -> None:
    """Run the missing conditions, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("laboratory"), help="folder to write to")
    parser.add_argument("--grains", type=int, default=3267)
    parser.add_argument("--seeds", default="101,102,103")
    parser.add_argument("--words", type=int, default=1024, help="grains of the pack that words are stored in, seed 101")
    parser.add_argument("--only", default=",".join(ALL))
    arguments = parser.parse_args()
    names = arguments.only.split(",")
    if unknown := [name for name in names if name not in ALL]:
        parser.error(f"--only: no condition {unknown[0]!r}; there are {', '.join(ALL)}")
    jax.config.update("jax_enable_x64", True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    path = arguments.output / "laboratory.csv"
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    for name in names:
        condition = ALL[name]
        jobs = [(arguments.grains, seed, FEW, slopes if name == SLOPES else measures) for seed in seeds]
        jobs += [(arguments.words, 101, MANY, bits)] if arguments.words and name != SLOPES else []
        for grains, seed, length, measure in jobs:
            pack = f"tetra-{grains}-{seed}"
            known = [row["quantity"] for row in done(path) if (row["pack"], row["condition"]) == (pack, name)]
            if any(quantity.startswith("bits") == (measure is bits) for quantity in known):
                continue
            began = time.process_time()
            made = prepared(arguments.output, grains, seed, condition)
            found, status = measure(experiment(made, gm.words(length), condition))
            own = {"pack": pack, "N": grains, "condition": name, "seconds": f"{time.process_time() - began:.0f}"}
            note(path, COLUMNS, [own | {"quantity": key, "value": f"{value:.5g}"} for key, value in found.items()])
            print(pack, name, gm.explain(status), f"{own['seconds']} CPU s", flush=True)
    rows = done(path)
    for grains, name, quantity in dict.fromkeys(map(of_mean, rows)):
        values = [float(row["value"]) for row in rows if of_mean(row) == (grains, name, quantity)]
        mean, _, error = spread(values)
        print(f"{grains:>6} {name:22} {quantity:28} {mean:9.4g} ± {error:.2g} ({len(values)})")


def of_mean(row: Mapping[str, str]) -> tuple[str, str, str]:
    """The values that the rows of one mean have in common."""
    return row["N"], row["condition"], row["quantity"]


if __name__ == "__main__":
    in_one_line(main)
