"""Tables of results beside the published points."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from rich.table import Table

from gmem_jax.experiment import analysis
from gmem_jax.experiment.analysis import spread
from gmem_jax.experiment.experiment import NOT_OF_PAPER, NUMBERS, Experiment
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.record import values_of
from gmem_jax.files.configuration import recorded_material
from gmem_jax.files.measures import relative_scale
from gmem_jax.files.printing import printable
from gmem_jax.physics.boundary import boundary_of
from gmem_jax.physics.grain import words_of_sizes
from gmem_jax.physics.numbers import plural
from gmem_jax.preparation.recipe import pressure_over_wanted
from gmem_jax.show.numbers import published
from gmem_jax.simulation.stage import BINS

FEW = 8  # most signals, and stages, that are listed unasked
NONE = "-"  # stands for a measure that is NaN
SLOW_ENOUGH = 1.8e3  # t0, in t_c: there G and F agree with those of ten times slower drives if nothing rings


class Fact(NamedTuple):
    """A number for a person.

    Attributes:
        name: name of the number.
        value: a number, or a text.
        unit: unit of the value.
        words: meaning of the number.
    """

    name: str
    value: Any
    unit: str = ""
    words: str = ""

    @property
    def text(self) -> str:
        """The value with its unit."""
        number = f"{self.value:.3f}" if isinstance(self.value, float) else str(self.value)
        return f"{number} {self.unit}".rstrip()

    def __str__(self) -> str:
        return f"{self.name}: {self.text}" + (f"  ({self.words})" if self.words else "")


def history_table(names: Iterable[str], history: Sequence[Mapping[str, float]]) -> Table:
    """Values and the mean fidelity after every iteration."""
    table = Table("iteration", *names, "mean F")
    for number, one in enumerate(history):
        table.add_row(str(number), *(f"{one[name]:.4g}" for name in names), f"{one['fidelity']:.4f}")
    return table


def errors_table(recall: Recall) -> Table:
    """G and F with their standard errors over signals, without and with a running mean over the ringing period."""
    configuration, window = recall.configuration, float(recall.window)
    scale = np.asarray(relative_scale(configuration))
    told = "G: gain; F: fidelity, 1 if what is recalled is the integral of what was stored; errors: standard errors "
    parts = [*recall.each()]
    where = _where(parts)
    table = Table("", *where, "G", "F", caption=f"{told}over the signals stored in this pack (jackknife)")
    for one in parts:
        bins = one.windows(values_of(configuration)["t0"])[0] * BINS
        for name, values, smooth in (
            ("as recalled", (one.gain, one.fidelity), None),
            (f"averaged over T1 = {window:.0f} t_c", (one.windowed_gain, one.windowed_fidelity), bins),
        ):
            curves = [jnp.asarray(curve) for curve in (one.p_sig, one.J)]
            if smooth is not None:
                curves = [analysis.running_mean(curve, smooth) for curve in curves]
            signal, integral = map(np.asarray, curves)
            known = np.any(integral)
            errors = analysis.errors_over_signals(signal, integral, scale) if known else (math.nan, math.nan)
            pairs = zip(values, errors, strict=True)
            place = (str(getattr(one, f"{name}s")[0]) for name in where)
            table.add_row(name, *place, *(decimal(float(value), error) for value, error in pairs))
    return table


def _where(parts: Sequence[Recall]) -> list[str]:
    """Which of "read" and "channel" differ between recalls of one read and channel each."""
    return [name for name in ("read", "channel") if len({getattr(one, f"{name}s") for one in parts}) > 1]


def decimal(value: float, error: float = math.nan, digits: int = 3) -> str:
    """A measure with its standard error, if there is one, as a text; "-" for NaN."""
    if math.isnan(value):
        return NONE
    return f"{value:.{digits}f}" + (f" ± {error:.{digits}f}" if math.isfinite(error) else "")


def target_line(row: dict[str, Any]) -> str:
    """Gain and fidelity with respect to the target of a design, as a text, from the `summary` of a recall."""
    return (
        f"designed waveforms: G = {row['target_gain']:.3f}, F = {row['target_fidelity']:.4f} with respect to the\n"
        "target of their design; the table compares with the J of the waveforms themselves"
    )


def recall_lines(row: dict[str, Any], configuration: dict[str, Any], *, each: bool = False) -> list[Any]:
    """Tables and lines for one recall, from its `summary`; more than `FEW` signals are listed only if `each` is set."""
    more: list[Any] = [signals_table(row)] if each or 1 < signals_told(row) <= FEW else []
    if len(row.get("channels", ())) > 1:
        more = [gains_table(row), *more]
    for one in parts_of(row):
        if "backgrounds" in one:
            more += [backgrounds_table(one), second_readout_lines(one)]
        if "target_fidelity" in one:
            more += [target_line(one)]
    if row["note"]:
        more += [f"note: {row['note']}"]
    return [recall_table([row], configuration), *more]


def parts_of(row: dict[str, Any]) -> list[dict[str, Any]]:
    """The numbers of each read and channel, from the `summary` of a recall."""
    found: list[dict[str, Any]] = row.get("each", [row])
    return found


def _named(row: dict[str, Any]) -> list[str]:
    """Which of "read" and "channel" a recall has several of, from its `summary`; tables then name them."""
    return [name for name in ("read", "channel") if len(row.get(f"{name}s", ())) > 1]


def signals_told(row: dict[str, Any]) -> int:
    """Number of rows of `signals_table`."""
    return sum(len(one["signals"]) for one in parts_of(row))


def signals_table(row: dict[str, Any]) -> Table:
    """Gain and fidelity of each signal by itself, from the `summary` of a recall."""
    table, named = Table(title="By signal", caption="each with a gain of its own"), _named(row)
    for column in (*named, "signal", "G", "F", "F over T1", "correlation with J"):
        table.add_column(column, justify="left" if column in (*named, "signal") else "right")
    for one in parts_of(row):
        for own in one["signals"]:
            values = (own[name] for name in ("gain", "fidelity", "windowed_fidelity", "correlation"))
            table.add_row(*(one[name] for name in named), own["signal"], *map(decimal, values))
    return table


def gains_table(row: dict[str, Any]) -> Table:
    """The gain matrix of several channels, from the `summary` of a recall: off its diagonal is the cross-talk."""
    named, channels = _named(row), row["channels"]
    table = Table(title="Gain by channel", caption="what a channel gives back of what was written on each")
    for column in (*named, *(f"of {name}" for name in channels)):
        table.add_column(column, justify="left" if column in named else "right")
    for one in row["each"]:
        table.add_row(*(one[name] for name in named), *(decimal(one["gains"][name]) for name in channels))
    return table


def backgrounds_table(row: dict[str, Any]) -> Table:
    """Gain and fidelity with each background, from the `summary` of a recall with a second readout."""
    table = Table(title="By background")
    for column in ("background", "G", "F", "G over T1", "F over T1"):
        table.add_column(column, justify="left" if column == "background" else "right")
    for name, values in row["backgrounds"].items():
        table.add_row(name.upper(), *(f"{values[key]:.3f}" for key in analysis.MEASURES))
    return table


def second_readout_lines(row: dict[str, Any]) -> str:
    """The memory that the second readout still finds, as a text, from the `summary` of a recall."""
    left = row["second_readout"]
    error = " ± SE" if math.isfinite(left["gain_se"]) else ""
    return (
        f"second readout: correlation with J {decimal(left['correlation'], left['correlation_se'])},\n"
        f"gain {decimal(left['gain'], left['gain_se'], 4)} (mean{error} over signals)"
    )


def recall_table(rows: list[dict[str, Any]], configuration: dict[str, Any]) -> Table:
    """Gain and fidelity of recalls, without and with a mean over the ringing period, beside the published point.

    Args:
        rows: a `summary` for each pack; several packs get a line of mean and standard deviation.
        configuration: configuration of any of the recalls.
    """
    table, named = Table(title="Recall of the waveforms", caption=conditions(configuration)), _named(rows[0])
    texts = ("pack", *named, "status")  # may wrap in a narrow terminal; numbers are never cut
    for column in ("pack", *named, "G", "F", "G over T1", "F over T1", "T1 (t_c)", "status"):
        words = column in texts
        table.add_column(column, justify="left" if words else "right", no_wrap=not words, overflow="fold")
    for row in rows:
        ends = (cell(row["pack"]), f"{row['ringing_period']:.0f}", row["status_names"])
        for one in parts_of(row):
            places = (one[name] for name in named)
            numbers = [decimal(one[key]) for key in analysis.MEASURES]
            table.add_row(ends[0], *places, *numbers, *ends[1:])
            ends = ("",) * 3  # given once for all reads and channels
    if len(rows) > 1:
        table.add_section()
        for several in zip(*map(parts_of, rows), strict=True):
            means = [spread([one[key] for one in several]) for key in analysis.MEASURES]
            told = (NONE if math.isnan(mean) else f"{mean:.3f}\n± {sd:.3f}" for mean, sd, _ in means)
            table.add_row(f"mean ± SD ({len(rows)})", *(several[0][name] for name in named), *told)
    for point in _comparable(configuration):
        table.add_section()
        gain = f"{point['gain_mean']:.3f}\n± {point['gain_sd']:.3f}"
        fidelity = f"{point['fidelity_mean']:.3f}\n± {point['fidelity_sd']:.3f}"
        table.add_row(f"published ({point['n_packs']:.0f})", gain, fidelity)
    return table


def heading(configuration: dict[str, Any]) -> str:
    """The title of a picture of a recall: its pack and its conditions."""
    return f"{cell(configuration['pack'])}: {conditions(configuration)}"


def cell(value: Any) -> str:
    """A value as a short text for a table; an HDF5 file by its name without folder and suffix."""
    text = f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)
    return Path(text).stem if text.endswith(".h5") else text


def conditions(configuration: dict[str, Any]) -> str:
    """The main conditions of a recall: law, mu, gamma0, delta0, t0 and signals; the background if it is not SUB0.

    Effects that the paper does not have, such as creep, are named if they were given; and so are the stages of a
    protocol that is not the paper's.
    """
    known = values_of(configuration)
    first = ", ".join(f"{name} = {_amount(known[name])}" for name in ("mu", "gamma0", "delta0", "t0"))
    more = (
        f"{name} = {_amount(known[name])} {NUMBERS[name].metadata['unit']}".strip()
        for name in NOT_OF_PAPER
        if known.get(name) is not None
    )
    form = configuration.get("experiment", {}).get("signals", {})
    count = len(configuration.get("signals", ()))
    named = {"six": "the six signals", "words": f"all {count} words of {plural(form.get('bits'), 'bit')}"}
    named["sets"] = f"{len(form) - 1} sets of {plural(count, 'signal')}"
    stored = named.get(str(form.get("kind")), plural(count, "signal") if count else "")
    background = known.get("background", "sub0")
    subtracted = "" if background == "sub0" else background.upper()
    stages = _stages(configuration.get("experiment", {}).get("protocol"))
    return ", ".join(filter(None, (configuration["friction"], f"{first} t_c", *more, stored, subtracted, stages)))


def _stages(protocol: Any) -> str:
    """The stages of a protocol in written form as a text; "" for the paper's protocol."""
    given = protocol if isinstance(protocol, list) else ()
    names = [str(stage.get("name")) for stage in given if isinstance(stage, Mapping)]
    more = f", ... ({len(names)} in all)" if len(names) > FEW else ""
    return printable(f"stages {', '.join(names[:FEW])}{more}") if names else ""


