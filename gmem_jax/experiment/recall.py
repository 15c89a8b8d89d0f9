"""The memory experiment: encode, store, recall (paper, Secs. II and III; spec, section 5)."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax import native
from gmem_jax.experiment import analysis
from gmem_jax.experiment.host import CHUNK, Progress, Runner, require_x64, silent
from gmem_jax.experiment.pack import SKIN, Pack, smallest_box
from gmem_jax.experiment.protocol import Motion, Stage, clock, memory_protocol, split
from gmem_jax.experiment.signals import BINS, Signals, bin_average, part
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.material import Material
from gmem_jax.physics.state import Scalar, State, Status, replicate
from gmem_jax.physics.step import Sample, System, start

PAPER_T0 = 1.8e4  # the paper's duration of a compression, in t_c
HOLD_DRAG = 0.05  # 1 / t_c; damps the slowest mode within about 40 t_c up to N = 10,000 without overdamping it
REST_SPEED = 0.01  # a pack is at rest when its fastest grain moves at less than this part of the walls' speed
COPIES = 4  # of a replica's arrays that live at once: a call's arguments and results, its scratch, and one to spare
GRAIN_BYTES = 800  # of a grain's own numbers and its spheres'
LARGEST_STEP = 0.5  # t_c; the stiffest mode has a period near 10 t_c


Samples = dict[str, Sample]
"""Samples of stages by name."""

Keep = Callable[[str, Callable[[], Any]], Any]
"""Gives the part of a run of that name: as kept earlier, or by running it."""


def forget(name: str, run: Callable[[], Any]) -> Any:
    """Run every part, keep none."""
    return run()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Recall:
    """What a pack gave back of S signals.

    Attributes:
        u: centres of the bins, [256].
        J: integrals of the waveforms, averaged over each bin, [S, 256].
        p_sig: recalled signals, [S, 256], in E.
        gain: G of the set.
        fidelity: F of the set.
        windowed_gain: G after a running mean of p_sig and J over the ringing period.
        windowed_fidelity: F after the same.
        window: that period T_1, in t_c.
        residual_speed: largest grain speed when the readout began, over the walls' speed, [S + 1].
        status: bits of `Status`, [S + 1]; replica 0 is the zero signal.
        stages: samples of every stage by name, leading axis bins; one replica before "encode".
        dt: the time step used, in t_c.
    """

    u: jax.Array
    J: jax.Array
    p_sig: jax.Array
    gain: jax.Array
    fidelity: jax.Array
    windowed_gain: jax.Array
    windowed_fidelity: jax.Array
    window: jax.Array
    residual_speed: jax.Array
    status: jax.Array
    stages: Samples
    dt: Scalar


@dataclass
class _Inline:
    """The same stages as part of a traced computation: nothing can grow, the status bits tell."""

    system: System
    state: State
    dt: Scalar
    backend: str

    def stage(self, name: str, motion: Motion, *, bins: int, steps: Any, drag: Any = 0.0) -> Sample:
        self.state, sample = native.pick(self.backend)(
            self.system, self.state, motion, jnp.asarray(self.dt), bins=bins, steps=steps, drag=drag
        )
        return sample


def _traced(*trees: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def _refuse_bad_numbers(friction: FrictionLaw, **numbers: Any) -> None:
    """Check what is concrete; traced values cannot be checked.

    Raises:
        ValueError: naming the argument, its value and what would be right.
    """
    positive = {"t0": numbers["t0"], "dt": numbers["dt"], "gamma0": numbers["gamma0"]}
    for name, value in positive.items():
        if not _traced(value) and not np.all(np.asarray(value) > 0.0):
            raise ValueError(f"{name} must be positive, got {value}")
    for name in ("rest", "hold", "store"):
        if not numbers[name] >= 0.0:
            raise ValueError(f"{name} must not be negative, got {numbers[name]}")
    if not _traced(numbers["dt"]) and np.any(np.asarray(numbers["dt"]) > LARGEST_STEP):
        raise ValueError(f"dt must be at most {LARGEST_STEP} t_c, got {numbers['dt']}")
    delta0 = numbers["delta0"]
    if not _traced(delta0) and not np.all((np.asarray(delta0) > 0.0) & (np.asarray(delta0) < 0.5)):
        raise ValueError(f"delta0 must be in (0, 0.5), got {delta0}")
    mu = getattr(friction, "mu", 0.0)
    if not _traced(mu) and not np.all(np.asarray(mu) >= 0.0):
        raise ValueError(f"mu must not be negative, got {mu}")


def _refuse_open_waveforms(signals: Signals) -> None:
    """The walls are unsheared at u = 0 and u = 1; a waveform that is not would make them jump."""
    if _traced(signals):
        return
    with jax.ensure_compile_time_eval():
        ends = np.asarray(signals.shear(jnp.asarray([0.0, 1.0])))
    if not np.all(np.isfinite(ends)) or np.max(np.abs(ends)) > 1e-9:
        raise ValueError(f"waveforms must vanish at u = 0 and u = 1; found {np.abs(ends).max():g} there")


def _width(*parameters: Any) -> int:
    """Replicas that the parameters need: 1 if all are scalars, else the length of their axis."""
    return max([1, *(int(np.prod(np.shape(leaf))) for leaf in jax.tree.leaves(parameters))])


def run_memory(
    pack: Pack,
    signals: Signals,
    *,
    friction: FrictionLaw | None = None,
    gamma0: Scalar = 1e-3,
    delta0: Scalar | None = None,
    t0: Scalar = 1.8e3,
    dt: Scalar = 0.3,
    background: str = "sub0",
    backend: str = "auto",
    rest: float = 0.2,
    hold: float = 0.2,
    store: float = 2.0,
    hold_drag: Scalar | None = None,
    material: Material | None = None,
    batch: int | None = None,
    keep: Keep = forget,
    progress: Progress = silent,
) -> Recall:
    """Store S waveforms in S copies of a pack and recall them; a further copy stores none.

    Called with concrete arguments it runs in chunks on the host: stale neighbour lists are rebuilt, a broken run
    raises. Inside `jax.jit`, `jax.vmap` or `jax.grad` it is one traced computation on the pack's own list, and what
    goes wrong sets bits of `status` and turns gain and fidelity into NaN.

    Args:
        pack: the pack at rest.
        signals: the waveforms.
        friction: the friction law; default `Hooke()`. Its parameters may be scalars or [S + 1].
        gamma0: shear amplitude.
        delta0: areal compression; default the pack's own. Another value warns.
        t0: duration of one compression, in t_c. The paper's is 1.8e4.
        dt: largest time step, in t_c.
        background: "sub0", "sub2" or "sub2-bl"; the last two add a second readout.
        backend: "jax", the definition; "native", C++ on CPUs; "auto", native where it is built and knows the law.
        rest: rests at u = 0, in t0.
        hold: holds at u = 1, in t0.
        store: storage, in t0.
        hold_drag: viscous drag while the walls stand still, 1 / t_c; default 0.05 for t0 below the paper's, else 0.
        material: the elastic solid.
        batch: signals that run together; default all of them. Ignored inside a transformation.
        keep: asked for every finished part of a long run, so that it can be resumed (see `storage.Parts`).
        progress: told about every chunk.

    Raises:
        ValueError: for impossible numbers or waveforms, or if 64-bit mode is off.
        RunFailedError: if the simulation broke down (concrete arguments only).
    """
    require_x64()
    friction = Hooke() if friction is None else friction
    own = delta0 is None
    delta0 = pack.delta0 if delta0 is None else delta0
    _refuse_bad_numbers(friction, t0=t0, dt=dt, gamma0=gamma0, delta0=delta0, rest=rest, hold=hold, store=store)
    _refuse_open_waveforms(signals)
    if batch is not None and batch < 1:
        raise ValueError(f"batch must be at least 1, got {batch}")
    if background not in analysis.BACKGROUNDS:
        raise ValueError(f"background must be one of {', '.join(analysis.BACKGROUNDS)}; got {background!r}")
    if not own and not _traced(delta0, pack) and not np.allclose(np.asarray(delta0), np.asarray(pack.delta0)):
        warnings.warn(
            f"{pack.name} was cycled with delta0 = {float(pack.delta0):g}, not {delta0}: its memory of the preparation "
            "differs from the paper's; prepare a pack for this delta0",
            stacklevel=2,
        )
    if hold_drag is None:
        hold_drag = jnp.where(jnp.asarray(t0) < 0.999 * PAPER_T0, HOLD_DRAG, 0.0)
    step, steps = clock(t0, dt)
    system = System(pack.clump, friction, pack.pairs, material or Material())
    width = _width(friction, delta0, step)
    position, quaternion = replicate((pack.position[..., None], pack.quaternion[..., None]), width)
    state = start(system, position, quaternion, pack.box)
    stages = memory_protocol(rest, hold, store, second_readout=background != "sub0")
    drive = _Drive(pack, delta0, gamma0, step, steps, hold_drag)
    if isinstance(state.status, jax.core.Tracer) or _traced(signals, gamma0, delta0, t0, dt, hold_drag):
        inline = _Inline(system, state, step, backend)
        common, sheared = split(stages)
        samples = drive.play(inline, common)
        inline.state = _fan_out(inline.state, signals)
        samples |= drive.play(inline, sheared, signals)
        status = inline.state.status
    else:
        runner = _on_host(system, state, pack, delta0, step)
        runner.backend, runner.progress = backend, progress
        samples, status = _in_batches(drive, runner, stages, signals, batch or signals.count, keep)
    return _recall(pack, signals, samples, status, background, delta0, gamma0, t0, step)


def _fan_out(state: State, signals: Signals) -> State:
    """A replica for the zero signal and one for each of the others."""
    copies: State = replicate(state, signals.count + 1) if state.replicas == 1 else state
    return copies


@dataclass(frozen=True)
class _Drive:
    """The numbers of the walls' motion, common to all stages and signals."""

    pack: Pack
    delta0: Scalar
    gamma0: Scalar
    dt: Scalar
    steps: Any
    hold_drag: Scalar

    def play(self, stepper: _Inline | Runner, stages: tuple[Stage, ...], signals: Signals | None = None) -> Samples:
        """Run the stages one after the other."""
        samples: Samples = {}
        for stage in stages:
            motion = Motion(
                lower=self.pack.box.lower,
                upper=self.pack.box.upper,
                delta0=self.delta0,
                start=stage.start,
                stop=stage.stop,
                duration=stage.bins * self.steps * self.dt,
                gamma0=self.gamma0 if stage.sheared else 0.0,
                signals=signals if stage.sheared else None,
            )
            drag = self.hold_drag if stage.holds else 0.0
            samples[stage.name] = stepper.stage(stage.name, motion, bins=stage.bins, steps=self.steps, drag=drag)
        return samples


