"""All words of a length, pre-distorted by the kernel of their pack: how they are read before and after.

python experiments/design_words.py [-o designed-words] [--packs tetra-325-a,...] [--bits 3,5,8] [--iterations 3]

The paper's net has seen inputs only. The designed words are read from a run of their own on the samples as they are
written. Resumes; a row for each pack and length goes to words.csv as it comes. L = 8 on 325 grains at t0 = 1,800 takes
some 1e10 grain-steps.
"""

import argparse
import csv
import time
from pathlib import Path

import jax
import numpy as np
from console import say

import gmem_jax as gm
from gmem_jax.experiment.recall import LARGEST_BATCH
from gmem_jax.files.configuration import key_of_run
from gmem_jax.files.parts import Parts
from gmem_jax.reading import training
from gmem_jax.reading.lessons import Lessons
from gmem_jax.reading.net import accuracy
from gmem_jax.reading.readers import linear_decoder, nearest_template


def main() -> None:
    """Design, verify and read, pack by pack."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("designed-words"), help="folder to write to")
    parser.add_argument("--packs", default="tetra-325-a,tetra-325-b,tetra-325-c,tetra-325-d,tetra-325-e")
    parser.add_argument("--bits", default="3,5,8")
    parser.add_argument("--iterations", type=int, default=3)
    parser.add_argument("--t0", type=float, default=1.8e3)
    parser.add_argument("--budget", type=float, default=600.0, help="seconds for training a net")
    arguments = parser.parse_args()
    folder = arguments.output
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    for bits in map(int, arguments.bits.split(",")):
        kept = folder / f"words-{bits}-seed-0.msgpack"
        net = training.train(Lessons(bits), 0, budget=arguments.budget, checkpoint=kept).net
        for name in arguments.packs.split(","):
            began = time.perf_counter()
            words = gm.words(bits)
            experiment = gm.Experiment(gm.load_pack(name), words, t0=arguments.t0)
            options = {"iterations": arguments.iterations, "batch": LARGEST_BATCH}
            stem = f"{name}-{bits}-t0-{arguments.t0:g}"
            parts = Parts(folder / f"{stem}.parts", key_of_run(experiment, **options))
            design = gm.design_by_kernel(experiment, **options, keep=parts, progress=say)
            gm.save_waveforms(folder / f"{stem}.csv", design.signals, words)
            row: dict[str, object] = {
                "pack": name,
                "bits": bits,
                "t0": arguments.t0,
                "iterations": arguments.iterations,
            }
            for when, p_sig in (("untouched", design.untouched), ("designed", design.p_sig)):
                match, count = experiment.compare(p_sig), np.arange(len(p_sig))
                row |= {
                    f"F {when}": round(float(match.fidelity), 4),
                    f"G {when}": round(float(match.gain), 4),
                    f"net {when}": float(accuracy(net, p_sig)),
                    f"template {when}": float(np.mean(nearest_template(p_sig, design.target) == count)),
                    f"linear {when}": float(np.mean(linear_decoder(p_sig) == count)),
                }
            row["seconds"] = round(time.perf_counter() - began)
            table, new = folder / "words.csv", not (folder / "words.csv").exists()
            with table.open("a") as file:
                writer = csv.DictWriter(file, row)
                if new:
                    writer.writeheader()
                writer.writerow(row)
            print(row, flush=True)
            parts.discard()


if __name__ == "__main__":
    main()
