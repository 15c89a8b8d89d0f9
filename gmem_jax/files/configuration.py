"""The written form of an experiment: the configuration in every result, which reads back to the same experiment."""

import hashlib
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax import native
from gmem_jax.errors import FileFormatError
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.signals import (
    LONGEST_WORD,
    PAD,
    WIDTH,
    Bumps,
    Signals,
    Spline,
    bit_width,
    six_signals,
    word_bits,
    words,
)
from gmem_jax.files.checked import numbers, require, require_kinds
from gmem_jax.files.packs import load_pack
from gmem_jax.files.provenance import provenance, sources
from gmem_jax.physics.contact.friction import CoulombLaw, FrictionLaw
from gmem_jax.physics.contact.laws import entry_of, law_named
from gmem_jax.physics.material import Material
from gmem_jax.physics.rules import usual_rules

_SIGNALS = {"bumps": Bumps, "spline": Spline}
# What files from before there was such a field did; laws, material and words: their defaults of today.
_OLDER = {"precision": "double", "shear": "during", "shear_share": 0.5}
_GONE = ("tangential_damping",)  # of the material, once; nothing followed it
DIGITS = 9  # of the pad and width of words
_PARTS = ("pack", "signals", "friction", "material")


def fingerprint(tree: Any) -> str:
    """SHA-256 of the arrays of a pytree, shapes and types included."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        array = np.asarray(leaf)
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def pack_fingerprint(pack: Pack) -> str:
    """SHA-256 of what makes a pack: grain, centres, orientations, box, T1; not of its list of candidates."""
    at = (pack.position, pack.quaternion, pack.lower, pack.upper)
    return fingerprint((pack.clump, *at, pack.delta0, pack.ringing_period))


def _plain(value: Any) -> Any:
    """Numbers and lists of a parameter, which JSON can hold exactly."""
    return value if isinstance(value, float | int | str | None) else np.asarray(value).tolist()


def _equal(one: Signals, other: Signals) -> bool:
    return fingerprint(one) == fingerprint(other) if type(one) is type(other) else False


def written_signals(signals: Signals) -> dict[str, Any]:
    """Waveforms as JSON: by name where they have one, else by their numbers."""
    if _equal(signals, six_signals()):
        return {"kind": "six"}
    if form := _as_words(signals):
        return {"kind": "words", **form}
    for kind, known in _SIGNALS.items():
        if isinstance(signals, known):
            return {"kind": kind, **{entry.name: _plain(getattr(signals, entry.name)) for entry in fields(known)}}
    return {"kind": type(signals).__name__, "sha256": fingerprint(signals)}


def _as_words(signals: Signals) -> dict[str, Any]:
    """The arguments of `words` that give these waveforms; {} if none do."""
    bits = signals.count.bit_length() - 1
    if not isinstance(signals, Bumps) or signals.count != 1 << bits or not 1 <= bits <= LONGEST_WORD:
        return {}
    first = float(signals.centres[0, 0])  # pad / (bits + 2 pad)
    if np.ndim(signals.width) != 0 or not 0.0 < first < 0.5:
        return {}
    pad = round(bits * first / (1.0 - 2.0 * first), DIGITS)
    form: dict[str, Any] = {
        "bits": bits,
        "pad": pad,
        "width": round(float(signals.width) / bit_width(bits, pad), DIGITS),
    }
    try:
        return form if _equal(signals, words(**form)) else {}
    except ValueError:
        return {}


def names_of(signals: Signals) -> list[str]:
    """What the signals are called: words by their bits, others by their number from 1."""
    form = written_signals(signals)
    if form["kind"] == "words":
        return ["".join(map(str, row)) for row in word_bits(form["bits"])]
    return [f"signal {number + 1}" for number in range(signals.count)]


def signals_from(written: Mapping[str, Any]) -> Signals:
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
    if kind not in _SIGNALS:
        raise ValueError(f"signals of kind {kind!r} cannot be read back")
    numbers = {name: value for name, value in written.items() if name != "kind"}
    made: Signals = _SIGNALS[kind](**{name: _number(value) for name, value in numbers.items()})
    return made


def _number(value: Any) -> Any:
    return jnp.asarray(value, float) if isinstance(value, list) else value


def written_law(law: FrictionLaw) -> dict[str, Any]:
    """A friction law as JSON: its name and parameters."""
    entry = entry_of(law)
    if entry is None:
        return {"law": repr(law)}
    return {"law": entry.name, **{item.name: _plain(getattr(law, item.name)) for item in fields(entry.kind)}}


def _law_from(written: Mapping[str, Any]) -> FrictionLaw:
    require_kinds(written)
    parameters = {name: _number(value) for name, value in written.items() if name != "law"}
    return law_named(written["law"], **parameters)


@usual_rules()
def written(experiment: Experiment) -> dict[str, Any]:
    """An experiment as JSON: every field, the pack by its source and content.

    `experiment_from` makes the same experiment of it.
    """
    pack = experiment.pack
    numbers = [entry.name for entry in fields(Experiment) if entry.init and entry.name not in _PARTS]
    material = experiment.material
    return {
        "pack": {"source": pack.source or pack.name, "name": pack.name, "sha256": pack_fingerprint(pack)},
        "signals": written_signals(experiment.signals),
        "friction": written_law(experiment.friction),
        "material": {entry.name: _plain(getattr(material, entry.name)) for entry in fields(Material)},
        **{name: _plain(getattr(experiment, name)) for name in numbers},
    }


@usual_rules()
def experiment_from(configuration: Mapping[str, Any], pack: Pack | None = None) -> Experiment:
    """The experiment of a written form.

    Args:
        configuration: what `written` gave.
        pack: its pack; default the one that it names, read from its file or from those that ship.

    Raises:
        FileNotFoundError: if the pack is not there.
        FileFormatError: if the pack is another one than was written, or the form is not one of an experiment.
        ValueError: for impossible numbers, or own laws and signals, which have no written form.
    """
    configuration = {**_OLDER, **configuration}
    known = {entry.name for entry in fields(Experiment) if entry.init}
    if odd := sorted(known ^ set(configuration)):
        problem = "its {} is missing" if odd[0] in known else "it has no field {}"
        raise FileFormatError(f"not the written form of an experiment: {problem.format(repr(odd[0]))}")
    of_pack = configuration["pack"]
    pack = load_pack(of_pack["source"]) if pack is None else pack
    if pack_fingerprint(pack) != of_pack["sha256"]:
        raise FileFormatError(f"{of_pack['source']}: not the pack that this was made with (its content has changed)")
    require_kinds({name: value for name, value in configuration.items() if name not in _PARTS})
    require_kinds(configuration["material"])
    own = {name: _number(value) for name, value in configuration.items() if name not in _PARTS}
    material = material_from(configuration["material"])
    return Experiment(
        pack, signals_from(configuration["signals"]), _law_from(configuration["friction"]), material, **own
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
    if odd := sorted(set(written) - known - set(_GONE)):
        raise FileFormatError(f"its material has a field {odd[0]!r}, which none has")
    return Material(**{name: _number(value) for name, value in written.items() if name in known})


def key_of_run(experiment: Experiment, **more: Any) -> dict[str, Any]:
    """What the numbers of a run depend on, and no more: for parts of it that may be used again.

    Args:
        experiment: what is run.
        **more: what else they depend on, like the batch.
    """
    own = {**written(experiment), "pack": pack_fingerprint(experiment.pack)}
    return {**own, **more, "backend": native.name(experiment.backend, experiment.friction), **sources()}


@usual_rules()
def resolved(experiment: Experiment, seconds: float) -> dict[str, Any]:
    """All that is to be known of a result: the experiment as written, what its defaults came to, and where it ran."""
    pack, law, entry = experiment.pack, experiment.friction, entry_of(experiment.friction)
    dt, steps = experiment.timing
    return {
        "experiment": written(experiment),
        "pack": pack.source or pack.name,
        "grains": pack.grains,
        "grain": {
            "shape": pack.clump.shape,
            "mass": float(pack.clump.mass),
            "diameter": float(pack.clump.diameter),
        },
        "pack_record": pack.info,
        "signals": names_of(experiment.signals),
        "friction": entry.name if entry else type(law).__name__,
        "mu": _plain(law.mu) if isinstance(law, CoulombLaw) else 0.0,
        "delta0": _plain(experiment.compression),
        "gamma0": _plain(experiment.gamma0),
        "t0": _plain(experiment.t0),
        "hold_drag": _plain(experiment.drag),
        "dt": _plain(dt),
        "steps": steps,
        "background": experiment.background,
        "precision": experiment.precision,
        "seconds": seconds,
        **provenance(),
        "backend": native.name(experiment.backend, experiment.friction),
    }
