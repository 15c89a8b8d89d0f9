"""Experiments from their written form (see `gmem_jax.experiment.record`), and by the names of fields.

The command line and sweep files give those names to the fields of an experiment and to those of its law.
"""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import jax.numpy as jnp

from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.experiment import NUMBERS, Experiment
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.record import PARTS, pack_fingerprint
from gmem_jax.experiment.signals import Signals, SignalSets, signals
from gmem_jax.files.packs import load_pack
from gmem_jax.files.validation import numbers, require, require_kinds
from gmem_jax.files.waveforms import OF_SAMPLES, OF_WORDS, named_signals, signals_from_dict, waveforms_of
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.laws import LAWS, law_named
from gmem_jax.physics.material import Material
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.protocol import Protocol

OF_LAW = {entry.name: entry for law in reversed(LAWS) for entry in fields(law.kind)}
OF_MATERIAL = {entry.name: entry for entry in fields(Material) if entry.metadata.get("option")}
NAMES = ("signals", *OF_WORDS, *OF_SAMPLES, "friction", *OF_LAW, *OF_MATERIAL, *NUMBERS)


def sets_from_dict(written: Mapping[str, Any]) -> Signals | SignalSets:
    """The waveforms of a written form, or several sets of them.

    Raises:
        ValueError: as of `signals_from_dict`.
    """
    if written["kind"] != "sets":
        return signals_from_dict(written)
    return signals(**{name: signals_from_dict(one) for name, one in written.items() if name != "kind"})


def _number(value: Any) -> Any:
    return jnp.asarray(value, float) if isinstance(value, list) else value


def _law_from(written: Mapping[str, Any]) -> FrictionLaw:
    require_kinds(written)
    parameters = {name: _number(value) for name, value in written.items() if name != "law"}
    return law_named(written["law"], **parameters)


@usual_rules()
def from_dict(configuration: Mapping[str, Any], pack: Pack | None = None) -> Experiment:
    """The experiment of a written form.

    Args:
        configuration: what `to_dict` gave.
        pack: its pack; default the one that it names, read from its file or from those that ship.

    Raises:
        FileNotFoundError: if the pack is not there.
        FileFormatError: if the pack is another one than was written, or the form is not one of an experiment.
        ValueError: for impossible numbers, or own laws and signals, which have no written form.
    """
    known = {entry.name for entry in fields(Experiment) if entry.init} - {"observe"}
    if odd := sorted(known ^ set(configuration)):
        problem = "its {} is missing" if odd[0] in known else "it has no field {}"
        raise FileFormatError(f"not the written form of an experiment: {problem.format(repr(odd[0]))}")
    of_pack = configuration["pack"]
    pack = load_pack(of_pack["source"]) if pack is None else pack
    if pack_fingerprint(pack) != of_pack["sha256"]:
        raise FileFormatError(f"{of_pack['source']}: not the pack that this was made with (its content has changed)")
    require_kinds({name: value for name, value in configuration.items() if name not in PARTS})
    require_kinds(configuration["material"])
    own = {name: _number(value) for name, value in configuration.items() if name not in PARTS}
    if configuration["protocol"] is not None:
        own["protocol"] = Protocol.from_list(configuration["protocol"])
    material = material_from(configuration["material"])
    return Experiment(
        pack, sets_from_dict(configuration["signals"]), _law_from(configuration["friction"]), material, **own
    )


def material_from(written: Mapping[str, Any]) -> Material:
    """The material of a written form; the default of none.

    Raises:
        FileFormatError: if it has a field that no material has.
        ValueError: for impossible numbers.
    """
    require(
        isinstance(written, Mapping) and all(map(numbers, written.values())), "its material is no object of numbers"
    )
    known = {entry.name for entry in fields(Material)}
    if odd := sorted(set(written) - known):
        raise FileFormatError(f"its material has a field {odd[0]!r}, which none has")
    return Material(**{name: _number(value) for name, value in written.items() if name in known})


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
