"""What a pack gives back: an experiment run, its background subtracted, compared with the integrals (Secs. II, III)."""

import dataclasses
import json
import time
import warnings
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment import html
from gmem_jax.experiment.arguments import require_kind, require_several
from gmem_jax.experiment.asked import require_double, require_inside
from gmem_jax.experiment.experiment import Experiment, replica_parameters, with_part
from gmem_jax.experiment.record import describe
from gmem_jax.experiment.stepping import require_stable
from gmem_jax.experiment.validity import compression_speed, readable, rounding, validity
from gmem_jax.physics.numbers import plural, require_whole
from gmem_jax.physics.pytree import Scalar, label, pytree, static, traced
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import WARNINGS, State, Status, combined_status, explain, replicate
from gmem_jax.simulation.checkpoints import Checkpoint, ResultCache, no_cache
from gmem_jax.simulation.compiled import Compiled, require_x64
from gmem_jax.simulation.frames import FrameRecorder, Frames, FrameSchedule, concatenate, places, places_at
from gmem_jax.simulation.loop import Simulation, rollout_stages
from gmem_jax.simulation.observers import CHUNK
from gmem_jax.simulation.progress import Progress, ProgressChoice, callback, shows_progress, silent, work_of
from gmem_jax.simulation.protocol import BINS, Protocol, Stage
from gmem_jax.simulation.runner import Runner, raise_if_fatal, status_of
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.sharding import placement_of
from gmem_jax.simulation.strain import smallest_box

REST_SPEED = 0.01  # a pack is at rest when its fastest grain moves at less than this part of the walls' speed
COPIES = 4  # of a replica's arrays that live at once: a call's arguments and results, its scratch, and one to spare
GRAIN_BYTES = 800  # of a grain's own numbers and its spheres'
PREFIX = "prefix"  # name of the part of a run that is common to all waveforms
LARGEST_BATCH = 63  # signals; with the zero signal they fill whole vectors of every CPU


@pytree
@dataclass(frozen=True)
class Recall:
    """What a pack gave back of S signals. Where the status is fatal, p_sig and all measures are NaN.

    With R reads and C channels, shear, J and p_sig are [R, C, S, 256], gains [R, C, C] and fidelities [R, C]; an axis
    of length one is left out, as below. `at` gives one read of one channel. p_sig and J are 0 where a read does not go.

    Attributes:
        u: centres of the bins, [256].
        shear: the waveforms I there, [S, 256].
        J: integrals of the waveforms, averaged over each bin, [S, 256].
        p_sig: recalled signals, [S, 256], in E.
        rounding: what round-off makes of each, root mean square over the bins, [S], in E; see `validity.rounding`.
        gain: G of the set.
        fidelity: F of the set.
        windowed_gain: G after a running mean of p_sig and J over the ringing period.
        windowed_fidelity: F after the same.
        window: that period T_1, in t_c.
        residual_speed: largest grain speed when the readout began, over the walls' speed, [S + 1].
        status: bits of `Status`, [S + 1]; replica 0 is the zero signal. Those of
            `WARNINGS` leave the numbers as they are.
        stages: samples of every stage by name, leading axis bins; one replica before the first waveform. Ordered: JAX
            sorts the keys of plain dictionaries.
        dt: the time step used, in t_c.
        protocol: the stages that were gone through.
        reads: names of the R stages that p_sig is of.
        channels: names of the C channels.
        frames: configurations of one replica along the run, if they were asked for.
        record: JSON of the configuration that it belongs to: what `describe` says of the experiment. "{}" for a recall
            of a traced experiment. A label: no part of what programs are compiled for.
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
        """What the signals are called: words by their bits, others by their number from 1."""
        known, count = self.configuration.get("signals"), self.J.shape[-2]
        if isinstance(known, list) and len(known) == count:
            return [str(name) for name in known]
        return [f"signal {number + 1}" for number in range(count)]

    def described(self, configuration: Mapping[str, Any]) -> "Recall":
        """The same recall with this configuration."""
        return dataclasses.replace(self, record=json.dumps(configuration))

    @property
    def second_readout(self) -> str | None:
        """The stage that was read for the background, if there is one."""
        known, reads = self.protocol.reads, self.reads
        whole = tuple(self.configuration.get("reads", reads))  # what `at` gives is a part
        return known[1] if len(known) == 2 and reads == known[:1] == whole else None

    def at(self, read: str | int = 0, channel: str | int = 0) -> "Recall":
        """The recall of one channel in one read, as of a run that has no others: p_sig [S, 256], one G and one F.

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
        """`at` every read and channel."""
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


