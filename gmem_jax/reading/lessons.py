"""Training data of the paper's reader: the inputs J_s alone, shifted, scaled and with noise (paper, Sec. III).

All words under one transformation are a set. Each set is divided by its own <|J|>, as recalled signals are when they
are read, so that a factor changes only the relative size of the noise.

Only the shifted J_s are stored, [S, shifts, 256]: an example follows from the numbers of its word, shift, amplitude and
draw, and from the seed. All functions are pure.
"""

import functools
import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.signals import LONGEST_WORD, bin_average, bit_width, words
from gmem_jax.physics import chance
from gmem_jax.physics.numbers import require_numbers, require_whole
from gmem_jax.simulation.stage import BINS

MOST_LAYERS = 8
RATIOS = 64  # ratios of noise to signal at which <|J|> of a set is computed; linear interpolation is right to 1e-5


@dataclass(frozen=True)
class TrainingConfig:
    """The layers of the net and its training data; by default the paper's net, and 17,325 examples of each word.

    Attributes:
        bits: length L of the words.
        hidden: widths of the hidden layers.
        shifts: number of shifts in u, equally spaced in +-`shift`.
        shift: largest shift, in widths of a bit u_b.
        amplitudes: number of factors on J, equally spaced in 1 +- `amplitude`.
        amplitude: largest relative change of J.
        draws: number of draws of the noise; their standard deviations are equally spaced from 0 to `noise`.
        noise: largest standard deviation of the noise, in <|J|>.
        held_out: fraction of the (shift, amplitude, draw) combinations that is held out for validation.
        batch: number of examples in a step of the training.
        rate: learning rate of plain SGD.

    Raises:
        ValueError: for impossible numbers, or if no example is left to train on.
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

    def __post_init__(self) -> None:
        for name in ("bits", "shifts", "amplitudes", "draws", "batch"):
            object.__setattr__(self, name, require_whole(name, getattr(self, name), 1))
        widths = self.hidden if np.iterable(self.hidden) else (self.hidden,)
        object.__setattr__(self, "hidden", tuple(require_whole("a width of hidden", width, 1) for width in widths))
        if self.bits > LONGEST_WORD or len(self.hidden) > MOST_LAYERS:
            limits = f"at most {LONGEST_WORD} bits and {MOST_LAYERS} hidden layers"
            raise ValueError(f"a net has {limits}, got {self.bits} and {len(self.hidden)}")
        for name in ("shift", "amplitude", "noise", "held_out", "rate"):
            require_numbers(**{name: getattr(self, name)})
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be a number from 0, got {getattr(self, name)}")
        if self.rate == 0.0:
            raise ValueError("rate must be above 0")
        if self.kept >= self.combinations:
            raise ValueError(
                f"held_out = {self.held_out:g} of {self.combinations} (shift, amplitude, draw) combinations leaves "
                "none to train on; hold out less, or take more of them"
            )

    @property
    def classes(self) -> int:
        """Number of words S."""
        return 1 << self.bits

    @property
    def combinations(self) -> int:
        """Number of transformations (shift, amplitude, draw) of one word."""
        return self.shifts * self.amplitudes * self.draws

    @property
    def kept(self) -> int:
        """Number of transformations of one word that are held out for validation."""
        return max(1, round(self.held_out * self.combinations))


@functools.partial(
    jax.tree_util.register_dataclass, data_fields=["table", "level", "order", "noise"], meta_fields=["lessons"]
)
@dataclass(frozen=True)
class Examples:
    """The data from which examples are made.

    Attributes:
        table: J_s(u - shift) / <|J|>, [S, shifts, 256], float32.
        level: mean of |J| of each set, noise included, over that of the unchanged words, by shift, amplitude and draw;
            float32.
        order: numbers of the (shift, amplitude, draw) combinations, shuffled by the seed; the first `lessons.kept` are
            held out.
        noise: random key.
        lessons: the transformations.
    """

    table: jax.Array
    level: jax.Array
    order: jax.Array
    noise: jax.Array
    lessons: TrainingConfig

    def make(self, word: jax.Array, combination: jax.Array) -> jax.Array:
        """Input [..., 256] of word number `word` (from 0) under a combination; equal numbers give equal inputs."""
        lessons = self.lessons
        shift, rest = jnp.divmod(combination, lessons.amplitudes * lessons.draws)
        factor, draw = jnp.divmod(rest, lessons.draws)
        scale, deviation = _scale(lessons, factor), _deviation(lessons, draw)
        number = word * lessons.combinations + combination

        def normal(one: jax.Array) -> jax.Array:
            return jax.random.normal(jax.random.fold_in(self.noise, one), (BINS,), jnp.float32)

        noise = jax.vmap(normal)(number.ravel()).reshape(*number.shape, BINS)
        level = self.level[shift, factor, draw]
        clean = (scale.astype(jnp.float32) / level)[..., None] * self.table[word, shift]
        return clean + (deviation.astype(jnp.float32) / level)[..., None] * noise

    def training(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A batch of training inputs [batch, 256] and their words [batch], drawn with replacement."""
        lessons = self.lessons
        for_word, for_combination = jax.random.split(key)
        word = jax.random.randint(for_word, (lessons.batch,), 0, lessons.classes)
        place = jax.random.randint(for_combination, (lessons.batch,), lessons.kept, lessons.combinations)
        return self.make(word, self.order[place]), word

    def held_out(self, number: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Held-out inputs [..., 256] and their words; `number` is below S * kept, and the word changes with each."""
        word = number % self.lessons.classes
        # Neighbouring words take different combinations, so that a few thousand examples cover many.
        place = (number // self.lessons.classes + 7 * word) % self.lessons.kept
        return self.make(word, self.order[place]), word


def _ladder(place: jax.Array, rungs: int) -> jax.Array:
    """Number `place` of `rungs` equally spaced numbers from -1 to 1; 0 if there is only one."""
    return 2.0 * place / (rungs - 1) - 1.0 if rungs > 1 else 0.0 * place


def _scale(lessons: TrainingConfig, factor: jax.Array) -> jax.Array:
    """The factor on J in a set."""
    return 1.0 + lessons.amplitude * _ladder(factor, lessons.amplitudes)


def _deviation(lessons: TrainingConfig, draw: jax.Array) -> jax.Array:
    """Standard deviation of the noise of a set, in <|J|>."""
    return lessons.noise * (draw / max(lessons.draws - 1, 1))


def examples(lessons: TrainingConfig, seed: jax.typing.ArrayLike) -> Examples:
    """The training and validation set of a seed."""
    shuffle, noise = jax.random.split(jax.random.fold_in(chance.key(seed), 1))
    order = jax.random.permutation(shuffle, lessons.combinations)
    table = _table(lessons)
    return Examples(table=table, level=_level(lessons, table), order=order, noise=noise, lessons=lessons)


def _table(lessons: TrainingConfig) -> jax.Array:
    """The shifted J_s over the mean of |J| of the unshifted words, [S, shifts, 256]."""
    signals = words(lessons.bits)
    mean = jnp.mean(jnp.abs(bin_average(signals)))
    steps = _ladder(jnp.arange(lessons.shifts), lessons.shifts) * lessons.shift * bit_width(lessons.bits)

    def moved(step: jax.Array) -> jax.Array:
        return jnp.asarray(bin_average(replace(signals, centres=signals.centres + step)) / mean, jnp.float32)

    # One shift after another: side by side they would need `shifts` times the memory of `bin_average`.
    return jnp.moveaxis(jax.lax.map(moved, steps), 0, 1)


def _level(lessons: TrainingConfig, table: jax.Array) -> jax.Array:
    """Mean of |scale J + deviation n| over words, u and Gaussian n, [shifts, amplitudes, draws]."""
    scale = _scale(lessons, jnp.arange(lessons.amplitudes))[:, None]
    noise = _deviation(lessons, jnp.arange(lessons.draws)) / scale  # that of an equivalent set with scale 1
    known = jnp.linspace(0.0, jnp.max(noise), RATIOS)

    def mean(signal: jax.Array, deviation: jax.Array) -> jax.Array:
        """Mean of the absolute value of Gaussian numbers: that of a folded normal distribution."""
        x = signal / (math.sqrt(2.0) * jnp.maximum(deviation, 1e-6))
        return jnp.mean(deviation * math.sqrt(2.0 / math.pi) * jnp.exp(-(x**2)) + signal * jax.lax.erf(x))

    def of_shift(moved: jax.Array) -> jax.Array:
        means = jax.lax.map(lambda deviation: mean(moved, deviation), known.astype(table.dtype))
        return (scale * jnp.interp(noise, known, means)).astype(jnp.float32)

    level: jax.Array = jax.lax.map(of_shift, jnp.moveaxis(table, 1, 0))
    return level