def _amount(value: Any) -> str:
    low, high = np.min(value), np.max(value)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _comparable(configuration: dict[str, Any]) -> list[dict[str, Any]]:
    """Published points of the same experiment: signals, background, law, grain, size, drive and stages.

    There are none if t0 is below `SLOW_ENOUGH`. Parameters that the paper leaves open may have other values: one would
    change them to see the effect on the agreement.
    """
    written, known = configuration.get("experiment", {}), values_of(configuration)
    if written.get("signals") != {"kind": "six"} or known.get("background") != "sub0":
        return []
    if known["friction"] != "hooke" or not np.min(known["t0"]) >= SLOW_ENOUGH:
        return []
    as_published = ("shear", "store", "hold", "protocol", *NOT_OF_PAPER)
    if any(written.get(name) != getattr(Experiment, name) for name in as_published):
        return []
    same = {key: known[key] for key in ("mu", "delta0", "gamma0")}
    boundary = configuration["pack_record"].get("recipe", {}).get("boundary", "walls")
    if "sizes" in configuration["grain"] or boundary != "walls":
        return []
    shape = configuration["grain"]["shape"]
    kind, overlap = ("sphere", 1.0) if shape == "sphere" else _tetra(shape)
    return published(n_grains=float(configuration["grains"]), shape=kind, overlap=overlap, **same)


