"""Copies of an experiment with other values of some fields, named by dotted names."""

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from gmem_jax.experiment.arguments import require_kind, require_once
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.signals import Signals, SignalSets, part, sets_of, signals
from gmem_jax.physics.grain import Clump
from gmem_jax.physics.numbers import said
from gmem_jax.physics.pytree import traced, with_field
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.protocol import Protocol


@usual_rules()
def replace(experiment: Experiment, values: Mapping[str, Any] | None = None, /, **changes: Any) -> Experiment:
    """A copy of an experiment with other values of some fields.

    With a traced t0 the copy keeps the number of steps in a bin. With a concrete t0 that number is chosen anew, unless
    the experiment was made with `steps`.

    Args:
        experiment: the experiment; it stays as it is.
        values: new values by dotted name, like {"friction.mu": 0.5}.
        changes: new values by field, like gamma0=2e-3.

    Raises:
        ValueError: if there is no such field, a field is given twice, or the new experiment is impossible.
    """
    require_kind("replace", experiment, Experiment)
    if values is not None and not (isinstance(values, Mapping) and all(isinstance(name, str) for name in values)):
        raise ValueError(f'replace takes new values by name, as in {{"friction.mu": 0.5}}; got {said(values)}')
    found: dict[str, Any] = dict(changes)
    require_once(values or {}, changes)
    for path, value in (values or {}).items():
        name, *deeper = path.split(".")
        _require_field(experiment, name)
        before = found.get(name, getattr(experiment, name))
        found[name] = _with(before, deeper, value)
    for name in found:
        _require_field(experiment, name)
    if traced(found.get("t0")):
        found.setdefault("steps", experiment.steps_per_bin)
    if experiment.is_paper:  # the paper's protocol is made anew from the new lengths and sets
        found.setdefault("protocol", None)
    return dataclasses.replace(experiment, **found)


def with_part(experiment: Experiment, first: int, last: int) -> Experiment:
    """The same experiment with waveforms `first` to `last` - 1 only. They may be zero: the whole set was checked."""
    few = copy.copy(experiment)
    object.__setattr__(few, "signals", part(experiment.signals, first, last))
    return few


def with_signals(experiment: Experiment, waveforms: Signals) -> Experiment:
    """The same experiment with other waveforms in its one set, whatever its name."""
    (name,) = experiment.sets
    return replace(experiment, signals=signals(**{name: waveforms}))


def _with(tree: Any, path: list[str], value: Any) -> Any:
    if not path:
        return value
    if isinstance(tree, Protocol):
        return tree.with_value(".".join(path), value)
    if isinstance(tree, SignalSets) and path[0] in tree.names:
        sets = [_with(one, path[1:], value) if name == path[0] else one for name, one in sets_of(tree).items()]
        return SignalSets(tuple(sets), tree.names)
    _require_field(tree, path[0])
    changed = with_field(tree, path[0], _with(getattr(tree, path[0]), path[1:], value))
    return anisotropic(changed) if path[0] == "inertia" else changed


def anisotropic(tree: Any) -> Any:
    """A part of an experiment whose grain, if it has one, has three moments of inertia, be they equal or not.

    A grain that is marked isotropic has one: its first moment counts alone.
    """
    if not isinstance(tree, Clump):
        return tree
    return with_field(tree, "isotropic", False)


def value_at(experiment: Experiment, path: str) -> Any:
    """The value at a dotted name, like "friction.mu"; defaults resolved.

    Raises:
        ValueError: if there is no such field.
    """
    resolved: dict[str, Any] = {"delta0": experiment.compression, "hold_drag": experiment.drag}
    if path in resolved:
        return resolved[path]
    found: Any = experiment
    for name in path.split("."):
        if isinstance(found, SignalSets) and name in found.names:
            found = sets_of(found)[name]
            continue
        _require_field(found, name)
        found = getattr(found, name)
    return found


def _require_field(tree: Any, name: str) -> None:
    names = [field.name for field in fields(tree)] if is_dataclass(tree) else []
    if name not in names:
        parts = [part for part in names if is_dataclass(getattr(tree, part))]
        near = [f"{part}.{name}" for part in parts if any(one.name == name for one in fields(getattr(tree, part)))]
        meant = f" (meant is {' or '.join(near)}?)" if near else ""
        raise ValueError(f"{type(tree).__name__} has no field {name!r}{meant}; it has {', '.join(names) or 'none'}")
