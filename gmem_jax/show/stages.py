"""Pictures of what was recorded in the stages of a recall or a preparation, against time or u."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from gmem_jax.physics.material import Material
from gmem_jax.show.drawing import Drawing, blank
from gmem_jax.simulation.protocol import BINS
from gmem_jax.simulation.sample import Sample

AGAINST = ("time", "u")
NO_CHOICE: Mapping[str, int] = {}
_KPA = float(Material().modulus) / 1e3


class Quantity(NamedTuple):
    """What can be drawn of a `Sample`.

    Attributes:
        label: of the axis, with its unit.
        curves: values [bins, B] by name.
        log: whether the axis is logarithmic.
    """

    label: str
    curves: Callable[[Sample], dict[str, np.ndarray]]
    log: bool = False


def _wall(*axes: int) -> Callable[[Sample], dict[str, np.ndarray]]:
    def curves(sample: Sample) -> dict[str, np.ndarray]:
        pressure: np.ndarray = np.asarray(sample.pressure) * _KPA
        return {f"$p_{'xyz'[axis]}$": pressure[:, axis] for axis in axes}

    return curves


def _field(name: str) -> Callable[[Sample], dict[str, np.ndarray]]:
    return lambda sample: {"": np.asarray(getattr(sample, name))}


QUANTITIES = {
    "pressure": Quantity("pressure (kPa)", _wall(0, 1, 2)),
    "p_x": Quantity("$p_x$ (kPa)", _wall(0)),
    "p_y": Quantity("$p_y$ (kPa)", _wall(1)),
    "p_z": Quantity("$p_z$ (kPa)", _wall(2)),
    "p_xy": Quantity(
        "$p_x - p_y$ (Pa)",
        lambda sample: {"": 1e3 * _KPA * (np.asarray(sample.pressure)[:, 0] - np.asarray(sample.pressure)[:, 1])},
    ),
    "Z": Quantity("coordination Z", _field("coordination")),
    "per_grain": Quantity("contacts per grain, those with walls too", _field("contacts_per_grain")),
    "contacts": Quantity("touching spheres per grain, times two", _field("contacts")),
    "phi": Quantity(r"filling $\phi$", _field("filling")),
    "energy": Quantity("kinetic energy ($E R^3$)", _field("kinetic_energy"), log=True),
    "speed": Quantity("largest speed of a grain ($R/t_c$)", _field("largest_speed"), log=True),
    "overlap": Quantity("largest overlap ($R$)", _field("largest_overlap")),
    "inertial": Quantity("inertial number I", _field("inertial_number"), log=True),
}


def stages_drawing(
    stages: Mapping[str, Sample],
    what: str,
    title: str,
    *,
    against: str = "time",
    t0: float | None = None,
    chosen: Mapping[str, int] = NO_CHOICE,
) -> Drawing:
    """A quantity of every stage: a line for the first replica, the zero signal; a band from the lowest to the highest.

    Of chosen signals a line each, and no band.

    Args:
        stages: samples by name, in order.
        what: one of `QUANTITIES`.
        title: over the picture.
        against: "time", or "u" for the stages in which it changes.
        t0: duration of a compression in t_c, which time is given in; in t0 without it.
        chosen: numbers of the signals to draw, 0 for the zero signal, by what they are called.
    """
    quantity = QUANTITIES[what]
    if chosen:
        quantity = quantity._replace(curves=functools.partial(_of_signals, quantity.curves, chosen))
    drawing, ((axis,),) = blank(size=(9.6, 4.2))
    if against == "u":
        _against_u(axis, stages, quantity)
    else:
        _against_time(axis, stages, quantity, t0)
    many = not chosen and any(np.shape(sample.filling)[-1] > 1 for sample in stages.values())
    drawing.title(title, "line: zero signal, band: lowest to highest of all replicas" if many else "")
    axis.set_ylabel(quantity.label)
    if quantity.log:
        axis.set_yscale("log", nonpositive="mask")
    if axis.get_legend_handles_labels()[1]:
        drawing.figure.legend(loc="outside right upper", fontsize=7, frameon=False)
    return drawing


def _of_signals(
    curves: Callable[[Sample], dict[str, np.ndarray]], chosen: Mapping[str, int], sample: Sample
) -> dict[str, np.ndarray]:
    """The curves of some signals, [bins, 1] each; before they part, all are the zero signal's."""
    return {
        f"{name} {label}".strip(): values[:, [min(number, values.shape[1] - 1)]]
        for label, values in curves(sample).items()
        for name, number in chosen.items()
    }


def _curve(axis: Any, at: np.ndarray, values: np.ndarray, **style: Any) -> None:
    axis.plot(at, values[:, 0], linewidth=1.1, **style)
    if values.shape[1] > 1:
        axis.fill_between(at, values.min(axis=1), values.max(axis=1), color=style["color"], alpha=0.25, linewidth=0)


_STYLES = ("-", "--", ":", "-.")


def _against_time(axis: Any, stages: Mapping[str, Sample], quantity: Quantity, t0: float | None) -> None:
    unit = 1.0 if t0 is None else t0
    passed, first = 0, True
    for name, sample in stages.items():
        bins = len(sample.filling)
        at = unit * (passed + np.arange(1, bins + 1)) / BINS
        for number, (label, values) in enumerate(quantity.curves(sample).items()):
            _curve(axis, at, values, color=f"C{number}", label=label if first and label else None)
        axis.axvline(unit * passed / BINS, color="0.85", linewidth=0.7, zorder=0)
        middle = unit * (passed + 0.5 * bins) / BINS
        axis.annotate(
            name, (middle, 0.01), xycoords=("data", "axes fraction"), rotation=90, fontsize=6, color="0.45", ha="center"
        )
        passed, first = passed + bins, False
    axis.margins(x=0.0)
    axis.set_xlabel("time ($t_0$)" if t0 is None else "time ($t_c$)")


def _against_u(axis: Any, stages: Mapping[str, Sample], quantity: Quantity) -> None:
    moving = {name: u for name, sample in stages.items() if np.ptp(u := np.asarray(sample.u)[:, 0]) > 0.0}
    for place, (name, u) in enumerate(moving.items()):
        curves = quantity.curves(stages[name])
        for number, (label, values) in enumerate(curves.items()):
            color = f"C{number if len(curves) > 1 else place}"
            _curve(axis, u, values, color=color, linestyle=_STYLES[place % 4], label=f"{name} {label}".strip())
    axis.set_xlim(0.0, 1.0)
    axis.set_xlabel("compression variable u")
