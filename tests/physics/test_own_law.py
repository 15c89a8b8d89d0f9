"""A friction law of one's own is tried before a run: what it must return, and what it must leave alone."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from scenes import TETRA_27

import gmem_jax as gm

PACK = gm.load_pack(TETRA_27)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Drag:
    """A force against sliding that remembers the last one."""

    mu: Any = 0.1

    def init(self, contacts: int, replicas: int, dtype: Any) -> Any:
        return jnp.zeros((contacts, 3, replicas), dtype)

    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        force = jnp.where(kin.touching, self.mu * kin.sliding, 0.0)
        return force, force


class Scalar(Drag):
    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        force, history = super().__call__(kin, normal_force, history)
        return force[:, :1], history


class Sticky(Drag):
    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        return self.mu * kin.sliding, history


class Remembering(Drag):
    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        return super().__call__(kin, normal_force, history)[0], history + kin.touching


class Counting(Drag):
    def init(self, contacts: int, replicas: int, dtype: Any) -> Any:
        return jnp.zeros((contacts, 1, replicas), int)


class Alone(Drag):
    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        return super().__call__(kin, normal_force, history)[0]


class Single(Drag):
    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        force, history = super().__call__(kin, normal_force, history)
        return force.astype(jnp.float32), history


class Flat(Drag):
    def init(self, contacts: int, replicas: int, dtype: Any) -> Any:
        return jnp.zeros((replicas, 3, contacts), dtype)


class Growing(Drag):
    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        force, history = super().__call__(kin, normal_force, history)
        return force, (history, history)


class Undefined(Drag):
    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        force = jnp.sqrt(kin.overlap) * kin.sliding
        return force, jnp.where(kin.touching, force, 0.0)


for kind in (Scalar, Sticky, Remembering, Counting, Alone, Single, Flat, Growing, Undefined):
    jax.tree_util.register_dataclass(kind, data_fields=["mu"], meta_fields=[])


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (Scalar(), r"Scalar returned a force float64\[7, 1, 3\]; it must be \[P, 3, B\], here float64\[7, 3, 3\]"),
        (Sticky(), "Sticky returned a force where kin.touching is False; it must be exactly 0 there"),
        (Undefined(), "Undefined returned a force where kin.touching is False"),
        (Remembering(), "Remembering returned a history where kin.touching is False that is not the one of its init"),
        (Counting(), r"Counting.init returned a history with int64\[7, 1, 3\]; all of it must be numbers of the dtype"),
        (Flat(), r"Flat.init returned a history with float64\[3, 3, 7\]; .* \[contacts, ..., replicas\]"),
        (Alone(), r"Alone must return a tangential force and a history, got float64\[7, 3, 3\]"),
        (Single(), r"Single returned a force float32\[7, 3, 3\]; .* here float64\[7, 3, 3\]"),
        (Growing(), r"Growing returned a history \(float64.*\); it must be like that of its init, float64\[7, 3, 3\]"),
        (Drag(mu=-0.1), r"friction.mu of friction law Drag must be in \[0, inf\), got -0.1"),
        (Drag(mu=jnp.asarray([0.1, 0.2, -0.3])), "friction.mu of friction law Drag must be in"),
    ],
    ids=lambda one: type(one).__name__,
)
def test_a_law_that_returns_something_else_is_refused_by_name_when_an_experiment_is_made(law: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        gm.Experiment(PACK, gm.words(1), law)


def test_a_sound_law_is_taken_within_a_trace_too() -> None:
    made = gm.Experiment(PACK, gm.words(1), Drag(mu=jnp.asarray([0.1, 0.2, 0.3])))
    assert made.replicas == 3

    def by_mu(mu: jax.Array) -> jax.Array:
        return gm.Experiment(PACK, gm.words(1), Drag(mu)).friction.mu  # its number is a tracer: nothing is tried

    def by_t0(t0: jax.Array) -> jax.Array:
        return gm.replace(gm.Experiment(PACK, gm.words(1), Drag()), t0=t0).t0  # its number is none: all is tried

    assert float(jax.jit(by_mu)(-1.0)) == -1.0
    assert float(jax.jit(by_t0)(60.0)) == 60.0
    with pytest.raises(ValueError, match="Sticky returned a force"):
        jax.jit(lambda t0: gm.Experiment(PACK, gm.words(1), Sticky(), t0=t0, steps=1).t0)(60.0)
