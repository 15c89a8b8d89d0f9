"""Warnings of a pack that was prepared otherwise than an experiment needs it."""

import numpy as np

from gmem_jax.errors import warn_caller
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.physics.numbers import is_real, said

_ELASTIC = ("poisson", "normal_damping", "wall_rigidity")  # fields of a `Material` that are not units


class OtherGravityWarning(UserWarning):
    """A pack was prepared under gravity, and the experiment has no gravity or a different one."""


class OtherCompressionWarning(UserWarning):
    """A pack was cycled with another delta0: a warning of `Status.OTHER_COMPRESSION` before the run."""


def warn_of_another_preparation(experiment: Experiment) -> None:
    """Warn if a pack was prepared with another delta0, other elastic constants, or another gravity."""
    warn_of_another_compression(experiment)
    _warn_of_another_material(experiment)
    if weight := other_weight(experiment):
        warn_caller(weight, OtherGravityWarning)


def warn_of_another_compression(experiment: Experiment) -> None:
    """Warn of a delta0 other than that with which the pack was cycled."""
    own = float(experiment.pack.delta0)
    if not np.allclose(np.asarray(experiment.compression), own):
        warn_caller(
            f"{experiment.pack.name} was cycled with delta0 = {own:g}, not {experiment.delta0}: its memory of the "
            "preparation differs from the paper's; prepare a pack for this delta0",
            OtherCompressionWarning,
        )


def _warn_of_another_material(experiment: Experiment) -> None:
    """Warn of elastic constants other than those with which the pack came to rest; units are left out."""
    pack, recorded = experiment.pack, experiment.pack.info.get("material", {})
    made = {name: recorded[name] for name in _ELASTIC if is_real(recorded.get(name, ""))}
    if odd := [name for name in made if not np.allclose(np.asarray(getattr(experiment.material, name)), made[name])]:
        others = ", ".join(f"{name} = {made[name]:g}, not {said(getattr(experiment.material, name))}" for name in odd)
        warn_caller(
            f"{pack.name} was prepared with {others}: it is not at rest with the new values; use those of its "
            "preparation, as in material=gm.Material(...), or prepare a pack with the new ones"
        )


def other_weight(experiment: Experiment) -> str:
    """The warning if a pack was prepared under another gravity than the experiment's; "" if not.

    A pack that was prepared without gravity sags a little under it, which an experiment may want: no warning.
    """
    pack, gravity = experiment.pack, 0.0 if experiment.gravity is None else experiment.gravity
    own = (pack.info.get("recipe") or {}).get("gravity", 0.0)
    if own <= 0.0 or np.allclose(np.asarray(gravity), own, atol=0.0):
        return ""
    return (
        f"{pack.name} was prepared under gravity = {own:g}, not {said(gravity)}: it is not at rest with the new "
        f"value; use gravity = {own:g}, or prepare a pack with the new one"
    )
