"""What a pack gives back: an experiment run, its background subtracted, compared with the integrals (Secs. II, III)."""

import dataclasses
import importlib
import warnings
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment import analysis, html
from gmem_jax.experiment.devices import spread_over
from gmem_jax.experiment.doubts import doubts
from gmem_jax.experiment.experiment import Experiment, replica_parameters, with_part
from gmem_jax.experiment.frames import Film, Frames, Taken, joined, places
from gmem_jax.experiment.host import (
    CHUNK,
    NOWHERE,
    Checkpoint,
    Compiled,
    Keep,
    Progress,
    Walker,
    forget,
    refuse,
    require_x64,
    silent,
    within,
    work_of,
    worst,
)
from gmem_jax.experiment.pack import smallest_box
from gmem_jax.experiment.protocol import Stage, table
from gmem_jax.experiment.signals import BINS
from gmem_jax.experiment.walk import walk
from gmem_jax.physics.pytree import Scalar, pytree, traced
from gmem_jax.physics.sample import Sample
from gmem_jax.physics.state import DOUBTFUL, Status, explain, together

REST_SPEED = 0.01  # a pack is at rest when its fastest grain moves at less than this part of the walls' speed
COPIES = 4  # of a replica's arrays that live at once: a call's arguments and results, its scratch, and one to spare
GRAIN_BYTES = 800  # of a grain's own numbers and its spheres'
PREFIX = "prefix"  # name of the part of a run that is common to all waveforms
LARGEST_BATCH = 63  # signals; with the zero signal they fill whole vectors of every CPU


@pytree
@dataclass(frozen=True)
class Recall:
    """What a pack gave back of S signals. Where the status is fatal, p_sig and all measures are NaN.

    Attributes:
        u: centres of the bins, [256].
        shear: the waveforms I there, [S, 256].
        J: integrals of the waveforms, averaged over each bin, [S, 256].
        p_sig: recalled signals, [S, 256], in E.
        gain: G of the set.
        fidelity: F of the set.
        windowed_gain: G after a running mean of p_sig and J over the ringing period.
        windowed_fidelity: F after the same.
        window: that period T_1, in t_c.
        residual_speed: largest grain speed when the readout began, over the walls' speed, [S + 1].
        status: bits of `Status`, [S + 1]; replica 0 is the zero signal. Those of
            `DOUBTFUL` leave the numbers as they are.
        stages: samples of every stage by name, leading axis bins; one replica before "encode". Ordered: JAX sorts the
            keys of plain dictionaries.
        dt: the time step used, in t_c.
        frames: configurations of one replica along the run, if they were asked for.
    """

    u: jax.Array
    shear: jax.Array
    J: jax.Array
    p_sig: jax.Array
    gain: jax.Array
    fidelity: jax.Array
    windowed_gain: jax.Array
    windowed_fidelity: jax.Array
    window: jax.Array
    residual_speed: jax.Array
    status: jax.Array
    stages: OrderedDict[str, Sample]
    dt: Scalar
    frames: Frames | None = None

    def plot(self, what: str = "signals", experiment: Experiment | None = None, *, against: str = "time") -> Any:
        """A picture of it, which a notebook shows: `.save(path)` writes it, `.figure` is matplotlib's.

        Args:
            what: "signals", "waveforms", "all"; or a quantity of the stages, like "pressure", "Z" or "phi".
            experiment: that it is of, for the names of signals and the conditions in the title.
            against: "time" or "u", for the stages.

        Raises:
            ValueError: if there is no such picture; it names those that there are.
        """
        from_above = importlib.import_module("gmem_jax.show.recalls")  # what draws stands on a floor above
        return from_above.plot(self, what, experiment, against)

    def _repr_html_(self) -> str:
        measures: dict[str, Any] = {"G": self.gain, "F": self.fidelity, "G over T1": self.windowed_gain}
        rows = {**measures, "F over T1": self.windowed_fidelity, "T1 (t_c)": self.window}
        if not traced(self.status):
            rows["status"] = explain(together(self.status))
        return html.facts(f"Recall of {self.J.shape[-2]} signals", rows)


