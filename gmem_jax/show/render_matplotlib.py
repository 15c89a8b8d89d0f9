"""Pictures by matplotlib, which is imported on first use; no display is asked for."""

import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gmem_jax.files.atomic import atomic
from gmem_jax.show.figure import Curve, Discs, Figure, Image, Panel

DPI = 130
PICTURE_FORMATS = (".png", ".svg", ".pdf")
_POINTS: dict[str, dict[str, Any]] = {
    "o": {"marker": "o", "markersize": 4, "linestyle": "none"},
    "o-": {"marker": "o", "markersize": 4},
    ".": {"marker": ".", "markersize": 5, "linestyle": "none", "alpha": 0.35},
}


@dataclass(frozen=True)
class Drawing:
    """A picture, which a notebook shows. `figure` is matplotlib's figure, and can be changed."""

    figure: Any

    def save(self, path: str | Path) -> None:
        """Write the picture, in the format of the path's suffix.

        Raises:
            OSError: if it cannot be written.
        """
        path = Path(path)
        with atomic(path) as temporary:
            self._write(temporary, format=path.suffix.removeprefix("."), dpi=DPI)

    def _repr_png_(self) -> bytes:
        content = io.BytesIO()
        self._write(content, format="png", dpi=100)
        return content.getvalue()

    def _write(self, target: Any, **options: Any) -> None:
        with _without_tex():  # tick labels are made while the figure is drawn
            self.figure.savefig(target, **options)


def _without_tex() -> Any:
    """Keep matplotlib from using LaTeX, whatever the user's matplotlibrc says: it may not be installed."""
    import matplotlib

    return matplotlib.rc_context({"text.usetex": False})


def pyplot() -> Any:
    """Matplotlib's pyplot, drawing to files."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams["text.usetex"] = False
    return plt


def save_picture(path: Path, figure: Any, *, also: Sequence[str] = (), caption: str = "") -> None:
    """Write a figure of `pyplot`, and close it.

    Args:
        path: the file; its suffix is the format.
        figure: matplotlib's figure.
        also: suffixes of further formats to write.
        caption: a caption below the figure.

    Raises:
        OSError: if it cannot be written.
    """
    lines = textwrap.wrap(caption, int(14 * figure.get_figwidth()))
    below = 0.2 * len(lines) / figure.get_figheight()
    figure.tight_layout(rect=(0.0, below, 1.0, 1.0))
    if lines:
        figure.text(0.02, 0.3 * below / len(lines), "\n".join(lines), va="bottom", fontsize=9)
    for target in (path, *(path.with_suffix(suffix) for suffix in also)):
        Drawing(figure).save(target)
    pyplot().close(figure)


def to_matplotlib(figure: Figure) -> Drawing:
    """The picture of a figure."""
    with _without_tex():
        return Drawing(_canvas(figure))


def _canvas(figure: Figure) -> Any:
    """The figure as matplotlib's."""
    from matplotlib.figure import Figure as Canvas

    canvas = Canvas(figsize=figure.size, layout="constrained")
    shared: dict[str, Any] = {
        "sharex": "x" in figure.shared,
        "sharey": "row" if "row" in figure.shared else "y" in figure.shared,
    }
    axes = canvas.subplots(figure.rows, figure.columns, squeeze=False, **shared)
    for axis in axes.flat[len(figure.panels) :]:
        axis.set_visible(False)
    for number, (axis, panel) in enumerate(zip(axes.flat, figure.panels, strict=False)):
        _panel(axis, panel, figure, number)
    if figure.title:
        width = int(12 * figure.size[0])  # 12 letters of this size in an inch
        lines = [textwrap.fill(line, width) for line in figure.title if line]
        canvas.suptitle("\n".join(lines), fontsize=9)
    known: dict[str, Any] = {}
    for axis in canvas.axes:
        known |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True)) | known
    if known and figure.legend:
        _legend(canvas, axes[0, 0], figure, known)
    return canvas


def _legend(canvas: Any, first: Any, figure: Figure, known: dict[str, Any]) -> None:
    style: dict[str, Any] = {"fontsize": 7, "frameon": False, "title": figure.legend_title or None}
    if figure.legend == "panel":
        first.legend(known.values(), known, **style)
    elif figure.legend == "below":
        fitting = max(1, int(canvas.get_figwidth() / 2.4))  # an entry takes 2.4 inches
        style |= {"fontsize": 8, "ncols": min(len(known), fitting)}
        canvas.legend(known.values(), known, loc="outside lower center", **style)
    else:
        canvas.legend(known.values(), known, loc="outside right upper", **style)