def _compared(experiment: Experiment, stages: OrderedDict[str, Sample], status: jax.Array) -> tuple[Recall, jax.Array]:
    """Subtract the background and compare with the integrals; and round-off in p_sig over its size, [S]."""
    pack, t0 = experiment.pack, experiment.t0
    step = experiment.timing.dt
    residual = stages[experiment.protocol.before_read].largest_speed[-1] / compression_speed(experiment)
    status = status | jnp.where(residual < REST_SPEED, 0, int(Status.NOT_AT_REST)).astype(jnp.int32)
    # A factor, not a choice: the derivative of what is broken must be NaN too.
    sound = jnp.where(jnp.any(status & ~int(WARNINGS)), jnp.nan, 1.0)
    found = experiment.recalled({name: stages[name].pressure for name in experiment.protocol.reads})
    p_sig = sound * found
    noise = rounding(experiment, stages)
    unrecorded = [stage.name for stage in experiment.protocol if not stage.recorded]
    match = experiment.compare(p_sig)
    smooth = experiment.compare(p_sig, pack.ringing_period / jnp.max(jnp.asarray(t0)))
    made = Recall(
        u=(jnp.arange(BINS) + 0.5) / BINS,
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


def _judged(experiment: Experiment, stages: OrderedDict[str, Sample], found: Recall, noise: jax.Array) -> jax.Array:
    """The status of a recall, and what makes it doubtful."""
    return found.status | validity(experiment, stages, found.fidelity, found.windowed_fidelity, noise)


def finish(experiment: Experiment, stages: OrderedDict[str, Sample], status: jax.Array) -> Recall:
    """The recall that the samples of all stages make."""
    found, noise = _compared(experiment, stages, status)
    return dataclasses.replace(found, status=_judged(experiment, stages, found, noise))


def _by_stage(sample: Sample, stages: tuple[Stage, ...]) -> "OrderedDict[str, Sample]":
    """The samples of a rollout of stages, apart."""
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
    """Run an experiment as one traced computation, for jit, vmap and grad; compiled once for each structure.

    Nothing is raised: what goes wrong sets bits of `status`, and turns p_sig, gain and fidelity, and their derivatives,
    into NaN. The pack's own neighbour list must last; `run` makes it anew.

    Raises:
        ValueError: if 64-bit mode is off, or was when the pack or the signals were made.
    """
    require_x64()
    require_kind("recall", experiment, Experiment)
    require_double(pack=experiment.pack, signals=experiment.signals)
    found: Recall = _recall(experiment)
    # Within somebody's `jax.jit` the numbers are traced also where the experiment is not.
    return found if traced(experiment, found) else found.described(describe(experiment, 0.0))


def fidelity(experiment: Experiment) -> jax.Array:
    """F of an experiment; see `recall`."""
    return recall(experiment).fidelity


def gain(experiment: Experiment) -> jax.Array:
    """G of an experiment; see `recall`."""
    return recall(experiment).gain


_begin = Experiment.begin
_fan_out = Compiled(Experiment.fan_out)
_compare = Compiled(_compared)
_judge = Compiled(_judged, quick=True)


def finished(experiment: Experiment, stages: OrderedDict[str, Sample], status: jax.Array) -> Recall:
    """`finish` on the host, in two programs, of which one need not be fast."""
    found, noise = _compare(experiment, stages, status)
    judged: Recall = dataclasses.replace(found, status=_judge(experiment, stages, found, noise))
    return judged


def runner_of(experiment: Experiment, **options: Any) -> Runner:
    """A runner at the beginning of the experiment.

    Raises:
        ValueError: if 64-bit mode is off, or was when the pack or the signals were made; or the experiment is traced;
            or its time step is not stable.
    """
    require_x64()
    require_double(pack=experiment.pack, signals=experiment.signals)
    if traced(experiment):
        raise ValueError("gm.run works on the host; inside jax.jit, jax.vmap or jax.grad use gm.recall")
    require_inside(experiment.pack)
    require_stable(experiment)
    pack, deepest = experiment.pack, float(np.max(np.asarray(experiment.compression)))
    smallest = smallest_box(np.asarray(pack.lower), np.asarray(pack.upper), deepest)
    state = _begin(experiment)
    raise_if_fatal(status_of(state), "begin")
    simulation = experiment.simulation(sheared=False)
    return Runner(simulation.marked(state, experiment.protocol.stages[0]), state, smallest, **options)


def with_waveforms(experiment: Experiment, before: Simulation, state: State) -> Simulation:
    """What is run after the prefix, for a state of all replicas; `before` is what was run in it.

    Observers compare with this moment if the protocol marks no stage.
    """
    simulation, own = experiment.simulation(sheared=True), experiment.phases[1]
    if not any(stage.mark for stage in experiment.protocol):
        return simulation.marked(state, own[0])
    mark = before.mark
    narrow = mark is not None and mark.touching.shape[-1] == 1 < state.replicas
    return dataclasses.replace(simulation, mark=replicate(mark, state.replicas) if narrow else mark)


def apply_waveforms(runner: Runner, experiment: Experiment) -> None:
    """Bring a runner from the end of the prefix to the first sheared stage: all replicas, with their waveforms."""
    pairs, runner.state = runner.simulation.system.pairs, _fan_out(experiment, runner.state)
    runner.simulation = with_waveforms(experiment, runner.simulation, runner.state).with_pairs(pairs)


class Prefix(NamedTuple):
    """The stages that all waveforms have in common, done.

    Attributes:
        runner: at their end.
        samples: theirs.
    """

    runner: Runner
    samples: "OrderedDict[str, Sample]"


@usual_rules()
def prefix_of(experiment: Experiment, *, cache: ResultCache = no_cache, progress: Progress = silent) -> Prefix:
    """Run the shear-free prefix, common to all waveforms on this pack under this law, for any number of `run`.

    Args:
        experiment: pack, law and protocol.
        cache: asked for the part "prefix".
        progress: told about every chunk.

    Raises:
        RunFailedError: if the simulation broke down.
    """
    common, _ = experiment.phases
    runner = runner_of(experiment, progress=progress)
    runner.total_work = work_of(common, runner.state.replicas)
    return Prefix(runner, runner.run_cached(PREFIX, cache, *common))


@usual_rules()
@shows_progress
def run(
    experiment: Experiment,
    *,
    prefix: Prefix | None = None,
    batch: int | None = None,
    devices: Sequence[jax.Device] | None = None,
    frames: int = 0,
    frames_of: int = 1,
    frames_at: Sequence[float] = (),
    cache: ResultCache = no_cache,
    progress: ProgressChoice = None,
) -> Recall:
    """Run an experiment on the host, in chunks: stale neighbour lists are built anew, a broken run raises.

    With several processes (`jax.distributed`) all must call it alike, and all get the recall; one should keep it.

    Args:
        experiment: the experiment.
        prefix: what `prefix_of` gave for the same pack and law, if it was run already.
        batch: signals that run together; default all of them. Each batch has a zero signal of its own.
        devices: that share out the replicas; default all that JAX sees, also those of other processes.
        frames: configurations to keep along the run, chosen by `frames.places`; the other numbers stay as they are.
        frames_of: the signal whose they are, from 1; 0 for the zero signal.
        frames_at: compressions u, 0 to 1, at which more are kept, each time that the run passes them, to the next of
            256 bins: u = 0.5 gives one of every compression and decompression.
        cache: asked for every part of a long run, so that it can be resumed (see `gmem_jax.files.checkpoints`).
        progress: told about every chunk; default a bar in a terminal or a notebook, False for none.

    Raises:
        ValueError: if 64-bit mode is off, or parameters that differ between replicas would be torn apart by batches;
            for a time step that is not stable (see `stable_step`); for too many or too few frames, a u beyond 0 and 1,
            frames of a prefix that was run before, or a signal that there is not.
        TypeError: if it is no `Experiment`.
        RunFailedError: if the simulation broke down.
    """
    require_kind("run", experiment, Experiment)
    began, tell = time.perf_counter(), callback(progress)
    count = experiment.signals.count
    size = count if batch is None else require_whole("batch", batch, 1)
    if size < count and any(jnp.ndim(value) for value in replica_parameters(experiment).values()):
        raise ValueError("parameters with a value for each replica need all signals in one batch")
    schedule = frame_schedule(experiment, frames, frames_of, frames_at)
    if prefix and schedule.wanted:
        raise ValueError("frames begin with the prefix: run it in the same call")
    warn_of_another_compression(experiment)
    common, own = experiment.phases
    firsts = range(0, count, size)
    work = sum(work_of(own, 1 + min(size, count - first)) for first in firsts)
    recorders = [FrameRecorder(schedule)] if schedule.wanted else []
    if prefix is None:
        runner = runner_of(experiment, progress=tell, observers=tuple(recorders))
        runner.total_work = work_of(common, runner.state.replicas) + work
        prefix = Prefix(runner, runner.run_cached(PREFIX, cache, *common))
        done = work_of(common, runner.state.replicas)
    else:
        runner = prefix.runner.fork(progress=tell, total_work=work)
        done = 0.0
    parts: list[tuple[dict[str, Sample], jax.Array]] = []
    recorded = recorders[0].recorded if recorders else OrderedDict()
    for number, first in enumerate(firsts):
        last = min(first + size, count)
        few = experiment if size >= count else with_part(experiment, first, last)
        wanted = bool(recorders) and (first < frames_of <= last or frames_of == first == 0)
        recorder = FrameRecorder(FrameSchedule(schedule.wanted if wanted else {}, max(0, frames_of - first)))
        recorder.restore(recorded)
        on = runner.fork(work=done, observers=(recorder,))

        def run_batch(
            checkpoint: Checkpoint, few: Experiment = few, on: Runner = on, recorder: FrameRecorder = recorder
        ) -> Any:
            apply_waveforms(on, few)
            on.place_on(placement_of(few.replicas, devices))
            samples = on.run_stages(*own, checkpoint=checkpoint)
            return (samples, on.status()), recorder.saved()

        found_part, seen = cache(f"batch-{number:04d}", run_batch)
        parts.append(found_part)
        recorded = seen if wanted else recorded
        done += work_of(own, 1 + last - first)
    after_prefix, status = jax.tree.map(_join, *parts) if len(parts) > 1 else parts[0]
    found: Recall = finished(experiment, prefix.samples | after_prefix, jnp.asarray(status))
    found = found.described(describe(experiment, time.perf_counter() - began))
    if not schedule.wanted:
        return found
    pack = experiment.pack
    return dataclasses.replace(found, frames=concatenate(recorded, pack.clump, frames_of, periodic=pack.periodic))


def frame_schedule(experiment: Experiment, frames: int, of: int, at: Sequence[float] = ()) -> FrameSchedule:
    """What is to be recorded of a run: `frames` configurations of the replica of a signal, and those `at` compressions.

    Raises:
        ValueError: for too many or too few, a u beyond 0 and 1, or a signal that there is not.
    """
    frames, of = require_whole("frames", frames), require_whole("frames_of", of)
    require_several(at, "frames_at")
    if of > experiment.signals.count:
        raise ValueError(f"frames of signal {of}: there are signals 1 to {experiment.signals.count}, and 0 for none")
    stages = experiment.protocol.stages
    along = [places(stages, frames, CHUNK)] if frames else []
    wanted = [*along, places_at(stages, at)]
    both = {stage.name: sorted({bins for each in wanted for bins in each.get(stage.name, ())}) for stage in stages}
    return FrameSchedule({name: found for name, found in both.items() if found}, of)


def replica_bins(experiment: Experiment, batch: int) -> int:
    """Bins times replicas of a run, of which the prefix has one and each batch one for no signal."""
    before, after = (sum(stage.bins for stage in some) for some in experiment.phases)
    count = experiment.signals.count
    return before + after * (count + -(-count // batch))


def _join(first: Any, *others: Any) -> np.ndarray:
    """Replicas of several batches, innermost; the zero signal of the first stands for all."""
    return np.concatenate([np.asarray(first), *(np.asarray(other)[..., 1:] for other in others)], axis=-1)


class OtherCompressionWarning(UserWarning):
    """A pack was cycled with another delta0: `Status.OTHER_COMPRESSION`, said before the run."""


def warn_of_another_compression(experiment: Experiment) -> None:
    """Warn of a delta0 that the pack was not made for."""
    own = float(experiment.pack.delta0)
    if not np.allclose(np.asarray(experiment.compression), own):
        warnings.warn(
            f"{experiment.pack.name} was cycled with delta0 = {own:g}, not {experiment.delta0}: its memory of the "
            "preparation differs from the paper's; prepare a pack for this delta0",
            OtherCompressionWarning,
            stacklevel=3,
        )


def _replica_bytes(experiment: Experiment) -> int:
    """Memory that a replica takes while it runs."""
    pairs = experiment.pack.pairs
    history = jax.eval_shape(lambda: experiment.friction.init(pairs.capacity, 1, jnp.zeros(()).dtype))
    contacts: int = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(history))
    return COPIES * (contacts + GRAIN_BYTES * experiment.pack.grains)


def run_bytes(experiment: Experiment, batch: int) -> int:
    """Memory that a run of `batch` signals and the zero signal will take."""
    return (batch + 1) * _replica_bytes(experiment)


def default_batch(experiment: Experiment, available: int) -> int:
    """Signals that may run together in half of the `available` bytes; at most `LARGEST_BATCH`."""
    return int(max(1, min(LARGEST_BATCH, 0.5 * available / _replica_bytes(experiment) - 1)))
