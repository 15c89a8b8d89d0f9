"""Running an experiment on the host: the prefix once, then batches of waveforms in chunks."""

import dataclasses
import time
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.arguments import require_kind, require_several
from gmem_jax.experiment.asked import require_host, require_inside
from gmem_jax.experiment.changes import with_part
from gmem_jax.experiment.experiment import Experiment, replica_parameters
from gmem_jax.experiment.identity import identity
from gmem_jax.experiment.pack_warnings import warn_of_another_preparation
from gmem_jax.experiment.recall import Recall, judged, unjudged, with_waveforms
from gmem_jax.experiment.record import describe
from gmem_jax.experiment.stepping import require_stable
from gmem_jax.physics.numbers import require_double, require_whole
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.checkpoints import Checkpoint, ResultCache, no_cache
from gmem_jax.simulation.compiled import Compiled, require_x64
from gmem_jax.simulation.frames import FrameRecorder, FrameSchedule, concatenate, places, places_at
from gmem_jax.simulation.observers import CHUNK
from gmem_jax.simulation.progress import ProgressChoice, callback, shows_progress, work_of
from gmem_jax.simulation.runner import Runner, raise_if_fatal, status_of
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.sharding import placement_of
from gmem_jax.simulation.strain import smallest_box

PREFIX = "prefix"  # name of the part of a run that is common to all waveforms

_begin = Compiled(Experiment.begin, quick=True)
_fan_out = Compiled(Experiment.fan_out)
_compare = Compiled(unjudged)
_judge = Compiled(judged, quick=True)


def finished(experiment: Experiment, stages: OrderedDict[str, Sample], status: jax.Array) -> Recall:
    """`finish` on the host, in two programs; the second is compiled quickly, since it need not be fast."""
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
    require_host("gm.run", experiment)
    require_inside(experiment.pack)
    require_stable(experiment)
    pack, deepest = experiment.pack, float(np.max(np.asarray(experiment.compression)))
    smallest = smallest_box(np.asarray(pack.lower), np.asarray(pack.upper), deepest)
    state = _begin(experiment)
    raise_if_fatal(status_of(state), "begin")
    simulation = experiment.simulation(sheared=False)
    return Runner(simulation.marked(state, experiment.protocol.stages[0]), state, smallest, **options)


def apply_waveforms(runner: Runner, experiment: Experiment) -> None:
    """Bring a runner from the end of the prefix to the first sheared stage, with all replicas and their waveforms."""
    pairs, runner.state = runner.simulation.system.pairs, _fan_out(experiment, runner.state)
    runner.simulation = with_waveforms(experiment, runner.simulation, runner.state).with_pairs(pairs)


class Prefix(NamedTuple):
    """The finished stages that all waveforms have in common.

    Attributes:
        runner: the runner at the end of these stages.
        samples: samples of these stages by name.
        key: hash of everything that they depend on.
    """

    runner: Runner
    samples: "OrderedDict[str, Sample]"
    key: str


def _key_of_prefix(experiment: Experiment) -> str:
    pack = experiment.pack
    return identity((experiment.simulation(sheared=False), pack.position, pack.quaternion, experiment.phases[0]))


