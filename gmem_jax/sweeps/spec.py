"""The format of sweep files: what a sweep varies, in TOML.

    [experiment]                    # what all points share: the options of `gmem recall`
    t0 = 1800
    [vary]                          # every combination of these
    pack = ["tetra-325-a", "tetra-325-b"]
    mu = {from = 0.0, to = 1.0, count = 6}
    [[zip]]                         # lists of one length that go together
    gamma0 = [1e-3, 2e-3]
    delta0 = [0.05, 0.05]
    [[points]]                      # further points, one by one
    mu = 2.0
    [[protocol.stage]]              # another protocol than the paper's: see `gmem_jax.files.protocols`; also a file
    kind = "write"                  # or a name, by protocol = "mine.toml" in [experiment]
    [prepare]                       # packs to be made, where no pack is named: the options of `gmem prepare`
    grains = 325
    [run]                           # how it is done: the options of `gmem sweep`
    executor = "processes"

A name is an option of `gmem recall`, one of `gmem prepare` as "prepare.seed", or a number of a stage as
"protocol.store.length".
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

from gmem_jax.errors import FileFormatError
from gmem_jax.files.protocols import toml_of
from gmem_jax.files.validation import is_number, whole

TABLES = ("experiment", "vary", "zip", "points", "protocol", "prepare", "run")
PREPARE = "prepare."
MOST_SWEEP_POINTS = 100_000  # points: more are a mistake


@dataclass(frozen=True)
class Spec:
    """A sweep as it was asked for.

    Attributes:
        shared: values that all points have, by name.
        axes: the axes of the sweep; each is one or more names with lists of values of one length.
        extra: points beyond the combinations of the axes.
        run: options of `gmem sweep`.
    """

    shared: dict[str, Any] = field(default_factory=dict)
    axes: tuple[dict[str, list[Any]], ...] = ()
    extra: tuple[dict[str, Any], ...] = ()
    run: dict[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """The names that vary, in order."""
        tables: list[Mapping[str, Any]] = [*self.axes, *self.extra]
        return list(dict.fromkeys(name for table in tables for name in table))

    def combinations(self) -> Iterator[dict[str, Any]]:
        """The values of every point that differ between points."""
        steps = [[dict(zip(axis, row, strict=True)) for row in zip(*axis.values(), strict=True)] for axis in self.axes]
        if self.axes or not self.extra:
            for chosen in itertools.product(*steps):
                yield {name: value for part in chosen for name, value in part.items()}
        yield from self.extra


def read_spec(path: Path) -> Spec:
    """The sweep in a TOML file.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it is not TOML, has an unknown table, an empty list, or lists of different length in a
            [[zip]].
    """
    path = Path(path)
    tables = toml_of(path)
    try:
        return spec_of(tables)
    except ValueError as error:
        raise FileFormatError(f"{path}: {error}") from error


def spec_of(tables: Mapping[str, Any]) -> Spec:
    """The sweep that tables describe.

    Raises:
        ValueError: saying what is wrong.
    """
    if unknown := sorted(set(tables) - set(TABLES)):
        raise ValueError(f"no table {unknown[0]!r} in a sweep; there are {', '.join(TABLES)}")
    vary, zipped, extra = tables.get("vary", {}), tables.get("zip", []), tables.get("points", [])
    shared, prepare, run = (tables.get(name, {}) for name in ("experiment", "prepare", "run"))
    for name, table in (("vary", vary), ("experiment", shared), ("prepare", prepare), ("run", run)):
        _require(isinstance(table, dict), f"[{name}] must be a table")
    for name, list_ in (("zip", zipped), ("points", extra)):
        _require(isinstance(list_, list) and all(isinstance(one, dict) for one in list_), f"[[{name}]] must be tables")
    axes = [{name: _values(name, value)} for name, value in vary.items()]
    axes += [{name: _values(name, value) for name, value in table.items()} for table in zipped]
    for axis in axes:
        lengths = {name: len(values) for name, values in axis.items()}
        _require(len(set(lengths.values())) == 1, f"[[zip]]: {lengths} differ in length")
    own = {PREPARE + name: value for name, value in prepare.items()}
    both = sorted(set(own) & set(shared))
    _require(not both, f"{both[:1]}: give it in [prepare] or in [experiment], not in both")
    if "protocol" in tables:
        _require("protocol" not in shared, "give the protocol in [protocol] or in [experiment], not in both")
        own["protocol"] = tables["protocol"]
    spec = Spec({**shared, **own}, tuple(axes), tuple(extra), run)
    grid = set().union(*axes) if axes else set.intersection(*map(set, extra)) if extra else set()
    if idle := sorted(set(spec.shared) & grid):
        raise ValueError(
            f"{idle[0]} varies, so that its value in [experiment] or [prepare] does nothing; leave one out"
        )
    twice = [name for name in spec.names if sum(name in axis for axis in axes) > 1]
    _require(not twice, f"{twice[:1]} varies twice")
    _require(bool(axes or extra), "nothing varies: give a table [vary], [[zip]] or [[points]]")
    count = math.prod(len(next(iter(axis.values()))) for axis in axes) + len(extra)
    _require(count <= MOST_SWEEP_POINTS, f"{count} points; {MOST_SWEEP_POINTS} at most")
    return spec


def _values(name: str, value: Any) -> list[Any]:
    """The values on an axis, from a list or from a table of from, to and count: evenly spaced, or by equal factors."""
    if isinstance(value, dict):
        known = {"from", "to", "count", "factors"}
        _require(
            {"from", "to", "count"} <= set(value) <= known,
            f"{name}: give a list, or from, to and count (and factors = true)",
        )
        numbers = [value["from"], value["to"]]
        _require(
            all(map(is_number, numbers)), f"{name}: from and to must be numbers, got {numbers[0]} and {numbers[1]}"
        )
        count = value["count"]
        _require(
            whole(count) and 2 <= count <= MOST_SWEEP_POINTS,
            f"{name}: count must be a whole number from 2 to {MOST_SWEEP_POINTS}, got {count}",
        )
        _require(isinstance(value.get("factors", False), bool), f"{name}: factors must be true or false")
        low, high, last = float(numbers[0]), float(numbers[1]), value["count"] - 1
        if value.get("factors", False):
            _require(low > 0.0 and high > 0.0, f"{name}: equal factors need positive numbers")
            return [low, *(float(f"{low * (high / low) ** (step / last):.14g}") for step in range(1, last)), high]
        exact = [Fraction(str(number)) for number in (low, high)]  # 0.6, not 0.6000000000000001
        return [float(exact[0] + (exact[1] - exact[0]) * Fraction(step, last)) for step in range(last + 1)]
    _require(isinstance(value, list), f"{name}: give a list of values, got {value!r}")
    _require(bool(value), f"{name}: the list is empty, so there are no points")
    return list(value)


def _require(true: bool, problem: str) -> None:
    if not true:
        raise ValueError(problem)
