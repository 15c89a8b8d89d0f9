"""The tables of docs/results/figures.md, and of docs/remember_more.md, of words.

PYTHONPATH=experiments python docs/make/results_page.py [--redraw]

What is published beside each point is looked up anew. With --redraw pictures are drawn anew too, those that show no
more than their table holds and those that need no run; those of recalls (figs. 3, 4, 6 and 13) and of choices stay as
they are.
"""

import argparse
import csv
import json
from pathlib import Path

import design_words
import drawn_words
import jax
import points
from packs import over_packs

from gmem_jax.bench.table import into
from gmem_jax.reproduce import choices as weighed
from gmem_jax.reproduce import draw
from gmem_jax.reproduce.compare import comparison_rows, read_csv, write_csv
from gmem_jax.reproduce.figures import FIGURES, SCALES, scale_of
from gmem_jax.reproduce.run import SCHEMATICS
from gmem_jax.show.numbers import published

HERE = Path(__file__).parents[1] / "results"
JOINED = {  # figures that no one command makes
    "fig12b-paper": "Fig. 6 of this scale, figs. 8 and 12b of smaller ones, "
    "`--scale workstation,sizes=31680,few=1` and `experiments/large_pack.py`, put together by `experiments/joined.py`. "
    "The point of 31,680 grains is one pack at t0 = 5,400; three packs at 18,000 have G = 0.374 ± 0.004 "
    "([every point](points.md))",
    **dict.fromkeys(
        points.WHICH, "Sweeps of single packs ([table](points.csv), [how](runs.md#points-of-10240-grains))"
    ),
}
TITLES = {"fig03": "packs at rest, by size and by shape", "choices": "what the paper leaves open, each tried otherwise"}
RATES = {"fig12b-paper": "1,800 to 18,000"}  # of figures whose points are of several


