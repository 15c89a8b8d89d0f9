"""The parameters of a preparation, the lattice on which its grains begin, and what it will cost."""

import math
import operator
from collections.abc import Mapping
from dataclasses import Field, dataclass, fields, replace
from typing import Any

import numpy as np

from gmem_jax.experiment.stages import cycle
from gmem_jax.files.validation import is_number
from gmem_jax.physics.boundary import boundary_of, periodic_axes, require_room
from gmem_jax.physics.grain import Clump, sized
from gmem_jax.physics.numbers import is_real, said
from gmem_jax.physics.pytree import parameter, static
from gmem_jax.preparation.grading import LARGEST_SPREAD, lognormal, mixture
from gmem_jax.simulation.stage import BINS, Stage
from gmem_jax.simulation.strain import COMPRESSIONS

SETTLING = 500.0  # t_c that a dense pack takes to come to rest, per R of height (170 to 880, N = 325 to 10,240)
FREE_SKIN = 1.0  # neighbour-list skin while grains fly, in R: fewer rebuilds for more candidates
FEWEST_GRAINS = 12  # grains of the smallest pack that was prepared
DENSE = 0.72  # filling of a large pressed pack, which decides the lattice; it gives those of the paper's six packs
LATTICE_SPACING = 1.02  # least spacing of the lattice, in outer diameters of the grain, so that grains turn freely
# t_c. Outside its cycles a preparation has the bins and steps of this t0, or of its own t0 if that is longer. Its cost
# would grow as t0 falls otherwise: a bin is t0 / 256, and a step no longer than a bin.
SLOWEST_BINS = 1.8e3
STEP_OVERHEAD = 200.0  # cost of a step apart from its grains, in grain-steps: calls and lists (N = 16 to 250, native)
BIN_OVERHEAD = 4000.0  # cost of a bin apart from its steps, in grain-steps


