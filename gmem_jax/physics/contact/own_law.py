"""Check of a user's own friction law, which is tried on a few contacts before a run."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.physics.contact.friction import CoulombLaw, FrictionLaw
from gmem_jax.physics.contact.kinematics import Kinematics, kinematics

_DT = 0.3  # t_c, length of the step on which a law is tried


def require_law(law: FrictionLaw, replicas: int) -> None:
    """Refuse a law whose forces or histories are not of the shape and kind asked for, or that acts without contact.

    Args:
        law: the law, not traced.
        replicas: B, the length of parameters that have a value for each replica.

    Raises:
        ValueError: naming the law, what it returned and what is expected.
    """
    contacts = replicas + 4  # a length that differs from those of the other axes

    def tried(overlap: float, history: Any) -> Any:
        kin = _moving(contacts, replicas, overlap)
        return law(kin, jnp.where(kin.touching, 1e-3, 0.0), history)

    # Evaluated at once, even if the experiment is made within a traced function.
    with jax.ensure_compile_time_eval():
        blank = law.init(contacts, replicas, jnp.zeros(()).dtype)
        _require_history(law, "init", blank, contacts, replicas)
        found = jax.eval_shape(lambda history: tried(0.1, history), blank)
        _require_result(law, found, blank, contacts, replicas)
        if isinstance(law, CoulombLaw) and not np.all(np.asarray(law.mu) >= 0.0):
            raise ValueError(f"friction.mu of {_name(law)} must be in [0, inf), got {law.mu}")
        _, used = tried(0.1, blank)
        force, left = tried(-0.1, used)
        if np.any(np.asarray(force) != 0.0):
            raise ValueError(f"{_name(law)} returned a force where kin.touching is False; it must be exactly 0 there")
        if not all(map(np.array_equal, jax.tree.leaves(left), jax.tree.leaves(blank))):
            raise ValueError(
                f"{_name(law)} must return the history of its init where kin.touching is False; it returned another"
            )


def _moving(contacts: int, replicas: int, overlap: float) -> Kinematics:
    """Kinematics of sliding contacts with this overlap; the last row is padding."""
    shape = (contacts, 3, replicas)
    away = jnp.broadcast_to(jnp.asarray([0.6, 0.0, 0.8])[:, None] * (2.0 - overlap), shape)
    motion = jnp.broadcast_to(jnp.asarray([1e-3, 2e-3, -1e-3])[:, None], shape)
    valid = jnp.arange(contacts) < contacts - 1
    away = jnp.where(valid[:, None, None], away, 0.0)
    return kinematics(away, motion, motion, valid, jnp.asarray(_DT))


def _require_result(law: FrictionLaw, found: Any, blank: Any, contacts: int, replicas: int) -> None:
    if not isinstance(found, tuple) or len(found) != 2:
        raise ValueError(f"{_name(law)} must return a tangential force and a history, got {_described(found)}")
    force, history = found
    expected = jax.ShapeDtypeStruct((contacts, 3, replicas), jnp.zeros(()).dtype)
    if _described(force) != _described(expected):
        raise ValueError(
            f"{_name(law)} returned a force {_described(force)}; it must be [P, 3, B], here {_described(expected)}"
        )
    same = str(jax.tree.structure(history)) == str(jax.tree.structure(blank))
    if not same or _described(history) != _described(blank):
        raise ValueError(
            f"{_name(law)} returned a history {_described(history)}; it must be like that of its init, "
            f"{_described(blank)}"
        )


def _require_history(law: FrictionLaw, where: str, history: Any, contacts: int, replicas: int) -> None:
    for leaf in jax.tree.leaves(history):
        shape, double = jnp.shape(leaf), jnp.result_type(leaf) == jnp.zeros(()).dtype
        if not double or len(shape) < 2 or (shape[0], shape[-1]) != (contacts, replicas):
            raise ValueError(
                f"{_name(law)}.{where} returned a history with {_described(leaf)}; all of it must be numbers of the "
                f"dtype it is given, [contacts, ..., replicas], here {jnp.zeros(()).dtype}[{contacts}, ..., {replicas}]"
            )


def _name(law: FrictionLaw) -> str:
    return f"friction law {type(law).__name__}"


def _described(tree: Any) -> str:
    """Dtype and shape of every array, like float64[6, 3, 2]."""
    leaves = [f"{jnp.result_type(leaf)}{list(jnp.shape(leaf))}" for leaf in jax.tree.leaves(tree)]
    return leaves[0] if len(leaves) == 1 else f"({', '.join(leaves)})"
