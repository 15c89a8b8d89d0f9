"""All words of a length, pre-distorted by the kernel of their pack: how they are read before and after.

python experiments/design_words.py [-o designed-words] [--packs tetra-325-a,...] [--bits 3,5,8] [--iterations 3]
    [--drawn 256]

The paper's net is trained on inputs only, those of all words. The designed words are read from a separate run with the
samples that are written. A pack's kernel is measured once. Of many words only some are drawn, so that an accuracy p of
N of them has a standard error of sqrt(p (1 - p) / N); the net and the templates choose among all words. A killed script
resumes. A row for each pack and length is added to words.csv, which is drawn to words.png. L = 8 on 325 grains at
t0 = 1,800 takes some 1e10 grain-steps.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from console import in_one_line, say
from packs import FIVE, called, over_packs
from rows import done, note

import gmem_jax as gm
from gmem_jax.design.by_kernel import KERNEL_BUMP_WIDTH, KERNEL_BUMPS
from gmem_jax.experiment.cost import LARGEST_BATCH
from gmem_jax.experiment.record import key_of_run
from gmem_jax.experiment.signals import bin_average
from gmem_jax.files.checkpoints import Checkpoints
from gmem_jax.reading import training
from gmem_jax.reading.lessons import TrainingConfig
from gmem_jax.reading.net import Net, accuracy
from gmem_jax.reading.readers import linear_decoder, nearest_template
from gmem_jax.reproduce.draw import OURS, THEIRS
from gmem_jax.show.numbers import published
from gmem_jax.show.render_matplotlib import pyplot, save_picture

TABLE = "words.csv"
Row = dict[str, str | int | float]


def main() -> None:
    """Design, verify and read, pack by pack."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("designed-words"), help="folder to write to")
    parser.add_argument("--packs", type=called, default=FIVE)
    parser.add_argument("--bits", default="3,5,8")
    parser.add_argument("--iterations", type=int, default=3)
    parser.add_argument("--drawn", type=int, default=256, help="words at most; of more, so many are drawn")
    parser.add_argument("--t0", type=float, default=1.8e3)
    parser.add_argument("--budget", type=float, default=600.0, help="seconds for training a net")
    arguments = parser.parse_args()
    folder = arguments.output
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    for name in arguments.packs:
        any_words = gm.Experiment(gm.load_pack(name), gm.words(3), t0=arguments.t0)
        measured = Checkpoints(folder / f"{name}-t0-{arguments.t0:g}.kernel", key_of_run(any_words))
        kernel = gm.memory_kernel(any_words, KERNEL_BUMPS, KERNEL_BUMP_WIDTH, cache=measured, progress=say)
        for bits in map(int, arguments.bits.split(",")):
            number = drawn(2**bits, arguments.drawn)
            if there(folder / TABLE, name, bits, len(number), arguments.t0, arguments.iterations):
                continue
            net = net_of(bits, folder, arguments.budget)
            row = design(folder, any_words, kernel, bits, number, net, arguments.iterations)
            print(row, flush=True)
            note(folder / TABLE, list(row), [row])
            draw(folder / TABLE, folder / "words.png")


def drawn(count: int, most: int) -> np.ndarray:
    """Numbers of the words that are drawn: at most `most` of `count`."""
    every = np.arange(count)
    return every if count <= most else np.sort(np.random.default_rng(count).choice(every, most, replace=False))


def net_of(bits: int, folder: Path, budget: float) -> Net:
    """The paper's net for words of this length, which a folder keeps; training it takes up to `budget` seconds."""
    kept = folder / f"words-{bits}-seed-0.msgpack"
    trained = training.train_net(TrainingConfig(bits), 0, budget=budget, checkpoint=kept)
    if not trained.finished:
        print(f"net of {bits} bits: out of time, held-out accuracy {trained.validation:.4f}", flush=True)
    return trained.net


