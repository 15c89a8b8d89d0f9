"""Figures of 10,240 grains from packs that ran one by one, and every published point beside ours.

PYTHONPATH=experiments python docs/make/points.py

`docs/results/points.csv` has a row for each pack and condition, as `gmem sweep export` gave them: sweeps over delta0,
gamma0, mu and the seed of `prepare`, with t0 = 5,400 and dt = 1.2. Of a point that ran at several rates the one of most
packs counts, the slower of two alike: a mean over packs mixes no rates. Means over packs become the tables and pictures
of figs. 8, 9, 11 and 12a, by the names of their scale; and docs/results/points.md is written anew. Packs of 3,267
grains in the table are others than those of the figures. In points.md a point of three packs or more that were cycled
and ran at the paper's rate is that of these packs alone.
"""

import csv
import functools
import math
import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drawn_words import over_packs, read_rows
from scipy.special import stdtr

from gmem_jax.bench.table import into
from gmem_jax.experiment.experiment import PAPER_T0
from gmem_jax.physics.state import Status
from gmem_jax.reproduce import draw
from gmem_jax.reproduce.compare import Compared, Conditions, Estimate, compared, comparison_rows, read_csv, write_csv
from gmem_jax.reproduce.figures import CALIBRATED, FIGURES
from gmem_jax.show.numbers import published

HERE = Path(__file__).parents[1] / "results"
OWN = HERE / "points.csv"
USUAL = {"mu": 1.0, "delta0": 0.05, "gamma0": 1e-3, "overlap": 0.6, "law": "H"}
GRAINS = 10_240  # of figures
APART = 3267  # grains of packs that count beside those of the figures of this size
Measured = tuple[Conditions, str]


def _only(row: Compared, *free: str) -> bool:
    at = asdict(row.conditions)
    usual = all(at[name] == value for name, value in USUAL.items() if name not in free)
    return usual and row.conditions.grains == GRAINS and row.grains in (GRAINS, 0)  # 0: nothing was published


SHOWN = (0.01, 0.02, 0.05, 0.08)  # delta0 of the curves of fig. 11: with all eight, points would lie under one another
LARGE = 5e-3  # gamma0 from which on G is no longer that of small shear
SHEARED = 0.07  # gamma0 over delta0 from which on F falls as where the compression is thin
WHICH: dict[str, Callable[[Compared], bool]] = {
    "fig08-paper-t0=5400-packs=4": lambda row: _only(row, "mu"),
    "fig09-paper-t0=5400-packs=4-few=2": lambda row: _only(row, "law"),
    "fig11-paper-t0=5400-few=2": lambda row: (
        _only(row, "overlap")
        or (_only(row, "delta0", "gamma0") and row.conditions.delta0 in SHOWN and row.conditions.gamma0 < LARGE)
    ),
    "fig12a-paper-t0=5400-few=2": lambda row: _only(row, "delta0"),
}
"""Figures that are made of the packs' own rows, and which rows are theirs."""

SLOW = ("points.csv", "rates.csv", "pressure.csv", "standard_points.csv")  # tables with runs at the paper's rate
UNSAID: dict[str, Any] = {  # what a table without such a column has
    **USUAL,
    **{"shape": "tetra", "pressure": 2e-3, "cycles": 2, "piston_fixed_at_speed": 1e-5, "drag": 0.01},
}
ENOUGH = 3  # packs whose mean at the paper's rate is the point
WITHIN = 2.0  # combined errors that count as agreement
REASONS: tuple[tuple[Callable[[Mapping[str, Any]], bool], str], ...] = (
    (
        lambda at: at["delta0"] <= 0.02 or (at["gamma0"] < LARGE and at["gamma0"] / at["delta0"] > SHEARED),
        "[thin compression](differences.md#thin-compression)",
    ),
    (lambda at: at["mu"] < 0.7, "[small friction](differences.md#g-at-small-friction)"),
    (lambda at: at["gamma0"] > LARGE, "[large shear](differences.md#large-shear)"),
    (lambda at: at["n_grains"] > 20_000, "[large packs](differences.md#g-of-31680-and-100450-grains)"),
    (lambda at: at["shape"] == "sphere", "[spheres](differences.md#spheres)"),
    (lambda at: at["n_grains"] == APART, "[packs of 3,267](differences.md#g-of-3267-grains)"),
    (
        lambda at: at["n_grains"] == GRAINS and at["delta0"] >= 0.05 and at["overlap"] == USUAL["overlap"],
        "[the rate and F](differences.md#f-and-the-rate-of-the-drive)",
    ),
)


