"""The friction laws by name: the one table for the command line, files, benchmarks and the native backend."""

from dataclasses import fields
from typing import Any, NamedTuple

from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled


class Entry(NamedTuple):
    """A law that has a name.

    Attributes:
        name: in files and on the command line.
        paper: what the paper calls it.
        kind: its class.
        native: its number in the native library (native/src/physics/parameters.h, enum Law).
        numbers: attributes that the native library is given, in the order of its parameter array.
    """

    name: str
    paper: str
    kind: Any
    native: int
    numbers: tuple[str, ...] = ("mu", "stiffness", "damping_time", "spinning")


LAWS = (
    Entry("frictionless", "mu = 0", Frictionless, 0, ()),
    Entry("hooke", "H", Hooke, 1),
    Entry("m1", "M1", MindlinRescaled, 2),
    Entry("m2", "M2", Mindlin, 3, ("mu", "stiffness", "damping_time", "spinning", "spacing")),
)


def entry_of(law: FrictionLaw) -> Entry | None:
    """The table's row of a law; None for a user's own."""
    return next((entry for entry in LAWS if entry.kind is type(law)), None)


def law_named(name: str, **parameters: Any) -> FrictionLaw:
    """A law by its name or the paper's, in any case.

    Args:
        name: "frictionless", "hooke" or "H", "m1", "m2".
        parameters: fields of the law; those not given keep their defaults.

    Raises:
        ValueError: if there is no such law, it has no such parameter, or a number is outside its interval.
    """
    wanted = name.lower()
    entry = next((entry for entry in LAWS if wanted in (entry.name, entry.paper.lower())), None)
    if entry is None:
        raise ValueError(f"friction must be one of {', '.join(entry.name for entry in LAWS)}; got {name!r}")
    known = [field.name for field in fields(entry.kind)]
    if unknown := sorted(set(parameters) - set(known)):
        raise ValueError(f"the law {entry.name} has no parameter {unknown[0]!r}; it has {', '.join(known) or 'none'}")
    law: FrictionLaw = entry.kind(**parameters)
    return law
