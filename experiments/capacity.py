"""What figs. 13 and 14 share: packs, words, recalls on disk, and what they cost.

Recalls are kept as HDF5 in the output folder, with their configuration, and are not run again when they are there.
"""

import argparse
import math
import time
from pathlib import Path

import gmem_jax as gm
from gmem_jax.experiment.signals import BINS
from gmem_jax.show.tables import summary

SCALES = {"laptop": range(3, 7), "paper": range(3, 11)}
LENGTH = 9.0  # t0 of an experiment with a second readout ...
COMMON = 2.6  # ... and of its beginning, which is run once for all signals
PAPER_GRAINS = 10_240
DT = 0.3  # t_c; the default time step
BATCH = 63  # words that run together


def parser(doc: str, folder: str) -> argparse.ArgumentParser:
    """Options of both figures."""
    options = argparse.ArgumentParser(description=doc.splitlines()[0])
    options.add_argument("--scale", choices=list(SCALES), default="laptop")
    options.add_argument("--pack", nargs="+", help="shipped names or pack files; default those of the scale")
    options.add_argument("--bits", nargs="+", type=int, help="lengths of the words; default those of the scale")
    options.add_argument("--t0", type=float, help="duration of one compression, t_c; default 1800, paper 18000")
    options.add_argument("-o", "--output", type=Path, default=Path(folder), help="folder to write to")
    return options


def chosen(options: argparse.Namespace) -> tuple[list[gm.Pack], list[int], float]:
    """Packs, lengths of words and t0.

    Raises:
        SystemExit: if no pack of the scale is at hand.
    """
    paper = options.scale == "paper"
    names = options.pack or [
        name for name in gm.list_packs() if ("10240" in name if paper else name.startswith(("tetra-325", "tetra-1024")))
    ]
    if not names:
        raise SystemExit(
            f"no shipped pack of {PAPER_GRAINS} grains; make some with `gmem prepare --grains {PAPER_GRAINS} --seed 1 "
            "-o pack.h5` and name them with --pack"
        )
    t0 = options.t0 or (1.8e4 if paper else 1.8e3)
    return [gm.load_pack(name) for name in names], options.bits or list(SCALES[options.scale]), t0


def experiment_of(pack: gm.Pack, bits: int, t0: float) -> gm.Experiment:
    """All words of a length, with a second readout."""
    return gm.Experiment(pack, gm.words(bits), t0=t0, dt=DT, background="sub2-bl")


def announce(packs: list[gm.Pack], bits: list[int], t0: float) -> None:
    """Say what it will cost: from two fast recalls of three bits, with one and with three steps to a bin.

    The difference is what steps cost, apart from what a run costs anyway; both are scaled to the work planned.
    """

    def seconds(steps: int) -> float:
        began = time.perf_counter()
        gm.run(experiment_of(packs[0], 3, steps * BINS * DT))
        return time.perf_counter() - began

    for steps in (1, 3):
        seconds(steps)  # compiles
    one, three = seconds(1), seconds(3)
    step = max(three - one, 0.0) / 2.0
    each = one - step + step * math.ceil(t0 / (BINS * DT))
    width = {length: COMMON + (LENGTH - COMMON) * (2**length + 1) for length in (3, *bits)}  # replicas times t0
    share = sum(pack.grains / packs[0].grains * width[length] / width[3] for pack in packs for length in bits)
    minutes = each * share / 60.0
    cost = f"{minutes:.1f} minutes" if minutes < 90.0 else f"{minutes / 60.0:.1f} hours"
    long = f" ({minutes / 1440.0:.0f} days)" if minutes > 2880.0 else ""
    print(f"{len(packs)} packs, words of {bits} bits, t0 = {t0:g}: about {cost}{long} of recalls", flush=True)


def recall(pack: gm.Pack, bits: int, t0: float, folder: Path) -> dict:
    """The summary of one recall of all words of a length, with its file's path; run only if it is not there yet."""
    path = folder / f"recall-{pack.name}-words-{bits}-t0-{t0:g}.h5"
    if not path.exists():
        experiment = experiment_of(pack, bits, t0)
        began = time.perf_counter()
        found = gm.run(experiment, batch=BATCH)
        gm.save_recall(path, found, gm.resolved(experiment, time.perf_counter() - began))
    kept, configuration = gm.load_recall(path)
    row = summary(kept, configuration)
    left = row["second_readout"]
    print(
        f"{pack.name}  L = {bits}  "
        + "  ".join(f"F({name}) = {values['fidelity']:.3f}" for name, values in row["backgrounds"].items())
        + f"  second readout: correlation {left['correlation']:+.3f}, gain {left['gain']:+.4f}  {row['status_text']}",
        flush=True,
    )
    return {**row, "bits": bits, "path": path}
