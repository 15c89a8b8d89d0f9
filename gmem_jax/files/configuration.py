"""Experiments from their written form; see `gmem_jax.experiment.record`."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import jax.numpy as jnp

from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.record import PARTS, SIGNALS, pack_fingerprint
from gmem_jax.experiment.signals import PAD, WIDTH, Signals, SignalSets, signals, six_signals, words
from gmem_jax.files.packs import load_pack
from gmem_jax.files.validation import numbers, require, require_kinds
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.laws import law_named
from gmem_jax.physics.material import Material
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.protocol import Protocol


def sets_from_dict(written: Mapping[str, Any]) -> Signals | SignalSets:
    """The waveforms of a written form, or several sets of them.

    Raises:
        ValueError: as of `signals_from_dict`.
    """
    if written["kind"] != "sets":
        return signals_from_dict(written)
    return signals(**{name: signals_from_dict(one) for name, one in written.items() if name != "kind"})


def signals_from_dict(written: Mapping[str, Any]) -> Signals:
    """The waveforms of a written form.

    Raises:
        ValueError: if they are of a kind that has none, or its numbers make no waveforms.
    """
    require_kinds(written)
    kind = written["kind"]
    if kind == "six":
        return six_signals()
    if kind == "words":
        return words(written["bits"], written.get("pad", PAD), written.get("width", WIDTH))
    if kind not in SIGNALS:
        raise ValueError(f"signals of kind {kind!r} cannot be read back")
    numbers = {name: value for name, value in written.items() if name != "kind"}
    made: Signals = SIGNALS[kind](**{name: _number(value) for name, value in numbers.items()})
    return made


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
