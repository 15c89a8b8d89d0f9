"""The written form of an experiment in files and keys, and where and by which code it was run."""

import json
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.identity import fingerprint, identity
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.provenance import provenance, sources
from gmem_jax.experiment.signals import Bumps, Signals, SignalSets, Spline, sets_of, six_signals, word_bits, words
from gmem_jax.physics.contact.friction import CoulombLaw, FrictionLaw
from gmem_jax.physics.contact.laws import entry_of
from gmem_jax.physics.grain import words_of_sizes
from gmem_jax.physics.material import Material
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.observables import Observable

NAMED: dict[str, Callable[..., Bumps]] = {"six": six_signals, "words": words}
SIGNALS = {"bumps": Bumps, "spline": Spline}
PARTS = ("pack", "signals", "friction", "material", "protocol", "observe")
"""Fields of an experiment that are not numbers. Observers change no numbers: the written form leaves them out."""


def pack_fingerprint(pack: Pack) -> str:
    """SHA-256 of the numbers of a pack: grain, centres, orientations, box, delta0, T_1; not of its neighbour list."""
    at = (pack.position, pack.quaternion, pack.lower, pack.upper)
    beyond = (np.asarray(pack.periodic),) if any(pack.periodic) else ()
    return fingerprint((pack.clump, *at, pack.delta0, pack.ringing_period, *beyond))


def plain(value: Any) -> Any:
    """The value of a parameter as a number, text or list, which JSON holds exactly."""
    return value if isinstance(value, float | int | str | None) else np.asarray(value).tolist()


def signals_to_dict(signals: Signals | SignalSets) -> dict[str, Any]:
    """Waveforms as JSON: by the call that made them if their numbers are unchanged since, else by their numbers."""
    if isinstance(signals, SignalSets):
        return {"kind": "sets", **{name: signals_to_dict(one) for name, one in sets_of(signals).items()}}
    if type(signals) is Bumps and signals.form:  # a class of the user's own may give other waveforms
        form: dict[str, Any] = json.loads(signals.form)
        named = NAMED[form["kind"]](**{name: value for name, value in form.items() if name != "kind"})
        if fingerprint(signals) == fingerprint(named):
            return form
    if kind := next((kind for kind, known in SIGNALS.items() if known is type(signals)), None):
        numbers = (entry.name for entry in fields(SIGNALS[kind]) if entry.init)
        return {"kind": kind, **{name: plain(getattr(signals, name)) for name in numbers}}
    return {"kind": type(signals).__name__, "sha256": fingerprint(signals)}


def names_of(signals: Signals | SignalSets) -> list[str]:
    """Names of the signals: the bits of a word; for others "signal 1", "signal 2", ..."""
    form = signals_to_dict(signals)
    if form["kind"] == "words":
        return ["".join(map(str, row)) for row in word_bits(form["bits"])]
    return [f"signal {number + 1}" for number in range(signals.count)]


def law_to_dict(law: FrictionLaw) -> dict[str, Any]:
    """A friction law as JSON: its name and parameters."""
    entry = entry_of(law)
    if entry is None:
        return {"law": repr(law)}
    return {"law": entry.name, **{item.name: plain(getattr(law, item.name)) for item in fields(entry.kind)}}


@usual_rules()
def to_dict(experiment: Experiment) -> dict[str, Any]:
    """An experiment as a dictionary that JSON can hold: every field but `observe`; the pack by its source and SHA-256.

    `from_dict` makes the same experiment of it, if the law and the waveforms are of this library. A law of the user's
    own is written as its `repr`, and waveforms of the user's own as the name of their class and a hash.
    """
    require_kind("to_dict", experiment, Experiment)
    pack = experiment.pack
    numbers = [entry.name for entry in fields(Experiment) if entry.init and entry.name not in PARTS]
    material = experiment.material
    return {
        "pack": {"source": pack.source or pack.name, "name": pack.name, "sha256": pack_fingerprint(pack)},
        "signals": signals_to_dict(experiment.signals),
        "friction": law_to_dict(experiment.friction),
        "material": {entry.name: plain(getattr(material, entry.name)) for entry in fields(Material)},
        **{name: plain(getattr(experiment, name)) for name in numbers},
        "protocol": None if experiment.is_paper else experiment.protocol.to_list(),
    }


def key_of_run(experiment: Experiment, **more: Any) -> dict[str, Any]:
    """The key of a run, for parts of it that may be used again: everything that its numbers depend on, and no more.

    Args:
        experiment: the experiment.
        **more: other things that the numbers depend on, like the batch.
    """
    own = {**to_dict(experiment), "pack": pack_fingerprint(experiment.pack)}
    if entry_of(experiment.friction) is None:
        own["law"] = identity(experiment.friction)
    for name, one in experiment.sets.items():
        if type(one) not in SIGNALS.values():
            own[f"signals {name}"] = identity(one)
    if experiment.observe:  # parts of a run with other observers lack the arrays of these
        own["observe"] = [(name, identity(reduce)) for name, reduce in experiment.observe]
    return {**own, **more, "backend": experiment.runs_on, **sources()}


@usual_rules()
def describe(experiment: Experiment, seconds: float = 0.0) -> dict[str, Any]:
    """The configuration that is kept with a result, as a dictionary that JSON can hold.

    It has the experiment as `to_dict` writes it, the values of its defaults, facts about the pack, the names of
    signals, reads and channels, and where it ran: versions, device and backend.

    Args:
        experiment: the experiment, not traced.
        seconds: wall time of the call that finished the run, in s; 0 if it was not measured.
    """
    pack, law, entry = experiment.pack, experiment.friction, entry_of(experiment.friction)
    dt, steps = experiment.timing
    clump = pack.clump
    return {
        "experiment": to_dict(experiment),
        "pack": pack.source or pack.name,
        "grains": pack.grains,
        "grain": {
            "shape": clump.shape,
            "mass": float(clump.mass),
            "diameter": float(clump.diameter),
            **({} if clump.equal else {"sizes": words_of_sizes(clump)}),
        },
        "pack_record": pack.info,
        "signals": names_of(experiment.signals),
        "reads": list(experiment.readings.reads),
        "channels": list(experiment.readings.channels),
        "observed": {
            name: {"units": of.unit, "words": of.words} for name, of in experiment.observe if isinstance(of, Observable)
        },
        "friction": entry.name if entry else type(law).__name__,
        "mu": plain(law.mu) if isinstance(law, CoulombLaw) else 0.0,
        "delta0": plain(experiment.compression),
        "hold_drag": plain(experiment.drag),
        "dt": plain(dt),
        "steps": steps,
        "seconds": seconds,
        **provenance(),
        "backend": experiment.runs_on,
    }


def values_of(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a configuration by name: resolved defaults first, and else the fields of the experiment."""
    return {**configuration.get("experiment", {}), **configuration}
