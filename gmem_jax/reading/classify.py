"""The paper's reader in one place, as `gmem_jax.classify`: its lessons, the net, its training."""

from gmem_jax.reading.lessons import Examples, TrainingConfig, examples
from gmem_jax.reading.net import Net, Perceptron, accuracy, cross_entropy, initial, logits, normalise, predict
from gmem_jax.reading.training import Listener, Training, learn, load, save
from gmem_jax.reading.training import train_net as train
from gmem_jax.reading.training import validation_accuracy as validate
from gmem_jax.simulation.progress import silent

__all__ = [
    "Examples",
    "Listener",
    "Net",
    "Perceptron",
    "Training",
    "TrainingConfig",
    "accuracy",
    "cross_entropy",
    "examples",
    "initial",
    "learn",
    "load",
    "logits",
    "normalise",
    "predict",
    "save",
    "silent",
    "train",
    "validate",
]
