"""A few words of each length on a pack too large for all of them: how well they come back, and are read.

python experiments/drawn_words.py [-o drawn-words] [--pack tetra-10240-d] [--bits 7,9,10] [--drawn 15] [--t0 5400]
    [--dt 1]

All 1,024 words of ten bits on 10,240 grains would take a day of a core; fifteen and the zero signal fill two vectors of
a CPU and take twenty minutes. A GPU runs 64 in half a minute. Words are drawn at random; of ten bits the word that the
paper shows replaces the last. F of the drawn words estimates F of all within its standard error over words; the
standard error of an accuracy p is sqrt(p (1 - p) / drawn). The paper's net, trained on inputs of all words, and the
templates choose among all words.

A killed script resumes, and recalls are kept. Each pack, t0 and time step has one table, to which lengths may be added
later, and its picture. The script says if a net ran out of time; the same command goes on training it.
"""

import argparse
import csv
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from console import in_one_line, say
from design_words import drawn, net_of

import gmem_jax as gm
from gmem_jax.experiment import analysis
from gmem_jax.experiment.record import key_of_run
from gmem_jax.experiment.signals import bin_average
from gmem_jax.files.checkpoints import Checkpoints
from gmem_jax.reading.net import Net, accuracy
from gmem_jax.reading.readers import nearest_template
from gmem_jax.reproduce.compare import write_csv
from gmem_jax.reproduce.draw import OURS, THEIRS
from gmem_jax.reproduce.figures import SHOWN_WORD
from gmem_jax.show.numbers import published
from gmem_jax.show.render_matplotlib import pyplot, save_picture

SHOWN_OF = 10  # bits of the word that the paper shows
Row = dict[str, str | int | float]


