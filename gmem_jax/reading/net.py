"""The paper's reader: a small neural net that names a binary word from its recalled signal (Sec. III).

It never sees a recalled signal before it reads one. All functions are pure: they can be jitted, vmapped over seeds, and
differentiated. The net is single precision, whatever JAX's default is.
"""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from gmem_jax.physics import chance
from gmem_jax.reading.lessons import TrainingConfig
from gmem_jax.simulation.stage import BINS


class Perceptron(nn.Module):
    """Dense layers 256 - hidden - classes with ReLU between; Kaiming-uniform weights, zero biases, single precision."""

    classes: int
    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Logits [..., classes] of normalised signals [..., 256]."""
        layer = functools.partial(
            nn.Dense, kernel_init=nn.initializers.he_uniform(), dtype=jnp.float32, param_dtype=jnp.float32
        )
        for width in self.hidden:
            x = nn.relu(layer(width)(x))
        return layer(self.classes)(x)


@functools.partial(jax.tree_util.register_dataclass, data_fields=["parameters"], meta_fields=["lessons"])
@dataclass(frozen=True)
class Net:
    """A net that reads words from recalled signals.

    Attributes:
        parameters: weights and biases, a pytree of flax, float32.
        lessons: its layers and training data.
    """

    parameters: Any
    lessons: TrainingConfig


def initial(lessons: TrainingConfig, seed: jax.typing.ArrayLike) -> Net:
    """The untrained net of a seed."""
    key = jax.random.fold_in(chance.key(seed), 0)
    module = Perceptron(lessons.classes, lessons.hidden)
    return Net(module.init(key, jnp.zeros((1, BINS), jnp.float32))["params"], lessons)


def raw_logits(net: Net, inputs: jax.Array) -> jax.Array:
    """Logits [..., words] of normalised signals [..., 256]."""
    module = Perceptron(net.lessons.classes, net.lessons.hidden)
    return jnp.asarray(module.apply({"params": net.parameters}, inputs))


def loss_of(net: Net, inputs: jax.Array, word: jax.Array) -> jax.Array:
    """Mean cross-entropy, in nats, of normalised signals [..., 256] and the numbers of their words."""
    return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(raw_logits(net, inputs), word))


def normalise(signals: jax.Array) -> jax.Array:
    """A set of recalled signals over its own mean of |p_sig|, [S, 256], float32."""
    return (signals / jnp.mean(jnp.abs(signals))).astype(jnp.float32)


def logits(net: Net, signals: jax.typing.ArrayLike) -> jax.Array:
    """Logits of all words for a set of recalled signals.

    Args:
        net: a trained net.
        signals: p_sig, [S, 256], in any unit: they are divided by the mean of |p_sig| over the set.

    Returns:
        Logits, [S, 2^L].
    """
    return raw_logits(net, normalise(jnp.asarray(signals)))


def predict(net: Net, signals: jax.typing.ArrayLike) -> jax.Array:
    """The word that is read from each of a set of recalled signals.

    Args:
        net: a trained net.
        signals: p_sig, [S, 256], in any unit.

    Returns:
        Numbers of the words, from 0, [S]; all are -1 if a signal is not finite, or all are zero.
    """
    found = logits(net, signals)
    return jnp.where(jnp.all(jnp.isfinite(found), axis=-1), jnp.argmax(found, axis=-1), -1)


def accuracy(net: Net, signals: jax.typing.ArrayLike, word: jax.typing.ArrayLike | None = None) -> jax.Array:
    """Fraction of recalled signals that is read right; NaN if a signal is not finite, or all are zero.

    Args:
        net: a trained net.
        signals: p_sig, [S, 256], in any unit.
        word: numbers of the words stored, from 0, [S]; default 0, 1, 2, ...

    Raises:
        ValueError: if there are more signals than words, and no `word` says which each is.
    """
    read = predict(net, signals)
    right = jnp.mean(read == _stored(net, len(read), word), dtype=jnp.float32)
    return jnp.where(jnp.all(read >= 0), right, jnp.nan)


def cross_entropy(net: Net, signals: jax.typing.ArrayLike, word: jax.typing.ArrayLike | None = None) -> jax.Array:
    """Mean cross-entropy of recalled signals, in nats; it can be differentiated with respect to them.

    Args:
        net: a trained net.
        signals: p_sig, [S, 256], in any unit.
        word: numbers of the words stored, from 0, [S]; default 0, 1, 2, ...

    Raises:
        ValueError: if there are more signals than words, and no `word` says which each is.
    """
    signals = jnp.asarray(signals)
    return loss_of(net, normalise(signals), _stored(net, len(signals), word))


def _stored(net: Net, count: int, word: jax.typing.ArrayLike | None) -> jax.Array:
    if word is None and count > net.lessons.classes:
        raise ValueError(f"{count} signals, and the net knows {net.lessons.classes} words: name the word of each")
    return jnp.arange(count) if word is None else jnp.asarray(word)
