"""The paper's reader: a small neural net that names a binary word from its recalled signal (Sec. III; spec, section 7).

It is trained on the inputs J_s alone: shifted, scaled, with noise; it never sees a recalled signal. Nothing of the
training set is stored but the shifted J_s, [S, shifts, 256]: an example follows from the numbers of its word, shift,
amplitude and draw, and from the seed. All functions but `train`, `save` and `load` are pure: they can be jitted,
vmapped over seeds, and differentiated. The net is single precision, whatever JAX's default is.

The library's users see this module as `gmem_jax.classify`.
"""

import functools
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from flax import serialization

from gmem_jax.experiment.signals import BINS, bin_average, bit_width, words
from gmem_jax.files.storage import FileFormatError, atomic

SCHEMA = "gmem-classifier/1"
STEPS = 250  # to a call from the host: a second or so, and one check of the validation accuracy
QUICK_CHECK = 4_096  # held-out examples tried after every call
LAST_CHECK = 65_536  # held-out examples, at most, that must agree before training stops early
SLICE = 1_024  # examples evaluated side by side
SAVE_EVERY = 30.0  # seconds between checkpoints


@dataclass(frozen=True)
class Recipe:
    """What the net is and what it is trained on; by default the paper's net and 17,325 examples a word.

    Attributes:
        bits: L, the length of the words.
        hidden: widths of the hidden layers.
        shifts: number of shifts in u, equally spaced in +-`shift`.
        shift: largest shift, in bits (u_b).
        amplitudes: number of factors, equally spaced in 1 +- `amplitude`.
        amplitude: largest change of the amplitude.
        draws: noise draws; their SDs are equally spaced from 0 to `noise`.
        noise: largest SD of the noise, in <|J|>.
        held_out: part of the (shift, amplitude, draw) combinations that is kept for validation.
        batch: examples to a step.
        rate: learning rate of plain SGD.
    """

    bits: int
    hidden: tuple[int, ...] = (1024, 1024)
    shifts: int = 21
    shift: float = 0.3
    amplitudes: int = 33
    amplitude: float = 0.3
    draws: int = 25
    noise: float = 0.3
    held_out: float = 0.1
    batch: int = 32
    rate: float = 0.1

    @property
    def classes(self) -> int:
        """Number of words S."""
        return 1 << self.bits

    @property
    def combinations(self) -> int:
        """Transformations of one word."""
        return self.shifts * self.amplitudes * self.draws

    @property
    def kept(self) -> int:
        """How many of them are held out."""
        return max(1, round(self.held_out * self.combinations))


class Perceptron(nn.Module):
    """256 - hidden - classes, ReLU between, Kaiming-uniform weights, biases zero at first, single precision."""

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


@functools.partial(jax.tree_util.register_dataclass, data_fields=["parameters"], meta_fields=["recipe"])
@dataclass(frozen=True)
class Net:
    """A net.

    Attributes:
        parameters: flax's tree of weights and biases, float32.
        recipe: what it was built from.
    """

    parameters: Any
    recipe: Recipe


@functools.partial(jax.tree_util.register_dataclass, data_fields=["table", "order", "noise"], meta_fields=["recipe"])
@dataclass(frozen=True)
class Examples:
    """Everything an example is made from.

    Attributes:
        table: J_s(u - shift) / <|J|>, [S, shifts, 256], float32.
        order: numbers of the (shift, amplitude, draw) combinations, shuffled by the seed; the first `recipe.kept` are
            held out.
        noise: random key.
        recipe: the transformations.
    """

    table: jax.Array
    order: jax.Array
    noise: jax.Array
    recipe: Recipe

    def make(self, word: jax.Array, combination: jax.Array) -> jax.Array:
        """Input [..., 256] of word number `word` (from 0) under a combination; the same numbers, the same input."""
        recipe = self.recipe
        shift, rest = jnp.divmod(combination, recipe.amplitudes * recipe.draws)
        factor, draw = jnp.divmod(rest, recipe.draws)
        scale = 1.0 + recipe.amplitude * _ladder(factor, recipe.amplitudes)
        deviation = recipe.noise * (draw / max(recipe.draws - 1, 1))
        number = word * recipe.combinations + combination

        def normal(one: jax.Array) -> jax.Array:
            return jax.random.normal(jax.random.fold_in(self.noise, one), (BINS,), jnp.float32)

        noise = jax.vmap(normal)(number.ravel()).reshape(*number.shape, BINS)
        clean = self.table[word, shift]
        return scale.astype(jnp.float32)[..., None] * clean + deviation.astype(jnp.float32)[..., None] * noise

    def training(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A batch of training inputs [batch, 256] and their words [batch], drawn with replacement."""
        recipe = self.recipe
        for_word, for_combination = jax.random.split(key)
        word = jax.random.randint(for_word, (recipe.batch,), 0, recipe.classes)
        place = jax.random.randint(for_combination, (recipe.batch,), recipe.kept, recipe.combinations)
        return self.make(word, self.order[place]), word

    def held_out(self, number: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Held-out inputs [..., 256] and their words; `number` counts through all S * kept of them, words first."""
        word = number % self.recipe.classes
        # Neighbouring words take different combinations, so that a few thousand examples cover many.
        place = (number // self.recipe.classes + 7 * word) % self.recipe.kept
        return self.make(word, self.order[place]), word


def _ladder(place: jax.Array, rungs: int) -> jax.Array:
    """-1 to 1 in `rungs` equal steps; 0 if there is but one."""
    return 2.0 * place / (rungs - 1) - 1.0 if rungs > 1 else 0.0 * place


def examples(recipe: Recipe, seed: jax.typing.ArrayLike) -> Examples:
    """The training and validation set of a seed."""
    shuffle, noise = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1))
    order = jax.random.permutation(shuffle, recipe.combinations)
    return Examples(table=_table(recipe), order=order, noise=noise, recipe=recipe)


