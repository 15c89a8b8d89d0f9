"""How much G and F change with each choice that the paper leaves open, on the same packs."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from gmem_jax.physics.state import combined_status
from gmem_jax.reproduce.compare import Estimate, counted
from gmem_jax.reproduce.figures import SCALES, Scale, Values, crossed
from gmem_jax.show.render_matplotlib import pyplot, save_picture

_NOTHING: Values = {}


class Choice(NamedTuple):
    """A choice that the paper leaves open.

    Attributes:
        name: its name in a sweep file.
        words: a description.
        values: the values that are tried, the default first.
        shared: further values that all its points have.
    """

    name: str
    words: str
    values: tuple[Any, ...]
    shared: Values = _NOTHING


_WORDS: Values = {"signals": "words:3", "background": "sub2-bl"}
CHOICES = (
    Choice("shear_share", "part of gamma on each axis", (0.5, 0.25, 1.0)),
    Choice("stiffness", "k_H (E R)", (0.13, 0.10, 0.12, 0.145, 0.18)),
    Choice("wall_rigidity", "stiffness of walls over rigid ones", (1.0, 0.5, 2.0)),
    Choice("spinning", "history turns about the normal", (1.0, 0.0)),
    Choice("rest", "rests (t0)", (0.2, 0.05, 0.8)),
    Choice("dt", "time step (t_c)", (0.6, 0.365, 1.2)),
    Choice("variant", "M2's outermost ring", ("averaged", "exact", "paper"), {"friction": "M2"}),
    Choice("word_pad", "free bits at the ends of words", (2.0, 1.0, 3.0), _WORDS),
    Choice("word_width", "width of the bumps of words (bits)", (1.0, 0.5, 1.5), _WORDS),
)
# The packs are smaller than those of the figures, since there are many points.
SIZES: dict[str, Scale] = SCALES | {"workstation": replace(SCALES["workstation"], t0=3.6e3, grains=1024)}


class Effect(NamedTuple):
    """The effect of one value of a choice.

    Attributes:
        choice: the choice.
        value: the value.
        gain: mean of G over packs.
        fidelity: mean of F over packs.
        of_gain: mean over packs of the relative change of G against the default on the same pack; 0 for the default.
        of_fidelity: mean over packs of the change of F against the default on the same pack; 0 for the default.
        status: all status bits of the recalls.
    """

    choice: Choice
    value: Any
    gain: Estimate
    fidelity: Estimate
    of_gain: Estimate
    of_fidelity: Estimate
    status: int

    @property
    def default(self) -> bool:
        """Whether the value is the default."""
        return bool(self.value == self.choice.values[0])


def _values(choice: Choice, value: Any) -> Values:
    """The values of a point, without its pack. The default value is left out, so that all choices share that point."""
    return choice.shared if value == choice.values[0] else {**choice.shared, choice.name: value}


def choice_points(packs: Sequence[Values]) -> list[Values]:
    """The points that the table needs, on some packs; each occurs once."""
    tried = [_values(choice, value) for choice in CHOICES for value in choice.values]
    return crossed(packs, [values for place, values in enumerate(tried) if values not in tried[:place]])


def effects(packs: Sequence[Values], runs: Iterable[tuple[Values, dict[str, Any]]], t0: float) -> list[Effect]:
    """Every value of every choice beside its default, pack by pack.

    Args:
        packs: values that name the packs.
        runs: values of points and summaries of their recalls (`show.numbers.summary`); points that failed are missing.
            A value that makes the same run as the default, as steps longer than a bin do, is left out.
        t0: duration of a compression in these runs, in t_c; below the paper's, G and F are those after a running mean
            over the ringing period.
    """
    known = list(runs)

    def at(pack: Values, values: Values) -> dict[str, Any] | None:
        return next((numbers for own, numbers in known if own == {**pack, **values}), None)

    found = []
    for choice in CHOICES:
        for value in choice.values:
            both = [(at(pack, choice.shared), at(pack, _values(choice, value))) for pack in packs]
            pairs = [(default, tried) for default, tried in both if default and tried]
            if pairs and (value == choice.values[0] or any(_differ(*pair) for pair in pairs)):
                found.append(_effect(choice, value, pairs, t0))
    return found


def _differ(default: Mapping[str, Any], tried: Mapping[str, Any]) -> bool:
    """Whether two runs differ: the same run gives the same measures to the last bit."""
    return any(default[name] != tried[name] for name in ("gain", "fidelity", "windowed_gain", "windowed_fidelity"))


def _effect(choice: Choice, value: Any, pairs: Sequence[tuple[Any, Any]], t0: float) -> Effect:
    gain, fidelity = counted(t0)
    of_gain = [tried[gain] / default[gain] - 1.0 for default, tried in pairs]
    of_fidelity = [tried[fidelity] - default[fidelity] for default, tried in pairs]
    own = [Estimate.of([tried[name] for _, tried in pairs]) for name in (gain, fidelity)]
    status = combined_status([tried["status"] for _, tried in pairs])
    return Effect(choice, value, own[0], own[1], Estimate.of(of_gain), Estimate.of(of_fidelity), status)


def _row(effect: Effect) -> dict[str, Any]:
    named = {"G": effect.gain, "F": effect.fidelity, "dG_over_G": effect.of_gain, "dF": effect.of_fidelity}
    numbers: dict[str, str] = {}
    for name, estimate in named.items():
        numbers |= {name: f"{estimate.mean:.4f}", f"{name}_sd": "" if estimate.packs < 2 else f"{estimate.sd:.4f}"}
    at = " ".join(f"{name}={value}" for name, value in effect.choice.shared.items())
    about = {"choice": effect.choice.name, "meaning": effect.choice.words, "with": at, "value": effect.value}
    return {**about, "default": int(effect.default), **numbers, "packs": effect.gain.packs, "status": effect.status}


def effect_rows(found: Sequence[Effect]) -> list[dict[str, Any]]:
    """Rows of a table with every value of every choice."""
    return [_row(effect) for effect in found]


def draw(path: Path, found: Sequence[Effect], title: str) -> None:
    """Draw the changes of G and of F with every value that is not the default, with standard errors over packs.

    Raises:
        OSError: if it cannot be written.
    """
    shown = [effect for effect in found if not effect.default]
    figure, axes = pyplot().subplots(1, 2, figsize=(10.5, 0.3 * len(shown) + 1.6), sharey=True)
    places = range(len(shown))
    for axis, label, numbers, unit in (
        (axes[0], "change of G (%)", [effect.of_gain for effect in shown], 100.0),
        (axes[1], "change of F", [effect.of_fidelity for effect in shown], 1.0),
    ):
        means = [unit * one.mean for one in numbers]
        errors = [unit * one.error for one in numbers] if numbers and numbers[0].packs > 1 else None
        names = list(dict.fromkeys(effect.choice.name for effect in shown))
        colours = [f"C{names.index(effect.choice.name) % 10}" for effect in shown]
        axis.barh(places, means, xerr=errors, color=colours, height=0.6, capsize=2)
        axis.axvline(0.0, color="0.3", linewidth=0.8)
        axis.set_xlabel(label)
    axes[0].set_yticks(places, [_label(effect) for effect in shown], fontsize=8)
    axes[0].invert_yaxis()
    figure.suptitle(title, fontsize=10)
    save_picture(path, figure, also=(".svg",))


def choices_title(scale: Scale, packs: int) -> str:
    """The title of the picture, for a number of packs."""
    of = "one pack" if packs == 1 else f"mean ± SE over {packs} packs"
    return f"What the paper leaves open\nN = {scale.grains:,}, $t_0$ = {scale.t0:,.0f} $t_c$, {of}"


def _label(effect: Effect) -> str:
    default = effect.choice.values[0]
    shown = [f"{value:g}" if isinstance(value, float) else str(value) for value in (effect.value, default)]
    return f"{effect.choice.words}: {shown[0]} for {shown[1]}"