def reading_tables(result: dict[str, Any]) -> list[Table]:
    """Two tables from a `reading_report`: readers beside the published accuracy, and the error rate of each bit."""
    bits = result["bits"]
    title = f"Reading {result['words']} words of {plural(bits, 'bit')} ({result['background'].upper()})"
    readers_table = Table(
        title=title,
        caption="information in bits: plug-in, the most; bitwise, bit by bit; Fano, the least for these errors",
    )
    for column in ("reader", "accuracy", "plug-in", "bitwise", "Fano"):
        readers_table.add_column(column, justify="left" if column == "reader" else "right")
    errors_table = Table(title="Error rate by bit")
    errors_table.add_column("reader")
    for bit in range(bits):
        errors_table.add_column(f"{bit}" if bit else "0 (first)", justify="right")
    for name, row in result["readers"].items():
        deviation = "" if row["accuracy_sd"] is None else f" ± {row['accuracy_sd']:.3f}"
        known = (f"{row['information'][key]:.2f}" for key in ("plug_in", "bitwise", "fano"))
        label = f"{name} ({plural(len(result['nets']), 'seed')})" if name == "net" else name
        readers_table.add_row(label, f"{row['accuracy']:.3f}{deviation}", *known)
        errors_table.add_row(name, *(f"{error:.3f}" for error in row["bit_errors"]))
    for point in published("binary_words.csv", word_bits=float(bits)):
        readers_table.add_section()
        said = f"{point['classifier_accuracy']:.3f} ± {point['classifier_accuracy_sd']:.3f}"
        readers_table.add_row("published net (N = 10,240)", said)
    return [readers_table, errors_table]