def main() -> None:
    """Run and read, length by length."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("drawn-words"), help="folder to write to")
    parser.add_argument("--pack", default="tetra-10240-d")
    parser.add_argument("--bits", default="7,9,10")
    parser.add_argument("--drawn", type=int, default=15, help="words of a length")
    parser.add_argument("--t0", type=float, default=5.4e3)
    parser.add_argument("--dt", type=float, default=1.0, help="time step")
    parser.add_argument("--budget", type=float, default=600.0, help="seconds for training a net")
    arguments = parser.parse_args()
    folder = arguments.output
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    pack = gm.load_pack(arguments.pack)
    rate = f"t0-{arguments.t0:g}" + ("" if arguments.dt == parser.get_default("dt") else f"-dt-{arguments.dt:g}")
    table = folder / f"{pack.name}-{rate}.csv"
    rows = read_rows(table) if table.exists() else []
    for bits in map(int, arguments.bits.split(",")):
        every, number = gm.words(bits), chosen(bits, arguments.drawn)
        some = replace(every, amplitudes=every.amplitudes[number], centres=every.centres[number])
        experiment = gm.Experiment(pack, some, t0=arguments.t0, dt=arguments.dt, background="sub2-bl")
        file = folder / f"{pack.name}-{bits}-{len(number)}-{rate}.h5"
        if not file.exists():
            run(experiment, file)
        recall = gm.load_recall(file)
        if recall.configuration["experiment"] != gm.describe(experiment)["experiment"]:
            parser.error(f"{file}: is of another experiment; name another folder")
        net = net_of(bits, folder, arguments.budget)
        row = {"pack": pack.name, "t0": arguments.t0, **read(experiment, recall, bits, number, net)}
        print(row, flush=True)
        rows = sorted([row, *(other for other in rows if other["bits"] != bits)], key=lambda one: int(one["bits"]))
        write_csv(table, rows)
        draw(rows, table.with_suffix(".png"), pack.grains)


def chosen(bits: int, most: int) -> np.ndarray:
    """Numbers of the drawn words; of ten bits, with the word that the paper shows."""
    number = drawn(2**bits, most)
    shown = SHOWN_WORD - 1
    return np.sort([*number[:-1], shown]) if bits == SHOWN_OF and shown not in number else number


def run(experiment: gm.Experiment, file: Path) -> None:
    """Run an experiment, from its finished parts on, and save its recall."""
    parts = Checkpoints(file.with_suffix(".parts"), key_of_run(experiment))
    recall = gm.run(experiment, cache=parts, progress=say)
    gm.save_recall(file, recall)
    parts.discard()


def read(experiment: gm.Experiment, recall: gm.Recall, bits: int, number: np.ndarray, net: Net) -> Row:
    """G and F with every background, after a mean over the ringing period, and the accuracies with SUB2-BL."""
    scale, window = float(experiment.scale), float(recall.window) / float(experiment.t0)
    first, second = (analysis.recalled(jnp.asarray(recall.stages[name].pressure)) for name in recall.protocol.reads)
    row: Row = {"bits": bits, "words": len(number)}
    width = window * recall.J.shape[-1]
    integral = np.asarray(analysis.running_mean(recall.J, width))
    for name in analysis.BACKGROUNDS:
        signal = analysis.running_mean(analysis.subtract(name, first, second), width)
        match = analysis.compare(signal, jnp.asarray(integral), scale)
        errors = analysis.errors_over_signals(np.asarray(signal), integral, scale)
        for measure, value, error in zip("GF", match, errors, strict=True):
            row |= {f"{measure} {name}": round(float(value), 4), f"{measure} {name} error": round(error, 4)}
    templates = bin_average(gm.words(bits))
    row["net"] = float(accuracy(net, recall.p_sig, number))
    row["template"] = float(np.mean(nearest_template(recall.p_sig, templates) == number))
    return row


def read_rows(path: Path) -> list[Row]:
    """The rows of a table."""
    with path.open() as file:
        return [{**row, "bits": int(row["bits"])} for row in csv.DictReader(file)]


def over_packs(rows: list[Row]) -> list[Row]:
    """One row for each length, with means over packs; the same words were drawn for each pack."""
    groups: dict[str | int | float, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["bits"], []).append(row)
    found: list[Row] = []
    for members in groups.values():
        means = {name: float(np.mean([float(row[name]) for row in members])) for name in members[0] if name != "pack"}
        whole = {name: int(means[name]) for name in ("bits", "words")}
        found.append({"pack": " ".join(str(row["pack"]) for row in members), **means, **whole})
    return found


def draw(rows: list[Row], path: Path, grains: int) -> None:
    """Draw F with three backgrounds, and accuracies, against L beside the published; means over packs."""
    rows = over_packs(rows)
    lengths = np.array([int(row["bits"]) for row in rows])
    theirs = published("binary_words.csv")
    figure, (left, right) = pyplot().subplots(1, 2, figsize=(10, 4.2))
    for place, (name, symbol) in enumerate(zip(analysis.BACKGROUNDS, "osD", strict=True)):
        values, errors = ([float(row[f"F {name}{kind}"]) for row in rows] for kind in ("", " error"))
        at, label = lengths + 0.2 * (place - 1), f"{name.upper()}, "
        left.errorbar(at, values, errors, fmt=symbol, color=OURS, capsize=2, label=f"{label}gmem_jax")
        points = [(row["word_bits"], row[f"fidelity_{name.replace('-', '_')}"]) for row in theirs]
        left.plot(*zip(*points, strict=True), f"{symbol}:", color=THEIRS, mfc="white", ms=5, label=f"{label}published")
    for place, (reader, symbol) in enumerate((("net", "o"), ("template", "s"))):
        share = np.array([float(row[reader]) for row in rows])
        error = np.sqrt(share * (1.0 - share) / [int(row["words"]) for row in rows])
        at, label = lengths + 0.1 * (2 * place - 1), f"{reader}, gmem_jax"
        right.errorbar(at, share, error, fmt=symbol, color=OURS, capsize=2, label=label)
    points = [(row["word_bits"], row["classifier_accuracy"]) for row in theirs]
    right.plot(*zip(*points, strict=True), "o:", color=THEIRS, mfc="white", ms=5, label="net, published")
    for axis, words in ((left, "F"), (right, "words read right")):
        axis.set(xlabel="length of words L (bits)", ylabel=words, ylim=(0.0, 1.05))
        axis.legend(fontsize=8, frameon=False, loc="lower left")
    alike: dict[tuple[int, int], list[str]] = {}
    for row in rows:
        alike.setdefault((int(row["words"]), len(str(row["pack"]).split())), []).append(str(row["bits"]))
    counts = "; ".join(
        f"{words} of {', '.join(bits)} bits on {'one pack' if packs == 1 else f'{packs} packs'}"
        for (words, packs), bits in alike.items()
    )
    figure.suptitle(
        f"Drawn words ({counts}), N = {grains:,}, $t_0$ = {float(rows[0]['t0']):,.0f} $t_c$,\n"
        "mean ± SE over words; published: all words, N = 10,240",
        fontsize=10,
    )
    save_picture(path, figure)


if __name__ == "__main__":
    in_one_line(main)
