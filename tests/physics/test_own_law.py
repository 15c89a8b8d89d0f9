"""A friction law of one's own is tried before a run: what it must return, and what it must leave alone."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
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
        (Remembering(), "Remembering must return the history of its init where kin.touching is False"),
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


class Weights(eqx.Module):
    """Numbers of a law that all replicas share, made of something else than they are."""

    of: jax.Array

    def __init__(self, *numbers: float) -> None:
        self.of = jnp.asarray(numbers)


class Learnt(eqx.Module):
    """Hooke's law, its stiffness the sum of some weights."""

    mu: jax.Array
    weights: Weights

    def __init__(self, *weights: float) -> None:
        self.mu, self.weights = jnp.asarray(0.5), Weights(*weights)

    @property
    def plain(self) -> gm.Hooke:
        return gm.Hooke(self.mu, self.weights.of.sum(), damping_time=0.3)

    def init(self, contacts: int, replicas: int, dtype: Any) -> Any:
        return self.plain.init(contacts, replicas, dtype)

    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        return self.plain(kin, normal_force, history)


class Tupled(NamedTuple):
    """A law that is a tuple."""

    mu: Any = 0.5

    def init(self, contacts: int, replicas: int, dtype: Any) -> Any:
        return gm.Hooke().init(contacts, replicas, dtype)

    def __call__(self, kin: Any, normal_force: jax.Array, history: Any) -> Any:
        return gm.Hooke(self.mu, 0.125, damping_time=0.3)(kin, normal_force, history)


LEARNT = Learnt(0.0625, 0.03125, 0.03125)  # with exact sums, and as many as there are replicas
DIRECT = gm.Protocol(gm.write(), gm.read())  # without a prefix there is less to compile
FREELY = gm.Protocol(gm.write(), gm.hold(0.1, friction=False), gm.read())


def under(law: Any, protocol: Any = DIRECT, **more: Any) -> gm.Experiment:
    """A short experiment in plain JAX."""
    return gm.Experiment(PACK, gm.words(1), law, protocol=protocol, t0=75.0, dt=0.3, backend="jax", **more)


def test_weights_of_a_law_are_shared_by_all_replicas() -> None:
    assert gm.stable_step(under(LEARNT)) == pytest.approx(gm.stable_step(under(LEARNT.plain)), rel=1e-9)
    learnt, plain = (gm.run(under(law), frames=2).frames for law in (LEARNT, LEARNT.plain))
    assert np.any(plain.friction_force != 0.0)
    np.testing.assert_allclose(learnt.friction_force, plain.friction_force, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("law", [LEARNT, Tupled()], ids=lambda law: type(law).__name__)
@pytest.mark.parametrize("more", [{"wall_mu": 0.2}, {"protocol": FREELY}], ids=["walls", "freely"])
def test_a_law_need_not_take_its_own_fields_to_be_given_another_mu(law: Any, more: dict[str, Any]) -> None:
    found, expected = (gm.run(under(one, **more)).p_sig for one in (law, LEARNT.plain))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_parts_of_such_a_law_are_changed_and_differentiated_by_their_names() -> None:
    changed = gm.replace(under(LEARNT), {"friction.mu": 0.3, "friction.weights.of": jnp.asarray([0.25])})
    assert (float(changed.friction.mu), float(changed.friction.plain.stiffness)) == (0.3, 0.25)
    assert float(LEARNT.mu) == 0.5  # law and experiment stay what they are
    slopes = [
        float(gm.value_and_grad(under(law), ["friction.mu"], progress=False).slope["friction.mu"])
        for law in (LEARNT, LEARNT.plain)
    ]
    assert slopes[1] != 0.0
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-9)


def test_what_is_no_number_in_a_law_or_in_waveforms_is_refused_by_its_name() -> None:
    net = eqx.nn.MLP(1, 1, 2, 1, key=jax.random.key(1))
    with pytest.raises(ValueError, match=r"friction\.weights\.activation is no number: .*make it static"):
        under(eqx.tree_at(lambda law: law.weights, LEARNT, net))