def table(path: Path) -> list[str]:
    """A figure's CSV as Markdown: what varies, ours, the published."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0])
    conditions = names[: names.index("measure")]
    varied = [name for name in conditions if len({row[name] for row in rows}) > 1]
    head = [*varied, "measure", "ours ± SD (packs)", "published ± SD (packs), N", "combined errors apart"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for row in rows:
        ours = f"{_with(row['mean'], row['sd'])} ({row['packs']})"
        theirs = ""
        if row["published_mean"]:
            theirs = f"{_with(row['published_mean'], row['published_sd'])} ({row['published_packs']}), "
            theirs += f"{int(row['published_grains']):,}"
        apart = f"{float(row['combined_errors_apart']):+.1f}" if row["combined_errors_apart"] else ""
        lines.append(f"| {' | '.join([*(row[name] for name in varied), row['measure'], ours, theirs, apart])} |")
    return lines


def choices(path: Path) -> list[str]:
    """The table of what the paper leaves open as Markdown; defaults in bold."""
    lines = ["| choice | value | G | F | change of G | change of F | packs |", "|---|---|---|---|---|---|---|"]
    with path.open() as file:
        for row in csv.DictReader(file):
            own = [_with(row[name], row[f"{name}_sd"]) for name in ("G", "F")]
            of_gain = f"{100.0 * float(row['dG_over_G']):+.1f} %"
            if row["dG_over_G_sd"]:
                of_gain += f" ± {100.0 * float(row['dG_over_G_sd']):.1f}"
            of_fidelity = f"{float(row['dF']):+.3f}" + (f" ± {float(row['dF_sd']):.3f}" if row["dF_sd"] else "")
            default = row["default"] == "1"
            value = f"**{row['value']}**" if default else row["value"]
            change = ["", ""] if default else [of_gain, of_fidelity]
            lines.append(f"| {' | '.join([row['meaning'], value, *own, *change, row['packs']])} |")
    return lines


def designed_words(path: Path) -> list[str]:
    """What `design_words.py` wrote as Markdown, mean and SD over packs of a size."""
    columns = ("net untouched", "net designed", "template designed", "F untouched", "F designed")
    head = ["N", "L", "packs x words", "read by the net as they come", "designed", "nearest template, designed"]
    head += ["F as they come", "designed", "published: net, F"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    theirs = {
        row["word_bits"]: f"{row['classifier_accuracy']:g}, {row['fidelity_sub0']}"
        for row in published("binary_words.csv")
    }
    theirs[9] = "0.91"  # in the paper's text
    with path.open() as file:
        rows = list(csv.DictReader(file))
    for grains, bits in sorted({(_grains(row), int(row["bits"])) for row in rows}):
        own = [row for row in rows if (_grains(row), int(row["bits"])) == (grains, bits)]
        counts = [f"{grains:,}", str(bits), f"{len(own)} x {own[0]['words']}"]
        shown = []
        for column in columns:
            _, (mean,), (deviation,) = over_packs(own, "bits", column)
            shown.append(f"{mean:.2f}" + (f" ± {deviation:.2f}" if len(own) > 1 else ""))
        lines.append(f"| {' | '.join([*counts, *shown, theirs.get(bits, '')])} |")
    return lines


def _grains(row: dict[str, str]) -> int:
    return int(row["pack"].split("-")[1])


def _with(mean: str, deviation: str) -> str:
    return f"{float(mean):.3f}" + (f" ± {float(deviation):.3f}" if deviation else "")


def put(lines: list[str], page: Path) -> None:
    """Write lines between the marks of a page."""
    page.write_text(into(page.read_text(), "\n".join(["", *lines]), "docs/make/results_page.py"))


def heading(name: str, scale: str) -> list[str]:
    """Over a figure: which, at which scale, and by what command."""
    what = f"Fig. {name.removeprefix('fig').lstrip('0')}" if name.startswith("fig") else name.capitalize()
    named, *changes = scale.split("-")
    command = f"`gmem reproduce {name}" + (f" --scale {','.join([named, *changes])}`" if named else "`")
    command = JOINED.get(f"{name}-{scale}", command)
    at = ""
    if named:
        size = scale_of(",".join([named, *changes]), weighed.SIZES if name == "choices" else SCALES)
        grains = f"{size.sizes[0]:,} to {size.sizes[-1]:,}" if name in ("fig12b", "bulk") else f"{size.grains:,}"
        at = f": {grains} grains, t0 of {RATES.get(f'{name}-{scale}', f'{size.t0:,.0f}')}"
    return [f"## {what}{at}", "", command, ""]


def verdicts(path: Path) -> list[str]:
    """What was found of the claims as Markdown."""
    found, answers = json.loads(path.read_text()), {True: "yes", False: "no", None: "cannot be told"}
    lines = [f"One pack, {found[0]['pack']}.", "", "| claim | holds | numbers |", "|---|---|---|"]
    for verdict in found:
        why = f"; {verdict['why']}" if verdict["why"] else ""
        lines.append(f"| {verdict['claim']} | {answers[verdict['holds']]}{why} | {verdict['numbers']} |")
    return lines


def figure(picture: Path) -> list[str]:
    """A picture, what it shows, and its numbers, if it has any."""
    numbers = picture.with_suffix(".csv")
    name = picture.stem.partition("-")[0]
    shows = (FIGURES | SCHEMATICS)[name].title if name in FIGURES | SCHEMATICS else TITLES[name]
    lines = [f"![{shows}]({picture.relative_to(HERE)})", "", f"{shows[0].upper()}{shows[1:]}.", ""]
    if not numbers.is_file():
        return lines
    return [*lines, *(choices if picture.stem.startswith("choices") else table)(numbers), ""]


def anew(path: Path) -> None:
    """Write a figure's table with what is published now, and draw it."""
    name, _, scale = path.stem.partition("-")
    size = scale_of(scale.replace("-", ","), SCALES)
    picture = path.with_suffix(".png")
    if across := FIGURES[name].across:
        rows = read_csv(path)
        rate = RATES.get(path.stem, f"{size.t0:,.0f}")
        draw.draw_comparison(picture, rows, across, f"{FIGURES[name].title}\n{draw.said_of(rows, rate)}")
    picture.with_suffix(".svg").unlink(missing_ok=True)


def redraw() -> None:
    """Every picture that needs no run."""
    jax.config.update("jax_enable_x64", True)
    for name, picture in SCHEMATICS.items():
        picture.draw(target := HERE / "laptop" / f"{name}.png")
        for suffix in (".svg", ".csv"):
            target.with_suffix(suffix).unlink(missing_ok=True)
    for path in sorted(HERE.glob("*/*-*.csv")):
        if path.stem.startswith("fig"):
            anew(path)
    drawn_words.draw(drawn_words.read_rows(HERE / "drawn_words.csv"), HERE / "drawn_words.png", 10_240)
    design_words.draw(HERE / "designed_words.csv", HERE / "designed_words.png")


def main() -> None:
    """Put all of them between the marks of their pages: figure by figure, the largest scale first."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--redraw", action="store_true", help="draw pictures anew")
    arguments = parser.parse_args()
    points.figures()
    for path in HERE.glob("*/fig*.csv"):
        write_csv(path, comparison_rows(read_csv(path)))
    if arguments.redraw:
        redraw()
    shown = []
    for place, folder in enumerate(("paper", "workstation", "laptop")):
        for path in (HERE / folder).iterdir():
            name, _, scale = path.stem.partition("-")
            if path.suffix == ".png" or name == "claims":
                shown.append(((not name.startswith("fig"), name, place, scale), path))
    lines = []
    for (_, name, _, scale), path in sorted(shown):
        lines += [*heading(name, scale), *([*verdicts(path), ""] if name == "claims" else figure(path))]
    put(lines, HERE / "figures.md")
    put([*designed_words(HERE / "designed_words.csv"), "", ""], HERE.parent / "remember_more.md")


if __name__ == "__main__":
    main()
