"""The points that each figure of the paper needs, at three scales.

A figure is a sweep: all figures share one store, so that a point that two of them need is computed once.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

from gmem_jax.experiment.experiment import PAPER_T0
from gmem_jax.files.cache import list_packs
from gmem_jax.sweeps.spec import PREPARE

Values = dict[str, Any]
"""Names of a sweep file with the values of one point."""

DELTA0 = 0.05  # the paper's compression, and that of every shipped pack
CALIBRATED = tuple(f"tetra-10240-{x}" for x in "abc")  # k_H was chosen by their G, so that they do not test it
MADE = 101  # seed of the first pack that is made; shipped packs have small seeds
SHAPES: list[Values] = [{"shape": "sphere"}, *({"overlap": overlap} for overlap in (0.7, 0.8, 0.9))]
SHOWN_WORD = 683  # of ten bits, in the paper's Fig. 13


@dataclass(frozen=True)
class Scale:
    """How large and slow the experiments of a figure are.

    Attributes:
        t0: duration of one compression, in t_c.
        grains: N of the figures that do not vary it.
        packs: number of packs of a point.
        few: number of packs of a point, if each point needs its own packs.
        sizes: N of the figures that vary it.
        lengths: lengths of words, in bits.
        nets: number of nets for each length of words, from different seeds.
        budget: longest training of a net, in seconds.
    """

    t0: float
    grains: int
    packs: int
    few: int
    sizes: tuple[int, ...]
    lengths: tuple[int, ...]
    nets: int
    budget: float


SCALES = {
    "laptop": Scale(1.8e3, 325, 5, 2, (325, 1024, 3267), (3, 4, 5), 1, 120.0),
    "workstation": Scale(5.4e3, 3267, 3, 2, (325, 1024, 3267, 10240), (3, 5, 7), 2, 600.0),
    "paper": Scale(PAPER_T0, 10240, 5, 2, (325, 1024, 3267, 10240, 31680, 100450), (3, 5, 7, 9, 10), 3, 3600.0),
}


def scale_of(text: str, scales: Mapping[str, Scale] = SCALES) -> Scale:
    """A scale by its name, or with changes: "paper,t0=5400,packs=1,lengths=3+4".

    Args:
        text: the name, and after commas any of the fields of `Scale` with other numbers; + joins several.
        scales: the scales by name.

    Raises:
        ValueError: saying what is wrong, and what would be right.
    """
    name, *changes = text.split(",")
    if name not in scales:
        raise ValueError(f"no scale {name!r}; there are {', '.join(scales)}")
    found, known, given = scales[name], [field.name for field in fields(Scale)], set()
    for change in changes:
        field, _, value = change.partition("=")
        if field not in known:
            raise ValueError(
                f"a scale has no field to set by {change!r}; it has {', '.join(known)}, as in {name},packs=1"
            )
        if field in given:
            raise ValueError(f"{field} is given twice")
        given.add(field)
        was = getattr(found, field)
        wanted: Any
        try:
            wanted = tuple(map(int, value.split("+"))) if isinstance(was, tuple) else type(was)(value)
        except ValueError:
            raise ValueError(f"{change!r}: must be like {field}={_written(was)}") from None
        if not all(0.0 < each < math.inf for each in (wanted if isinstance(wanted, tuple) else (wanted,))):
            raise ValueError(f"{change!r}: must be positive")
        found = replace(found, **{field: wanted})
    return found


def _written(value: float | tuple[int, ...]) -> str:
    return "+".join(map(str, value)) if isinstance(value, tuple) else f"{value:g}"


class PaperFigure(NamedTuple):
    """A figure of the paper.

    Attributes:
        title: title of the figure.
        points: gives the values of every point at a scale.
        across: the conditions on the horizontal axes, if any; see `compare.Conditions`.
    """

    title: str
    points: Callable[[Scale], list[Values]]
    across: tuple[str, ...] = ()


def packs(scale: Scale, grains: int, count: int, delta0: float = DELTA0, **grain: Any) -> list[Values]:
    """Values that name `count` packs of a size: first shipped packs, then packs to be made at the scale's t0.

    Args:
        scale: the scale, for t0 of the preparation.
        grains: N.
        count: number of packs.
        delta0: compression with which they are cycled.
        grain: shape and overlap, if not the paper's tetra grain; and the boundary, if not walls.
    """
    shipped = [name for name in list_packs() if name.startswith(f"tetra-{grains}-") and name not in CALIBRATED]
    if delta0 != DELTA0 or grain:
        shipped = []
    recipe = {"grains": grains, "t0": scale.t0, "delta0": delta0, **grain}
    made = [{PREPARE + name: value for name, value in {**recipe, "seed": MADE + n}.items()} for n in range(count)]
    found: list[Values] = [{"pack": name} for name in shipped[:count]]
    return [*found, *made[: count - len(found)]]


def crossed(ones: Sequence[Values], others: Sequence[Values]) -> list[Values]:
    """Every combination of the values of both."""
    return [{**one, **other} for one in ones for other in others]


def _standard(scale: Scale) -> list[Values]:
    return packs(scale, scale.grains, scale.packs)


def _one(scale: Scale) -> list[Values]:
    return packs(scale, scale.grains, 1)


def shown_packs(scale: Scale) -> list[Values]:
    """The packs of Fig. 3: one of every size, and one of every shape in the inset of Fig. 11."""
    return [
        *(packs(scale, grains, 1)[0] for grains in scale.sizes),
        *(packs(scale, scale.grains, 1, **shape)[0] for shape in SHAPES),
    ]


def _friction(scale: Scale) -> list[Values]:
    return crossed(_standard(scale), [{"mu": mu} for mu in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)])


def _laws(scale: Scale) -> list[Values]:
    laws: list[Values] = [{"friction": law} for law in ("H", "M1", "M2")]
    return crossed(_standard(scale)[: scale.few], [*laws, {"friction": "M2", "variant": "paper"}])


def _compression(
    scale: Scale, values: Sequence[float] = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08)
) -> list[Values]:
    return [pack for delta0 in values for pack in packs(scale, scale.grains, scale.few, delta0)]


def _amplitudes(scale: Scale) -> list[Values]:
    gammas: list[Values] = [{"gamma0": gamma0} for gamma0 in (3e-4, 1e-3, 3e-3)]
    inset = [pack for shape in SHAPES for pack in packs(scale, scale.grains, scale.few, **shape)]
    return [*crossed(_compression(scale, (0.02, 0.05, 0.08)), gammas), *inset]


def _sizes(scale: Scale) -> list[Values]:
    return [
        pack for grains in scale.sizes for pack in packs(scale, grains, scale.packs if grains < 3000 else scale.few)
    ]


def _bulk(scale: Scale) -> list[Values]:
    sizes = [(grains, scale.packs if grains < 3000 else scale.few) for grains in scale.sizes]
    without = [pack for grains, count in sizes for pack in packs(scale, grains, count, boundary="periodic")]
    return [*_sizes(scale), *without]


def _words(scale: Scale) -> list[Values]:
    lengths: list[Values] = [{"signals": f"words:{length}", "background": "sub2-bl"} for length in scale.lengths]
    return crossed(_one(scale), lengths)


GALLERY = "fig03"  # pictures of packs, some of which may have to be made
FIGURES = {
    "fig04": PaperFigure("phi, Z and pressures through the experiment, with signal 5 and with none", _one),
    "fig06": PaperFigure("six recalled waveforms beside their integrals", _standard),
    "fig08": PaperFigure("G and F against friction", _friction, ("mu",)),
    "fig09": PaperFigure("G and F under the three friction laws", _laws, ("law",)),
    "fig11": PaperFigure(
        "G and F against compression and amplitude, and the shape of the grains", _amplitudes, ("gamma0", "overlap")
    ),
    "fig12a": PaperFigure("G and F against compression", _compression, ("delta0",)),
    "fig12b": PaperFigure("G and F against the number of grains", _sizes, ("grains",)),
    "bulk": PaperFigure("G and F of packs without walls, beside those between walls", _bulk, ("grains",)),
    "fig13": PaperFigure("Recalled words", _words),
    "fig14": PaperFigure("F by three backgrounds, and accuracy, against the length of words", _words, ("bits",)),
}