def _table(recipe: Recipe) -> jax.Array:
    """J_s shifted, over the mean of |J| of the words as they are, [S, shifts, 256]."""
    signals = words(recipe.bits)
    mean = jnp.mean(jnp.abs(bin_average(signals)))
    steps = _ladder(jnp.arange(recipe.shifts), recipe.shifts) * recipe.shift * bit_width(recipe.bits)

    def moved(step: jax.Array) -> jax.Array:
        return jnp.asarray(bin_average(replace(signals, centres=signals.centres + step)) / mean, jnp.float32)

    # One shift after another: side by side they would need `shifts` times the memory of `bin_average`.
    return jnp.moveaxis(jax.lax.map(moved, steps), 0, 1)


def initial(recipe: Recipe, seed: jax.typing.ArrayLike) -> Net:
    """The untrained net of a seed."""
    key = jax.random.fold_in(jax.random.key(seed), 0)
    module = Perceptron(recipe.classes, recipe.hidden)
    return Net(module.init(key, jnp.zeros((1, BINS), jnp.float32))["params"], recipe)


def _logits(net: Net, inputs: jax.Array) -> jax.Array:
    module = Perceptron(net.recipe.classes, net.recipe.hidden)
    return jnp.asarray(module.apply({"params": net.parameters}, inputs))


def _loss(net: Net, inputs: jax.Array, word: jax.Array) -> jax.Array:
    return jnp.mean(optax.softmax_cross_entropy_with_integer_labels(_logits(net, inputs), word))


def advance(
    net: Net, data: Examples, seed: jax.typing.ArrayLike, first: jax.typing.ArrayLike, count: int
) -> tuple[Net, jax.Array]:
    """`count` steps of plain SGD from step number `first`; the net after them and the mean loss during them.

    A step depends on its number and the seed alone, so that training can be broken off and taken up anywhere.
    """
    optimiser = optax.sgd(net.recipe.rate)  # plain: its state is empty
    key = jax.random.fold_in(jax.random.key(seed), 2)

    def step(net: Net, number: Any) -> tuple[Net, jax.Array]:
        inputs, word = data.training(jax.random.fold_in(key, number))
        loss, slope = jax.value_and_grad(_loss)(net, inputs, word)
        change, _ = optimiser.update(slope, optimiser.init(net))
        return optax.apply_updates(net, change), loss

    net, losses = jax.lax.scan(step, net, first + jnp.arange(count))
    return net, jnp.mean(losses)


