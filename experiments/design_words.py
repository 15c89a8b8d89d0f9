"""All words of a length, pre-distorted by the kernel of their pack: how they are read before and after.

python experiments/design_words.py [-o designed-words] [--packs tetra-325-a,...] [--bits 3,5,8] [--iterations 3]
    [--drawn 256]

The paper's net has seen inputs only, those of all words. The designed words are read from a run of their own on the
samples as they are written. Of longer words some are drawn, so that an accuracy p of N of them has a standard error of
sqrt(p (1 - p) / N); the net and the templates choose among all. Resumes; a row for each pack and length goes to
words.csv as it comes. L = 8 on 325 grains at t0 = 1,800 takes some 1e10 grain-steps.
"""

import argparse
import csv
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from console import say

import gmem_jax as gm
from gmem_jax.experiment.recall import LARGEST_BATCH
from gmem_jax.experiment.signals import bin_average
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
    parser.add_argument("--drawn", type=int, default=256, help="words at most; of more, so many are drawn")
    parser.add_argument("--t0", type=float, default=1.8e3)
    parser.add_argument("--budget", type=float, default=600.0, help="seconds for training a net")
    arguments = parser.parse_args()
    folder = arguments.output
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    for bits in map(int, arguments.bits.split(",")):
        kept = folder / f"words-{bits}-seed-0.msgpack"
        every = gm.words(bits)
        number = np.arange(every.count)
        if every.count > arguments.drawn:
            number = np.sort(np.random.default_rng(bits).choice(number, arguments.drawn, replace=False))
        learns = len(number) == every.count  # the linear decoder, from all the words
        words = replace(every, amplitudes=every.amplitudes[number], centres=every.centres[number])
        templates = bin_average(every)
        net = training.train(Lessons(bits), 0, budget=arguments.budget, checkpoint=kept).net
        for name in arguments.packs.split(","):
            began = time.perf_counter()
            experiment = gm.Experiment(gm.load_pack(name), words, t0=arguments.t0)
            options = {"iterations": arguments.iterations, "batch": LARGEST_BATCH}
            stem = f"{name}-{bits}-t0-{arguments.t0:g}"
            parts = Parts(folder / f"{stem}.parts", key_of_run(experiment, **options))
            design = gm.design_by_kernel(experiment, **options, keep=parts, progress=say)
            gm.save_waveforms(folder / f"{stem}.csv", design.signals, words)
            row: dict[str, object] = {
                "pack": name,
                "bits": bits,
                "words": len(number),
                "t0": arguments.t0,
                "iterations": arguments.iterations,
            }
            for when, p_sig in (("untouched", design.untouched), ("designed", design.p_sig)):
                match = experiment.compare(p_sig)
                row |= {
                    f"F {when}": round(float(match.fidelity), 4),
                    f"G {when}": round(float(match.gain), 4),
                    f"net {when}": float(accuracy(net, p_sig, number)),
                    f"template {when}": float(np.mean(nearest_template(p_sig, templates) == number)),
                    f"linear {when}": float(np.mean(linear_decoder(p_sig) == number)) if learns else "",
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
