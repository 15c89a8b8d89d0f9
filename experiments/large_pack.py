"""One waveform in a pack too large to wait for: how far a shorter preparation, and one waveform of six, can be trusted.

python experiments/large_pack.py --grains 100450 --seeds 101 --waveforms 3 --dt 0.425 --store 0.5
python experiments/large_pack.py --grains 1024 --seeds 1,2,3,4,5 [--prepared standard]

At the standard speed the piston presses a large pack for a long time, and the pack never comes to rest everywhere at
once, so that its largest speed says little. `SHORT` presses twice as fast, fixes the piston as soon as the pressure is
right within 1 %, and ends the last rest at a largest speed of 2e-4 R / t_c. Each waveform of a run is also evaluated by
itself. Rows are added to a table; packs and recalls are kept and not made again, and an interrupted script goes on.
"""

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from console import in_one_line, say
from drawn_words import run
from rows import done

import gmem_jax as gm
from gmem_jax.experiment import analysis
from gmem_jax.experiment.provenance import sources
from gmem_jax.files.checkpoints import Checkpoints
from gmem_jax.physics.state import combined_status
from gmem_jax.preparation.recipe import Recipe
from gmem_jax.reproduce.compare import write_csv

STANDARD = Recipe()
SHORT = Recipe(piston_gain=0.01, settled_speed=3e-3, quiet=2e-4)
RECIPES = {"standard": STANDARD, "short": SHORT}
CONDITIONS = ("grains", "seed", "prepared", "t0", "dt", "store", "run_with", "waveforms")
MEASURES = ("G", "F", "G_over_T1", "F_over_T1")


def main() -> None:
    """Prepare, run and evaluate, seed by seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("large-pack"), help="folder to write to")
    parser.add_argument("--grains", type=int, default=1024)
    parser.add_argument("--seeds", default="101")
    parser.add_argument("--prepared", choices=RECIPES, default="short")
    parser.add_argument("--waveforms", default="1,2,3,4,5,6", help="of the six, those to run")
    parser.add_argument("--t0", type=float, default=5.4e3)
    parser.add_argument("--dt", type=float, default=0.3)
    parser.add_argument("--store", type=float, default=2.0, help="in t0")
    arguments = parser.parse_args()
    wanted = [int(number) for number in arguments.waveforms.split(",") if number.isdecimal()]
    if not wanted or arguments.waveforms != ",".join(map(str, wanted)) or not set(wanted) <= set(range(1, 7)):
        parser.error(f"--waveforms: numbers from 1 to 6, like 1,3; got {arguments.waveforms}")
    jax.config.update("jax_enable_x64", True)
    folder: Path = arguments.output
    folder.mkdir(parents=True, exist_ok=True)
    for seed in map(int, arguments.seeds.split(",")):
        recipe = replace(RECIPES[arguments.prepared], grains=arguments.grains, seed=seed)
        pack = prepared(folder / f"tetra-{recipe.grains}-{seed}-{arguments.prepared}.h5", recipe)
        six, rows = gm.six_signals(), np.asarray(wanted) - 1
        some = replace(six, amplitudes=six.amplitudes[rows], centres=six.centres[rows])
        experiment = gm.Experiment(pack, some, t0=arguments.t0, dt=arguments.dt, store=arguments.store)
        row = {"grains": recipe.grains, "seed": seed, "prepared": arguments.prepared, "t0": arguments.t0}
        row |= {"dt": arguments.dt, "store": arguments.store, "run_with": len(wanted)}
        ran = "+".join(map(str, wanted))
        file = folder / f"{'-'.join(map(str, [*row.values(), ran]))}.h5"
        if not file.exists():
            run(experiment, file)
        recall = gm.load_recall(file)
        found = [
            {**row, "waveforms": " ".join(map(str, those)), **measured(experiment, recall, wanted, those)}
            for those in dict.fromkeys((tuple(wanted), *((one,) for one in wanted)))
        ]
        add(folder / "large_pack.csv", found)


def prepared(file: Path, recipe: Recipe) -> gm.Pack:
    """The pack in a file; it is made if it does not exist."""
    if not file.exists():
        parts = Checkpoints(file.with_suffix(".parts"), {"recipe": asdict(recipe), **sources()})
        gm.save_pack(file, gm.prepare(recipe, cache=parts, progress=say))
        parts.discard()
    return gm.load_pack(str(file))


def measured(
    experiment: gm.Experiment, recall: gm.Recall, ran: list[int], those: tuple[int, ...]
) -> dict[str, float | int]:
    """G and F of some of the waveforms that ran, without and with a mean over the ringing period."""
    rows = np.asarray([ran.index(number) for number in those])
    pair = recall.p_sig[rows], recall.J[rows], experiment.scale
    plain, smooth = analysis.compare(*pair), analysis.compare(*pair, float(recall.window) / float(experiment.t0))
    status = combined_status(np.asarray(recall.status)[[0, *(rows + 1)]])
    values = (float(value) for match in (plain, smooth) for value in match)
    return {**dict(zip(MEASURES, (round(value, 6) for value in values), strict=True)), "status": status}


def add(path: Path, rows: list[dict[str, Any]]) -> None:
    """Put rows into a table; they replace older rows of the same conditions."""
    new = {tuple(str(row[name]) for name in CONDITIONS): row for row in [*done(path), *rows]}
    write_csv(path, list(new.values()))
    for row in rows[:1]:
        print(row, flush=True)


if __name__ == "__main__":
    in_one_line(main)
