"""Checks of the kinds of arguments: packs, waveforms, laws, names."""

import json
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.signals import Signals, SignalSets
from gmem_jax.physics.contact.friction import FrictionLaw

_MADE_BY = {  # how an argument of each kind is made
    "Experiment": "gm.Experiment(pack, gm.six_signals()) makes one",
    "Pack": "see gm.load_pack and gm.prepare",
    "Recall": "gm.run(experiment) makes one, gm.load_recall(path) reads one",
    "Recipe": "gm.prepare(grains=325) changes its fields",
    "Signals": "as gm.six_signals(), gm.words(3)",
}


def require_kind(function: str, value: Any, kind: Any) -> None:
    """Refuse an argument that is not of the kind that a function takes.

    Raises:
        TypeError: naming the function, what was given, and what makes the right thing.
    """
    if not isinstance(value, kind):
        name = kind.__name__
        raise TypeError(f"gm.{function} takes a gm.{name}, got {_said(value)}; {_MADE_BY[name]}")


def require_parts(pack: Any, signals: Any, friction: Any) -> None:
    """Refuse arguments of an experiment that are not a pack, waveforms and a friction law.

    Raises:
        ValueError: saying what was given, and what makes the right thing of it.
    """
    if not isinstance(pack, Pack):
        read = f"gm.load_pack({pack!r}) reads one" if isinstance(pack, str) else "see gm.load_pack and gm.prepare"
        raise ValueError(f"pack must be a pack, got {_said(pack)}; {read}")
    if isinstance(signals, type) or not isinstance(signals, Signals | SignalSets):
        numbers = isinstance(signals, list | tuple | np.ndarray) or hasattr(signals, "shape")
        made = "gm.waveform makes waveforms of samples" if numbers else "as gm.six_signals(), gm.words(3)"
        raise ValueError(f"signals must be waveforms, got {_said(signals)}; {made}")
    require_friction(friction)


def require_friction(friction: Any) -> None:
    """Refuse an argument that is not a friction law.

    Raises:
        ValueError: saying what was given, and what makes the right thing of it.
    """
    plain = isinstance(friction, float | int | str) or hasattr(friction, "shape")
    # An object of a class that JAX does not know may be an unfinished law: `Experiment` says what it lacks.
    unregistered = not plain and jax.tree_util.all_leaves([friction])
    if isinstance(friction, type) or not (unregistered or isinstance(friction, FrictionLaw)):
        if isinstance(friction, type):
            made = f"make one with its parameters, as {friction.__name__}(mu=1.0)"
        else:
            made = f"gm.Hooke(mu={friction!r})" if isinstance(friction, float | int) else "as gm.Hooke(mu=1.0)"
        raise ValueError(f"friction must be a friction law, got {_said(friction)}; {made}")


def named_observers(observe: Any) -> tuple[tuple[str, Any], ...]:
    """Observers with their names: a mapping, pairs, or observers that have a `name`, as `gm.observables` makes them.

    Raises:
        ValueError: for anything else, or two observers of one name.
    """
    try:
        given: Any = observe.items() if isinstance(observe, Mapping) else observe
        named = tuple((one.name, one) if hasattr(one, "name") else (one[0], one[1]) for one in given)
    except (TypeError, LookupError):
        named = (("", observe),)
    for name, reduce in named:
        if not (isinstance(name, str) and name and name.isprintable() and "/" not in name and callable(reduce)):
            raise ValueError(
                "observe takes functions of (simulation, state) by name, as {'sliding': gm.observables.sliding()}, or "
                f"a list of gm.observables; got {_said(reduce)} called {name!r}"
            )
    names = [name for name, _ in named]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"two observers are called {twice[0]!r}; name them, as in observe={{'one': ..., 'two': ...}}")
    return tuple(sorted(named, key=lambda one: one[0]))  # one order in the run, its key and its files


def require_several(values: Any, argument: str) -> None:
    """Refuse a single value where a list is needed.

    Raises:
        ValueError: saying how to write the list.
    """
    if isinstance(values, str) or not isinstance(values, Iterable):
        one = json.dumps(values) if isinstance(values, str | int | float) else ""
        right = f"write [{one}] for {one}" if one else f"got {_said(values)}"
        raise ValueError(f"{argument} takes several, in a list: {right}")


def require_once(values: Mapping[str, Any], changes: Mapping[str, Any]) -> None:
    """Refuse a field that is given twice, or after one of its parts.

    Raises:
        ValueError: naming the field.
    """
    earlier: list[str] = []
    for name in values:
        if name in changes or any(one.startswith(f"{name}.") for one in earlier):
            raise ValueError(f"{name} is given twice; leave one away")
        earlier.append(name)


def _said(value: Any) -> str:
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, str | float | int | None):
        return repr(value)
    kind = type(value).__name__
    article = "an" if kind[0] in "AEIOUaeiou" else "a"
    return f"an array of shape {jnp.shape(value)}" if hasattr(value, "shape") else f"{article} {kind}"
