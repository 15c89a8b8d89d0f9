"""Training of the paper's reader, and files of trained nets."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import serialization

from gmem_jax.errors import FileFormatError
from gmem_jax.files.atomic import atomic
from gmem_jax.files.schemas import NET, other_kind
from gmem_jax.files.seal import BLOCK, require_sealed, seal
from gmem_jax.files.validation import (
    Array,
    fit,
    is_number,
    json_of,
    refusing,
    require,
    require_fields,
    require_finite,
    whole,
)
from gmem_jax.physics import chance
from gmem_jax.physics.numbers import require_whole
from gmem_jax.reading.lessons import Examples, TrainingConfig, examples
from gmem_jax.reading.net import Net, initial, loss_of, raw_logits
from gmem_jax.simulation.progress import silent
from gmem_jax.simulation.stage import BINS

STEPS_PER_CALL = 250  # steps in a call from the host, about a second; then the validation accuracy is checked
QUICK_CHECK = 4_096  # held-out examples tried after every call
LAST_CHECK = 65_536  # held-out examples, at most, that must agree before training stops early
SLICE = 1_024  # examples evaluated side by side
SAVE_EVERY = 30.0  # seconds between checkpoints


def learn(
    net: Net, data: Examples, seed: jax.typing.ArrayLike, first: jax.typing.ArrayLike, count: int
) -> tuple[Net, jax.Array]:
    """Make `count` steps of plain SGD from step number `first`; return the net after them and their mean loss.

    The random numbers of a step depend on its number and the seed alone, so that training can stop and resume anywhere.
    """
    key = jax.random.fold_in(chance.key(seed), 2)

    def step(net: Net, number: Any) -> tuple[Net, jax.Array]:
        inputs, word = data.training(jax.random.fold_in(key, number))
        loss, slope = jax.value_and_grad(loss_of)(net, inputs, word)
        return jax.tree.map(lambda weight, uphill: weight - net.lessons.rate * uphill, net, slope), loss

    net, losses = jax.lax.scan(step, net, first + jnp.arange(count))
    return net, jnp.mean(losses)


def validation_accuracy(net: Net, data: Examples, count: int) -> jax.Array:
    """Accuracy on the first `count` held-out examples (or on all S * kept, if fewer)."""
    total = min(count, net.lessons.classes * net.lessons.kept)
    slices = -(-total // SLICE)

    def right(number: jax.Array) -> jax.Array:
        inputs, word = data.held_out(number)
        return jnp.sum((jnp.argmax(raw_logits(net, inputs), axis=-1) == word) & (number < total))

    return jnp.sum(jax.lax.map(right, jnp.arange(slices * SLICE).reshape(slices, SLICE))) / total


@dataclass(frozen=True)
class Training:
    """The state of a training, finished or interrupted.

    Attributes:
        net: the net.
        seed: random seed of weights, order and noise.
        step: number of steps done.
        loss: mean cross-entropy over the last 250 steps or fewer, in nats.
        validation: accuracy on held-out examples at the last check.
        examples: number of examples in that check.
        finished: whether the target accuracy was reached, confirmed on 65,536 held-out examples or all there are.
        seconds: time spent so far, compilation included, in s.
    """

    net: Net
    seed: int
    step: int = 0
    loss: float = float("nan")
    validation: float = 0.0
    examples: int = 0
    finished: bool = False
    seconds: float = 0.0


Listener = Callable[[Training], None]
"""A function that is called with the `Training` after every `STEPS_PER_CALL` steps."""


_learn = jax.jit(learn, static_argnames="count")
_validate = jax.jit(validation_accuracy, static_argnames="count")
_examples = jax.jit(examples, static_argnames="lessons")


def train_net(
    lessons: TrainingConfig,
    seed: int = 0,
    *,
    budget: float = 600.0,
    target: float = 0.999,
    most_steps: int | None = None,
    checkpoint: Path | None = None,
    listener: Listener = silent,
) -> Training:
    """Train a net until it reads held-out examples with the target accuracy, or until time is up.

    On one machine the same lessons and seed give the same net, bit for bit, even if the training is interrupted.

    Args:
        lessons: the layers of the net and its training data.
        seed: random seed of weights, order and noise.
        budget: time that this call may take, in s; it ends after the 250 steps at which this has passed, and a last
            check.
        target: accuracy on held-out examples at which the training stops.
        most_steps: number of steps at which the training stops; default no limit.
        checkpoint: file that keeps the training, written every 30 s, at the end and after an interrupt; default none.
            If it exists, the training continues from it; if that has reached `target`, it is only loaded.
        listener: called with the `Training` after every 250 steps; default none.

    Raises:
        FileFormatError: if the checkpoint is broken.
        ValueError: if the checkpoint is of other lessons or of another seed, or the seed is no whole number from 0.
        OSError: if the checkpoint cannot be written.
    """
    began = saved = time.perf_counter()
    seed = require_whole("seed", seed)
    training = _take_up(lessons, seed, checkpoint)
    before = training.seconds
    if training.finished and training.validation >= target:
        return training
    data = _examples(lessons, seed)
    total = lessons.classes * lessons.kept
    kept, over = training, False
    try:
        while not over:
            new = training
            count = STEPS_PER_CALL if most_steps is None else min(STEPS_PER_CALL, most_steps - new.step)
            if count > 0:
                net, loss = _learn(new.net, data, seed, new.step, count)
                new = replace(new, net=net, step=new.step + count, loss=float(loss))
            quick = float(_validate(new.net, data, QUICK_CHECK))
            over = time.perf_counter() - began > budget or (most_steps is not None and new.step >= most_steps)
            new = replace(new, validation=quick, examples=min(QUICK_CHECK, total), finished=False)
            if over or quick >= target:
                whole = float(_validate(new.net, data, LAST_CHECK))
                new = replace(new, validation=whole, examples=min(LAST_CHECK, total), finished=whole >= target)
                over = over or new.finished
            now = time.perf_counter()
            training = replace(new, seconds=before + now - began)
            if checkpoint is not None and now - saved > SAVE_EVERY:
                save(checkpoint, training)
                kept, saved = training, now  # after it: what an interrupted save did not keep is saved below
            listener(training)
    finally:  # the last whole round, also where the next was interrupted
        if checkpoint is not None and training is not kept:
            save(checkpoint, training)
    return training


def _take_up(lessons: TrainingConfig, seed: int, checkpoint: Path | None) -> Training:
    if checkpoint is None or not Path(checkpoint).exists():
        return Training(initial(lessons, seed), seed)
    found = load(checkpoint)
    if (found.net.lessons, found.seed) != (lessons, seed):
        raise ValueError(f"{checkpoint}: holds the net of seed {found.seed} and {found.net.lessons}; name another file")
    return found


def save(path: Path, training: Training) -> None:
    """Write a training, finished or not.

    Raises:
        OSError: if the path cannot be written.
    """
    content = {
        "schema": NET.name,
        "recipe": json.dumps(asdict(training.net.lessons)),
        "training": {entry.name: getattr(training, entry.name) for entry in fields(training) if entry.name != "net"},
        "parameters": jax.tree.map(np.asarray, training.net.parameters),
    }
    with atomic(path) as temporary:
        temporary.write_bytes(bytes(BLOCK) + serialization.msgpack_serialize(content))
        seal(temporary)


def load(path: Path) -> Training:
    """Read a training; its net can be used whether it is finished or not.

    Raises:
        FileNotFoundError: if there is no such file.
        FileFormatError: if it is not a complete file of this schema.
    """
    path = Path(path)
    with refusing(path, "classifier file"), path.open("rb") as file:
        require_sealed(file, "classifier file")
        # The format has no compression and no code, so that the content is no larger than the file.
        content = serialization.msgpack_restore(file.read())
        found = content.get("schema", "none") if isinstance(content, dict) else "none"
        if found != NET.name:
            raise FileFormatError(f"{path}: {other_kind(found, NET.name)}")
        recipe = json_of(content.get("recipe"), "recipe")
        known = {entry.name for entry in fields(TrainingConfig)}
        require(isinstance(recipe, dict) and set(recipe) == known, "its recipe has other fields than lessons have")
        lessons = TrainingConfig(**recipe)
        require_fields(content.get("training"), "training", **_TRAINING)
        require(set(content["training"]) == set(_TRAINING), "its training has fields that it should not have")
        net = Net(_parameters(content.get("parameters"), lessons), lessons)
        return Training(net, **content["training"])


def _part(value: Any) -> bool:
    return is_number(value) and 0.0 <= value <= 1.0


_TRAINING: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("seed", "step", "examples"), whole),
    "loss": lambda value: isinstance(value, float),  # NaN before the first step
    "validation": _part,
    "finished": lambda value: isinstance(value, bool),
    "seconds": is_number,
}


def _parameters(found: Any, lessons: TrainingConfig) -> dict[str, dict[str, jax.Array]]:
    """Weights and biases `found` in a file, checked against the layers of `lessons`.

    Raises:
        FileFormatError: if they are those of another net, or not finite.
    """
    widths = (BINS, *lessons.hidden, lessons.classes)
    layers = [f"Dense_{number}" for number in range(len(widths) - 1)]
    require(isinstance(found, dict) and sorted(found) == sorted(layers), "its layers are not those of its recipe")
    for layer, inputs, outputs in zip(layers, widths[:-1], widths[1:], strict=True):
        own = found[layer]
        require(isinstance(own, dict) and all(isinstance(array, np.ndarray) for array in own.values()), "no arrays")
        fit({"kernel": Array("real", (inputs, outputs)), "bias": Array("real", (outputs,))}, own)
        require_finite({f"{layer}/{name}": array for name, array in own.items()})
        require(sorted(own) == ["bias", "kernel"], f"{layer} holds more than weights and biases")
    return {layer: {name: jnp.asarray(array) for name, array in found[layer].items()} for layer in layers}
