"""Protocols that are ready for use: `gm.protocols`. Lengths are in t0.

Each function gives a `Protocol` for `gm.Experiment(pack, signals, protocol=...)`; each says what it is for, and where
it was asked for first.
"""

from dataclasses import replace
from typing import Literal

from gmem_jax.experiment.stages import cycle
from gmem_jax.simulation.protocol import OWN, Protocol, Stage

Shear = Literal["during", "before"]
"""When waveforms are applied: during the compression, or before it."""


def memory_protocol(
    rest: float,
    hold: float,
    store: float,
    *,
    second_readout: bool,
    shear: str = "during",
) -> Protocol:
    """The experiment of Sec. II, lengths in t0: a shear-free cycle, rest, encode, store, readout (6.6 t0 in all).

    With `second_readout`, Sec. III's: another rest, compression, hold and readout (9 t0 in all). With shear "before",
    the waveform is gone through in t0 at u = 0 before the compression ("pulse"), which is without shear then.
    """
    pulsed = shear == "before"
    pulse = (Stage("pulse", 0.0, 0.0, 1.0, "write", OWN),) if pulsed else ()
    stages = (
        *cycle(rest, hold),
        Stage("rest-2", 0.0, 0.0, rest, "hold"),
        *pulse,
        Stage("encode", 0.0, 1.0, 1.0, "condition" if pulsed else "write", () if pulsed else OWN),
        Stage("store", 1.0, 1.0, store, "hold"),
        Stage("readout", 1.0, 0.0, 1.0, "read"),
    )
    if second_readout:
        *again, last = cycle(rest, hold)
        stages += (*(replace(stage, name=f"{stage.name}-3") for stage in again),)
        stages += (replace(last, name="readout-2", role="read"),)
    return Protocol(*stages)
