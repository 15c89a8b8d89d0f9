"""The recall: p_sig of a run with its background subtracted, and its gain and fidelity (paper, Secs. II and III)."""

import dataclasses
import json
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment import html
from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.readings import rates_of
from gmem_jax.experiment.record import describe
from gmem_jax.experiment.validity import compression_speed, readable, rounding, validity
from gmem_jax.physics.numbers import plural, require_double
from gmem_jax.physics.pytree import Scalar, label, pytree, static, traced
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import WARNINGS, State, Status, combined_status, explain, replicate
from gmem_jax.simulation.compiled import require_x64
from gmem_jax.simulation.frames import Frames
from gmem_jax.simulation.loop import Simulation, rollout_stages
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.stage import Stage, bin_centres

REST_SPEED = 0.01  # a pack is at rest if its fastest grain moves at less than this part of the walls' speed


@pytree
@dataclass(frozen=True)
class Recall:
    """The recall of S signals. If a bit of the status is fatal, p_sig and all gains and fidelities are NaN.

    With R reads and C channels, shear, J and p_sig are [R, C, S, 256], gains [R, C, C] and fidelities [R, C]. An axis
    of length one is left out: the shapes below are those of one read and one channel, which `at` picks out. p_sig and J
    are 0 in the bins of u that a read does not go through.

    Attributes:
        u: centres of the bins, [256].
        shear: the waveforms I at u, [S, 256].
        J: integrals of the waveforms, averaged over each bin, [S, 256].
        p_sig: recalled signals, [S, 256], in E.
        rounding: estimated round-off in each p_sig, root mean square over the bins, [S], in E.
        gain: G, one number for all S signals.
        fidelity: F, one number for all S signals.
        windowed_gain: G after a running mean of p_sig and J over the ringing period T_1.
        windowed_fidelity: F after the same running mean.
        window: T_1, in t_c.
        residual_speed: largest grain speed when the first readout began, over the speed of the walls in that readout
            (over their speed in a compression in t0, if u stands still in it), [S + 1].
        status: bits of `Status`, [S + 1]; replica 0 has the zero signal. Bits that only warn leave the numbers as they
            are (`Status.fatal`).
        stages: a `Sample` of every recorded stage by name, with a leading axis of bins; one replica before the first
            waveform, S + 1 from there on. An ordered dictionary, since JAX sorts the keys of plain ones.
        dt: the time step that was used, in t_c.
        protocol: the stages of the run.
        reads: names of the R stages that p_sig was read in.
        channels: names of the C channels.
        frames: configurations of one replica along the run; None if none were asked for.
        record: JSON of what `describe` says of the experiment; "{}" if the experiment was traced. A label: programs are
            not compiled for it.
    """

    u: jax.Array
    shear: jax.Array
    J: jax.Array
    p_sig: jax.Array
    rounding: jax.Array
    gain: jax.Array
    fidelity: jax.Array
    windowed_gain: jax.Array
    windowed_fidelity: jax.Array
    window: jax.Array
    residual_speed: jax.Array
    status: jax.Array
    stages: OrderedDict[str, Sample]
    dt: Scalar
    protocol: Protocol = static()
    reads: tuple[str, ...] = static(())
    channels: tuple[str, ...] = static(())
    frames: Frames | None = None
    record: str = label("{}")

    @property
    def configuration(self) -> dict[str, Any]:
        """`record` as a dictionary."""
        found: dict[str, Any] = json.loads(self.record)
        return found

    @property
    def names(self) -> list[str]:
        """Names of the S signals: "0110" for words, "signal 1", "signal 2", ... for others."""
        known, count = self.configuration.get("signals"), self.J.shape[-2]
        if isinstance(known, list) and len(known) == count:
            return [str(name) for name in known]
        return [f"signal {number + 1}" for number in range(count)]

    def described(self, configuration: Mapping[str, Any]) -> "Recall":
        """The same recall with another configuration as its record."""
        return dataclasses.replace(self, record=json.dumps(configuration))

    @property
    def second_readout(self) -> str | None:
        """Name of the stage that was read for the background; None if there is none."""
        known, reads = self.protocol.reads, self.reads
        whole = tuple(self.configuration.get("reads", reads))  # `at` leaves some of them out
        return known[1] if len(known) == 2 and reads == known[:1] == whole else None

    @property
    def of_time(self) -> bool:
        """Whether u stands still in every read; p_sig is then a function of the time in the read, from 0 to 1."""
        return not any(stage.moves for stage in self.protocol if stage.name in self.reads)

    def windows(self, t0: Any) -> np.ndarray:
        """The part of u that each read goes through in a time T_1, or the part of its own duration, if u stands still.

        Args:
            t0: duration of one compression, in t_c; if it differs between replicas, the longest counts.

        Returns:
            The parts, [R].
        """
        found: np.ndarray = rates_of(self.protocol, self.reads) * (float(self.window) / float(np.max(t0)))
        return found

    def at(self, read: str | int = 0, channel: str | int = 0) -> "Recall":
        """The recall of one channel in one read, as if there were no others: p_sig [S, 256], one G and one F.

        Args:
            read: name of the stage, or its number among the reads from 0.
            channel: name of the channel, or its number from 0.

        Raises:
            ValueError: if there is no such read or channel.
        """
        axes = (("read", self.reads, read), ("channel", self.channels, channel))
        place = tuple(_number(*axis) for axis in axes)
        reads, channels = self.reads[place[0]], self.channels[place[1]]
        place = tuple(number for number, (_, known, _) in zip(place, axes, strict=True) if len(known) > 1)
        if not place:
            return self
        own = place[-1:] if len(self.channels) > 1 else ()
        curves = {name: getattr(self, name)[place] for name in ("shear", "J", "p_sig", "fidelity", "windowed_fidelity")}
        gains = {name: getattr(self, name)[(*place, *own)] for name in ("gain", "windowed_gain")}
        return dataclasses.replace(self, **curves, **gains, reads=(reads,), channels=(channels,))

    def each(self) -> "Iterator[Recall]":
        """The recalls of all reads and channels, one by one: `at` of each."""
        return (self.at(read, channel) for read in self.reads for channel in self.channels)

    def _facts(self) -> html.Facts:
        measures: dict[str, Any] = {"G": self.gain, "F": self.fidelity, "G over T1": self.windowed_gain}
        rows = {**measures, "F over T1": self.windowed_fidelity, "T1 (t_c)": self.window}
        if len(self.reads) * len(self.channels) > 1:
            rows = {"reads": ", ".join(self.reads), "channels": ", ".join(self.channels), **rows}
        if not traced(self.status):
            rows["status"] = explain(combined_status(self.status))
        return f"Recall of {plural(self.J.shape[-2], 'signal')}", rows

    def __repr__(self) -> str:
        return html.line(self, self._facts)

    def _repr_html_(self) -> str:
        return html.facts(*self._facts())


