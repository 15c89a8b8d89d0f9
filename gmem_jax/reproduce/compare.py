"""Our points beside the published ones, each with its spread, and the difference in units of the combined error."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

from gmem_jax.experiment.analysis import spread
from gmem_jax.experiment.experiment import PAPER_T0
from gmem_jax.experiment.record import values_of
from gmem_jax.files.atomic import atomic
from gmem_jax.physics.contact.laws import LAWS
from gmem_jax.physics.state import combined_status
from gmem_jax.show.numbers import published, summary
from gmem_jax.sweeps.store import Store

PAPER_GRAINS = 10_240


@dataclass(frozen=True)
class Conditions:
    """The conditions of a point, without its pack.

    Attributes:
        law: "H", "M1" or "M2", and its variant if that is not the default.
        shape: "tetra" or "sphere"; with sizes of the grains, if they differ.
        overlap: O of a tetra grain; 1 for spheres.
        grains: N.
        mu: friction coefficient.
        delta0: compression.
        gamma0: shear amplitude.
        bits: length of words; 0 for the six signals.
        background: background of the measure.
        boundary: boundary of the box: "walls", as in the paper, or see `gm.Recipe`.
    """

    law: str
    shape: str
    overlap: float
    grains: int
    mu: float
    delta0: float
    gamma0: float
    bits: int
    background: str
    boundary: str = "walls"


class ComputedPoint(NamedTuple):
    """One pack at some conditions: `show.numbers.summary` of its recall, and the key of the point in the store."""

    conditions: Conditions
    numbers: dict[str, Any]
    key: str


class Estimate(NamedTuple):
    """A mean over packs; SD and SE are NaN for one pack."""

    mean: float
    sd: float
    packs: int

    @classmethod
    def of(cls, values: Sequence[float]) -> "Estimate":
        """The estimate from one value for each pack."""
        mean, deviation, _ = spread(values)
        return cls(mean, deviation, len(values))

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return self.sd / math.sqrt(self.packs)


class Compared(NamedTuple):
    """A measure at some conditions.

    Attributes:
        conditions: our conditions.
        measure: "F", "G" or "accuracy" and a reader of words.
        ours: the estimate over our packs.
        theirs: the published estimate at the same conditions, or, if there is none of the same N, that at the paper's
            usual N; None if there is none.
        grains: N of the published point.
        status: all status bits of our recalls.
    """

    conditions: Conditions
    measure: str
    ours: Estimate
    theirs: Estimate | None
    grains: int
    status: int

    @property
    def errors_apart(self) -> float:
        """(ours - theirs) over the combined standard error, if N is the same; else NaN.

        If ours is one pack, its error is taken to be the published SD over packs.
        """
        if self.theirs is None or self.grains != self.conditions.grains:
            return math.nan
        own = self.ours.error if self.ours.packs > 1 else self.theirs.sd
        combined = math.hypot(own, self.theirs.error)
        return (self.ours.mean - self.theirs.mean) / combined if combined > 0.0 else math.nan


def conditions_of(configuration: dict[str, Any]) -> Conditions:
    """The conditions of a recall, from its configuration."""
    law, known = configuration["experiment"]["friction"], values_of(configuration)
    entry = next(entry for entry in LAWS if entry.name == known["friction"])
    variant = law.get("variant", "averaged")
    shape, _, overlap = configuration["grain"]["shape"].partition("(")
    shape += "".join(f", {words}" for words in (configuration["grain"].get("sizes"),) if words)
    signals = configuration["experiment"]["signals"]
    return Conditions(
        law=entry.paper + ("" if variant == "averaged" else f", {variant}"),
        shape=shape,
        overlap=float(overlap.rstrip(")")) if overlap else 1.0,
        grains=configuration["grains"],
        mu=float(known["mu"]),
        delta0=round(float(known["delta0"]), 12),
        gamma0=float(known["gamma0"]),
        bits=signals.get("bits", 0) if signals["kind"] == "words" else 0,
        background=known["background"],
        boundary=configuration["pack_record"].get("recipe", {}).get("boundary", "walls"),
    )


def points_of(store: Store) -> list[ComputedPoint]:
    """All finished points of the latest sweep of a store; points with one key count once."""
    found = []
    done = store.done()
    for key in dict.fromkeys(row["key"] for row in store.card()["points"]):
        if key in done:
            recall = store.load(key)
            found.append(ComputedPoint(conditions_of(recall.configuration), summary(recall), key))
    return found


def counted(t0: float) -> tuple[str, str]:
    """The names of the gain and fidelity that count at t0; below the paper's, those after a mean over the ringing."""
    return ("windowed_gain", "windowed_fidelity") if t0 < PAPER_T0 else ("gain", "fidelity")