def _in_batches(
    drive: _Drive, runner: Runner, stages: tuple[Stage, ...], signals: Signals, batch: int, keep: Keep
) -> tuple[Samples, jax.Array]:
    """The prefix once, then the signals in batches, each with a zero signal of its own; samples and status of all.

    A batch depends on nothing but the state after the prefix, so that batches kept by an earlier run can be used.

    Raises:
        ValueError: if the parameters differ between replicas, which is for a single batch only.
    """
    common, rest = split(stages)
    count, width = signals.count, runner.state.replicas
    if width > 1 and batch < count:
        raise ValueError("parameters with a value for each replica need all signals in one batch")
    starts = range(0, count, batch)
    before, after = (sum(stage.bins * drive.steps for stage in some) for some in (common, rest))
    runner.total_work = float(before * width + after * (count + len(starts)))
    samples: Samples
    samples, runner.system, runner.state = keep(
        "prefix", lambda: (drive.play(runner, common), runner.system, runner.state)
    )
    runner = replace(runner, work=float(before * width), finder=None, skin=SKIN, chunk=CHUNK)
    parts: list[tuple[Samples, jax.Array]] = []
    for number, first in enumerate(starts):
        few = part(signals, first, min(first + batch, count))

        def run_batch(few: Signals = few) -> tuple[Samples, jax.Array]:
            own = replace(runner, state=_fan_out(runner.state, few))
            return drive.play(own, rest, few), own.state.status

        parts.append(keep(f"batch-{number:04d}", run_batch))
        runner.work = float(before * width + after * (min(first + batch, count) + number + 1))
    joined, status = jax.tree.map(_join, *parts) if len(parts) > 1 else parts[0]
    return samples | joined, status


