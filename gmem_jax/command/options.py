"""Options that describe an experiment: the same for every command, their defaults those of `Experiment` and its law."""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from gmem_jax.command.console import claim, refuse_idle, say
from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.signals import Signals
from gmem_jax.files.named import named_experiment, named_signals, waveforms_of
from gmem_jax.files.packs import load_pack
from gmem_jax.files.waveforms import load_target
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.laws import LAWS, law_named
from gmem_jax.preparation.recipe import Recipe, words_of

_NAMES = ", ".join(entry.name for entry in LAWS)


class _Option(NamedTuple):
    kind: Any
    words: str
    flags: tuple[str, ...] = ()


_FIELDS = {  # of an experiment
    "gamma0": _Option(float, "Shear amplitude."),
    "shear_share": _Option(float, "Part of gamma by which L_x shrinks and L_y grows."),
    "delta0": _Option(float | None, "Areal compression; default the pack's own."),
    "t0": _Option(float, "Duration of one compression, t_c (the paper's is 18000)."),
    "dt": _Option(float, "Largest time step, t_c."),
    "rest": _Option(float, "Rests at u = 0, in t0."),
    "hold": _Option(float, "Holds at u = 1, in t0."),
    "store": _Option(float, "Storage, in t0."),
    "hold_drag": _Option(float | None, "Drag in holds, 1/t_c; default 0.05 if t0 < 18000."),
    "background": _Option(str, "sub0, sub2 or sub2-bl."),
    "shear": _Option(str, "during the compression, or before it (in time, at u = 0)."),
    "backend": _Option(str, "auto, jax or native."),
    "precision": _Option(str, "double; or mixed, contacts in single precision (native)."),
}
_OF_LAW = {  # of its friction law
    "mu": _Option(float, "Friction coefficient."),
    "stiffness": _Option(float | None, "k_H in E R, or k_M in E R^0.5; default the law's."),
    "damping_time": _Option(float | None, "Tangential damping over stiffness, t_c; default the law's."),
    "spinning": _Option(float | None, "1: the history turns with a contact about its normal; 0: not."),
    "p_max": _Option(float | None, "m2: largest overlap of its history, R."),
    "points": _Option(int | None, "m2: points of its history."),
    "variant": _Option(str | None, "m2: averaged, exact or paper."),
}
_OTHERS = {
    "signals": _Option(
        str, "six; words:L, all words of L bits; or a .npy or .csv file (a column per signal, one may be time)."
    ),
    "word_pad": _Option(float | None, "words: bits left free at either end; default 2."),
    "word_width": _Option(float | None, "words: width of bumps, in bits; default 1."),
    "smooth": _Option(float | None, "Samples in a file: width in u over which they are averaged."),
    "taper": _Option(
        float | None, "Samples in a file: width in u at either end within which they are brought to zero."
    ),
    "scale": _Option(bool | None, "Samples in a file: divide them by the largest.", ("--scale",)),
    "wall_rigidity": _Option(float | None, "Stiffness of walls over that of rigid ones; default 1."),
    "friction": _Option(str, f"Friction law: {_NAMES}, or the paper's H, M1, M2."),
}


class Chosen:
    """What the options of a command chose; a pack makes an experiment of it."""

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values

    def with_signals(self, name: str) -> "Chosen":
        """The same, but for the signals."""
        return Chosen({**self._values, "signals": name})

    def claim(
        self, packs: Sequence[str], output: Path, suffix: str, *, picture: bool, force: bool
    ) -> tuple[list[Experiment], Path | None]:
        """The experiments on some packs, once it is sure that the output and the picture beside it can be written.

        Raises:
            ValueError: for impossible values, or an output that would destroy something.
            FileNotFoundError: if there is no such pack.
        """
        experiments = [self.experiment(pack) for pack in packs]
        inputs = (*packs, self._values["signals"])
        claim(output, suffix, inputs=inputs, force=force)
        drawn = claim(output.with_suffix(".png"), ".png", inputs=inputs, force=force) if picture else None
        return experiments, drawn

    def target(self, count: int) -> Signals | None:
        """The waveforms that the `count` chosen ones were designed to be recalled as; None if they were not designed.

        Raises:
            FileFormatError: if their file has another target.
        """
        name = self._values["signals"]
        target = load_target(Path(name)) if Path(name).suffix.lower() == ".csv" else None
        if target is not None and target.count != count:
            raise FileFormatError(f"{name}: its target has {target.count} signals, must have {count}")
        return target

    def experiment(self, pack: str) -> Experiment:
        """The experiment on a pack file, or a shipped pack.

        Raises:
            ValueError: for impossible values.
            FileNotFoundError: if there is no such pack.
        """
        values = dict(self._values)
        if law_named(values["friction"]) == Frictionless():
            refuse_idle(f"with --friction {values['friction']}", "mu")
            values["mu"] = None  # the option's default is not for this law
        return named_experiment(load_pack(pack), values, self._signals)

    @functools.cached_property
    def _signals(self) -> Signals:
        return named_signals(*waveforms_of(self._values), told=say)


def _default(name: str) -> Any:
    if name in _FIELDS:
        return next(entry.default for entry in fields(Experiment) if entry.name == name)
    return {"signals": "six", "friction": "hooke", "mu": Hooke().mu}.get(name)


def with_experiment(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command all options of an experiment; it gets what they chose as `chosen`."""
    options = {
        name: (_default(name), option.kind, option.words, option.flags)
        for name, option in {**_OTHERS, **_OF_LAW, **_FIELDS}.items()
    }
    return _with(command, "chosen", Chosen, options)


def with_recipe(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command every number of a preparation as an option; it gets the `recipe` that they make."""
    options = {entry.name: (entry.default, entry.type, words_of(entry), ()) for entry in fields(Recipe)}
    return _with(command, "recipe", lambda values: Recipe(**values), options)


def _with(
    command: Callable[..., None],
    name: str,
    make: Callable[[dict[str, Any]], Any],
    options: Mapping[str, tuple[Any, Any, str, tuple[str, ...]]],
) -> Callable[..., None]:
    """A command with more options (default, type, help, flags); it gets what `make` makes of their values as `name`."""
    signature = inspect.signature(command)
    own = [entry for entry in signature.parameters.values() if entry.name != name]
    added = [
        inspect.Parameter(
            option,
            inspect.Parameter.KEYWORD_ONLY,
            default=default,
            annotation=Annotated[kind, typer.Option(*flags, help=words)],
        )
        for option, (default, kind, words, flags) in options.items()
    ]

    @functools.wraps(command)
    def wrapper(**given: Any) -> None:
        made = make({option: given.pop(option) for option in options})
        command(**{name: made}, **given)

    wrapper.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[entry.replace(kind=inspect.Parameter.KEYWORD_ONLY) for entry in own] + added
    )
    return wrapper
