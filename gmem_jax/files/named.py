"""Experiments by the names that the command line and sweep files give to their fields and to those of their law."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from gmem_jax.experiment.experiment import NUMBERS, Experiment
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.samples import Told, untold
from gmem_jax.experiment.signals import LONGEST_WORD, Signals, six_signals, waveform, words
from gmem_jax.files.validation import require_kinds
from gmem_jax.files.waveforms import load_waveforms
from gmem_jax.physics.contact.laws import LAWS, law_named
from gmem_jax.physics.material import Material

OF_LAW = {entry.name: entry for law in reversed(LAWS) for entry in fields(law.kind)}
OF_MATERIAL = {entry.name: entry for entry in fields(Material) if entry.metadata.get("option")}
OF_WORDS = ("word_pad", "word_width")
OF_SAMPLES = ("smooth", "taper", "scale")
NAMES = ("signals", *OF_WORDS, *OF_SAMPLES, "friction", *OF_LAW, *OF_MATERIAL, *NUMBERS)


def named_signals(
    name: str,
    pad: float | None = None,
    width: float | None = None,
    smooth: float | None = None,
    taper: float | None = None,
    scale: bool | None = None,
    *,
    told: Told = untold,
) -> Signals:
    """Waveforms by what the command line calls them.

    Args:
        name: "six", "words:3" or a file.
        pad: of words; None stands for the default.
        width: of their bumps.
        smooth: of the samples in a file: see `load_waveforms`.
        taper: of them.
        scale: of them.
        told: what was found in a file and changed.

    Raises:
        ValueError: if the name is none, or waveforms are given what they cannot have.
        FileNotFoundError: if there is no such file.
        FileFormatError: if a file cannot be read.
    """
    kind, _, length = name.lower().partition(":")
    shape = {name: float(value) for name, value in (("pad", pad), ("width", width)) if value is not None}
    done: dict[str, Any] = {"smooth": smooth, "taper": taper, "scale": scale}
    done = {name: value for name, value in done.items() if value is not None}
    if shape and kind != "words":
        raise ValueError(f"--signals {name}: word_pad and word_width are for words:L only")
    if done and kind in ("six", "words"):
        raise ValueError(f"--signals {name}: {', '.join(done)}: for samples in a file only")
    if kind == "six":
        return six_signals()
    if kind == "words":
        if not length.isdecimal() or not 1 <= int(length) <= LONGEST_WORD:
            raise ValueError(f"--signals {name}: words need a length from 1 to {LONGEST_WORD}, as in words:3")
        return words(int(length), **shape)
    if Path(name).suffix.lower() not in (".csv", ".npy"):
        raise ValueError(f'--signals {name}: must be "six", "words:L" or a .csv or .npy file')
    return waveform(load_waveforms(Path(name), told=told, **done))


def named_experiment(pack: Pack, values: Mapping[str, Any], signals: Signals | None = None) -> Experiment:
    """An experiment on a pack.

    Args:
        pack: the pack.
        values: by name (`NAMES`; dotted ones like "friction.mu" too); None stands for the default.
        signals: in the place of those that `values` names.

    Raises:
        ValueError: for an unknown name, or impossible values.
    """
    require_kinds(values)
    given = {name.removeprefix("friction."): value for name, value in values.items() if value is not None}
    twice = [name for name in given if values.get(name) is not None and values.get(f"friction.{name}") is not None]
    if twice:
        raise ValueError(f"{twice[0]} and friction.{twice[0]} are one; give one of them")
    if unknown := sorted(set(given) - set(NAMES)):
        raise ValueError(f"an experiment has no {unknown[0]!r}; it has {', '.join(NAMES)}")
    of_law = {name: given[name] for name in OF_LAW if name in given}
    law = law_named(str(given.get("friction", "hooke")), **of_law)
    own = {name: given[name] for name in NUMBERS if name in given}
    if {"steps", "dt"} <= set(own):
        raise ValueError("steps and dt: steps in a bin say what the time step is, so that dt does nothing; give one")
    material = Material(**{name: given[name] for name in OF_MATERIAL if name in given})
    return Experiment(pack, signals or named_signals(*waveforms_of(given)), law, material, **own)


def waveforms_of(values: Mapping[str, Any]) -> tuple[Any, ...]:
    """The arguments of `named_signals` among named values."""
    return str(values.get("signals", "six")), *(values.get(name) for name in (*OF_WORDS, *OF_SAMPLES))