@dataclass(frozen=True)
class Recipe:
    """The parameters of a preparation, including all that the paper leaves open (docs/physics.md, "Preparation").

    `gmem prepare --help` shows meaning, interval and unit of each field, which are in its metadata.

    Attributes:
        grains: number of grains N.
        seed: random seed of orientations, velocities and spins.
        delta0: areal compression of the cycles.
        t0: duration of one compression, in t_c.
        dt: largest time step, in t_c.
        filling: packing fraction of the lattice that the gas starts from; less for grains so long that they could not
            turn freely.
        gas_speed: rms of each grain's initial velocity, and of its spin times R, in R / t_c.
        gas_time: duration of the gas, in t_c.
        pressure: p_z, in E, at which the piston (the +z wall) is fixed; the cycles change it. Law H has one stiffness
            for all overlaps: at another pressure give it k_H = k_M <sqrt(p)> over the contacts (docs/physics.md).
        piston_speed: largest speed of the piston, in R / t_c.
        piston_gain: speed of the piston per relative error of the pressure, in R / t_c.
        cycles: number of compress/decompress cycles.
        rest: length of the rests at u = 0, in t0.
        hold: length of the holds at u = 1, in t0.
        drag: viscous drag while the piston settles at its pressure, and whenever the walls stand still, in 1 / t_c. A
            larger drag takes longer to bring the pack to rest: it overdamps soft frictionless modes.
        settled_speed: largest grain speed at which the piston is fixed, in R / t_c.
        quiet: largest grain speed of the finished pack, in R / t_c.
        pressure_error: relative error of p_z at which the piston is fixed.
        patience: longest time spent on coming to rest, in t_c; the default is four times what 100,450 grains should
            need.
        size_spread: standard deviation of the sizes of grains over their mean, which is 1; see `gm.lognormal`.
        sizes: sizes of the grains of a mixture, as in "1,1.4" or (1.0, 1.4), instead of a spread; see `gm.mixture`.
        shares: fraction of the grains that has each of these sizes, as in "0.5,0.5"; default equal fractions.
        gravity: acceleration of gravity along -z in all of the preparation, in R / t_c^2. An experiment has its own.
        boundary: "walls", "periodic", or one for each axis, as in "periodic,periodic,walls". A periodic box is
            compressed like one between walls, and its grains are displaced with it.
    """

    grains: int = parameter(325, "[12, inf)", "Number of grains N")
    seed: int = parameter(1, "[0, 9007199254740991]", "Random seed, a number that JSON holds exactly")
    delta0: float = parameter(0.05, COMPRESSIONS, "Areal compression of the cycles and of the experiment")
    t0: float = parameter(1.8e3, "(0, inf)", "Duration of one compression", "t_c")
    dt: float = parameter(0.3, "(0, 0.5]", "Largest time step", "t_c")
    filling: float = parameter(
        0.30, "(0, 0.6)", "Packing fraction of the lattice that the gas starts from; less for long grains"
    )
    gas_speed: float = parameter(0.02, "(0, inf)", "Rms velocity of grains in the gas, and rms spin times R", "R/t_c")
    gas_time: float = parameter(6.0e3, "(0, inf)", "Duration of the gas", "t_c")
    pressure: float = parameter(
        2.0e-3, "(0, inf)", "p_z before the cycles (at another one choose k_H of law H anew: docs/howto/grain.md)", "E"
    )
    piston_speed: float = parameter(0.02, "(0, inf)", "Largest speed of the upper wall", "R/t_c")
    piston_gain: float = parameter(0.005, "(0, inf)", "Speed of the upper wall per relative error of p_z", "R/t_c")
    cycles: int = parameter(2, "[0, 1000]", "Number of compress/decompress cycles")
    rest: float = parameter(0.2, "[0, inf)", "Length of each rest at u = 0", "t0")
    hold: float = parameter(0.2, "[0, inf)", "Length of each hold at u = 1", "t0")
    drag: float = parameter(
        0.01, "[0, inf)", "Viscous drag while the piston settles, and while walls stand still", "1/t_c"
    )
    settled_speed: float = parameter(1.0e-5, "(0, inf)", "Largest grain speed at which the piston is fixed", "R/t_c")
    quiet: float = parameter(1.0e-6, "(0, inf)", "Largest grain speed of the finished pack", "R/t_c")
    pressure_error: float = parameter(0.01, "(0, inf)", "Relative error of p_z at which the piston is fixed")
    patience: float = parameter(2.0e5, "(0, inf)", "Longest time spent on coming to rest", "t_c")
    gravity: float = parameter(0.0, "[0, 0.01]", "Acceleration of gravity along -z", "R/t_c^2")
    size_spread: float = parameter(
        0.0, f"[0, {LARGEST_SPREAD:g}]", "SD of the sizes of grains over their mean, lognormal, cut at 3 SD"
    )
    sizes: str = static("", "Sizes of the grains of a mixture, like 1,1.4")
    shares: str = static("", "Fraction of the grains that has each of --sizes, like 0.5,0.5; default equal")
    boundary: str = static(
        "walls", "Boundary of the box: walls, periodic, or one for each axis, as periodic,periodic,walls"
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "boundary", boundary_of(periodic_axes(self.boundary)))
        for name in ("sizes", "shares"):
            object.__setattr__(self, name, ",".join(f"{value:.12g}" for value in _listed(name, getattr(self, name))))
        for entry in fields(self):
            if "interval" not in entry.metadata:
                continue
            given, within, unit = getattr(self, entry.name), entry.metadata["interval"], entry.metadata["unit"]
            try:
                value = _plain(entry.type, given)
            except TypeError:
                kind = "a whole number" if entry.type is int else "a number"
                raise ValueError(f"{entry.name} must be {kind} in {within.words}, got {given!r}") from None
            if entry.name == "grains" and value < FEWEST_GRAINS:
                raise ValueError(f"grains must be at least {FEWEST_GRAINS} to jam, got {given}")
            if not within.holds(value):
                raise ValueError(f"{entry.name} must be in {within.words}{unit and ' ' + unit}, got {given}")
            object.__setattr__(self, entry.name, value)
        if self.gravity and periodic_axes(self.boundary)[2]:
            raise ValueError("gravity acts along z, and a box that is periodic there has no floor: leave gravity out")
        if self.sizes and self.size_spread:
            raise ValueError("sizes and size_spread exclude each other: grains are a mixture, or are spread")
        if self.shares and not self.sizes:
            raise ValueError("shares are the fractions of grains of each size: give sizes, too")
        self.drawn_sizes()

    def drawn_sizes(self) -> np.ndarray | None:
        """Sizes of the grains, [N]; None if all have size 1.

        Raises:
            ValueError: if the recipe asks for impossible sizes.
        """
        if self.sizes:
            shares = _listed("shares", self.shares)
            return mixture(self.grains, _listed("sizes", self.sizes), shares or None, seed=self.seed)
        return lognormal(self.grains, self.size_spread, seed=self.seed) if self.size_spread else None


def _listed(name: str, given: Any) -> list[float]:
    """Numbers of a text like "1,1.4", or of a sequence."""
    words = given.split(",") if isinstance(given, str) and given.strip() else given
    try:
        return [float(word) for word in (() if words is None else words)]
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers with commas between them, like 1,1.4; got {said(given)}") from None


def graded(recipe: Recipe, clump: Clump) -> Clump:
    """The grain with the sizes of the recipe, or with its own.

    Raises:
        ValueError: if both have sizes, the grain has not one size for each grain of the pack, or spheres of these sizes
            cannot be listed together.
    """
    drawn = recipe.drawn_sizes()
    if clump.sizes is not None and (drawn is not None or len(clump.sizes) != recipe.grains):
        raise ValueError(
            f"the grain has {len(clump.sizes)} sizes of its own: then there must be as many grains, and the recipe "
            f"names no sizes; it has {recipe.grains} grains"
        )
    return clump if drawn is None else sized(clump, drawn)


def _plain(kind: Any, given: Any) -> float | int:
    """The number `given` as an int if `kind` is int, else as a float."""
    if not is_real(given) or np.ndim(given):
        raise TypeError
    return operator.index(given) if kind is int else float(given)


