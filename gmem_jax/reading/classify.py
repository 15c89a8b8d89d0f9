"""The paper's reader of binary words, `gm.classify`: the net, its training data and its training."""

from gmem_jax.reading.lessons import Examples, TrainingConfig, examples
from gmem_jax.reading.net import Net, accuracy, cross_entropy, initial, logits, normalise, predict
from gmem_jax.reading.training import Training, learn, load, save
from gmem_jax.reading.training import train_net as train
from gmem_jax.reading.training import validation_accuracy as validate

__all__ = [
    "Examples",
    "Net",
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
    "train",
    "validate",
]