def _number(kind: str, known: tuple[str, ...], wanted: str | int) -> int:
    """The place of a read or channel by its name or number."""
    if wanted in known:
        return known.index(str(wanted))
    if isinstance(wanted, int) and 0 <= wanted < len(known):
        return wanted
    raise ValueError(f"the recall has no {kind} {wanted!r}; it has {', '.join(known)}")


def unjudged(experiment: Experiment, stages: OrderedDict[str, Sample], status: jax.Array) -> tuple[Recall, jax.Array]:
    """The recall without the bits of `validity`; and the round-off in p_sig over the size of p_sig, [S]."""
    pack, t0 = experiment.pack, experiment.t0
    step = experiment.timing.dt
    first = experiment.protocol.stage(experiment.protocol.reads[0])
    walls = compression_speed(experiment) * (experiment.readings.rates[0] if first.moves else 1.0)
    residual = stages[experiment.protocol.before_read].largest_speed[-1] / walls
    status = status | jnp.where(residual < REST_SPEED, 0, int(Status.NOT_AT_REST)).astype(jnp.int32)
    # A factor rather than a `where` on p_sig: derivatives of a broken run must be NaN too.
    sound = jnp.where(jnp.any(status & ~int(WARNINGS)), jnp.nan, 1.0)
    found = experiment.recalled({name: stages[name].pressure for name in experiment.protocol.reads})
    p_sig = sound * found
    noise = rounding(experiment, stages)
    unrecorded = [stage.name for stage in experiment.protocol if not stage.recorded]
    match = experiment.compare(p_sig)
    smooth = experiment.compare(p_sig, pack.ringing_period / jnp.max(jnp.asarray(t0)))
    made = Recall(
        u=jnp.asarray(bin_centres()),
        shear=experiment.readings.shears(experiment.sets),
        J=experiment.integral(),
        p_sig=p_sig,
        rounding=noise,
        gain=match.gain,
        fidelity=match.fidelity,
        windowed_gain=smooth.gain,
        windowed_fidelity=smooth.fidelity,
        window=pack.ringing_period,
        residual_speed=residual,
        status=status,
        stages=OrderedDict((name, sample) for name, sample in stages.items() if name not in unrecorded),
        dt=step,
        protocol=experiment.protocol,
        reads=experiment.readings.reads,
        channels=experiment.readings.channels,
    )
    return made, noise / readable(experiment, found)


