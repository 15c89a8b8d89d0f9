"""Figures of quantities recorded in the stages of a recall or a preparation, against time or u."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from gmem_jax.files.validation import is_number
from gmem_jax.physics.material import Material
from gmem_jax.show.figure import CYCLE, GREY, Curve, Figure, Panel, U
from gmem_jax.simulation.sample import MEASURED, Measured, Sample, ends_of_bins
from gmem_jax.simulation.stage import BINS

AGAINST = ("time", "u")
ZERO = "zero signal"
LINES = 7  # most replicas in a figure of a page: the zero signal and six others
NO_CHOICE: Mapping[str, int] = {}
_STYLES = ("-", "--", ":", "-.")


class Quantity(NamedTuple):
    """A quantity of a `Sample` that can be drawn.

    Attributes:
        label: label of the axis, with the unit.
        curves: gives the curves of a sample, values [bins, B] by name.
        log: whether the axis is logarithmic.
        pascals: for stresses, which are recorded in E, the unit of the label in Pa; 0 for other quantities.
    """

    label: str
    curves: Callable[[Sample], dict[str, np.ndarray]]
    log: bool = False
    pascals: float = 0.0

    def of(self, sample: Sample, material: Material) -> dict[str, np.ndarray]:
        """The curves in the unit of the label."""
        factor = float(material.modulus) / self.pascals if self.pascals else 1.0
        return {name: factor * values for name, values in self.curves(sample).items()}


def _of(field: str, of: Measured) -> dict[str, Quantity]:
    """The quantities of a field; for a vector all components together, and each by itself."""
    unit = {"1": "", "E": "kPa"}.get(of.unit, f"${of.unit.replace(' ', chr(92) + ',')}$")
    in_unit, pascals = f" ({unit})" if unit else "", 1e3 if unit == "kPa" else 0.0

    def values(sample: Sample) -> np.ndarray:
        return np.asarray(getattr(sample, field))

    if not of.symbol:
        return {of.plot: Quantity(of.label + in_unit, lambda sample: {"": values(sample)}, of.log, pascals)}
    names = [f"{of.symbol}_{axis}" for axis in "xyz"]
    found = {of.plot: Quantity(of.label + in_unit, lambda sample: _components(values(sample), names), of.log, pascals)}
    for axis, name in enumerate(names):
        one = partial(lambda sample, axis: {"": values(sample)[:, axis]}, axis=axis)
        found[name] = Quantity(f"${name}${in_unit}", one, pascals=pascals)
    return found


def _components(values: np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
    return {f"${name}$": values[:, axis] for axis, name in enumerate(names)}


def _shear_stress(sample: Sample) -> dict[str, np.ndarray]:
    pressure = np.asarray(sample.pressure)
    return {"": pressure[:, 0] - pressure[:, 1]}


QUANTITIES: dict[str, Quantity] = {}
"""Quantities that can be drawn, by name: the fields of a `Sample`, and others that follow from them."""
for _field, _measured in MEASURED.items():
    QUANTITIES |= _of(_field, _measured) if _measured.plot else {}
QUANTITIES |= {
    "p_xy": Quantity("$p_x - p_y$ (Pa)", _shear_stress, pascals=1.0),
    "per_grain": Quantity(
        "contacts per grain, those with walls too", lambda sample: {"": np.asarray(sample.contacts_per_grain)}
    ),
}

OBSERVED_PLOT = "observed:"  # before the name of an observer


def observed_quantities(stages: Mapping[str, Sample], told: Mapping[str, Any]) -> dict[str, Quantity]:
    """The quantities of observers, by "observed:NAME": one curve, or one for each component.

    Args:
        stages: samples by name.
        told: units and descriptions of observers by name, if known.
    """
    names = next(iter(stages.values())).observed or {}
    return {OBSERVED_PLOT + name: _observed(name, told.get(name, {})) for name in names}


def _observed(name: str, told: Mapping[str, str]) -> Quantity:
    units = told.get("units", "1")

    def curves(sample: Sample) -> dict[str, np.ndarray]:
        values = np.asarray((sample.observed or {})[name])
        places = np.ndindex(values.shape[1:-1])
        return {", ".join(map(str, place)): values[:, *place] for place in places}

    return Quantity(told.get("words", name) + ("" if units == "1" else f" ({units})"), curves)


PAGE = ("p_x", "p_y", "p_z", "p_xy", "Z", "phi")  # of QUANTITIES


def stages_figure(
    stages: Mapping[str, Sample],
    quantity: Quantity,
    title: str,
    *,
    against: str = "time",
    begins: Mapping[str, int] | None = None,
    t0: Any = None,
    chosen: Mapping[str, int] = NO_CHOICE,
    material: Material = Material(),
) -> Figure:
    """A quantity in all stages: a line for the zero signal, and a band from the lowest to the highest replica.

    If signals are chosen, there is a line for each of them, and no band.

    Args:
        stages: samples by name, in order.
        quantity: one of `QUANTITIES`, or of `observed_quantities`.
        title: title above the picture.
        against: horizontal axis: "time"; or "u", for the stages in which u changes.
        begins: see `ends_of_bins`.
        t0: duration of a compression, in t_c; without it the time axis is in t0.
        chosen: numbers of the signals to draw, by name; 0 is the zero signal.
        material: the material, for stresses in Pa.
    """
    marks = []
    time, spans = _times(stages, begins, t0)
    moving = [name for name, sample in stages.items() if np.ptp(np.asarray(sample.u)[:, 0]) > 0.0]
    for name in stages if against == "time" else moving:
        sample, place = stages[name], moving.index(name) if name in moving else 0
        curves = _of_signals(quantity.of(sample, material), chosen)
        for number, (label, values) in enumerate(curves.items()):
            band = np.stack([values.min(axis=1), values.max(axis=1)]) if values.shape[1] > 1 else None
            x, called, colour, style = time[name], label, number, "-"
            if against == "u":
                x, called, style = np.asarray(sample.u)[:, 0], f"{name} {label}".strip(), _STYLES[place % 4]
                colour = number if len(curves) > 1 else place
            marks.append(Curve(x, values[:, 0], called, f"C{colour % 10}", style, 1.1, band))
    many = not chosen and any(np.shape(sample.filling)[-1] > 1 for sample in stages.values())
    told = "line: zero signal, band: lowest to highest of all replicas" if many else ""
    axis: dict[str, Any] = {"x": U, "x_limits": (0.0, 1.0)}
    if against == "time":
        axis = {"x": _time_label(t0), "spans": spans}
    panel = Panel(tuple(marks), y=quantity.label, log=quantity.log, **axis)
    return Figure((panel,), size=(9.6, 4.2), title=(title, told), legend="right")


def _of_signals(curves: Mapping[str, np.ndarray], chosen: Mapping[str, int]) -> dict[str, np.ndarray]:
    """The curves of the chosen signals, [bins, 1] each; in stages before the first waveform all are the same."""
    if not chosen:
        return dict(curves)
    return {
        f"{name} {label}".strip(): values[:, [min(number, values.shape[1] - 1)]]
        for label, values in curves.items()
        for name, number in chosen.items()
    }


def _times(
    stages: Mapping[str, Sample], begins: Mapping[str, int] | None, t0: Any
) -> tuple[dict[str, np.ndarray], tuple[tuple[float, float, str], ...]]:
    """The times of the ends of bins by stage; and begin, end and name of each stage."""
    unit = t0 if is_number(t0) else 1.0
    times = {name: unit * ends for name, ends in ends_of_bins(stages, begins).items()}
    return times, tuple((ends[0] - unit / BINS, ends[-1], name) for name, ends in times.items())


def _time_label(t0: Any) -> str:
    return "time ($t_c$)" if is_number(t0) else "time ($t_0$)"


def series_figures(
    stages: Mapping[str, Sample],
    names: Sequence[str],
    t0: Any,
    begins: Mapping[str, int] | None = None,
    material: Material = Material(),
) -> dict[str, Figure]:
    """Pressures, coordination and filling along a whole run, with a line for the zero signal and the first six others.

    Args:
        stages: samples by name, in order.
        names: names of the signals; none for a preparation.
        t0: duration of a compression, in t_c; not a number if it differs between replicas.
        begins: see `ends_of_bins`.
        material: the material, for stresses in Pa.

    Returns:
        The figure against time and the figure against u, by the text of their buttons.
    """
    time, spans = _times(stages, begins, t0)
    u = [np.asarray(sample.u)[:, 0] for sample in stages.values()]
    called = {ZERO if names else "preparation": 0} | {name: number for number, name in enumerate(names[: LINES - 1], 1)}
    ways = {"time": (time.values(), _time_label(t0), spans), "u": (u, U, ())}

    def panel(what: str, parts: Any, label: str, spans: Any) -> Panel:
        quantity = QUANTITIES[what]
        pieces = [_of_signals(quantity.of(sample, material), called) for sample in stages.values()]
        colours = (GREY, *CYCLE)
        x = np.concatenate(list(parts))
        marks = [
            Curve(x, np.concatenate([piece[name][:, 0] for piece in pieces]), name, colours[number], width=1.0)
            for name, number in called.items()
        ]
        return Panel(tuple(marks), quantity.label, label, spans=spans)

    return {
        f"against {way}": Figure(tuple(panel(what, *of) for what in PAGE), 2, shared=("x",), legend="panel")
        for way, of in ways.items()
    }
