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
        name: entry in the legend, which has each name once; "" for none.
        colour: colour of the line.
        style: "-", "--", ":", "-."; "o" for points, "o-" for points on a line, "." for small and faint points.
        width: width of the line, in points.
        band: lowest and highest values, [2, n], filled in the same colour.
        errors: half lengths of error bars, [n].
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
    """Values on a grid, drawn as colours.

    Attributes:
        values: the values, [rows, columns].
        x: centres of the columns, equally far apart, [columns].
        y: centres of the rows, [rows].
        label: label of the colour bar.
        limits: lowest and highest value of the colours; default symmetric about zero.
        colours: name of a colour map of both matplotlib and plotly.
        written: whether each value above zero is written into its cell.
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
        """Lowest and highest value of the colours."""
        most = float(np.nanmax(np.abs(self.values), initial=0.0)) or 1.0
        return self.limits or (-most, most)


@dataclass(frozen=True)
class Discs:
    """Discs, each drawn over the ones before it; in pictures only, not on pages.

    Attributes:
        places: centres of the discs, [n, 2].
        values: values that give their colours, [n].
        label: label of the colour bar.
        radii: radii of the discs, [n].
    """

    places: np.ndarray
    values: np.ndarray
    label: str
    radii: np.ndarray


@dataclass(frozen=True)
class Panel:
    """A panel: marks in one pair of axes.

    Attributes:
        marks: curves, images and discs, each drawn over the ones before it.
        title: title above the panel.
        x: label of the horizontal axis.
        y: label of the vertical axis.
        x_limits: ends of the horizontal axis; default those of the marks.
        y_limits: ends of the vertical axis; default those of the marks.
        log: whether y is logarithmic.
        whole: whether ticks of x are whole numbers.
        zero: whether there is a line at y = 0.
        down: whether y grows downwards.
        equal: whether x and y have one scale.
        x_names: names of the places x = 0, 1, ...
        y_names: names of the places y = 0, 1, ...
        spans: named parts of x, each with begin, end and name.
        behind: a curve drawn as an area from 0, behind the marks, with an axis of its own on the right.
        behind_label: label of that axis.
        behind_limit: highest value of that axis; the lowest is its negative.
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
        """The curves among its marks."""
        return [mark for mark in self.marks if isinstance(mark, Curve)]


@dataclass(frozen=True)
class Figure:
    """Panels, row by row.

    Attributes:
        panels: the panels.
        columns: number of panels in a row.
        size: size of a picture, in inches.
        title: lines above the picture.
        legend: place of the legend: "panel", in the first panel; "below" or "right" of all panels; "" for none.
        legend_title: title of the legend.
        shared: axes that all panels share, "x" and "y"; "row" if the panels of a row share y. They are labelled at the
            edges of the figure only.
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
        """Number of rows of panels."""
        return -(-len(self.panels) // self.columns)

    def labelled(self, number: int) -> tuple[bool, bool]:
        """Whether x and y of a panel have labels; shared axes have them at the edges of the figure only."""
        edge = number + self.columns >= len(self.panels), number % self.columns == 0
        return edge[0] or "x" not in self.shared, edge[1] or not {"y", "row"} & set(self.shared)


def ramp(count: int) -> list[str]:
    """`count` colours from blue to red."""
    return [f"#{round(255 * tone):02x}4d{round(255 * (1.0 - tone)):02x}" for tone in np.linspace(0.0, 1.0, count)]


def grid(count: int) -> tuple[int, tuple[float, float]]:
    """Number of columns for `count` panels of signals, and the size of their picture in inches."""
    columns = min(count, 3) if count <= 12 else min(8, math.ceil(math.sqrt(count)))
    width, height = (3.4, 2.4) if count <= 12 else (2.1, 1.7)
    return columns, (max(width * columns, 5.0) + 0.4, height * -(-count // columns) + 0.9)


def u_label(columns: int, *, of_time: bool = False) -> str:
    """Label of an axis of u, or of the time of a read; a single word if there are many narrow columns."""
    if columns <= 3:
        return TIME_OF_READ if of_time else U
    return "time" if of_time else "u"


def shown_part(shown: int, count: int) -> str:
    """A remark for a title if only some of the signals are shown; else ""."""
    return f" (the first {shown} of {count} signals are shown)" if shown < count else ""
