"""Making experiments from their written form (see `gmem_jax.experiment.record`), or from values by name.

The command line and sweep files give those names to the fields of an experiment and to those of its law.
"""

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import jax.numpy as jnp

from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.changes import replace
from gmem_jax.experiment.experiment import NUMBERS, OF_PAPER, Experiment
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.record import PARTS, pack_fingerprint, values_of
from gmem_jax.experiment.signals import Signals, SignalSets, signals
from gmem_jax.files.packs import load_pack
from gmem_jax.files.protocols import ProtocolFile, named_protocol, stage_value
from gmem_jax.files.validation import numbers, require, require_kinds
from gmem_jax.files.waveforms import OF_SAMPLES, OF_WORDS, named_signals, signals_from_dict, waveforms_of
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.laws import LAWS, law_named
from gmem_jax.physics.material import Material
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.compiled import require_x64
from gmem_jax.simulation.protocol import Protocol

OF_LAW = {entry.name: entry for law in reversed(LAWS) for entry in fields(law.kind)}
OF_MATERIAL = {entry.name: entry for entry in fields(Material) if entry.metadata.get("option")}
NAMES = ("signals", *OF_WORDS, *OF_SAMPLES, "protocol", "friction", *OF_LAW, *OF_MATERIAL, *NUMBERS)
STAGES = "protocol."  # prefix of the values of stages, as in "protocol.store.length"


def sets_from_dict(written: Mapping[str, Any]) -> Signals | SignalSets:
    """The waveforms of a written form, or several sets of them.

    Raises:
        ValueError: as in `signals_from_dict`.
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
    """The experiment that `to_dict` has written.

    Args:
        configuration: what `to_dict` returned.
        pack: the pack; default the one that the configuration names, read from its file or from those that ship.

    Raises:
        FileNotFoundError: if the pack is not there.
        FileFormatError: if the pack differs from the one that was written, or the configuration is of no experiment.
        ValueError: for impossible numbers, or laws and signals of the user's own, which cannot be made from it.
    """
    known = {entry.name for entry in fields(Experiment) if entry.init} - {"observe"}
    if odd := sorted(known ^ set(configuration)):
        problem = "its {} is missing" if odd[0] in known else "it has no field {}"
        raise FileFormatError(f"not the written form of an experiment: {problem.format(repr(odd[0]))}")
    of_pack = configuration["pack"]
    pack = load_pack(of_pack["source"]) if pack is None else pack
    if pack_fingerprint(pack) != of_pack["sha256"]:
        require_x64()  # in single precision no pack has the same hash
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
    """The material of a written form. An empty form gives the default material.

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


def recorded_material(configuration: Mapping[str, Any]) -> Material:
    """The material that a configuration records, or the default one. Errors are those of `material_from`."""
    return material_from(values_of(configuration).get("material", {}))


def with_protocol(values: Mapping[str, Any], named: Callable[[Any], ProtocolFile] = named_protocol) -> dict[str, Any]:
    """The values with the name of the protocol replaced by the protocol, and `signals` by those of its file, if any.

    Args:
        values: values by name; None stands for the default.
        named: gives the protocol of a name.

    Raises:
        ValueError: if the name is not that of a protocol, or one of the values does nothing beside it.
        FileNotFoundError: if there is no such file.
        FileFormatError: if the file does not make a protocol.
    """
    found, name = dict(values), values.get("protocol")
    if name is None or isinstance(name, Protocol):
        return found
    written = named(name)
    if written.signals:
        _refuse_beside("the protocol has [signals] of its own", values, ("signals", *OF_WORDS, *OF_SAMPLES))
        found["signals"] = written.signals
    return {**found, "protocol": written.protocol}


def _refuse_beside(why: str, values: Mapping[str, Any], names: tuple[str, ...]) -> None:
    if idle := [name for name in names if values.get(name) is not None]:
        raise ValueError(f"{idle[0]} does nothing: {why}")


def named_experiment(pack: Pack, values: Mapping[str, Any], signals: Signals | SignalSets | None = None) -> Experiment:
    """An experiment on a pack.

    Args:
        pack: the pack.
        values: values by name (`NAMES`, and dotted names like "friction.mu" and "protocol.store.length"); None stands
            for the default.
        signals: waveforms instead of those that `values` names.

    Raises:
        ValueError: for an unknown name, or impossible values.
        FileNotFoundError: if the file of the protocol or of the waveforms does not exist.
        FileFormatError: if such a file cannot be read.
    """
    require_kinds({name: value for name, value in values.items() if not isinstance(value, tuple)})  # a protocol's sets
    values = with_protocol(values)
    stages = {
        name: stage_value(name.rpartition(".")[2], value)
        for name, value in values.items()
        if name.startswith(STAGES) and value is not None
    }
    given = {
        name.removeprefix("friction."): value
        for name, value in values.items()
        if value is not None and name not in stages
    }
    twice = [name for name in given if values.get(name) is not None and values.get(f"friction.{name}") is not None]
    if twice:
        raise ValueError(f"{twice[0]} and friction.{twice[0]} are one; give one of them")
    if unknown := sorted(set(given) - set(NAMES)):
        raise ValueError(f"an experiment has no {unknown[0]!r}; it has {', '.join(NAMES)}")
    of_law = {name: given[name] for name in OF_LAW if name in given}
    law = law_named(str(given.get("friction", "hooke")), **of_law)
    if "protocol" in given or stages:
        _refuse_beside("stages of the protocol say that", given, OF_PAPER)
    own = {name: given[name] for name in NUMBERS if name in given}
    if {"steps", "dt"} <= set(own):
        raise ValueError("steps and dt: steps in a bin say what the time step is, so that dt does nothing; give one")
    material = Material(**{name: given[name] for name in OF_MATERIAL if name in given})
    signals = signals or named_signals(*waveforms_of(given))
    found = Experiment(pack, signals, law, material, protocol=given.get("protocol"), **own)  # type: ignore[arg-type]
    return replace(found, stages) if stages else found