def _join(first: Any, *others: Any) -> np.ndarray:
    """Replicas of several batches, innermost; the zero signal of the first stands for all."""
    return np.concatenate([np.asarray(first), *(np.asarray(other)[..., 1:] for other in others)], axis=-1)


def default_batch(pack: Pack, friction: FrictionLaw, available: int) -> int:
    """Signals that may run together in half of the `available` bytes; at most 63, which with the zero signal fill
    whole vectors of every CPU, and lose little when a run is interrupted.
    """
    history = jax.eval_shape(lambda: friction.init(pack.pairs.capacity, 1, jnp.zeros(()).dtype))
    contacts = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(history))
    replica = COPIES * (contacts + GRAIN_BYTES * pack.grains)
    return int(max(1, min(63, 0.5 * available / replica - 1)))


def _on_host(system: System, state: State, pack: Pack, delta0: Scalar, dt: Scalar) -> Runner:
    deepest = float(np.max(np.asarray(delta0)))
    smallest = smallest_box(np.asarray(pack.lower), np.asarray(pack.upper), deepest)
    return Runner(system, state, pack.box, dt, smallest=smallest, skin=SKIN)


def _recall(
    pack: Pack,
    signals: Signals,
    samples: Samples,
    status: jax.Array,
    background: str,
    delta0: Scalar,
    gamma0: Scalar,
    t0: Scalar,
    dt: Scalar,
) -> Recall:
    """Subtract the background and compare with the integrals."""
    first = analysis.recalled(jnp.asarray(samples["readout"].pressure))
    second = samples.get("readout-2")
    p_sig = analysis.subtract(background, first, None if second is None else analysis.recalled(second.pressure))
    integral = bin_average(signals)
    window = pack.ringing_period * BINS / t0
    smooth = analysis.running_mean(p_sig, window), analysis.running_mean(integral, window)
    wall_speed = 0.5 * (pack.upper - pack.lower)[0] * (1.0 - jnp.sqrt(1.0 - delta0)) / t0
    residual = samples["store"].largest_speed[-1] / wall_speed
    status = jnp.asarray(status) | jnp.where(residual < REST_SPEED, 0, int(Status.NOT_AT_REST)).astype(jnp.int32)
    status = status | jnp.where(dt <= LARGEST_STEP, 0, int(Status.STEP_TOO_LARGE)).astype(jnp.int32)
    sound = jnp.all(status & ~int(Status.NOT_AT_REST) == 0)

    def guarded(value: jax.Array) -> jax.Array:
        return jnp.where(sound, value, jnp.nan)

    return Recall(
        u=(jnp.arange(BINS) + 0.5) / BINS,
        J=integral,
        p_sig=p_sig,
        gain=guarded(analysis.gain(p_sig, integral, delta0, gamma0)),
        fidelity=guarded(analysis.fidelity(p_sig, integral, delta0, gamma0)),
        windowed_gain=guarded(analysis.gain(*smooth, delta0, gamma0)),
        windowed_fidelity=guarded(analysis.fidelity(*smooth, delta0, gamma0)),
        window=pack.ringing_period,
        residual_speed=residual,
        status=status,
        stages=samples,
        dt=dt,
    )


def fidelity(pack: Pack, signals: Signals, **run: Any) -> jax.Array:
    """F of one set of signals; arguments as in `run_memory`."""
    return run_memory(pack, signals, **run).fidelity


def gain(pack: Pack, signals: Signals, **run: Any) -> jax.Array:
    """G of one set of signals; arguments as in `run_memory`."""
    return run_memory(pack, signals, **run).gain
