"""Figures as plain data, which `render_matplotlib` draws and `render_plotly` puts into a page.

Texts may hold formulas between dollars, with Greek letters and indices. Colours are those of matplotlib's cycle ("C0"),
greys from "0.0" to "1.0" or hexadecimal.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

U = "compression variable u"
TIME_OF_READ = "time, in parts of the read"
CYCLE = ("C0", "C3", "C2", "C4", "C1", "C5", "C6")  # of replicas; red is not beside orange
GREY = "0.27"


@dataclass(frozen=True)
class Curve:
    """Values over places.

    Attributes:
        x: places, [n].
        y: values, [n].
        name: in the legend, where a name stands once; "" for none.
        colour: of the line.
        style: "-", "--", ":", "-."; "o" for points, "o-" for points on a line, "." for small and faint points.
        width: of the line, in points.
        band: lowest and highest values, [2, n], filled in the same colour.
        errors: up and down from each value, [n], drawn as bars.
    """

    x: np.ndarray
    y: np.ndarray
    name: str = ""
    colour: str = "C0"
    style: str = "-"
    width: float = 1.2
    band: np.ndarray | None = None
    errors: np.ndarray | None = None


@dataclass(frozen=True)
class Image:
    """Values of a grid.

    Attributes:
        values: [rows, columns].
        x: centres of the columns, equally far apart, [columns].
        y: centres of the rows, [rows].
        label: of the colours.
        limits: where the colours begin and end; default symmetric about zero.
        colours: a map that matplotlib and plotly know.
        written: whether each value that is not zero stands in its cell.
    """

    values: np.ndarray
    x: np.ndarray
    y: np.ndarray
    label: str
    limits: tuple[float, float] | None = None
    colours: str = "RdBu_r"
    written: bool = False

    @property
    def range(self) -> tuple[float, float]:
        """Where the colours begin and end."""
        most = float(np.nanmax(np.abs(self.values), initial=0.0)) or 1.0
        return self.limits or (-most, most)


@dataclass(frozen=True)
class Discs:
    """Discs, the later before the earlier; in pictures only.

    Attributes:
        places: of the centres, [n, 2].
        values: what they are coloured by, [n].
        label: of the colours.
        radii: of the discs, [n].
    """

    places: np.ndarray
    values: np.ndarray
    label: str
    radii: np.ndarray


@dataclass(frozen=True)
class Panel:
    """What stands in one frame.

    Attributes:
        marks: what is drawn, the later before the earlier.
        title: over it.
        x: label of the axis.
        y: label of the axis.
        x_limits: where it begins and ends; default where the marks do.
        y_limits: the same of y.
        log: whether y is logarithmic.
        whole: whether ticks of x are whole numbers.
        zero: whether there is a line at y = 0.
        down: whether y grows downwards.
        equal: whether x and y have one scale.
        x_names: of the places 0, 1, ...
        y_names: the same of y.
        spans: parts of x with names: begin, end, name.
        behind: an area behind the marks with an axis of its own on the right, from 0 to its y.
        behind_label: of that axis.
        behind_limit: where it ends, up and down.
    """

    marks: tuple[Curve | Image | Discs, ...]
    title: str = ""
    x: str = ""
    y: str = ""
    x_limits: tuple[float, float] | None = None
    y_limits: tuple[float, float] | None = None
    log: bool = False
    whole: bool = False
    zero: bool = False
    down: bool = False
    equal: bool = False
    x_names: Sequence[str] = ()
    y_names: Sequence[str] = ()
    spans: tuple[tuple[float, float, str], ...] = ()
    behind: Curve | None = None
    behind_label: str = ""
    behind_limit: float = 1.0

    @property
    def curves(self) -> list[Curve]:
        """Those of its marks that are."""
        return [mark for mark in self.marks if isinstance(mark, Curve)]


@dataclass(frozen=True)
class Figure:
    """Panels, row by row.

    Attributes:
        panels: the panels.
        columns: panels in a row.
        size: of a picture, in inches.
        title: lines over it.
        legend: "panel": in the first panel; "below" or "right": one of all panels; "" for none.
        legend_title: over the legend.
        shared: axes that all panels have in common, "x" and "y"; "row": y in each row. They are labelled at the edges.
    """

    panels: tuple[Panel, ...]
    columns: int = 1
    size: tuple[float, float] = (6.4, 3.6)
    title: tuple[str, ...] = ()
    legend: str = ""
    legend_title: str = ""
    shared: tuple[str, ...] = ()

    @property
    def rows(self) -> int:
        """Rows of panels."""
        return -(-len(self.panels) // self.columns)

    def labelled(self, number: int) -> tuple[bool, bool]:
        """Whether x and y of a panel have labels: of shared axes, only those at the edges of the figure."""
        edge = number + self.columns >= len(self.panels), number % self.columns == 0
        return edge[0] or "x" not in self.shared, edge[1] or not {"y", "row"} & set(self.shared)


def ramp(count: int) -> list[str]:
    """So many colours from blue to red."""
    return [f"#{round(255 * tone):02x}4d{round(255 * (1.0 - tone)):02x}" for tone in np.linspace(0.0, 1.0, count)]


def grid(count: int) -> tuple[int, tuple[float, float]]:
    """Columns of so many panels of signals, and the size of their picture in inches."""
    columns = min(count, 3) if count <= 12 else min(8, math.ceil(math.sqrt(count)))
    width, height = (3.4, 2.4) if count <= 12 else (2.1, 1.7)
    return columns, (max(width * columns, 5.0) + 0.4, height * -(-count // columns) + 0.9)


def u_label(columns: int, *, of_time: bool = False) -> str:
    """What is written under an axis of u, or of the time of a read: a word where panels are narrow."""
    if columns <= 3:
        return TIME_OF_READ if of_time else U
    return "time" if of_time else "u"


def shown_part(shown: int, count: int) -> str:
    """What is said where not all signals have panels."""
    return f" (the first {shown} of {count} signals are shown)" if shown < count else ""