def design(
    folder: Path,
    any_words: gm.Experiment,
    kernel: gm.MemoryKernel,
    bits: int,
    number: np.ndarray,
    net: Net,
    iterations: int,
) -> Row:
    """Design the words with these numbers, and read them before and after."""
    began = time.perf_counter()
    every = gm.words(bits)
    words = replace(every, amplitudes=every.amplitudes[number], centres=every.centres[number])
    experiment = gm.replace(any_words, signals=words)
    pack, t0 = experiment.pack.name, float(experiment.t0)
    stem = f"{pack}-{bits}-t0-{t0:g}"
    parts = Checkpoints(folder / f"{stem}.parts", key_of_run(experiment, iterations=iterations, batch=LARGEST_BATCH))
    found = gm.design_by_kernel(
        experiment, iterations=iterations, batch=LARGEST_BATCH, kernel=kernel, cache=parts, progress=say
    )
    gm.save_waveforms(folder / f"{stem}.csv", found.signals, words)
    templates = bin_average(every)
    row: Row = {"pack": pack, "bits": bits, "words": len(number), "t0": t0, "iterations": iterations}
    for when, p_sig in (("untouched", found.untouched), ("designed", found.p_sig)):
        match = experiment.compare(jnp.asarray(p_sig))
        row |= {
            f"F {when}": round(float(match.fidelity), 4),
            f"G {when}": round(float(match.gain), 4),
            f"net {when}": float(accuracy(net, p_sig, number)),
            f"template {when}": float(np.mean(nearest_template(p_sig, templates) == number)),
            f"linear {when}": float(np.mean(linear_decoder(p_sig) == number)) if len(number) == every.count else "",
        }
    parts.discard()
    return row | {"seconds": round(time.perf_counter() - began)}


def there(table: Path, pack: str, bits: int, words: int, t0: float, iterations: int) -> bool:
    """Whether the table has these words; it ends the script if the table has another t0, effort or number of words."""
    rows = done(table)
    for row in rows:
        if (float(row["t0"]), int(row["iterations"])) != (t0, iterations):
            sys.exit(f"{table}: has words of t0 = {row['t0']}, {row['iterations']} iterations; name another folder")
    found = {int(row["words"]) for row in rows if (row["pack"], row["bits"]) == (pack, str(bits))}
    if found - {words}:
        sys.exit(f"{table}: has {min(found)} words of {bits} bits of {pack}; name another folder")
    return bool(found)


def draw(table: Path, path: Path) -> None:
    """Draw F and the net's accuracy against L before and after, mean and SD over packs; and the published values."""
    figure, axes = pyplot().subplots(1, 2, figsize=(10, 4.2))
    rows = done(table)
    sizes = sorted({gm.load_pack(row["pack"]).grains for row in rows})
    for axis, column, theirs in ((axes[0], "F", "fidelity_sub0"), (axes[1], "net", "classifier_accuracy")):
        place = 0
        for grains, symbol in zip(sizes, "osD", strict=False):
            own = [row for row in rows if gm.load_pack(row["pack"]).grains == grains]
            for when, style, face in (("untouched", "--", "white"), ("designed", "-", OURS)):
                lengths, means, deviations = over_packs(own, "bits", f"{column} {when}")
                at = np.array(lengths) + 0.06 * (place - 1.5)
                label, fmt = f"{when}, N = {grains:,}", f"{symbol}{style}"
                axis.errorbar(at, means, deviations, fmt=fmt, color=OURS, mfc=face, capsize=2, label=label)
                place += 1
        points = [(row["word_bits"], row[theirs]) for row in published("binary_words.csv")]
        label = "published, untouched, N = 10,240"
        axis.plot(*zip(*points, strict=True), "^", color=THEIRS, mfc="white", ms=6, label=label)
        axis.set(xlabel="bits of a word, L", ylim=(0.0, 1.05))
    axes[0].set_ylabel("F (SUB0)")
    axes[1].set_ylabel("words read right by the net")
    axes[0].set_ylim(top=1.2)  # room for the legend
    axes[0].legend(fontsize=7, frameon=False, loc="upper left", ncols=2)
    figure.suptitle("Words as they come and designed; mean and SD over packs", fontsize=10)
    save_picture(path, figure)


if __name__ == "__main__":
    in_one_line(main)