def finish(experiment: Experiment, stages: OrderedDict[str, Sample], status: jax.Array) -> Recall:
    """Subtract the background and compare with the integrals."""
    pack, t0 = experiment.pack, experiment.t0
    step = experiment.timing.dt
    wall_speed = 0.5 * (pack.upper - pack.lower)[0] * (1.0 - jnp.sqrt(1.0 - experiment.compression)) / t0
    residual = stages["store"].largest_speed[-1] / wall_speed
    status = status | jnp.where(residual < REST_SPEED, 0, int(Status.NOT_AT_REST)).astype(jnp.int32)
    # A factor, not a choice: the derivative of what is broken must be NaN too.
    sound = jnp.where(jnp.any(status & ~int(DOUBTFUL)), jnp.nan, 1.0)
    p_sig = sound * experiment.recalled({name: stages[name].pressure for name in stages if "readout" in name})
    integral = experiment.integral()
    match = experiment.compare(p_sig)
    smooth = analysis.compare(p_sig, integral, experiment.scale, pack.ringing_period / jnp.max(jnp.asarray(t0)))
    u = (jnp.arange(BINS) + 0.5) / BINS
    return Recall(
        u=u,
        shear=experiment.signals.shear(u).T,
        J=integral,
        p_sig=p_sig,
        gain=match.gain,
        fidelity=match.fidelity,
        windowed_gain=smooth.gain,
        windowed_fidelity=smooth.fidelity,
        window=pack.ringing_period,
        residual_speed=residual,
        status=status | doubts(experiment, stages, match.fidelity, smooth.fidelity),
        stages=stages,
        dt=step,
    )


def _by_stage(sample: Sample, stages: tuple[Stage, ...]) -> "OrderedDict[str, Sample]":
    """The samples of a walk through stages, apart."""
    ends = np.cumsum([stage.bins for stage in stages])
    places = [slice(end - stage.bins, end) for stage, end in zip(stages, ends, strict=True)]
    return OrderedDict(
        (stage.name, jax.tree.map(lambda leaf, place=place: leaf[place], sample))
        for stage, place in zip(stages, places, strict=True)
    )


@jax.jit
def _recall(experiment: Experiment) -> Recall:
    common, own = experiment.phases
    state, before = walk(experiment.course(sheared=False), experiment.begin(), table(common))
    state, after = walk(experiment.course(sheared=True), experiment.fan_out(state), table(own))
    return finish(experiment, _by_stage(before, common) | _by_stage(after, own), state.status)


def recall(experiment: Experiment) -> Recall:
    """Run an experiment as one traced computation, for jit, vmap and grad; compiled once for each structure.

    Nothing is raised: what goes wrong sets bits of `status`, and turns p_sig, gain and fidelity, and their derivatives,
    into NaN. The pack's own neighbour list must last; `run` makes it anew.

    Raises:
        ValueError: if 64-bit mode is off.
    """
    require_x64()
    found: Recall = _recall(experiment)
    return found


def fidelity(experiment: Experiment) -> jax.Array:
    """F of an experiment; see `recall`."""
    return recall(experiment).fidelity


def gain(experiment: Experiment) -> jax.Array:
    """G of an experiment; see `recall`."""
    return recall(experiment).gain


_begin = Experiment.begin
_fan_out = Compiled(Experiment.fan_out)
finished = Compiled(finish)


def walker(experiment: Experiment, **options: Any) -> Walker:
    """A walk on the host, at the beginning of the experiment.

    Raises:
        ValueError: if 64-bit mode is off, or the experiment is traced.
    """
    require_x64()
    if traced(experiment):
        raise ValueError("gm.run works on the host; inside jax.jit, jax.vmap or jax.grad use gm.recall")
    pack, deepest = experiment.pack, float(np.max(np.asarray(experiment.compression)))
    smallest = smallest_box(np.asarray(pack.lower), np.asarray(pack.upper), deepest)
    state = _begin(experiment)
    refuse(worst(state), "begin")
    return Walker(experiment.course(sheared=False), state, smallest, **options)


def shear(walker: Walker, experiment: Experiment) -> None:
    """Bring a walk from the end of the prefix to the beginning of the encoding: all replicas, with their waveforms."""
    walker.course = experiment.course(sheared=True).with_pairs(walker.course.system.pairs)
    walker.state = _fan_out(experiment, walker.state)