def _panel(axis: Any, panel: Panel, figure: Figure, number: int) -> None:
    many, several = len(figure.panels) > 16, len(figure.panels) > 2
    if panel.behind is not None:
        _behind(axis, panel, last=(number + 1) % figure.columns == 0 or number == len(figure.panels) - 1)
    if panel.zero:
        axis.axhline(0.0, color="0.8", linewidth=0.6)
    for mark in panel.marks:
        if isinstance(mark, Curve):
            _curve(axis, mark)
        elif isinstance(mark, Image):
            _image(axis, mark, square=panel.equal)
        else:
            _discs(axis, mark)
    _spans(axis, panel)
    axis.set_title(panel.title, fontsize=7 if many else 9, pad=3)
    below, left = figure.labelled(number)
    size = 9 if several else 10
    if below:
        axis.tick_params(labelbottom=True)
        axis.set_xlabel(panel.x, fontsize=size)
    if left:
        axis.set_ylabel(panel.y, fontsize=size)
    if panel.log:
        axis.set_yscale("log", nonpositive="mask")
    if panel.whole:
        axis.xaxis.get_major_locator().set_params(integer=True)
    if panel.equal:
        axis.set_aspect("equal")
    _names(axis, panel, figure)
    if panel.x_limits:
        axis.set_xlim(*panel.x_limits)
    if panel.y_limits:
        axis.set_ylim(*panel.y_limits)
    if panel.down:
        axis.invert_yaxis()


def _curve(axis: Any, curve: Curve) -> None:
    style: dict[str, Any] = {"color": curve.colour, "linewidth": curve.width, "label": curve.name or None}
    style |= _POINTS.get(curve.style, {"linestyle": curve.style})
    if curve.errors is not None:
        axis.errorbar(curve.x, curve.y, curve.errors, capsize=3, **style)
    else:
        axis.plot(curve.x, curve.y, **style)
    if curve.band is not None:
        axis.fill_between(curve.x, *curve.band, color=curve.colour, alpha=0.25, linewidth=0)


def _image(axis: Any, image: Image, *, square: bool) -> None:
    edges = []
    for centres in (image.x, image.y):
        half = 0.5 * (centres[1] - centres[0]) if len(centres) > 1 else 0.5
        edges += [centres[0] - half, centres[-1] + half]
    low, high = image.range
    place = {"extent": tuple(edges), "origin": "lower", "interpolation": "nearest", "aspect": "auto"}
    drawn = axis.imshow(image.values, cmap=image.colours, vmin=low, vmax=high, **place)
    axis.figure.colorbar(drawn, ax=axis, label=image.label, shrink=0.8 if square else 1.0)
    for row, column in np.argwhere(image.values > 0.0) if image.written else ():
        value = image.values[row, column]
        tone = "white" if value > 0.5 * high else "black"
        where = {"ha": "center", "va": "center", "fontsize": 7, "color": tone}
        axis.text(image.x[column], image.y[row], f"{value:.2g}", **where)


def _discs(axis: Any, discs: Discs) -> None:
    from matplotlib.collections import EllipseCollection

    width = 2.0 * discs.radii
    place = {"units": "xy", "offsets": discs.places, "transOffset": axis.transData, "array": discs.values}
    drawn = EllipseCollection(width, width, 0.0 * width, **place)
    drawn.set(cmap="viridis", edgecolor="0.2", linewidth=0.2)
    axis.add_collection(drawn)
    axis.figure.colorbar(drawn, ax=axis, label=discs.label)


def _spans(axis: Any, panel: Panel) -> None:
    for start, end, name in panel.spans:
        axis.axvline(start, color="0.85", linewidth=0.7, zorder=0)
        where = {"xycoords": ("data", "axes fraction"), "rotation": 90, "ha": "center"}
        axis.annotate(name, (0.5 * (start + end), 0.01), fontsize=6, color="0.45", **where)
    if panel.spans:
        axis.margins(x=0.0)


def _names(axis: Any, panel: Panel, figure: Figure) -> None:
    """Write the names of places at the ticks, as many as there is room for."""
    for names, inches, ticks in (
        (panel.x_names, figure.size[0] / figure.columns, axis.set_xticks),
        (panel.y_names, figure.size[1] / figure.rows, axis.set_yticks),
    ):
        step = -(-len(names) // int(8 * inches))
        turned: dict[str, Any] = {} if ticks == axis.set_yticks else {"rotation": 90 if panel.equal else 30}
        if turned and not panel.equal:
            turned["ha"] = "right"
        if names:
            ticks(range(0, len(names), step), list(names)[::step], fontsize=8 if len(names) <= 16 else 6, **turned)


def _behind(axis: Any, panel: Panel, *, last: bool) -> None:
    assert panel.behind is not None
    right, area = axis.twinx(), panel.behind
    right.fill_between(area.x, area.y, color=area.colour, linewidth=0, label=area.name)
    axis.set_zorder(right.get_zorder() + 1)
    axis.patch.set_visible(False)
    right.set_ylim(-panel.behind_limit, panel.behind_limit)
    right.tick_params(labelright=last, labelsize=7, colors="0.5")
    if last:
        right.set_ylabel(panel.behind_label, fontsize=8, color="0.5")