def rows_of(path: Path) -> Iterable[tuple[Conditions, dict[str, Any]]]:
    """What each row of a table of packs ran under, and the row."""
    with path.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            row = {**UNSAID, **line}
            overlap, mu, delta0, gamma0 = (float(row[name]) for name in ("overlap", "mu", "delta0", "gamma0"))
            grain = row["law"], row["shape"], overlap, int(row["grains"])
            yield Conditions(*grain, mu, delta0, gamma0, 0, "sub0"), row


def _status(rows: Iterable[Mapping[str, Any]]) -> int:
    """The status bits of all rows."""
    return functools.reduce(operator.or_, (int(row["status"]) for row in rows))


def of_packs(path: Path = OWN) -> list[Compared]:
    """Means over the packs of a table, where G and F are those over the ringing period."""
    groups: dict[Conditions, dict[float, list[dict[str, Any]]]] = {}
    for at, row in rows_of(path):
        groups.setdefault(at, {}).setdefault(float(row["t0"]), []).append(row)
    found = []
    for at, rates in groups.items():
        members = max(rates.items(), key=lambda rate: (len(rate[1]), rate[0]))[1]
        status = _status(members)
        for measure in "FG":
            found.append(compared(at, measure, [float(member[f"{measure}_over_T1"]) for member in members], status))
    return found


def figures() -> None:
    """Write the tables and pictures of `WHICH`; what they have of other conditions (as mu = 0) stays."""
    rows = of_packs()
    for name, belongs in WHICH.items():
        table, figure = HERE / "paper" / f"{name}.csv", FIGURES[name.partition("-")[0]]
        kept = {(row.conditions, row.measure): row for row in (read_csv(table) if table.is_file() else [])}
        kept |= {(row.conditions, row.measure): row for row in rows if belongs(row)}
        ordered = sorted(kept.values(), key=lambda row: [getattr(row.conditions, name) for name in figure.across])
        write_csv(table, comparison_rows(ordered))
        title = f"{figure.title}\n{draw.said_of(ordered, '5,400')}"
        draw.draw_comparison(table.with_suffix(".png"), ordered, figure.across, title)
        table.with_suffix(".svg").unlink(missing_ok=True)


def pooled(one: Estimate, other: Estimate) -> Estimate:
    """The mean and SD over the packs of both."""
    packs = one.packs + other.packs
    mean = (one.packs * one.mean + other.packs * other.mean) / packs
    squares = sum((part.packs - 1) * part.sd**2 if part.packs > 1 else 0.0 for part in (one, other))
    squares += one.packs * other.packs / packs * (one.mean - other.mean) ** 2
    return Estimate(mean, math.sqrt(squares / (packs - 1)), packs)


def ours() -> dict[Measured, Compared]:
    """Of every condition that ran anywhere the estimate of most packs, of as many grains as published.

    Of two alike the slower: laptop tables, whose folder is the first, ran at t0 = 1,800, others at 5,400 or slower.
    """
    best: dict[Measured, Compared] = {}
    packs = of_packs()
    tables = [row for path in sorted(HERE.glob("*/fig*.csv")) for row in read_csv(path)]
    for row in [*tables, *(row for row in packs if row.conditions.grains != APART)]:
        known = best.get((row.conditions, row.measure))
        if row.theirs and row.grains == row.conditions.grains and (not known or row.ours.packs >= known.ours.packs):
            best[row.conditions, row.measure] = row
    for row in packs:
        at = row.conditions, row.measure
        if row.conditions.grains == APART:
            best[at] = row._replace(ours=pooled(row.ours, best[at].ours)) if at in best else row
    return best


