"""The numbers of an experiment and of a running state with respect to which a run can be differentiated."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.arguments import require_several
from gmem_jax.experiment.changes import anisotropic, value_at
from gmem_jax.experiment.changes import replace as with_values
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.physics.numbers import said
from gmem_jax.physics.state import State
from gmem_jax.simulation.loop import Simulation
from gmem_jax.simulation.progress import work_of
from gmem_jax.simulation.runner import Runner

STATIC_FIELDS = tuple(entry.name for entry in fields(Experiment) if "static" in entry.metadata)
LENGTHS = ("pack.clump.radii", "pack.clump.sizes")  # radii and sizes of unequal spheres

Moving = tuple[Any, ...]  # grains, histories, held walls and periodic cell: the differentiable part of a state


def fixed_by(names: Iterable[str]) -> tuple[str, ...]:
    """Parts of a simulation with respect to which it is not differentiated.

    They are the list, the mark, and those radii and sizes of spheres that are not among `names`. The library has no
    derivatives with respect to radii and sizes: if one is wanted, plain JAX computes all derivatives.
    """
    lengths = [length for length in LENGTHS if not any(f"{length}.".startswith(f"{name}.") for name in names)]
    return (".system.pairs", ".mark", *(length.replace("pack", ".system") for length in lengths))


def _is_moving(path: Any, leaf: Any, fixed: tuple[str, ...]) -> bool:
    """Whether derivatives are taken with respect to a number of a simulation."""
    floats = jnp.issubdtype(jnp.result_type(leaf), jnp.floating)
    return floats and not jax.tree_util.keystr(path).startswith(fixed)


def numbers_of(simulation: Simulation, fixed: tuple[str, ...]) -> list[jax.Array]:
    """The numbers of a simulation with respect to which derivatives are taken."""
    leaves = jax.tree_util.tree_leaves_with_path(simulation)
    return [jnp.asarray(leaf) for path, leaf in leaves if _is_moving(path, leaf, fixed)]


def numbers_by(experiment: Experiment, fixed: tuple[str, ...], *, sheared: bool) -> Callable[[Any], list[jax.Array]]:
    """The numbers of the experiment's simulation as a function of its parts by dotted name."""
    return lambda theta: numbers_of(with_values(experiment, theta).simulation(sheared=sheared), fixed)


def with_numbers(simulation: Simulation, numbers: Sequence[jax.Array], fixed: tuple[str, ...]) -> Simulation:
    """The simulation with other numbers in the place of `numbers_of`."""
    left = iter(numbers)
    leaves, structure = jax.tree_util.tree_flatten_with_path(simulation)
    filled: Simulation = jax.tree.unflatten(
        structure, [next(left) if _is_moving(path, leaf, fixed) else leaf for path, leaf in leaves]
    )
    return filled


def moving_of(state: State) -> Moving:
    """The differentiable part of a state."""
    return state.grains, state.history, state.servo, state.cell, state.wall_history


def state_of(moving: Moving, status: jax.Array) -> State:
    """The state with this differentiable part and this status."""
    return State(moving[0], moving[1], status, *moving[2:])


def require_derivatives(experiment: Experiment) -> None:
    """Refuse an experiment that has no derivatives.

    Raises:
        ValueError: if its contacts are computed in single precision.
    """
    if experiment.precision == "mixed":
        raise ValueError("there are no derivatives in mixed precision; use precision='double'")


def theta_of(experiment: Experiment, names: Any) -> dict[str, Any]:
    """The parts of an experiment with these dotted names, as arrays.

    Raises:
        ValueError: if there is no part of that name, it has no derivative, or it is within another.
    """
    require_several(names, "by")
    names = [*names]
    if wrong := [name for name in names if not isinstance(name, str)]:
        raise ValueError(f"by must hold names, as in ['gamma0', 'friction.mu']; got {said(wrong[0])}")
    found = {name: anisotropic(value_at(experiment, name)) for name in names}
    for name, tree in found.items():
        if inside := next((other for other in found if name.startswith(f"{other}.")), ""):
            raise ValueError(f"{name} is part of {inside}; name one of them")
        if tree is None and name not in STATIC_FIELDS:
            raise ValueError(f"the experiment has no {name}: give it a number first")
        if name in STATIC_FIELDS or not all(map(_is_number, jax.tree.leaves(tree))):
            raise ValueError(
                f"{name} is fixed when a program is compiled and has no derivative; "
                "numbers like gamma0, friction.mu, signals.amplitudes and pack.position have"
            )
    theta = {name: jax.tree.map(jnp.asarray, tree) for name, tree in found.items()}
    for name, tree in theta.items():
        if isinstance(tree, jax.Array) and jnp.issubdtype(tree.dtype, jnp.integer):
            raise ValueError(f"{name} holds whole numbers, which have no derivative; write a number as 1.0")
        if not all(jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in jax.tree.leaves(tree)):
            raise ValueError(f"{name} holds more than floats; name what to differentiate by, like pack.position")
    return theta


def with_grain(experiment: Experiment, theta: dict[str, Any]) -> Experiment:
    """The experiment, with a grain of three moments of inertia if they are among the parts `theta`."""
    of_grain = {name: part for name, part in theta.items() if name.startswith("pack.clump")}
    return with_values(experiment, of_grain) if of_grain else experiment


def _is_number(leaf: Any) -> bool:
    return isinstance(leaf, float | int | np.ndarray | jax.Array)


def whole_work(experiment: Experiment, on: Runner) -> float:
    """Work of all stages of an experiment, for a runner at their beginning."""
    common, own = experiment.phases
    return work_of(common, on.state.replicas) + work_of(own, experiment.replicas)