def _tetra(shape: str) -> tuple[str, float]:
    """Kind and overlap of a shape like "tetra(0.6)"; for other shapes the overlap is NaN, which matches nothing."""
    kind, _, rest = shape.partition("(")
    return kind, float(rest.rstrip(")")) if kind == "tetra" else math.nan


def pack_table(pack: Pack) -> Table:
    """A table of the numbers of a pack."""
    unit = recorded_material(pack.info).modulus
    rest = pack.info.get("at_rest", {})
    recipe = pack.info.get("recipe", {})
    rows = [
        Fact("grains", f"{pack.grains} {pack.clump.shape}"),
        *([] if pack.clump.equal else [Fact("unequal", words_of_sizes(pack.clump))]),
        Fact("box", " x ".join(f"{x:.3f}" for x in np.asarray(pack.upper - pack.lower)), "R"),
        *([Fact("boundary", boundary_of(pack.periodic))] if any(pack.periodic) else []),
        Fact("meant for delta0" if "imported" in pack.info else "cycled with delta0", f"{float(pack.delta0):g}"),
        *([Fact("prepared under gravity", f"{weight:g}", "R/t_c^2")] if (weight := recipe.get("gravity")) else []),
        Fact("ringing period T1", f"{float(pack.ringing_period):.1f}", "t_c"),
        Fact("candidate contacts", int(np.asarray(pack.pairs.valid).sum())),
    ]
    if rest:
        pressures = ", ".join(f"{p * unit / 1e3:.2f}" for p in rest["pressure"])
        rows += [
            Fact("filling phi", f"{rest['filling']:.4f}"),
            Fact("coordination Z (grain pairs)", f"{rest['coordination']:.2f}"),
            Fact("sphere contacts, times two, per grain", f"{rest['contacts']:.2f}"),
        ]
        with_walls = 0.5 * rest["contacts"] + rest["wall_contacts"]
        rows.append(Fact("contacts per grain, with walls", f"{with_walls:.2f}"))
        rows.append(Fact("p_x, p_y, p_z", pressures, "kPa"))
        rows.append(Fact("largest speed", f"{rest['largest_speed']:.1e}", "R/t_c"))
        if (met := pressure_over_wanted(pack.info)) is not None:
            rows.append(Fact("p_z over the wanted one", f"{met:.2f}"))
    if recipe:
        rows.append(Fact("seed", recipe["seed"]))
    table = Table(title=f"Pack {pack.name}", show_header=False)
    for fact in rows:
        table.add_row(fact.name, fact.text)
    return table