def validate(net: Net, data: Examples, count: int) -> jax.Array:
    """Accuracy on the first `count` held-out examples (or on all S * kept, if fewer)."""
    total = min(count, net.recipe.classes * net.recipe.kept)
    slices = -(-total // SLICE)

    def right(number: jax.Array) -> jax.Array:
        inputs, word = data.held_out(number)
        return jnp.sum((jnp.argmax(_logits(net, inputs), axis=-1) == word) & (number < total))

    return jnp.sum(jax.lax.map(right, jnp.arange(slices * SLICE).reshape(slices, SLICE))) / total


def normalise(signals: jax.Array) -> jax.Array:
    """A set of recalled signals over its own mean of |p_sig|, [S, 256], float32."""
    return (signals / jnp.mean(jnp.abs(signals))).astype(jnp.float32)


def logits(net: Net, signals: jax.typing.ArrayLike) -> jax.Array:
    """Logits [S, words] of a set of recalled signals [S, 256], in any unit."""
    return _logits(net, normalise(jnp.asarray(signals)))


def predict(net: Net, signals: jax.typing.ArrayLike) -> jax.Array:
    """Number of the word read from each recalled signal [S, 256], from 0, [S]."""
    return jnp.argmax(logits(net, signals), axis=-1)


def accuracy(net: Net, signals: jax.typing.ArrayLike, word: jax.typing.ArrayLike | None = None) -> jax.Array:
    """Part of the recalled signals [S, 256] that is read right; `word` [S] as in `cross_entropy`."""
    read = predict(net, signals)
    return jnp.mean(read == (jnp.arange(len(read)) if word is None else jnp.asarray(word)), dtype=jnp.float32)


def cross_entropy(net: Net, signals: jax.typing.ArrayLike, word: jax.typing.ArrayLike | None = None) -> jax.Array:
    """Mean cross-entropy, in nats, of recalled signals; differentiable with respect to them.

    Args:
        net: a trained net.
        signals: p_sig, [S, 256], in any unit.
        word: numbers of the words stored, from 0, [S]; default 0, 1, 2, ...
    """
    signals = jnp.asarray(signals)
    return _loss(net, normalise(signals), jnp.arange(len(signals)) if word is None else jnp.asarray(word))


@dataclass(frozen=True)
class Training:
    """A training, finished or broken off.

    Attributes:
        net: as it is now.
        seed: random seed of weights, order and noise.
        step: steps done.
        loss: mean cross-entropy of the last call's steps.
        validation: accuracy on held-out examples at the last check.
        examples: how many these were.
        finished: whether the accuracy asked for was reached, confirmed on `LAST_CHECK` examples or all there are.
        seconds: spent so far, compilation included.
    """

    net: Net
    seed: int
    step: int = 0
    loss: float = float("nan")
    validation: float = 0.0
    examples: int = 0
    finished: bool = False
    seconds: float = 0.0


Progress = Callable[[Training], None]
"""Told about every call of `STEPS` steps."""


def silent(training: Training) -> None:
    """Report nothing."""


_advance = jax.jit(advance, static_argnames="count")
_validate = jax.jit(validate, static_argnames="count")
_examples = jax.jit(examples, static_argnames="recipe")


def train(
    recipe: Recipe,
    seed: int = 0,
    *,
    budget: float = 600.0,
    target: float = 0.999,
    most_steps: int | None = None,
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> Training:
    """Train a net until it reads held-out transformed inputs, or until time is up.

    The same recipe and seed go through the same nets, bit for bit on one machine, however often they are broken off.

    Args:
        recipe: the net and its training data.
        seed: of weights, order and noise.
        budget: seconds that this call may take; it ends within one call of `STEPS` steps and a last check of it.
        target: validation accuracy to stop at.
        most_steps: steps to stop at; default no limit.
        checkpoint: file that holds the training, written every 30 s and at the end; if it exists, training goes on
            from there, and one that has reached `target` is only loaded.
        progress: told about every `STEPS` steps.

    Raises:
        FileFormatError: if the checkpoint is broken.
        ValueError: if it is of another recipe or seed.
        OSError: if it cannot be written.
    """
    began = saved = time.perf_counter()
    training = _take_up(recipe, seed, checkpoint)
    before = training.seconds
    if training.finished and training.validation >= target:
        return training
    data = _examples(recipe, seed)
    total = recipe.classes * recipe.kept
    over = False
    while not over:
        count = STEPS if most_steps is None else min(STEPS, most_steps - training.step)
        if count > 0:
            net, loss = _advance(training.net, data, seed, training.step, count)
            training = replace(training, net=net, step=training.step + count, loss=float(loss))
        quick = float(_validate(training.net, data, QUICK_CHECK))
        over = time.perf_counter() - began > budget or (most_steps is not None and training.step >= most_steps)
        training = replace(training, validation=quick, examples=min(QUICK_CHECK, total), finished=False)
        if over or quick >= target:
            whole = float(_validate(training.net, data, LAST_CHECK))
            training = replace(training, validation=whole, examples=min(LAST_CHECK, total), finished=whole >= target)
            over = over or training.finished
        now = time.perf_counter()
        training = replace(training, seconds=before + now - began)
        if checkpoint is not None and (over or now - saved > SAVE_EVERY):
            save(checkpoint, training)
            saved = now
        progress(training)
    return training


def _take_up(recipe: Recipe, seed: int, checkpoint: Path | None) -> Training:
    if checkpoint is None or not Path(checkpoint).exists():
        return Training(initial(recipe, seed), seed)
    found = load(checkpoint)
    if (found.net.recipe, found.seed) != (recipe, seed):
        raise ValueError(f"{checkpoint}: holds the net of seed {found.seed} and {found.net.recipe}; name another file")
    return found


def save(path: Path, training: Training) -> None:
    """Write a training, finished or not.

    Raises:
        OSError: if the path cannot be written.
    """
    content = {
        "schema": SCHEMA,
        "recipe": json.dumps(asdict(training.net.recipe)),
        "training": {entry.name: getattr(training, entry.name) for entry in fields(training) if entry.name != "net"},
        "parameters": jax.tree.map(np.asarray, training.net.parameters),
    }
    with atomic(path) as temporary:
        temporary.write_bytes(serialization.msgpack_serialize(content))


def load(path: Path) -> Training:
    """Read a training; its net can be used whether it is finished or not.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it is not a complete file of this schema.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        content = serialization.msgpack_restore(path.read_bytes())
    except ValueError as error:
        raise FileFormatError(f"{path}: not a readable classifier file (truncated?)") from error
    found = content.get("schema", "none") if isinstance(content, dict) else "none"
    if found != SCHEMA:
        raise FileFormatError(f"{path}: schema is {found!r}, expected {SCHEMA!r}")
    given = json.loads(content["recipe"])
    recipe = Recipe(**{**given, "hidden": tuple(given["hidden"])})
    parameters = jax.tree.map(jnp.asarray, content["parameters"])
    return Training(Net(parameters, recipe), **content["training"])