@usual_rules()
@shows_progress
def prefix_of(experiment: Experiment, *, cache: ResultCache = no_cache, progress: ProgressChoice = None) -> Prefix:
    """Run the stages before the first waveform once, for use in any number of calls of `run`.

    They are common to all waveforms on one pack, under one law and protocol.

    Args:
        experiment: the experiment; its waveforms, gamma0 and shear_share do not matter.
        cache: see `run`; it keeps the part "prefix".
        progress: see `run`.

    Returns:
        The state and the samples at the end of these stages, to be passed to `run` as `prefix`.

    Raises:
        ValueError: as in `run`.
        RunFailedError: if the simulation broke down.
    """
    require_kind("prefix_of", experiment, Experiment)
    common, _ = experiment.phases
    runner = runner_of(experiment, progress=callback(progress))
    runner.total_work = work_of(common, runner.state.replicas)
    return Prefix(runner, runner.run_cached(PREFIX, cache, *common), _key_of_prefix(experiment))


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
    """Run an experiment on the host, in chunks of bins: stale neighbour lists are rebuilt, and a broken run raises.

    With several processes (`jax.distributed`) all must call it alike. All get the recall; one of them should keep it.

    Args:
        experiment: the experiment, not traced.
        prefix: what `gm.prefix_of` returned for an experiment that differs at most in waveforms, gamma0 and
            shear_share; default none: the prefix is run here.
        batch: number of signals that run together; default all of them. Each batch has a zero signal of its own.
        devices: devices that share the replicas; default all that JAX sees, those of other processes included.
        frames: number of configurations to keep along the run, at places chosen by
            `gmem_jax.simulation.frames.places`; 0 for none. The recall is the same with and without.
        frames_of: number of the signal whose replica is recorded, from 1; 0 for the zero signal.
        frames_at: compressions u in [0, 1] at which further configurations are kept, each time that the run passes
            them, to the nearest bin: u = 0.5 gives one of every compression and decompression.
        cache: keeps the finished parts of a long run, so that it can be resumed (see `gmem_jax.files.checkpoints`);
            default none are kept.
        progress: called after every chunk with the name of the stage, the simulated time in t_c and the fraction done;
            default a bar in a terminal or a notebook, False for none.

    Raises:
        ValueError: if 64-bit mode is off; if parameters differ between replicas and `batch` would divide them; for a
            time step that is not stable (see `stable_step`); for too many or too few frames, a u outside [0, 1], a
            signal that does not exist, frames together with a prefix, or the prefix of another experiment.
        TypeError: if it is no `Experiment`.
        RunFailedError: if the simulation broke down.
    """
    require_kind("run", experiment, Experiment)
    began, tell = time.perf_counter(), callback(progress)
    count = experiment.signals.count
    size = count if batch is None else require_whole("batch", batch, 1)
    if size < count and any(jnp.ndim(value) for value in replica_parameters(experiment).values()):
        raise ValueError("parameters with a value for each replica need all signals in one batch")
    require_host("gm.run", experiment)
    schedule = frame_schedule(experiment, frames, frames_of, frames_at)
    if prefix and schedule.wanted:
        raise ValueError("frames begin with the prefix, which was run before: leave out the argument prefix")
    warn_of_another_preparation(experiment)
    common, own = experiment.phases
    firsts = range(0, count, size)
    work = sum(work_of(own, 1 + min(size, count - first)) for first in firsts)
    recorders = [FrameRecorder(schedule)] if schedule.wanted else []
    if prefix is None:
        runner = runner_of(experiment, progress=tell, observers=tuple(recorders))
        runner.total_work = work_of(common, runner.state.replicas) + work
        before = runner.run_cached(PREFIX, cache, *common)
        done = work_of(common, runner.state.replicas)
    else:
        if prefix.key != _key_of_prefix(experiment):
            raise ValueError("the prefix is that of another pack, law or protocol; run it by gm.prefix_of(experiment)")
        runner, before = prefix.runner.fork(progress=tell, total_work=work), prefix.samples
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
            return (samples, on.gather(on.state.status)), recorder.saved()

        found_part, seen = cache(f"batch-{number:04d}", run_batch)
        parts.append(found_part)
        recorded = seen if wanted else recorded
        done += work_of(own, 1 + last - first)
    after_prefix, status = jax.tree.map(_join, *parts) if len(parts) > 1 else parts[0]
    found: Recall = finished(experiment, before | after_prefix, jnp.asarray(status))
    found = found.described(describe(experiment, time.perf_counter() - began))
    if not schedule.wanted:
        return found
    pack = experiment.pack
    return dataclasses.replace(found, frames=concatenate(recorded, pack.clump, frames_of, periodic=pack.periodic))


def frame_schedule(experiment: Experiment, frames: int, of: int, at: Sequence[float] = ()) -> FrameSchedule:
    """The frames to be recorded of one replica: `frames` of them along the run, and those at the compressions `at`.

    Raises:
        ValueError: for too many or too few frames, a u outside [0, 1], or a signal that does not exist.
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


def _join(first: Any, *others: Any) -> np.ndarray:
    """Join the replicas of several batches along the last axis; the zero signal of the first batch stands for all."""
    return np.concatenate([np.asarray(first), *(np.asarray(other)[..., 1:] for other in others)], axis=-1)
