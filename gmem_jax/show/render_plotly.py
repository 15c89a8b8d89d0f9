"""Interactive figures of a page by plotly, which is imported on first use."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from gmem_jax.files.validation import optional
from gmem_jax.show.figure import Curve, Figure, Image, Panel

COLOURS = {
    "C0": "#1f5fa8",
    "C1": "#b8860b",
    "C2": "#2a8c57",
    "C3": "#c8501e",
    "C4": "#8250b4",
    "C5": "#0f8b8d",
    "C6": "#b03060",
}
TOLD = {"displaylogo": False, "responsive": True, "toImageButtonOptions": {"format": "svg"}}
DASHES = {"--": "dash", ":": "dot", "-.": "dashdot"}
MARGIN = {"t": 80, "b": 50}  # pixels above and below the panels
ABOVE = 40  # pixels from the panels to the legend
_AXIS = {"showline": True, "linecolor": "#999", "ticks": "outside", "gridcolor": "#eceff3", "zerolinecolor": "#c8cdd4"}
_GREEK = {"delta": "δ", "gamma": "γ", "phi": "φ", "mu": "μ"}  # noqa: RUF001


def script() -> str:
    """plotly.js itself.

    Raises:
        ValueError: if it is not installed.
    """
    return str(optional("plotly.offline", "report").get_plotlyjs())


def html(figure: Figure | Mapping[str, Figure], name: str) -> str:
    """A figure as HTML, for a page that has `script`.

    Args:
        figure: the figure; or several that differ only in x, by the text of their buttons.
        name: identifier of the part of the page.
    """
    drawn = to_plotly(figure)
    return str(drawn.to_html(full_html=False, include_plotlyjs=False, config=TOLD, div_id=name))


def to_plotly(figure: Figure | Mapping[str, Figure]) -> Any:
    """The figure of plotly; see `html`."""
    views = {"": figure} if isinstance(figure, Figure) else dict(figure)
    first = next(iter(views.values()))
    images = any(isinstance(mark, Image) for panel in first.panels for mark in panel.marks)
    gaps = {"vertical_spacing": 0.11 if first.rows < 4 else 0.07, "horizontal_spacing": 0.18 if images else 0.09}
    shared = {"shared_xaxes": "all" if "x" in first.shared else False, "shared_yaxes": "y" in first.shared and "all"}
    titles = [_text(panel.title) for panel in first.panels]
    drawn = optional("plotly.subplots", "report").make_subplots(
        first.rows, first.columns, subplot_titles=titles, **gaps, **shared
    )
    drawn.update_annotations(font_size=13)
    height = 150 + 235 * first.rows
    drawn.update_layout(
        template="plotly_white",
        font={"family": "system-ui, DejaVu Sans, sans-serif", "size": 12.5, "color": "#1c232b"},
        margin={**MARGIN, "l": 70, "r": 20},
        height=height,
        hoverlabel={"bgcolor": "#fff"},
        hovermode="x unified" if {"x", "y"} <= set(first.shared) else "closest",
        legend={"orientation": "h", "x": 1.0, "xanchor": "right", **_above(height)},
    )
    drawn.update_xaxes(**_AXIS, zeroline=False)
    drawn.update_yaxes(**_AXIS)
    known: set[str] = set()
    for number, panel in enumerate(first.panels):
        _panel(drawn, panel, first, number, known)
    drawn.update_layout(shapes=_bands(first))
    if len(views) > 1:
        buttons = [_button(label, each) for label, each in views.items()]
        place = {"x": 0.0, "xanchor": "left", **_above(height)}
        drawn.update_layout(updatemenus=[{"type": "buttons", "direction": "right", "buttons": buttons, **place}])
    return drawn


def _above(height: int) -> dict[str, Any]:
    """A place above the panels of a figure that is `height` pixels high."""
    return {"y": 1.0 + ABOVE / (height - MARGIN["t"] - MARGIN["b"]), "yanchor": "middle"}


def _panel(drawn: Any, panel: Panel, figure: Figure, number: int, known: set[str]) -> None:
    at = {"row": number // figure.columns + 1, "col": number % figure.columns + 1}
    for mark in panel.marks:
        if isinstance(mark, Image):
            drawn.add_trace(_image(mark, panel), **at)
            axis = next(drawn.select_xaxes(**at))
            height = next(drawn.select_yaxes(**at))
            bar = {"x": axis.domain[1], "thickness": 14, "y": sum(height.domain) / 2, "len": np.ptp(height.domain)}
            drawn.data[-1].colorbar.update({**bar, "title": {"text": _text(mark.label), "side": "right"}})
        elif isinstance(mark, Curve):
            drawn.add_trace(_curve(mark, shown=mark.name not in known), **at)
            known.add(mark.name)
    told = zip((panel.x, panel.y), figure.labelled(number), strict=True)
    x, y = (dict[str, Any](title_text=_text(label) if shown else None) for label, shown in told)
    if panel.x_names and panel.equal:
        x["type"] = y["type"] = "category"
        y |= {"scaleanchor": f"x{number + 1}".removesuffix("x1") or "x", "constrain": "domain"}
    if panel.whole:
        x["dtick"] = 1 + int(max(curve.x[-1] for curve in panel.curves)) // 20
    if panel.log:
        y["type"] = "log"
    y["range"] = panel.y_limits or _common(figure)
    if panel.down:
        y["autorange"] = "reversed"
    drawn.update_xaxes(**x, range=panel.x_limits, **at)
    drawn.update_yaxes(**y, **at)


def _common(figure: Figure) -> list[float] | None:
    """Limits of y if all panels share it, since plotly does not find common ones; else None."""
    if "y" not in figure.shared:
        return None
    values = [curve.y for panel in figure.panels for curve in panel.curves]
    low, high = min(map(np.nanmin, values)), max(map(np.nanmax, values))
    return [low - 0.05 * (high - low), high + 0.05 * (high - low)]


def _curve(curve: Curve, *, shown: bool) -> Any:
    mode = {"o": "markers", ".": "markers", "o-": "lines+markers"}.get(curve.style, "lines")
    more = {} if curve.errors is None else {"error_y": {"array": np.float32(curve.errors)}}
    name = _text(curve.name)
    return optional("plotly.graph_objects", "report").Scatter(
        x=np.float32(curve.x),
        y=np.float32(curve.y),
        mode=mode,
        name=name,
        legendgroup=name,
        showlegend=bool(name) and shown,
        line={"color": _colour(curve.colour), "width": 1.2 * curve.width, "dash": DASHES.get(curve.style, "solid")},
        **more,
    )


def _image(image: Image, panel: Panel) -> Any:
    x, y = (list(names) or np.float32(places) for names, places in ((panel.x_names, image.x), (panel.y_names, image.y)))
    low, high = image.range
    words = f"{_text(panel.y)} %{{y}}, {_text(panel.x)} %{{x}}: %{{z:.3g}}<extra></extra>"
    return optional("plotly.graph_objects", "report").Heatmap(
        x=x, y=y, z=np.float32(image.values), zmin=low, zmax=high, colorscale=image.colours, hovertemplate=words
    )


def _bands(figure: Figure) -> list[dict[str, Any]]:
    """Every second span of a figure as a grey band behind the curves."""
    look = {"type": "rect", "y0": 0, "y1": 1, "fillcolor": "#f1f4f8", "line": {"width": 0}, "layer": "below"}
    return [
        {**look, "x0": start, "x1": end, "xref": f"x{axis}", "yref": f"y{axis} domain"}
        for number, panel in enumerate(figure.panels)
        for start, end, _ in panel.spans[1::2]
        for axis in [number + 1 if number else ""]
    ]


def _button(label: str, figure: Figure) -> dict[str, Any]:
    """A button that changes the common x of all curves, its labels and its bands."""
    places = np.float32(figure.panels[0].curves[0].x).round(7).tolist()
    labels = {
        f"xaxis{number + 1 if number else ''}.title.text": _text(panel.x)
        for number, panel in enumerate(figure.panels)
        if figure.labelled(number)[0]
    }
    return {"label": label, "method": "update", "args": [{"x": [places]}, {"shapes": _bands(figure), **labels}]}


def _colour(colour: str) -> str:
    """A colour in HTML."""
    if re.fullmatch(r"[01]\.\d*", colour):
        return "#" + 3 * f"{round(255 * float(colour)):02x}"
    return COLOURS.get(colour, colour)


def _text(text: str) -> str:
    """A text with its formulas in HTML."""

    def formula(found: re.Match[str]) -> str:
        words = found[1].replace("\\,", " ")
        for name, letter in _GREEK.items():
            words = words.replace(f"\\{name}", letter)
        words = re.sub(r"\^(\w)", r"<sup>\1</sup>", words)
        return re.sub(r"_\{([^}]*)\}|_(\w)", lambda index: f"<sub>{index[1] or index[2]}</sub>", words)

    return re.sub(r"\$([^$]*)\$", formula, text)
