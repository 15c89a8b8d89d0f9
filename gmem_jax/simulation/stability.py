"""The parameter that makes the time steps of a run unstable, for error messages.

The steps are explicit. A spring k on a mass m needs dt < 2 sqrt(m / k) and a dashpot c needs dt < 2 m / c. These bounds
are evaluated here for one contact with an overlap as in a pack. A parameter that violates them is a cause; one that
does not may still be a cause.
"""

import math
from typing import Any

import numpy as np

from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.laws import entry_of
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.material import Material
from gmem_jax.simulation.loop import Simulation
from gmem_jax.simulation.sharding import to_host

OVERLAP = 0.05  # R
_USUAL: dict[str, Any] = {  # defaults, each put in the place of a parameter to see whether that one is the cause
    **{f"material.{name}": getattr(Material, name) for name in ("wall_rigidity", "normal_damping")},
    **{f"friction.{name}": getattr(Hooke, name) for name in ("stiffness", "damping_time")},
}


def one_contact_limit(simulation: Simulation, stiffer: float = 1.0, **changed: float) -> float:
    """The longest stable step for one contact: a grain on a wall, or two grains with friction, in t_c.

    Args:
        simulation: gives the smallest grain, the material and the law; parameters are the largest of all replicas.
        stiffer: factor on every spring and dashpot.
        changed: values of parameters in `_USUAL`, in the place of those of the simulation.
    """
    system = simulation.system
    numbers = {**_USUAL, **_numbers(simulation), **changed}
    rigidity, damping, spring, tangential_damping = (numbers[name] for name in _USUAL)
    mass = _most(system.clump.mass) * float(system.clump.smallest) ** 3 / stiffer
    root = math.sqrt(OVERLAP)
    stiffness = _most(system.material.plane_stiffness) * root * max(rigidity, 2.0**-0.5)  # wall, or two grains
    spring *= root if isinstance(system.friction, MindlinRescaled | Mindlin) else 1.0
    rates = (
        0.5 * math.sqrt(1.5 * stiffness / mass),
        0.5 * stiffness * damping / mass,
        0.5 * math.sqrt(2.0 * spring / mass),
        spring * tangential_damping / mass,
    )
    return float(1.0 / max(rates))


def _numbers(simulation: Simulation) -> dict[str, float]:
    """The parameters in `_USUAL` of a simulation: those of the material, and those of the law if it has a name."""
    material, law = simulation.system.material, simulation.system.friction
    of_material = ("wall_rigidity", "normal_damping")
    known: dict[str, Any] = {f"material.{name}": getattr(material, name) for name in of_material}
    if entry_of(law):
        known |= {f"friction.{name}": getattr(law, name, 0.0) for name in ("stiffness", "damping_time")}
    return {name: _most(value) for name, value in known.items()}


def cause(simulation: Simulation) -> str:
    """The parameter that made a run unstable, in words; "" if none is found."""
    numbers, longest, dt = _numbers(simulation), one_contact_limit(simulation), _most(simulation.dt)
    without = {name: one_contact_limit(simulation, **{name: _USUAL[name]}) for name in numbers}
    name = max(without, key=without.__getitem__)
    if longest >= dt or without[name] <= longest:
        return ""
    return (
        f"{name} = {numbers[name]:g} makes steps beyond {longest:.2g} t_c unstable, and dt is {dt:.2g}; "
        f"use a smaller {name}"
    )


def _most(value: Any) -> float:
    return float(np.max(to_host(value)))
