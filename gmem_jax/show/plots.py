"""Figures of a report, to be zoomed and pointed at. Plotly is imported on first use."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gmem_jax.design.kernel import MemoryKernel
from gmem_jax.experiment.recall import Recall
from gmem_jax.files.checked import optional
from gmem_jax.physics.material import Material
from gmem_jax.show.recalls import PALE, mean_over_ringing
from gmem_jax.simulation.protocol import BINS
from gmem_jax.simulation.sample import Sample

MOST = 12  # panels of recalled signals
LINES = 7  # replicas of a time series: the zero signal and six others
COLOURS = ("#1f5fa8", "#c8501e", "#2a8c57", "#8250b4", "#b8860b", "#0f8b8d", "#b03060")
TOLD = {"displaylogo": False, "responsive": True, "toImageButtonOptions": {"format": "svg"}}
U = "compression variable u"
MARGIN = {"t": 80, "b": 50}  # pixels above and below the panels
_AXIS = {"showline": True, "linecolor": "#999", "ticks": "outside", "gridcolor": "#eceff3", "zerolinecolor": "#c8cdd4"}


def _plotly(module: str) -> Any:
    return optional(f"plotly.{module}", "report")


def script() -> str:
    """plotly.js itself.

    Raises:
        ValueError: if it is not installed.
    """
    return str(_plotly("offline").get_plotlyjs())


def written(figure: Any, name: str, height: int) -> str:
    """A figure as HTML, for a page that holds `script`."""
    figure.update_layout(
        template="plotly_white",
        font={"family": "system-ui, DejaVu Sans, sans-serif", "size": 12.5, "color": "#1c232b"},
        margin={**MARGIN, "l": 70, "r": 20},
        height=height,
        hoverlabel={"bgcolor": "#fff"},
    )
    figure.update_xaxes(**_AXIS, zeroline=False)
    figure.update_yaxes(**_AXIS)
    return str(figure.to_html(full_html=False, include_plotlyjs=False, config=TOLD, div_id=name))


def _line(x: np.ndarray, y: np.ndarray, name: str, colour: str, **more: Any) -> Any:
    line = {"color": colour, "width": 1.5, **more.pop("line", {})}
    values = {"x": np.float32(x), "y": np.float32(y)}
    return _plotly("graph_objects").Scatter(**values, mode="lines", name=name, line=line, **more)


def _panels(count: int, columns: int, titles: Sequence[str], **more: Any) -> Any:
    rows = -(-count // columns)
    gaps = {"vertical_spacing": 0.11 if rows < 4 else 0.07, "horizontal_spacing": 0.09}
    figure = _plotly("subplots").make_subplots(rows, columns, subplot_titles=titles, **gaps, **more)
    figure.update_annotations(font_size=13)
    return figure


def recalls(
    recall: Recall, scale: np.ndarray, names: Sequence[str], target: np.ndarray | None = None, t0: Any = None
) -> tuple[Any, int]:
    """p_sig of the first signals beside G E delta0 gamma0 J, like the paper's Fig. 6; the figure and its height.

    Its mean over the ringing period too, where `mean_over_ringing` has one.

    Args:
        recall: what to draw.
        scale: delta0 gamma0, scalar or [S, 1].
        names: of the signals.
        target: J that designed waveforms should give, [S, 256].
        t0: duration of a compression in t_c, if it is known and the same for all.
    """
    unit = Material().modulus
    shown = min(len(names), MOST)
    columns = min(3, shown)
    figure = _panels(shown, columns, names[:shown], shared_xaxes=True, shared_yaxes=True)
    integrals = float(recall.gain) * scale * np.asarray(recall.J)
    curves: list[tuple[str, np.ndarray, str, dict[str, Any]]] = [
        ("recalled p<sub>sig</sub>", np.asarray(recall.p_sig), COLOURS[0], {}),
        ("G E δ<sub>0</sub> γ<sub>0</sub> J", integrals, COLOURS[1], {"dash": "dash"}),  # noqa: RUF001
    ]
    if (smooth := mean_over_ringing(recall, np.asarray(recall.p_sig), t0)) is not None:
        curves[0] = (*curves[0][:2], PALE, {})
        curves.insert(1, ("its mean over the ringing period", smooth, COLOURS[0], {}))
    if target is not None:
        p_sig, wanted = np.asarray(recall.p_sig), scale * target
        gain = np.sum(wanted * p_sig) / np.sum(wanted * wanted)
        curves.append(("the same of the target", gain * wanted, COLOURS[2], {"dash": "dot"}))
    for number in range(shown):
        at = {"row": number // columns + 1, "col": number % columns + 1}
        for name, values, colour, style in curves:
            more = {"legendgroup": name, "showlegend": number == 0, "line": style}
            figure.add_trace(_line(np.asarray(recall.u), unit * values[number], name, colour, **more), **at)
    rows = -(-shown // columns)
    for column in range(1, columns + 1):
        figure.update_xaxes(title_text=U, row=rows, col=column)
    for row in range(1, rows + 1):
        figure.update_yaxes(title_text="stress (Pa)", row=row, col=1)
    drawn = unit * np.stack([values[:shown] for _, values, *_ in curves])
    lowest, highest = np.nanmin(drawn), np.nanmax(drawn)
    margin = 0.05 * (highest - lowest)
    figure.update_xaxes(range=[0.0, 1.0])
    figure.update_yaxes(range=[lowest - margin, highest + margin])  # plotly finds none for axes that are shared
    figure.update_layout(legend=_above(40, 110 + 220 * rows), hovermode="x unified")
    return figure, 110 + 220 * rows


def series(stages: Mapping[str, Sample], names: Sequence[str], t0: float | None) -> tuple[Any, int]:
    """Pressures, coordination and filling along a run, against time or u; the figure and its height.

    Args:
        stages: what was recorded, of which the zero signal and the first six others are drawn.
        names: of the signals; none for a preparation.
        t0: duration of a compression in t_c; None where it differs between replicas.
    """
    bins = np.array([len(sample.filling) for sample in stages.values()])
    ends = np.cumsum(bins)
    tick, unit = (1.0 / BINS, "t<sub>0</sub>") if t0 is None else (t0 / BINS, "t<sub>c</sub>")
    time = tick * (np.arange(ends[-1]) + 1.0)
    u = np.concatenate([np.asarray(sample.u)[:, 0] for sample in stages.values()])

    def along(quantity: str, replica: int) -> np.ndarray:
        parts = [np.asarray(getattr(sample, quantity)) for sample in stages.values()]
        return np.concatenate([part[..., min(replica, part.shape[-1] - 1)] for part in parts])

    pascal = Material().modulus
    replicas = range(min(len(names) + 1, LINES))
    titles = ["p<sub>x</sub>", "p<sub>y</sub>", "p<sub>z</sub>", "p<sub>xy</sub> = p<sub>x</sub> - p<sub>y</sub>"]
    figure = _panels(6, 2, [*titles, "coordination Z", "filling φ"], shared_xaxes="all")
    for replica in replicas:
        pressure = pascal * along("pressure", replica)
        rows = [
            *(pressure.T / 1e3),
            pressure[:, 0] - pressure[:, 1],
            along("coordination", replica),
            along("filling", replica),
        ]
        name = names[replica - 1] if replica else "zero signal" if names else "preparation"
        colour = COLOURS[(replica - 1) % len(COLOURS)] if replica else "#444"
        for panel, values in enumerate(rows):
            more = {"legendgroup": name, "showlegend": panel == 0, "line": {"width": 1.2}}
            figure.add_trace(_line(time, values, name, colour, **more), row=panel // 2 + 1, col=panel % 2 + 1)
    for panel, unit_of in enumerate(("kPa", "kPa", "kPa", "Pa", "", "")):
        figure.update_yaxes(title_text=unit_of, row=panel // 2 + 1, col=panel % 2 + 1)
    words = {"time": f"time t ({unit})", "u": U}
    figure.update_xaxes(title_text=words["time"], row=3)
    starts = tick * (ends - bins)
    bands = [_band(start, tick * end) for start, end in list(zip(starts, ends, strict=True))[1::2]]
    bands = [{**band, "xref": f"x{n}", "yref": f"y{n} domain"} for band in bands for n in ("", *range(2, 7))]
    buttons = [
        {
            "label": f"against {label}",
            "method": "update",
            "args": [
                {"x": [np.float32(values).round(7).tolist()]},
                {"shapes": shapes, "xaxis5.title.text": words[label], "xaxis6.title.text": words[label]},
            ],
        }
        for label, values, shapes in (("time", time, bands), ("u", u, []))
    ]
    height = 860
    menu = {
        "type": "buttons",
        "direction": "right",
        "buttons": buttons,
        **_above(40, height),
        "x": 0.0,
        "xanchor": "left",
    }
    del menu["orientation"]
    figure.update_layout(shapes=bands, updatemenus=[menu], legend=_above(40, height))
    return figure, height


def _above(pixels: int, height: int) -> dict[str, Any]:
    """A place to the right, some pixels above the panels of a figure of that height."""
    y = 1.0 + pixels / (height - MARGIN["t"] - MARGIN["b"])
    return {"orientation": "h", "x": 1.0, "xanchor": "right", "y": y, "yanchor": "middle"}


def _band(start: float, end: float) -> dict[str, Any]:
    """A stage of the run as a grey band behind the curves."""
    shape = {"type": "rect", "x0": start, "x1": end, "y0": 0, "y1": 1}
    return {**shape, "fillcolor": "#f1f4f8", "line": {"width": 0}, "layer": "below"}


def confusion(tables: Mapping[str, np.ndarray], names: Sequence[str]) -> tuple[Any, int]:
    """Words read for words stored, by reader; tables are counts [S, S], the word stored down."""
    heat = _plotly("graph_objects").Heatmap
    figure = _panels(len(tables), len(tables), list(tables))
    for number, table in enumerate(tables.values(), 1):
        share = np.float32(table / table.sum(axis=1, keepdims=True))
        words = "stored %{y}, read %{x}: %{z:.2f}<extra></extra>"
        where = {"x": list(names), "y": list(names), "z": share, "zmin": 0.0, "zmax": 1.0}
        bar = {"title": {"text": "part of the readings", "side": "right"}}
        drawn = heat(**where, colorscale="Blues", hovertemplate=words, showscale=number == 1, colorbar=bar)
        figure.add_trace(drawn, row=1, col=number)
        figure.update_xaxes(title_text="word read", type="category", row=1, col=number)
        axis = {"type": "category", "autorange": "reversed", "scaleanchor": f"x{number}".removesuffix("1")}
        figure.update_yaxes(**axis, constrain="domain", row=1, col=number)
    figure.update_yaxes(title_text="word stored", row=1, col=1)
    return figure, 440


def kernel(found: MemoryKernel, noise: float) -> tuple[Any, int]:
    """M(u, v), and its singular values beside the noise (in E)."""
    figure = _panels(2, 2, ["M(u, v) / E δ<sub>0</sub>", "recall of the n-th best waveform"])
    values = np.float32(found.kernel() / found.delta0)
    limit = float(np.abs(values).max())
    where = {"x": np.float32(found.centres), "y": np.float32(found.u), "z": values, "zmin": -limit, "zmax": limit}
    words = "v = %{x:.3f}, u = %{y:.3f}: %{z:.3g}<extra></extra>"
    heat = _plotly("graph_objects").Heatmap(
        **where, colorscale="RdBu_r", hovertemplate=words, colorbar={"x": 0.44, "thickness": 14}
    )
    figure.add_trace(heat, row=1, col=1)
    singular = found.singular_values() * Material().modulus
    number = np.arange(1, singular.size + 1)
    figure.add_trace(_line(number, singular, "singular values", COLOURS[0]).update(mode="lines+markers"), row=1, col=2)
    floor = np.full(2, noise * Material().modulus)
    figure.add_trace(_line(number[[0, -1]], floor, "noise", COLOURS[1], line={"dash": "dash"}), row=1, col=2)
    figure.update_xaxes(title_text="v (where the shear acts)", domain=[0.0, 0.42], row=1, col=1)
    figure.update_yaxes(title_text="u (where it is read)", row=1, col=1)
    figure.update_xaxes(title_text="number n", domain=[0.6, 1.0], row=1, col=2)
    figure.update_yaxes(title_text="singular value (Pa)", type="log", dtick=1, row=1, col=2)
    figure.update_layout(legend=_above(40, 450))
    for title, at in zip(figure.layout.annotations, (0.21, 0.8), strict=True):
        title.x = at
    return figure, 450


def curves(
    rows: Mapping[str, tuple[np.ndarray, np.ndarray]],
    x: str,
    y: str,
    *,
    mode: str = "lines",
    log: bool = False,
    errors: Mapping[str, np.ndarray] | None = None,
) -> tuple[Any, int]:
    """Several curves by name in one panel, with errors where there are any."""
    figure = _plotly("graph_objects").Figure()
    for number, (name, (places, values)) in enumerate(rows.items()):
        colour = COLOURS[number % len(COLOURS)]
        more = {"error_y": {"array": np.float32(errors[name])}} if errors else {}
        figure.add_trace(_line(places, values, name, colour, **more).update(mode=mode))
    figure.update_xaxes(title_text=x, range=[0.0, 1.0] if x == U else None)
    figure.update_yaxes(title_text=y, type="log" if log else "linear")
    return figure, 380