def judged(experiment: Experiment, stages: OrderedDict[str, Sample], found: Recall, noise: jax.Array) -> jax.Array:
    """The status of a recall with the bits of `validity`."""
    return found.status | validity(experiment, stages, found.fidelity, found.windowed_fidelity, noise)


def finish(experiment: Experiment, stages: OrderedDict[str, Sample], status: jax.Array) -> Recall:
    """The recall from the samples of all stages."""
    found, noise = unjudged(experiment, stages, status)
    return dataclasses.replace(found, status=judged(experiment, stages, found, noise))


def _by_stage(sample: Sample, stages: tuple[Stage, ...]) -> "OrderedDict[str, Sample]":
    """The samples of a rollout, divided into those of each stage."""
    ends = np.cumsum([stage.bins for stage in stages])
    places = [slice(end - stage.bins, end) for stage, end in zip(stages, ends, strict=True)]
    return OrderedDict(
        (stage.name, jax.tree.map(lambda leaf, place=place: leaf[place], sample))
        for stage, place in zip(stages, places, strict=True)
    )


@jax.jit
def _recall(experiment: Experiment) -> Recall:
    common, own = experiment.phases
    simulation, state, samples = experiment.simulation(sheared=False), experiment.begin(), OrderedDict[str, Sample]()
    if common:
        simulation, state, before = rollout_stages(simulation.marked(state, common[0]), state, common)
        samples |= _by_stage(before, common)
    state = experiment.fan_out(state)
    _, state, after = rollout_stages(with_waveforms(experiment, simulation, state), state, own)
    return finish(experiment, samples | _by_stage(after, own), state.status)


@usual_rules()
def recall(experiment: Experiment) -> Recall:
    """Run an experiment as one JAX computation, for jit, vmap and grad. It is compiled once for each structure.

    A run that fails raises nothing: it sets fatal bits of `status`, and p_sig, gains, fidelities and their derivatives
    are NaN. The neighbour list of the pack serves the whole run; only `run` can rebuild it.

    Raises:
        ValueError: if 64-bit mode is off, or was when the pack or the signals were made.
    """
    require_x64()
    require_kind("recall", experiment, Experiment)
    require_double(pack=experiment.pack, signals=experiment.signals)
    found: Recall = _recall(experiment)
    # Inside `jax.jit` the numbers are traced even if the experiment is not.
    return found if traced(experiment, found) else found.described(describe(experiment, 0.0))


def fidelity(experiment: Experiment) -> jax.Array:
    """The fidelity F of an experiment, by `recall`: a scalar; [R, C] with several reads or channels (see `Recall`)."""
    return recall(experiment).fidelity


def gain(experiment: Experiment) -> jax.Array:
    """The gain G of an experiment, by `recall`: a scalar; [R, C, C] with several reads or channels (see `Recall`)."""
    return recall(experiment).gain


def with_waveforms(experiment: Experiment, before: Simulation, state: State) -> Simulation:
    """The simulation after the prefix, with waveforms, for a state of all replicas; `before` is that of the prefix.

    Observers compare with the end of the prefix if the protocol marks no stage. Without a prefix that is the beginning,
    with which they compare up to the first stage that is marked.
    """
    simulation, own = experiment.simulation(sheared=True), experiment.phases[1]
    mark = before.mark
    if mark is None or not any(stage.mark for stage in experiment.protocol):
        return simulation.marked(state, own[0])
    narrow = mark.touching.shape[-1] == 1 < state.replicas
    return dataclasses.replace(simulation, mark=replicate(mark, state.replicas) if narrow else mark)