def wholly_slow() -> dict[Measured, Compared]:
    """Means over packs that were cycled and ran at the paper's rate, by the usual recipe: of `ENOUGH` packs or more."""
    recipe = ("pressure", "cycles", "piston_fixed_at_speed", "drag")
    groups: dict[Conditions, dict[str, dict[str, Any]]] = {}
    for name in ("rates.csv", "standard_points.csv"):
        for at, row in rows_of(HERE / name):
            usual = all(float(row[key]) == UNSAID[key] for key in recipe) and row["pack"] not in CALIBRATED
            slow = float(row["t0"]) == PAPER_T0 == float(row["prepare_t0"])
            if usual and slow and not int(row["status"]) & Status.OTHER_COMPRESSION:
                groups.setdefault(at, {})[row["pack"].removesuffix(" anew")] = row
    found: dict[Measured, Compared] = {}
    for at, packs in groups.items():
        for measure in "FG" if len(packs) >= ENOUGH else "":
            # At this rate the running mean changes F by 1e-4, and some tables have G without it alone.
            values = [float(row.get(f"{measure}_over_T1", row[measure])) for row in packs.values()]
            found[at, measure] = compared(at, measure, values, _status(packs.values()))
    return found


def by_chance(row: Compared) -> float:
    """The probability that a measure lies beyond `WITHIN` although nothing differs: Student's t, degrees by Welch."""
    parts = [one for one in (row.ours, row.theirs) if one is not None and one.packs > 1]
    squares = [one.error**2 for one in parts]
    degrees = sum(squares) ** 2 / sum(square**2 / (one.packs - 1) for one, square in zip(parts, squares, strict=True))
    return 2.0 * float(stdtr(degrees, -WITHIN))


def at_the_papers_rate() -> dict[Conditions, str]:
    """G; F of packs of `GRAINS` that ran at the paper's rate, in words, by what they ran under."""
    runs: dict[tuple[Conditions, float], set[tuple[str, float, float]]] = {}  # of a pressure before the compression
    for name in SLOW:
        for at, row in rows_of(HERE / name):
            own = not int(row["status"]) & Status.OTHER_COMPRESSION and row["pack"] not in CALIBRATED
            if at.grains == GRAINS and float(row["t0"]) == PAPER_T0 and own:
                run = row["pack"], float(row.get("G_over_T1", row["G"])), float(row["F_over_T1"])
                runs.setdefault((at, float(row["pressure"])), set()).add(run)
    found: dict[Conditions, str] = {}
    for (at, pressure), each in sorted(runs.items(), key=lambda entry: entry[0][1]):
        gain, fidelity = sum(run[1] for run in each) / len(each), sum(run[2] for run in each) / len(each)
        pressed = "" if pressure == UNSAID["pressure"] else f" at {1e3 * pressure:g}e-3 E"
        told = f"{gain:.3f}; {fidelity:.3f} ({len(each)}{pressed})"
        found[at] = ", ".join(filter(None, (found.get(at), told)))
    return found


def _said(one: Estimate) -> str:
    error = "" if math.isnan(one.error) else f" ± {one.error:.3f}"
    return f"{one.mean:.3f}{error} ({one.packs})"


def _beside(row: Compared | None) -> tuple[str, str, str]:
    if row is None or row.theirs is None:
        return "", "", ""
    apart = row.errors_apart
    return _said(row.ours), _said(row.theirs), "" if math.isnan(apart) else f"{apart:+.1f}"


