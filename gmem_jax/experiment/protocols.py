"""Protocols that are ready for use: `gm.protocols`. All lengths are in t0.

Each function returns a `Protocol` for `gm.Experiment(pack, signals, protocol=...)`. Its docstring says which question
it answers, where the question was asked first, and what is expected. `store` is the length of the storage.
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
    """The experiment of Sec. II: a shear-free cycle, rest, encode, store, readout; 6.6 t0 with the default lengths.

    With `second_readout` it is the experiment of Sec. III: a rest, a compression, a hold and a readout follow (9 t0).
    With shear "before", a stage "pulse" of one t0 at u = 0 applies the waveform, and the compression is without shear.
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

    Asked in arXiv:2603.14595, Sec. III, where the second readout serves as background ("sub2"). Expected: the second
    readout does not differ from that of the zero signal, if the first erases the memory.
    """
    return memory_protocol(0.2, 0.2, store, second_readout=True)


def write_read_write_read(store: float = 2.0, cycles: int = 1) -> Protocol:
    """Two writes, each followed by a read: does reading erase, and does the second write depend on the first?

    The sets of waveforms are called "first" and "second": `gm.signals(first=..., second=...)`. It is the paper's
    experiment (arXiv:2603.14595, Sec. II), done twice. Expected: if the first set is zero, the second recall is the
    paper's for a pack that went through one cycle more; with cycles=0, and 0.2 t0 of storage for the first, it is the
    paper's own.

    Args:
        store: length of the storage after each write, in t0.
        cycles: number of cycles without shear before the first write.
    """
    return Protocol(
        [cycle() for _ in range(cycles)],
        *(rest(), write("first", name="write-first"), hold(store, name="store"), read("read-first")),
        *(rest(), write("second", name="write-second"), hold(store, name="store"), read("read-second")),
    )


def partial_readout(to: float = 0.5, store: float = 2.0) -> Protocol:
    """Read a part, compress again, read the whole: is what was read gone, and what was not read still there?

    The readout of arXiv:2603.14595, Sec. II, is cut short. By time reversal it begins with the end of the waveform.
    Expected: down to u = `to` the first read is the paper's.

    Args:
        to: u at which the first read ends.
        store: length of the storage, in t0.
    """
    part = 1.0 - to
    return Protocol(
        *(cycle(), rest(), write(), hold(store, name="store"), read("read-part", to=to, length=part)),
        *(compress(1.0, part, name="recompress"), hold(0.2), read("read-again")),
    )


def two_channels(first: str = "xy", second: str = "z", store: float = 2.0) -> Protocol:
    """Two waveforms at once, each on a channel of its own: how much do they disturb each other?

    The sets have the names of the channels: `gm.signals(xy=..., z=...)`. It is the paper's experiment
    (arXiv:2603.14595, Sec. II) with a second shear. Expected: an isotropic pack with a linear response has no
    cross-talk, and two channels hold twice as much. If one set is zero, the other is recalled as if alone.

    Args:
        first: one channel, and the set that is written on it.
        second: the other channel, and its set.
        store: length of the storage, in t0.
    """
    sets: dict[str, Any] = {first: first, second: second}
    return Protocol(cycle(), rest(), write(**sets), hold(store, name="store"), read())


def two_channels_in_turn(first: str = "xy", second: str = "z", length: float = 0.25, store: float = 0.5) -> Protocol:
    """Waveforms in time at u = 1, on one channel and then on the other, and a readout: does their order matter?

    Lindeman trained packings with two kinds of shear, and found that what can be read depends on the order
    (arXiv:2407.14966, doi:10.1039/D5SM00470E). Swap `first` and `second` and compare. Expected: the order does not
    matter in a pack with a linear response, nor if one of the two sets is zero.

    Args:
        first: channel that is written first, and its set of waveforms.
        second: channel that is written second, and its set.
        length: length of each write, in t0.
        store: length of the storage, in t0.
    """
    sets: list[dict[str, Any]] = [{first: first}, {second: second}]
    turns = [write(to=None, length=length, name=f"write-{name}", **own) for own in sets for name in own]
    return Protocol(_compressed(), turns, hold(store, name="store"), read())


def amplitude_training(
    amplitude: float = 1.0, times: int = 8, readout: Sequence[float] = READOUT, length: float = 0.25
) -> Protocol:
    """Training by cycles of shear at u = 1, then a readout of rising amplitude: is there a cusp at the trained one?

    Asked of amorphous solids in experiments (arXiv:1809.08505) and simulations (arXiv:1805.09113): the displacement
    since the training has a minimum, or a kink, where the readout reaches the trained amplitude. The sets of waveforms
    are the training cycles, for example a sine. The readout is a sine in all replicas, the untrained zero signal
    included. Observers compare with the end of the training. Expected: amplitude 0 gives the readout of an untrained
    pack.

    Args:
        amplitude: amplitude of the training, in gamma0.
        times: number of training cycles.
        readout: amplitudes of the readout, one sine each, in gamma0.
        length: length of a cycle, in t0.
    """
    return several_amplitudes((amplitude,), times, readout, length)


def several_amplitudes(
    amplitudes: Sequence[float] = (1.0, 0.5), times: int = 4, readout: Sequence[float] = READOUT, length: float = 0.25
) -> Protocol:
    """Training by rounds of several amplitudes: are all of them remembered?

    Amorphous solids remember both of two amplitudes, but only if each round ends with the smaller
    (arXiv:1809.08505; arXiv:1805.09113). Packs of frictional grains remember both if it ends with the larger
    (docs/protocols.md). All else is as in `amplitude_training`. Expected: without training, the readout of an untrained
    pack.

    Args:
        amplitudes: amplitudes of the cycles of one round, in their order, in gamma0.
        times: number of rounds.
        readout: as in `amplitude_training`.
        length: length of a cycle, in t0.
    """
    rounds = [train(1, amplitude=amplitude, length=length) for _ in range(times) for amplitude in amplitudes]
    reads = [
        read(f"read-{amplitude:g}", to=None, length=length, amplitude=amplitude, mark=place == 0, xy=ONE_SINE)
        for place, amplitude in enumerate(readout)
    ]
    return Protocol(_compressed(), rounds, reads)


def erasure_by_shear(amplitude: float = 10.0, length: float = 0.25, store: float = 0.5) -> Protocol:
    """One cycle of a larger shear at u = 1 between write and readout: how large must it be to erase?

    In amorphous solids a larger amplitude erases what was stored (arXiv:1805.09113). Expected: amplitude 0 changes
    nothing; the memory that is left falls with the amplitude.

    Args:
        amplitude: amplitude of the cycle, in gamma0.
        length: length of the cycle, in t0.
        store: length of the storage before it, in t0.
    """
    return erasure_by_vibration(amplitude, 1, length, store)


def erasure_by_vibration(
    amplitude: float = 3.0, periods: int = 16, length: float = 1.0, store: float = 0.5
) -> Protocol:
    """Vibration of the walls at u = 1 between write and readout: does it erase more than one slow cycle?

    Vibration is how a laboratory makes a pack forget its history. Expected: amplitude 0 changes nothing.

    Args:
        amplitude: amplitude of the sine, in gamma0.
        periods: number of its periods.
        length: length of the vibration, in t0.
        store: length of the storage before it, in t0.
    """
    erase = shake(amplitude, periods, length=length, name="erase")
    return Protocol(cycle(), rest(), write(), hold(store, name="store"), erase, hold(0.2), read())


def long_storage(store: float = 20.0) -> Protocol:
    """The paper's experiment with a long storage: does a pack forget by itself?

    Asked in arXiv:2603.14595, where the storage of 2 t0 lasts 36,000 t_c: as long as 20 t0 of the default 1,800 t_c.
    Expected: without temperature nothing changes once the grains rest; with 2 t0 it is the paper's experiment.
    """
    return paper(store)


def read_by_shear(
    amplitude: float = 5.0, *, one_sided: bool = False, times: int = 2, length: float = 0.25, store: float = 0.5
) -> Protocol:
    """Read by cycles of shear at u = 1, without decompression: what responds, what returns, what is dissipated?

    Shear to one side only distinguishes mechanisms of memory (the latch of arXiv:2306.07177); dissipation falls while
    frictional grains are trained (arXiv:1711.09382); displacements and rotations need not return alike
    (arXiv:2010.04150). p_sig is a function of the time in a cycle. Observers compare with the beginning of the first
    cycle. Expected: with amplitude 0 nothing moves; a reversible pack returns after each cycle.

    Args:
        amplitude: amplitude of the shear, in gamma0.
        one_sided: whether the shear goes to one side and back (half a sine), instead of a whole sine.
        times: number of cycles.
        length: length of a cycle, in t0.
        store: length of the storage before them, in t0.
    """
    reads = [
        read(to=None, length=length, amplitude=amplitude, mark=place == 0, xy=ONE_SIDED if one_sided else ONE_SINE)
        for place in range(times)
    ]
    return Protocol(cycle(), rest(), write(), hold(store, name="store"), reads)