def _measures(point: ComputedPoint, t0: float) -> dict[Conditions, tuple[float, float]]:
    """G and F of a point by conditions, for every background that it has."""
    at = asdict(point.conditions)
    rows = point.numbers.get("backgrounds", {point.conditions.background: point.numbers})
    gain, fidelity = counted(t0)
    return {Conditions(**{**at, "background": name}): (row[gain], row[fidelity]) for name, row in rows.items()}


def compare_points(points: Iterable[ComputedPoint], t0: float) -> list[Compared]:
    """Means over packs beside the published points, in the order in which the conditions occur.

    Args:
        points: points on any number of packs.
        t0: duration of a compression in these runs, in t_c; below the paper's, F and G are those after a running mean
            over the ringing period.
    """
    groups: dict[Conditions, list[tuple[float, float, int]]] = {}
    for point in points:
        for conditions, (gain, fidelity) in _measures(point, t0).items():
            groups.setdefault(conditions, []).append((gain, fidelity, point.numbers["status"]))
    found = []
    for conditions, members in groups.items():
        status = combined_status([bits for *_, bits in members])
        found += [compared(conditions, "F", [fidelity for _, fidelity, _ in members], status)]
        found += [compared(conditions, "G", [gain for gain, *_ in members], status)]
    return found


def compared(conditions: Conditions, measure: str, values: Sequence[float], status: int) -> Compared:
    """The mean of a measure over packs, beside the published one."""
    return _beside(conditions, measure, Estimate.of(values), status)


def _beside(conditions: Conditions, measure: str, ours: Estimate, status: int) -> Compared:
    theirs, grains = _published(conditions, measure)
    return Compared(conditions, measure, ours, theirs, grains, status)


def _published(at: Conditions, measure: str) -> tuple[Estimate | None, int]:
    """The published estimate of a measure, and its N: of the same N if there is one, else of the paper's usual N."""
    if at.boundary != "walls":
        return None, 0
    if at.bits:
        column = f"fidelity_{at.background.replace('-', '_')}" if measure == "F" else "classifier_accuracy"
        if measure not in ("F", "accuracy net") or at.law != "H":
            return None, 0
        rows = [
            {"n_grains": PAPER_GRAINS, "mean": row[column]} for row in published("binary_words.csv", word_bits=at.bits)
        ]
        return _closest(rows, at.grains, "mean", "", 1)
    same: dict[str, str | float] = {"shape": at.shape, "overlap": at.overlap, "delta0": at.delta0, "gamma0": at.gamma0}
    if at.law == "H":
        name = {"F": "fidelity", "G": "gain"}[measure]
        return _closest(published("six_signals.csv", mu=at.mu, **same), at.grains, f"{name}_mean", f"{name}_sd")
    if measure == "G" or same != {"shape": "tetra", "overlap": 0.6, "delta0": 0.05, "gamma0": 1e-3} or at.mu != 1.0:
        return None, 0
    return _closest(published("models.csv", law=at.law.partition(",")[0]), at.grains, "fidelity", "", 1)


def _closest(
    rows: Sequence[dict[str, Any]], grains: int, mean: str, sd: str, packs: int = 0
) -> tuple[Estimate | None, int]:
    if not rows:
        return None, 0
    row = min(rows, key=lambda row: (row["n_grains"] != grains, row["n_grains"] != PAPER_GRAINS))
    return Estimate(row[mean], row[sd] if sd else math.nan, packs or int(row["n_packs"])), int(row["n_grains"])


def comparison_rows(rows: Sequence[Compared]) -> list[dict[str, Any]]:
    """A row for each measure: conditions, our estimate, the published one, and the difference."""
    lines = []
    for row in rows:
        theirs = row.theirs or Estimate(math.nan, math.nan, 0)
        lines.append(
            asdict(row.conditions)
            | {"measure": row.measure, "mean": row.ours.mean, "sd": row.ours.sd, "packs": row.ours.packs}
            | {"published_grains": row.grains, "published_mean": theirs.mean, "published_sd": theirs.sd}
            | {"published_packs": theirs.packs, "combined_errors_apart": row.errors_apart, "status": row.status}
        )
    return [{name: _cell(value) for name, value in line.items()} for line in lines]


def write_csv(path: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Write a table whose lines have the same names.

    Raises:
        OSError: if it cannot be written.
    """
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)


def read_csv(path: Path) -> list[Compared]:
    """Our estimates from a table of `comparison_rows`, beside the published points that are known now.

    Raises:
        OSError: if it cannot be read.
        KeyError: if it is not such a table.
    """
    kinds, found = get_type_hints(Conditions), []
    with path.open(newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            # Older tables have no column "boundary": all their boxes have walls.
            conditions = Conditions(**{name: kind(line[name]) for name, kind in kinds.items() if name in line})
            ours = Estimate(float(line["mean"]), float(line["sd"] or math.nan), int(line["packs"]))
            found.append(_beside(conditions, line["measure"], ours, int(line["status"])))
    return found


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.6g}"
    return value
