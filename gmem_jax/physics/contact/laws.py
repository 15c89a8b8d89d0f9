"""The table of friction laws by name, for the command line, files, benchmarks and the native backend."""

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any, NamedTuple

from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled


class Entry(NamedTuple):
    """A law that has a name, and what the native library knows of it (native/src/physics/parameters.h).

    Attributes:
        name: its name in files and on the command line.
        paper: its name in the paper.
        kind: its class.
        native: its number in enum Law.
        history: axes of the arrays of its history: contacts P, points Q, replicas B, or a length.
        numbers: attributes that the library is given, in the order of its parameter array.
        variants: values of its attribute `variant`, in the order of enum Variant.
    """

    name: str
    paper: str
    kind: Any
    native: int
    history: tuple[str, ...]
    numbers: tuple[str, ...] = ("mu", "stiffness", "damping_time", "spinning")
    variants: tuple[str, ...] = ()

    @property
    def layered(self) -> bool:
        """Whether its history is resolved into rings; the library keeps these in double precision."""
        return any("Q" in axes for axes in self.history)

    def points(self, law: Any) -> int:
        """Q of a law of this kind; 0 if it has no rings."""
        return int(law.points) if self.layered else 0

    def variant(self, law: Any) -> int:
        """The number of the variant of a law of this kind; 0 if the kind has no variants."""
        return self.variants.index(law.variant) if self.variants else 0

    def with_numbers(self, law: Any, values: Iterable[Any]) -> Any:
        """A law of this kind with other `numbers`, the first of `values`."""
        own = dict(zip(self.numbers, values, strict=False))
        if "spacing" in own:  # the law derives it from p_max
            own["p_max"] = (own.pop("spacing") * (law.points - 1)) ** 2
        return replace(law, **own)


LAWS = (
    Entry("frictionless", "mu = 0", Frictionless, 0, (), ()),
    Entry("hooke", "H", Hooke, 1, ("P3B",)),
    Entry("m1", "M1", MindlinRescaled, 2, ("P3B", "P1B")),
    Entry(
        "m2",
        "M2",
        Mindlin,
        3,
        ("PQ2B", "P3B", "P1B"),
        ("mu", "stiffness", "damping_time", "spinning", "spacing"),
        ("exact", "averaged", "paper"),
    ),
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