def run(
    experiment: Experiment,
    *,
    batch: int | None = None,
    devices: Sequence[jax.Device] | None = None,
    frames: int = 0,
    frames_of: int = 1,
    keep: Keep = forget,
    progress: Progress = silent,
) -> Recall:
    """Run an experiment on the host, in chunks: stale neighbour lists are made anew, a broken run raises.

    With several processes (`jax.distributed`) all must call it alike, and all get the recall; one should keep it.

    Args:
        experiment: the experiment.
        batch: signals that run together; default all of them. Each batch has a zero signal of its own.
        devices: that share out the replicas; default all that JAX sees, also those of other processes.
        frames: configurations to keep along the run, chosen by `frames.places`; the other numbers stay as they are.
        frames_of: the signal whose they are, from 1; 0 for the zero signal.
        keep: asked for every part of a long run, so that it can be resumed (see `gmem_jax.files.parts`).
        progress: told about every chunk.

    Raises:
        ValueError: if 64-bit mode is off, or parameters that differ between replicas would be torn apart by batches;
            for too many or too few frames, or a signal that there is not.
        RunFailedError: if the simulation broke down.
    """
    count, size = experiment.signals.count, batch or experiment.signals.count
    if size < 1:
        raise ValueError(f"batch must be at least 1, got {batch}")
    film = film_of(experiment, frames, frames_of)
    begun = walker(experiment, progress=progress, film=film)
    warn_of_another_compression(experiment)
    if size < count and any(jnp.ndim(value) for value in replica_parameters(experiment).values()):
        raise ValueError("parameters with a value for each replica need all signals in one batch")
    common, own = experiment.phases
    firsts = range(0, count, size)
    done = work_of(common, begun.state.replicas)
    begun.total_work = done + sum(work_of(own, 1 + min(size, count - first)) for first in firsts)
    samples = begun.play_part(PREFIX, keep, *common)
    parts: list[tuple[dict[str, Sample], jax.Array]] = []
    taken: Taken = {}
    for number, first in enumerate(firsts):
        last = min(first + size, count)
        few = experiment if size >= count else with_part(experiment, first, last)
        filmed = first < frames_of <= last or frames_of == first == 0
        own_film = Film(film.wanted, max(0, frames_of - first)) if filmed else Film()
        on = begun.afresh(work=done, film=own_film)

        def run_batch(checkpoint: Checkpoint, few: Experiment = few, on: Walker = on) -> Any:
            shear(on, few)
            on.put_on(spread_over(few.replicas, devices))
            samples = on.play(*own, checkpoint=checkpoint)
            return (samples, on.status()), on.taken

        found_part, all_taken = keep(f"batch-{number:04d}", run_batch)
        parts.append(found_part)
        taken = all_taken if filmed else taken
        done += work_of(own, 1 + last - first)
    after_prefix, status = jax.tree.map(_join, *parts) if len(parts) > 1 else parts[0]
    found: Recall = finished(experiment, samples | after_prefix, jnp.asarray(status))
    return (
        found
        if frames == 0
        else dataclasses.replace(found, frames=joined(taken, np.asarray(experiment.pack.clump.offsets), frames_of))
    )


def film_of(experiment: Experiment, frames: int, of: int) -> Film:
    """What is to be taken of a run: `frames` configurations of the replica of a signal.

    Raises:
        ValueError: for too many or too few, or a signal that there is not.
    """
    if not 0 <= of <= experiment.signals.count:
        raise ValueError(f"frames of signal {of}: there are signals 1 to {experiment.signals.count}, and 0 for none")
    return Film(places(experiment.stages, frames, CHUNK), of) if frames else Film()


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


def prefix_of(experiment: Experiment, *, keep: Keep = forget, progress: Progress = silent) -> Walker:
    """A walk that has done the shear-free prefix, common to all waveforms on this pack; see `simulate`.

    Args:
        experiment: pack, law and protocol.
        keep: asked for the part "prefix".
        progress: told about every chunk.

    Raises:
        RunFailedError: if the simulation broke down.
    """
    common, _ = experiment.phases
    begun = walker(experiment, progress=progress)
    begun.total_work = work_of(common, begun.state.replicas)
    begun.play_part(PREFIX, keep, *common)
    return begun


def simulate(
    experiment: Experiment,
    begun: Walker | None = None,
    *,
    checkpoint: Checkpoint = NOWHERE,
    progress: Progress = silent,
) -> Recall:
    """`run` from a prefix that is done already; the stages of the prefix are not in the result.

    Args:
        experiment: the experiment.
        begun: what `prefix_of` gave for the same pack and law; it can be used again. Run here if not given.
        checkpoint: where to go on, and where to keep how far it is.
        progress: told about every chunk.

    Raises:
        RunFailedError: if the simulation broke down.
    """
    share = 0.1 if begun is None else 0.0
    begun = prefix_of(experiment, progress=within(progress, 0.0, share)) if begun is None else begun
    _, own = experiment.phases
    all_work = work_of(own, experiment.replicas)
    on = begun.afresh(progress=within(progress, share, 1.0), work=0.0, total_work=all_work)
    shear(on, experiment)
    found: Recall = finished(experiment, on.play(*own, checkpoint=checkpoint), on.state.status)
    return found
