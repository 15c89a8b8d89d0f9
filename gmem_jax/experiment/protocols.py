"""Protocols that are ready for use: `gm.protocols`. Lengths are in t0.

Each function gives a `Protocol` for `gm.Experiment(pack, signals, protocol=...)`; each says what it is for, and where
it was asked for first.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

from gmem_jax.experiment.stages import compress, cycle, hold, read, rest, shake, train, write
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stage import OWN, Stage

Shear = Literal["during", "before"]
"""When waveforms are applied: during the compression, or before it."""

ONE_SINE = "sine:1"
ONE_SIDED = tuple(math.sin(math.pi * place / 16) for place in range(1, 16))
"""A shear to one side and back: half a sine, as samples."""
READOUT = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
"""Amplitudes of an ascending readout, in gamma0."""


def _compressed() -> tuple[Stage, ...]:
    """A cycle, a rest, and a compression without a waveform: the pack at u = 1."""
    return (*cycle(), rest(), compress(1.0), hold(0.2))


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


def paper(store: float = 2.0) -> Protocol:
    """The paper's experiment: does a pack give back a waveform that was applied while it was compressed?

    Asked in arXiv:2603.14595, Sec. II. Expected: p_sig follows the integral J of the waveform, with a gain of some
    tenths; without friction nothing comes back.
    """
    return memory_protocol(0.2, 0.2, store, second_readout=False)


def paper_twice_read(store: float = 2.0) -> Protocol:
    """The paper's experiment with another cycle and a second readout: is anything left after the first?

    Asked in arXiv:2603.14595, Sec. III, where the second readout serves as background ("sub2"). Expected: what it finds
    beyond the zero signal's is nothing if the first readout erases the memory.
    """
    return memory_protocol(0.2, 0.2, store, second_readout=True)


def write_read_write_read(store: float = 2.0, cycles: int = 1) -> Protocol:
    """Two writes, each read after it: does reading erase, and does the second write see the first?

    The sets of waveforms are called "first" and "second": `gm.signals(first=..., second=...)`. It is the paper's
    experiment (arXiv:2603.14595, Sec. II), done twice. Expected: with a silent first set the second is the paper's on a
    pack one cycle older, and it is the paper's own with no cycle before and 0.2 t0 of storage for the first.

    Args:
        store: of each write, in t0.
        cycles: without shear, before the first write.
    """
    return Protocol(
        [cycle() for _ in range(cycles)],
        *(rest(), write("first", name="write-first"), hold(store, name="store"), read("read-first")),
        *(rest(), write("second", name="write-second"), hold(store, name="store"), read("read-second")),
    )


def partial_readout(to: float = 0.5, store: float = 2.0) -> Protocol:
    """Read a part, compress again, read the whole: is what was read gone, and what was not read still there?

    The readout of arXiv:2603.14595, Sec. II, cut short: time reversal says that the last of the waveform is read first.
    Expected: down to u = `to` the first read is the paper's.

    Args:
        to: u at which the first read ends.
        store: in t0.
    """
    part = 1.0 - to
    return Protocol(
        *(cycle(), rest(), write(), hold(store, name="store"), read("read-part", to=to, length=part)),
        *(compress(1.0, part, name="recompress"), hold(0.2), read("read-again")),
    )


def two_channels(first: str = "xy", second: str = "z", store: float = 2.0) -> Protocol:
    """Two waveforms at once, each on a channel of its own: how much do they disturb each other?

    The sets are called like the channels: `gm.signals(xy=..., z=...)`. It is the paper's experiment
    (arXiv:2603.14595, Sec. II) with a second shear. Expected: in an isotropic pack that answers linearly there is no
    cross-talk, and two channels hold twice as much. A silent channel leaves the other as it is alone.
    """
    sets: dict[str, Any] = {first: first, second: second}
    return Protocol(cycle(), rest(), write(**sets), hold(store, name="store"), read())


def two_channels_in_turn(first: str = "xy", second: str = "z", length: float = 0.25, store: float = 0.5) -> Protocol:
    """Waveforms in time at u = 1, on one channel and then on the other, and a readout: does their order matter?

    Lindeman trained packings with two kinds of shear, and found that what can be read depends on the order
    (arXiv:2407.14966, doi:10.1039/D5SM00470E). Swap `first` and `second` and compare. Expected: nothing differs in a
    pack that answers linearly, nor where one of the two is silent.

    Args:
        first: channel and set that come first.
        second: those that come then.
        length: of each, in t0.
        store: in t0.
    """
    sets: list[dict[str, Any]] = [{first: first}, {second: second}]
    turns = [write(to=None, length=length, name=f"write-{name}", **own) for own in sets for name in own]
    return Protocol(_compressed(), turns, hold(store, name="store"), read())


def amplitude_training(
    amplitude: float = 1.0, times: int = 8, readout: Sequence[float] = READOUT, length: float = 0.25
) -> Protocol:
    """Cycles of shear of one amplitude at u = 1, then a readout of ascending amplitude: is there a cusp at the first?

    Asked of amorphous solids in experiments (arXiv:1809.08505) and simulations (arXiv:1805.09113): what moved since the
    training is least, or bends, where the readout reaches the trained amplitude. The sets of waveforms are what is
    trained with, as a sine; the readout is a sine in all replicas, the untrained zero signal too. Observers compare
    with the end of the training. Expected: amplitude 0 leaves the readout of an untrained pack.

    Args:
        amplitude: of the training, in gamma0.
        times: cycles of training.
        readout: amplitudes of the sines of the readout, in gamma0, one cycle each.
        length: of a cycle, in t0.
    """
    return several_amplitudes((amplitude,), times, readout, length)


def several_amplitudes(
    amplitudes: Sequence[float] = (1.0, 0.5), times: int = 4, readout: Sequence[float] = READOUT, length: float = 0.25
) -> Protocol:
    """Training that goes through several amplitudes again and again, the smallest last: are all of them remembered?

    In amorphous solids both of two are, but only if the smaller one is last (arXiv:1809.08505; arXiv:1805.09113). In
    packs of frictional grains both are if the larger one is last (docs/protocols.md).
    The rest is as in `amplitude_training`. Expected: without training the readout of an untrained pack.

    Args:
        amplitudes: in the order of a round, in gamma0.
        times: rounds.
        readout: as in `amplitude_training`.
        length: of a cycle, in t0.
    """
    rounds = [train(1, amplitude=amplitude, length=length) for _ in range(times) for amplitude in amplitudes]
    reads = [
        read(f"read-{amplitude:g}", to=None, length=length, amplitude=amplitude, mark=place == 0, xy=ONE_SINE)
        for place, amplitude in enumerate(readout)
    ]
    return Protocol(_compressed(), rounds, reads)


def erasure_by_shear(amplitude: float = 10.0, length: float = 0.25, store: float = 0.5) -> Protocol:
    """One cycle of a larger shear at u = 1 between write and readout: how large must it be to erase?

    A larger amplitude erases what was stored in amorphous solids (arXiv:1805.09113). Expected: amplitude 0 changes
    nothing; what is left falls with the amplitude.

    Args:
        amplitude: in gamma0.
        length: of the cycle, in t0.
        store: before it, in t0.
    """
    return erasure_by_vibration(amplitude, 1, length, store)


def erasure_by_vibration(
    amplitude: float = 3.0, periods: int = 16, length: float = 1.0, store: float = 0.5
) -> Protocol:
    """Vibration of the walls at u = 1 between write and readout: does it erase more than one slow cycle?

    Vibration is how a laboratory makes a pack forget its history. Expected: amplitude 0 changes nothing.

    Args:
        amplitude: in gamma0.
        periods: of the sine.
        length: of the vibration, in t0.
        store: before it, in t0.
    """
    erase = shake(amplitude, periods, length=length, name="erase")
    return Protocol(cycle(), rest(), write(), hold(store, name="store"), erase, hold(0.2), read())


def long_storage(store: float = 20.0) -> Protocol:
    """The paper's experiment with a long storage: does a pack forget by itself?

    Asked in arXiv:2603.14595, where a storage of 2 t0 is 36,000 t_c, as long as 20 of t0 = 1,800. Expected: there is no
    temperature, so that nothing changes once the grains rest; with 2 t0 it is the paper's.
    """
    return paper(store)


def read_by_shear(
    amplitude: float = 5.0, *, one_sided: bool = False, times: int = 2, length: float = 0.25, store: float = 0.5
) -> Protocol:
    """Read by cycles of shear at u = 1, without decompression: what answers, what returns, what is dissipated?

    Driving to one side only tells mechanisms of memory apart (the latch of arXiv:2306.07177); dissipation falls while
    frictional grains are trained (arXiv:1711.09382); displacements and rotations need not return alike
    (arXiv:2010.04150). p_sig is a function of the time in a cycle. Observers compare with the beginning of the first.
    Expected: with amplitude 0 nothing moves; a pack that answers reversibly is back after each cycle.

    Args:
        amplitude: in gamma0.
        one_sided: whether the shear goes to one side and back, in the place of a sine.
        times: cycles.
        length: of a cycle, in t0.
        store: before them, in t0.
    """
    reads = [
        read(to=None, length=length, amplitude=amplitude, mark=place == 0, xy=ONE_SIDED if one_sided else ONE_SINE)
        for place in range(times)
    ]
    return Protocol(cycle(), rest(), write(), hold(store, name="store"), reads)
