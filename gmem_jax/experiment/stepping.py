"""The largest stable time step of an experiment, and the t0 and dt for a wanted accuracy of G."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.asked import require_host
from gmem_jax.experiment.changes import replace as with_changes
from gmem_jax.experiment.experiment import USUAL_STEP, Experiment
from gmem_jax.experiment.identity import fingerprint, identity
from gmem_jax.experiment.record import pack_fingerprint
from gmem_jax.physics.contact.friction import CoulombLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.laws import entry_of
from gmem_jax.physics.numbers import is_real, said
from gmem_jax.physics.pytree import map_numbers
from gmem_jax.physics.rotation import unit
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import Box, still_box
from gmem_jax.simulation.compiled import require_x64
from gmem_jax.simulation.loop import Simulation
from gmem_jax.simulation.stability import cause, one_contact_limit
from gmem_jax.simulation.stable_step import GROWTH, SHORTEST_STEP, growth, largest_stable_step

RINGING_PERIODS = 9.6  # t0 / T_1 at which the error of G would be 1; it falls as 1 / t0^2: at most 0.9 % at 96 T_1
ACCURACIES = 0.002, 0.1
STEP_PART = 0.6  # part of the stable step that is taken
LONG_STEP, LONG_DRIVE = 1.2, 1.8e3  # t_c; steps up to the first change G by 1.5e-3 at most if t0 is at least the second
ENOUGH_RINGS = 10  # rings of a contact's history: stiffness hardly depends on their number, and 100 take minutes
MUCH_STIFFER = 144.0  # times as stiff as one contact; packs at rest were 9 to 41 times as stiff

_known: dict[tuple[Any, ...], float] = {}  # largest stable steps that were found
_borne: dict[tuple[Any, ...], float] = {}  # longest steps that were tried and found stable


@usual_rules()
def stable_step(experiment: Experiment) -> float:
    """The largest stable time step of an experiment, in t_c.

    One step is linearised around the pack at rest, with sticking contacts, at u = 0 and at u = 1 (all positions scaled
    with the box). The result is the smallest of both and of all replicas. It depends on pack, law, material, delta0 and
    wall_mu; a process remembers it for each of these.

    Args:
        experiment: the experiment, not traced.

    Returns:
        The step, at most 2 t_c; 0 if not even 0.1 t_c is stable.

    Raises:
        ValueError: if JAX's 64-bit mode is off, the experiment is traced, or in a call inside a traced function.
    """
    require_kind("stable_step", experiment, Experiment)
    require_x64()
    require_host("gm.stable_step", experiment)
    key, law = _case(experiment)
    if key not in _known:
        _known[key] = largest_stable_step(*_at_rest(experiment, law))
    return _known[key]


def is_stable(experiment: Experiment, dt: float) -> bool:
    """Whether steps of `dt` are stable: `stable_step` without looking for the longest one, a quarter of the work."""
    key, law = _case(experiment)
    if key in _known:
        return dt <= _known[key]
    if dt > _borne.get(key, 0.0):
        if not growth(*_at_rest(experiment, law), dt) <= GROWTH:
            return False
        _borne[key] = dt
    return True


def _case(experiment: Experiment) -> tuple[tuple[Any, ...], Any]:
    """The key of the stable step, and the law that is used to find it."""
    law: Any = experiment.friction
    if isinstance(law, CoulombLaw) and not np.any(law.mu):
        law = Frictionless()
    if (row := entry_of(law)) and row.layered:
        law = replace(law, points=min(law.points, ENOUGH_RINGS))
    parts = (experiment.material, experiment.compression, experiment.wall_mu)
    return (pack_fingerprint(experiment.pack), identity(law), fingerprint(parts), experiment.backend), law


def _at_rest(experiment: Experiment, law: Any) -> tuple[Simulation, jax.Array, jax.Array, Box]:
    """The arguments of `largest_stable_step` under a law: all replicas at u = 0, then all at u = 1."""
    pack, sizes = experiment.pack, [jnp.size(experiment.compression)]

    def twice(number: Any) -> Any:
        sizes.append(jnp.size(number))
        return jnp.tile(number, 2) if jnp.ndim(number) else number

    law, wall_mu = map_numbers(twice, law), jax.tree.map(twice, experiment.wall_mu)
    single = max(sizes)
    compression, replicas = jnp.broadcast_to(experiment.compression, (single,)), 2 * single
    shrink = jnp.concatenate([jnp.ones(single), jnp.sqrt(1.0 - compression)])
    scale = jnp.stack([shrink, shrink, jnp.ones(replicas)])
    centre, half = 0.5 * (pack.lower + pack.upper)[:, None], 0.5 * (pack.upper - pack.lower)[:, None]
    position = centre + scale * (pack.position[..., None] - centre)
    quaternion = jnp.broadcast_to(unit(pack.quaternion[..., None]), (pack.grains, 4, replicas))
    simulation = experiment.simulation(sheared=False)
    # A constant force does not change the growth of small perturbations.
    system = replace(simulation.system, friction=law, wall_mu=wall_mu, gravity=None)
    simulation = replace(simulation, system=system, dt=1.0, drag=0.0, steps=1, precision="double")
    return simulation, position, quaternion, still_box(centre - scale * half, centre + scale * half, pack.periodic)


def require_stable(experiment: Experiment) -> None:
    """Refuse a time step that is longer than the stable one.

    No stable step is computed if dt is below the shortest step that `stable_step` tries; nor if dt is at most the
    default and stable even for a pack `MUCH_STIFFER` than one contact.

    Raises:
        ValueError: giving both steps, and the parameter of the experiment that is the cause, if there is one.
    """
    dt, simulation = float(np.max(np.asarray(experiment.timing.dt))), experiment.simulation(sheared=False)
    if dt <= max(SHORTEST_STEP, min(USUAL_STEP, one_contact_limit(simulation, MUCH_STIFFER))):
        return
    if is_stable(experiment, dt):
        return
    if dt > (stable := stable_step(experiment)):
        limit = f"{stable:.3g}" if stable else f"below {SHORTEST_STEP}"
        raise ValueError(
            f"dt = {dt:.3g} t_c exceeds the largest stable step of this pack, law and compression, {limit} t_c; "
            + (cause(simulation) or "use a smaller dt")
        )


@usual_rules()
def at_accuracy(experiment: Experiment, accuracy: float) -> Experiment:
    """The same experiment with the t0 and dt at which G has a wanted accuracy, relative to slow drives and short steps.

    In a drive that is too fast G is too large by a relative error of some (9.6 T1 / t0)^2, and F is off by about as
    much (docs/scaling.md). T1 is the ringing period of the pack.

    Args:
        experiment: the experiment, not traced; its own t0, dt and steps do not matter.
        accuracy: relative error of G, 0.002 to 0.1.

    Returns:
        The experiment with t0 = 9.6 T1 / accuracy^0.5, and dt 0.6 of the stable step, but at most 1.2 t_c, or 0.6 t_c
        if t0 is below 1,800.

    Raises:
        ValueError: if the accuracy is outside its range.
    """
    require_kind("at_accuracy", experiment, Experiment)
    least, most = ACCURACIES
    if not (is_real(accuracy) and np.ndim(accuracy) == 0 and least <= accuracy <= most):
        raise ValueError(f"accuracy must be a number from {least} to {most}, got {said(accuracy)}")
    t0 = float(RINGING_PERIODS * np.max(np.asarray(experiment.pack.ringing_period)) / accuracy**0.5)
    longest = LONG_STEP if t0 >= LONG_DRIVE else USUAL_STEP
    return with_changes(experiment, t0=t0, dt=min(longest, STEP_PART * stable_step(experiment)), steps=None)
