"""Scores of all readers on the words of a recall."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gmem_jax.experiment.analysis import spread
from gmem_jax.reading import net
from gmem_jax.reading.readers import Stored, bit_errors, confusion, information, linear_decoder, nearest_template
from gmem_jax.reading.training import Training


def reading_report(stored: Stored, nets: Sequence[Training]) -> dict[str, Any]:
    """How well the words of a recall are read: by the nets (mean and SD over training seeds) and by the baselines.

    For every reader it has the accuracy, the error rate of each bit and the `information`; the latter two are over the
    readings of all nets together.
    """
    count = len(stored.signals)
    answers = {
        "net": np.stack([np.asarray(net.predict(training.net, stored.signals)) for training in nets]),
        "nearest template": nearest_template(stored.signals, stored.templates),
        "linear decoder": linear_decoder(stored.signals),
    }
    rows = {}
    for name, read in answers.items():
        table = confusion(read, count)
        right = np.atleast_1d(np.mean(read == np.arange(count), axis=-1))
        mean, deviation, _ = spread(right.tolist())
        rows[name] = {
            "accuracy": mean,
            "accuracy_sd": deviation if name == "net" and len(right) > 1 else None,
            "bit_errors": bit_errors(read).tolist(),
            "information": information(table),
            "read": read.tolist(),
        }
    seeds = [
        {
            "seed": training.seed,
            "accuracy": float(net.accuracy(training.net, stored.signals)),
            "cross_entropy": float(net.cross_entropy(training.net, stored.signals)),
            **{key: getattr(training, key) for key in ("validation", "examples", "finished", "step", "seconds")},
        }
        for training in nets
    ]
    return {"bits": stored.bits, "words": count, "background": stored.background, "readers": rows, "nets": seeds}
