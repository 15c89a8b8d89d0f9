"""Options that describe an experiment: the same for every command, their defaults those of `Experiment` and its law."""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, fields
from pathlib import Path
from typing import Annotated, Any

import typer

from gmem_jax.command.console import check_output, log, refuse_idle
from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.experiment import NUMBERS, OF_PAPER, Experiment
from gmem_jax.experiment.signals import Signals, SignalSets
from gmem_jax.files.configuration import OF_LAW, OF_MATERIAL, named_experiment
from gmem_jax.files.packs import load_pack
from gmem_jax.files.protocols import named_protocol, ready_protocols
from gmem_jax.files.waveforms import OF_SAMPLES, OF_WORDS, load_target, named_signals, sets_named, waveforms_of
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.laws import LAWS, law_named
from gmem_jax.preparation.recipe import Recipe, words_of

_NAMES = ", ".join(entry.name for entry in LAWS)
_Options = Mapping[str, tuple[Any, Any, str, tuple[str, ...]]]  # default, type, help and flags by name

_OTHERS: _Options = {
    "signals": (
        "six",
        str,
        "Waveforms: six, the paper's; words:L, all words of L bits; or a file: .csv, a column per signal (one may be "
        "time), .npy, a row per signal. "
        "For several channels or writes NAME=six,NAME=words:L.",
        (),
    ),
    "word_pad": (None, float | None, "words: free widths of a bit at either end; default 2.", ()),
    "word_width": (None, float | None, "words: width of the bumps, in widths of a bit; default 1.", ()),
    "smooth": (None, float | None, "Samples in a file: width in u over which they are averaged.", ()),
    "taper": (
        None,
        float | None,
        "Samples in a file: width in u at either end within which they are brought to zero.",
        (),
    ),
    "scale": (None, bool | None, "Samples in a file: divide them by the largest absolute value.", ("--scale",)),
    "protocol": (
        None,
        str | None,
        f"Another protocol than the paper's: {', '.join(['a .toml file', *ready_protocols()])}.",
        (),
    ),
    "friction": ("hooke", str, f"Friction law: {_NAMES}, or the paper's H, M1, M2.", ()),
}


def _options(entries: Mapping[str, Field[Any]], **defaults: Any) -> _Options:
    """Options for fields that have `words` in their metadata: numbers of an experiment, of laws and of materials.

    Args:
        entries: the fields.
        defaults: defaults by name, instead of those of the fields.
    """
    found = {}
    for name, entry in entries.items():
        default, unit = defaults.get(name, entry.default), entry.metadata["unit"]
        kind = type(entry.default) if entry.default is not None else float
        words = f"{entry.metadata['words']}{unit and f' (in {unit})'}."
        if not entry.metadata.get("no_option"):
            found[name] = (default, kind if default is not None else kind | None, words, ())
    return found


class ExperimentOptions:
    """The values of a command's options, which make an experiment on any pack."""

    def __init__(self, values: dict[str, Any]) -> None:
        self._values, self._inputs = values, [values["signals"]]
        if not isinstance(values["protocol"], str):
            return
        refuse_idle(f"with --protocol {values['protocol']}, whose stages say that", *OF_PAPER)
        written = named_protocol(values["protocol"])
        self._inputs.append(values["protocol"])
        self._values = {**values, "protocol": written.protocol, **dict.fromkeys(OF_PAPER)}
        if written.signals:
            refuse_idle(f"beside [signals] in {values['protocol']}", "signals", *OF_WORDS, *OF_SAMPLES)
            self._values["signals"] = written.signals

    def with_signals(self, name: str) -> "ExperimentOptions":
        """The same options with other signals."""
        return ExperimentOptions({**self._values, "signals": name})

    def check_output(
        self,
        packs: Sequence[str],
        output: Path,
        suffix: str,
        *,
        picture: bool,
        force: bool,
        inputs: Sequence[Path] = (),
        pictures: Sequence[Path] = (),
    ) -> tuple[list[Experiment], Path | None]:
        """Make the experiments on some packs, and make sure that the output and the picture beside it can be written.

        Args:
            packs: pack files, or shipped packs.
            output: the file to write.
            suffix: the suffix that its name must have.
            picture: whether pictures are drawn.
            force: whether files that exist may be replaced.
            inputs: further files that the command reads.
            pictures: further pictures that it draws.

        Raises:
            ValueError: for impossible values, or an output that would destroy something.
            FileNotFoundError: if there is no such pack.
        """
        experiments = [self.experiment(pack) for pack in packs]
        of_sets = [file for _, file in sets_named(self._values["signals"])]
        read = (*packs, *self._inputs, *of_sets, *inputs)
        check_output(output, suffix, inputs=read, force=force)
        every = (output.with_suffix(".png"), *pictures) if picture else ()
        drawn = [check_output(path, ".png", inputs=read, force=force) for path in every]
        return experiments, drawn[0] if drawn else None

    def target(self, count: int) -> Signals | None:
        """The target of the design of the `count` chosen waveforms; None if they were not designed.

        Raises:
            FileFormatError: if the target in their file has another number of signals.
        """
        name = self._values["signals"]
        alone = not sets_named(name) and Path(name).suffix.lower() == ".csv"
        target = load_target(Path(name)) if alone else None
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
    def _signals(self) -> Signals | SignalSets:
        return named_signals(*waveforms_of(self._values), told=log)


def experiment_options() -> _Options:
    """All options of an experiment."""
    of_law = _options(OF_LAW, **{**dict.fromkeys(OF_LAW), "mu": Hooke().mu})  # None: the law's own default
    of_material = _options(OF_MATERIAL, **dict.fromkeys(OF_MATERIAL))
    return {**_OTHERS, **of_law, **of_material, **_options(NUMBERS)}


def with_experiment(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command all options of an experiment; it gets their values as `chosen`, an `ExperimentOptions`."""
    return _with(command, "chosen", ExperimentOptions, experiment_options())


def with_recipe(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command every number of a preparation as an option; it gets them as `recipe`."""
    options = {entry.name: (entry.default, entry.type, words_of(entry), ()) for entry in fields(Recipe)}
    return _with(command, "recipe", lambda values: Recipe(**values), options)


def _with(
    command: Callable[..., None], name: str, make: Callable[[dict[str, Any]], Any], options: _Options
) -> Callable[..., None]:
    """A command with further options; it gets the result of `make`, called with their values, as argument `name`."""
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