def every_point() -> list[str]:
    """Every published point of six signals and of laws beside ours, as Markdown, and how many agree."""
    best, slow = {**ours(), **wholly_slow()}, at_the_papers_rate()
    names = ("law", "O", "mu", "N", "delta0", "gamma0")
    head = [*names, "G", "published", "apart", "F", "published", "apart"]
    head += ["G; F at the paper's rate", "beyond 2: see"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    apart: list[float] = []
    missing, chance = 0, 0.0
    for at in _published():
        grain, box = (at["shape"], at["overlap"], int(at["n_grains"])), (at["mu"], at["delta0"], at["gamma0"])
        conditions = Conditions(at["law"], *grain, *box, 0, "sub0")
        rows = [best.get((conditions, measure)) for measure in "GF"]
        missing += rows[1] is None
        found = [row for row in rows if row is not None and not math.isnan(row.errors_apart)]
        own = [row.errors_apart for row in found]
        apart += own
        chance += sum(map(by_chance, found))
        reasons = [words for holds, words in REASONS if holds(at)][:1] if any(abs(x) > WITHIN for x in own) else []
        shown = [at["law"], f"{at['overlap']:g}", f"{at['mu']:g}", f"{conditions.grains:,}"]
        shown += [f"{at['delta0']:g}", f"{at['gamma0']:g}", *_beside(rows[0]), *_beside(rows[1])]
        shown += [slow.get(conditions, ""), *(reasons or [""])]
        lines.append(f"| {' | '.join(shown)} |")
    within = sum(abs(one) <= WITHIN for one in apart)
    total = len(lines) - 2
    told = f"{total - missing} of {total} published points of six signals have one of ours of the same N. "
    told += f"Of {len(apart)} measures {within} lie within two combined errors, and {len(apart) - within} beyond. "
    return [f"{told}Chance alone would put {chance:.0f} beyond, so few are the packs (Student's t).", "", *lines]


def _published() -> Iterable[dict[str, Any]]:
    for row in published("six_signals.csv"):
        yield {"law": "H", **row}
    for row in published("models.csv"):
        if row["law"] != "H":
            law = "M2, paper" if row["law"] == "M2" else row["law"]
            yield {**USUAL, "shape": "tetra", **row, "law": law}


def _words_of(row: Mapping[str, Any]) -> str:
    packs = len(row["pack"].split())
    told = "all" if int(row["words"]) == 2 ** int(row["bits"]) else f"{row['words']} drawn"
    return told + (f", {packs} packs" if packs > 1 else "")


def words() -> list[str]:
    """Published words beside ours, as Markdown: F by three backgrounds, and what the net reads."""
    drawn = {int(row["bits"]): row for row in over_packs(read_rows(HERE / "drawn_words.csv"))}
    known = [row for (at, measure), row in ours().items() if at.bits and measure == "F"]
    whole = {(row.conditions.bits, row.conditions.background): f"{row.ours.mean:.3f}" for row in known}
    kinds = ("sub0", "sub2", "sub2-bl")
    head = ["L", "words", *(f"F, {kind.upper()}; published" for kind in kinds), "net; published"]
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for theirs in published("binary_words.csv"):
        bits = int(theirs["word_bits"])
        row = drawn.get(bits)
        shown = [str(bits), _words_of(row) if row else "all"]
        for kind in kinds:
            if row:
                told = f"{float(row[f'F {kind}']):.3f} ± {float(row[f'F {kind} error']):.3f}"
            else:
                told = whole.get((bits, kind), "")
            shown.append(f"{told}; {theirs['fidelity_' + kind.replace('-', '_')]:g}")
        net = float(row["net"]) if row else 1.0
        shown.append(f"{net:.3f}; {theirs['classifier_accuracy']:g}")
        lines.append(f"| {' | '.join(shown)} |")
    return lines


if __name__ == "__main__":
    figures()
    page = HERE / "points.md"
    made = ["", *every_point(), "", *words(), "", ""]
    page.write_text(into(page.read_text(), "\n".join(made), "docs/make/points.py"))