def words_of(entry: Field[Any]) -> str:
    """The meaning, unit and interval of a field of a recipe, in words."""
    if "interval" not in entry.metadata:
        return f"{entry.metadata['words']}."
    unit = entry.metadata["unit"]
    return f"{entry.metadata['words']}{unit and ', ' + unit}; in {entry.metadata['interval'].words}."


def pressure_over_wanted(record: Mapping[str, Any]) -> float | None:
    """p_z of a finished pack over the pressure of its recipe, from its `Pack.info`; None if one is not there."""
    wanted, rest = record.get("recipe", {}).get("pressure"), record.get("at_rest")
    return float(rest["pressure"][2]) / wanted if rest and is_number(wanted) and wanted > 0.0 else None


def stepping(t0: float, dt: float) -> tuple[int, float]:
    """Steps in a bin of t0 / 256, and their length in t_c: `dt` or a little less."""
    steps = max(1, math.ceil(t0 / (BINS * dt) * (1.0 - 1e-12)))
    return steps, t0 / (BINS * steps)


def lattice(grains: int, filling: float = 0.30) -> tuple[int, int, int]:
    """Sites (n, n, n_z) of a lattice of this filling whose pressed pack is about a cube (325 = 5 x 5 x 13)."""
    side = max(2, round((grains * filling / DENSE) ** (1.0 / 3.0)))
    return side, side, math.ceil(grains / side**2)


def sites_of(recipe: Recipe, clump: Clump) -> tuple[tuple[int, int, int], np.ndarray]:
    """Sites of the lattice along each axis, and their spacing [3] in R: a pressed pack is about a cube.

    If grains turn freely on the cubic lattice of the recipe's filling, they begin there. Longer grains begin in
    columns, as far apart as they are long, in a box as wide as the pressed pack will be high.

    Raises:
        ValueError: if the pressed pack would be flatter than its grains, or too small for a periodic one.
    """
    count, diameter = recipe.grains, float(clump.diameter * clump.largest)
    mass = float(clump.mass) if clump.sizes is None else float(clump.volume(count)) / count
    least = LATTICE_SPACING * diameter
    spacing = (mass / recipe.filling) ** (1.0 / 3.0)
    cube = (count * mass / DENSE) ** (1.0 / 3.0)
    if spacing >= least:
        sites, apart = lattice(count, recipe.filling), np.full(3, spacing)
    else:
        side = max(1, int(cube / least))
        sites, apart = (side, side, math.ceil(count / side**2)), np.array([cube / side, cube / side, least])
    width, height = sites[0] * apart[0], count * mass / (DENSE * (sites[0] * apart[0]) ** 2)
    if min(width, height) < diameter:
        raise ValueError(
            f"{count} grains would make a pack of about {width:.1f} x {width:.1f} x {height:.1f} R, flatter than "
            f"a grain ({diameter:.1f} R): take more grains{', or a thicker gas' if spacing >= least else ''}"
        )
    pressed = np.array([width, sites[1] * apart[1], height])
    require_room(pressed, periodic_axes(recipe.boundary), float(clump.widest) + FREE_SKIN, diameter)
    return sites, apart


def cycles_of(recipe: Recipe) -> tuple[Stage, ...]:
    """The stages of all cycles."""
    return tuple(
        replace(stage, name=f"cycle {n}: {stage.name}")
        for n in range(1, recipe.cycles + 1)
        for stage in cycle(recipe.rest, recipe.hold)
    )


def last_rest(recipe: Recipe) -> Stage:
    """The rest that is repeated until the pack is quiet; its unit of length is `SLOWEST_BINS`, or t0 if longer."""
    return Stage("rest", 0.0, 0.0, max(recipe.rest, 0.1), "hold")


def bins_outside(recipe: Recipe, clump: Clump) -> float:
    """The estimated number of bins of a preparation before and after its cycles."""
    sites, apart = sites_of(recipe, clump)
    width, height = sites[0] * float(apart[0]), sites[2] * float(apart[2])
    dense = float(clump.volume(recipe.grains)) / (DENSE * width**2)
    fall = max(0.0, height - dense) / min(recipe.piston_speed, recipe.piston_gain)
    return last_rest(recipe).bins + BINS * (recipe.gas_time + fall + SETTLING * dense) / max(recipe.t0, SLOWEST_BINS)


def grain_steps(recipe: Recipe, clump: Clump) -> float:
    """The estimated cost of a preparation: grains times steps, plus the overheads of steps and of bins."""
    inside = sum(stage.bins for stage in cycles_of(recipe)), stepping(recipe.t0, recipe.dt)[0]
    outside = bins_outside(recipe, clump), stepping(max(recipe.t0, SLOWEST_BINS), recipe.dt)[0]
    return sum(bins * (steps * (recipe.grains + STEP_OVERHEAD) + BIN_OVERHEAD) for bins, steps in (inside, outside))
