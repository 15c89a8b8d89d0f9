"""The description of a memory experiment: its fields, their defaults, and the checks (paper, Secs. II and III)."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment import analysis
from gmem_jax.experiment.analysis import Background
from gmem_jax.experiment.arguments import named_observers, require_parts
from gmem_jax.experiment.asked import (
    require_data,
    require_finite_waveforms,
    require_memory,
    require_pack,
    require_seen,
    require_slippery,
    require_slow_creep,
    require_told_apart,
    require_walls,
    static_number,
)
from gmem_jax.experiment.html import Facts, brief, facts, line
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.protocols import Shear, memory_protocol
from gmem_jax.experiment.readings import Readings
from gmem_jax.experiment.signals import Signals, SignalSets, bin_average, sets_of, waveform
from gmem_jax.native.backend import Backend, Precision, backend_name, require_precision, supports
from gmem_jax.physics.contact.friction import CoulombLaw, FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.own_law import require_law
from gmem_jax.physics.material import Material
from gmem_jax.physics.numbers import require_double, require_whole
from gmem_jax.physics.pytree import Scalar, out_of_range, parameter, pytree, static, traced, validate
from gmem_jax.physics.rotation import unit
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import State, Status, replicate
from gmem_jax.physics.step import start
from gmem_jax.physics.system import System
from gmem_jax.simulation.channels import CHANNELS
from gmem_jax.simulation.loop import Observe, Simulation, at_rest
from gmem_jax.simulation.protocol import Protocol
from gmem_jax.simulation.stable_step import LONGEST_STEP
from gmem_jax.simulation.stage import BINS, Columns, Lane, Stage, bin_centres
from gmem_jax.simulation.strain import COMPRESSIONS, Sine, StrainPath, Waveforms

PAPER_T0 = 1.8e4  # the paper's duration of a compression, in t_c
HOLD_DRAG = 0.05  # 1 / t_c; damps the slowest mode within about 40 t_c up to N = 10,000 without overdamping it
MOST_STEPS = 1e9  # steps in a bin: more take a year of computing for a few grains
LEAST_STEP = 1e-100  # t_c; its square does not underflow
USUAL_STEP = 0.6  # t_c; less than a third of the stable step under the default law
OF_PAPER = ("rest", "hold", "store", "shear")  # fields of the paper's protocol; in others the stages give them
NOT_OF_PAPER = ("creep", "creep_fades", "gravity", "wall_mu")  # effects that the paper does not have; None switches off


class Timing(NamedTuple):
    """The time step, in t_c, and the whole number of them in a bin."""

    dt: Scalar
    steps: int


@pytree
@dataclass(frozen=True)
class Experiment:
    """Everything a recall depends on. S signals make S + 1 replicas; replica 0 has the zero signal.

    An experiment is a pytree: its floats can be differentiated and vmapped. The parameters of the friction law, gamma0,
    shear_share, delta0, t0, hold_drag, creep, creep_fades, gravity and wall_mu are one number, or one for each
    replica, [S + 1].

    Attributes:
        pack: the pack at rest.
        signals: the S waveforms; `gm.signals` joins several sets, for several channels or writes.
        friction: the friction law.
        material: the elastic solid that the spheres are made of.
        gamma0: amplitude of the shear strain gamma = gamma0 I, where I is the waveform.
        shear_share: the part of gamma by which L_x shrinks and L_y grows (1/2: by gamma / 2 each); see
            `gmem_jax.simulation.strain.StrainPath`.
        delta0: fraction of its area in x and y that the box loses at u = 1; default the pack's own. `run` warns of any
            other value.
        t0: duration of one compression, in t_c. The paper's is 1.8e4.
        hold_drag: viscous drag while the walls stand still, in 1 / t_c; default 0.05 for t0 below the paper's, else 0.
        creep: rate at which the elastic tangential forces of contacts relax, in 1 / t_c; default: they never relax. At
            most a twentieth of a force may relax in one bin.
        creep_fades: time since the beginning of a stage after which the rate of creep falls as 1 / t, in t_c; default:
            the rate is constant.
        gravity: acceleration of gravity along -z, in R / t_c^2, which is E / (rho R); default none. It acts from the
            start of the run.
        wall_mu: friction coefficient of the walls; default smooth walls. Contacts with walls take the friction law with
            this mu. It acts from the start of the run, except in stages without friction.
        dt: largest time step, in t_c; a bin is divided into whole steps no longer than this.
        steps: number of steps in a bin of t0 / 256, instead of dt; default the fewest that dt allows. Needed where t0
            is a tracer.
        steps_per_bin: number of steps in a bin; it follows from `steps` or `dt` and cannot be given.
        rest: length of each rest at u = 0, in t0.
        hold: length of each hold at u = 1 other than the storage, in t0.
        store: length of the storage at u = 1, in t0. Rests, holds and storage are rounded up to whole bins of t0 / 256,
            and last one bin at least.
        background: what is subtracted from the readout: "sub0", that of the zero signal; "sub2", a second readout of
            the same replica; "sub2-bl", the same, and then the line through the ends of the result.
        shear: "during": waveforms are functions of u, applied during the compression; "before": they are functions of
            time, applied at u = 0 before it.
        protocol: the stages of the run; default the paper's, made of rest, hold, store, background and shear. In any
            other protocol its stages give all lengths, and "sub2" and "sub2-bl" need two reads: the second is the
            background of the first.
        observe: functions of (simulation, state), as a dictionary by name or a list of `gm.observables`. They are
            called at the end of each bin and give arrays [..., B], kept in `Recall.stages[...].observed`. Each replica
            must be treated by itself, since the B replicas of a batch or device are not always all S + 1.
        backend: "jax", plain JAX, which defines the physics; "native", the same in C++, on CPUs and CUDA GPUs; "auto",
            native where it is built and knows the law, else "jax".
        precision: "double"; or "mixed": contacts in single precision, on the native backend, without derivatives.

    Raises:
        ValueError: for impossible numbers or waveforms, and shapes that do not fit. Traced values cannot be refused:
            impossible ones set `Status.IMPOSSIBLE`.
    """

    pack: Pack
    signals: Signals | SignalSets = dataclasses.field(metadata={"after_prefix": True})
    friction: FrictionLaw = Hooke()
    material: Material = Material()
    gamma0: Scalar = parameter(1e-3, "[1e-100, 0.5)", "Shear amplitude", varies=True, after_prefix=True)
    shear_share: Scalar = parameter(
        0.5, "(0, 1]", "Part of gamma by which L_x shrinks and L_y grows", varies=True, after_prefix=True
    )
    delta0: Scalar | None = parameter(
        None, COMPRESSIONS, "Areal compression at u = 1; default the pack's own", varies=True
    )
    t0: Scalar = parameter(1.8e3, "(0, inf)", "Duration of one compression (the paper's is 18000)", "t_c", varies=True)
    hold_drag: Scalar | None = parameter(
        None,
        "[0, inf)",
        "Viscous drag while walls stand still; default 0.05 if t0 < 18000, else 0",
        "1/t_c",
        varies=True,
    )
    creep: Scalar | None = parameter(
        None, "[0, inf)", "Rate at which elastic tangential forces relax; default never", "1/t_c", varies=True
    )
    creep_fades: Scalar | None = parameter(
        None,
        "(0, inf)",
        "Time in a stage after which the rate of creep falls as 1/t; default never",
        "t_c",
        varies=True,
    )
    gravity: Scalar | None = parameter(
        None, "[0, 0.01]", "Acceleration of gravity along -z; default none", "R/t_c^2", varies=True
    )
    wall_mu: Scalar | None = parameter(
        None, "[0, inf)", "Friction coefficient of the walls; default smooth walls", varies=True
    )
    dt: float = static(USUAL_STEP, "Largest time step", "t_c")
    steps: int | None = static(None, "Steps in a bin of t0 / 256, in the place of dt", no_option=True)
    rest: float = static(0.2, "Length of each rest at u = 0", "t0")
    hold: float = static(0.2, "Length of each hold at u = 1 but the storage", "t0")
    store: float = static(2.0, "Length of the storage at u = 1", "t0")
    background: Background = static("sub0", "Background that is subtracted: sub0, sub2 or sub2-bl")
    shear: Shear = static("during", "Waveforms are applied during the compression, or before it (in time, at u = 0)")
    backend: Backend = static("auto", "Code that computes the steps: auto, jax or native")
    precision: Precision = static("double", "double; or mixed: contacts in single precision (native)")
    protocol: Protocol = static(None)
    observe: tuple[tuple[str, Observe], ...] = static(())
    steps_per_bin: int = dataclasses.field(init=False, default=1, metadata={"static": True})

    @usual_rules()
    def __post_init__(self) -> None:
        require_parts(self.pack, self.signals, self.friction)
        for name in ("dt", "rest", "hold", "store"):
            object.__setattr__(self, name, static_number(name, getattr(self, name)))
        object.__setattr__(self, "background", str(self.background).lower())
        object.__setattr__(self, "observe", named_observers(self.observe))
        validate(self)
        if self.background not in analysis.BACKGROUNDS:
            raise ValueError(f"background must be one of {', '.join(analysis.BACKGROUNDS)}; got {self.background!r}")
        if self.shear not in get_args(Shear):
            raise ValueError(f"shear must be {' or '.join(get_args(Shear))}, got {self.shear!r}")
        self._set_protocol()
        of_pack = self.pack.periodic, self.pack.clump.equal, self.wall_mu is None
        require_precision(self.precision, self.backend, self.friction, *of_pack)
        require_walls(self.pack.periodic, self.material, self.wall_mu)
        if self.gravity is not None and self.pack.periodic[2]:
            raise ValueError("gravity acts along z, and a box that is periodic there has no floor: leave gravity out")
        if not 0.0 < self.dt <= LONGEST_STEP:
            raise ValueError(f"dt must be in (0, {LONGEST_STEP}], got {self.dt:g}")
        if self.steps is not None:
            object.__setattr__(self, "steps", require_whole("steps", self.steps, 1))
        object.__setattr__(self, "steps_per_bin", self._whole_steps())
        self._check_shapes()
        if jax.config.read("jax_enable_x64"):
            require_double(pack=self.pack, signals=self.signals)
        if not supports(self.friction) and not traced(self.friction):
            require_law(self.friction, self.replicas)
        self._check_waveforms()
        require_slippery(self.friction, self.wall_mu)
        require_slow_creep(self.friction, self.creep, self.creep_fades, self.t0)
        step = self.timing.dt
        if not traced(step) and not np.all(np.asarray(step) >= LEAST_STEP):
            raise ValueError(f"t0 = {np.min(self.t0):g} is too short: steps must be {LEAST_STEP:g} t_c or longer")
        if not traced(step) and not np.all(np.asarray(step) <= LONGEST_STEP):
            raise ValueError(
                f"steps = {self.steps_per_bin} makes a time step of {np.max(step):g} t_c, which must be at most "
                f"{LONGEST_STEP}; give more steps, or none to have them chosen"
            )

    def _whole_steps(self) -> int:
        if self.steps is not None:
            return self.steps
        if traced(self.t0):
            raise ValueError(
                "t0 is traced, and the number of steps must not depend on it: give steps, or use gm.replace, which "
                "keeps those of the experiment"
            )
        fewest = float(np.max(self.t0)) / BINS / self.dt * (1.0 - 1e-12)
        if not fewest < MOST_STEPS:
            raise ValueError(
                f"dt = {self.dt:g} makes {fewest:g} steps in a bin of t0 / 256, must be below {MOST_STEPS:g}"
            )
        return max(1, math.ceil(fewest))

    def _set_protocol(self) -> None:
        paper, names = self._paper_protocol(), tuple(self.sets)
        given: Protocol | None = self.protocol
        if given is not None and not isinstance(given, Protocol):
            raise ValueError(
                f"protocol must be a gm.Protocol, got a {type(given).__name__}; see gm.protocols and gm.load_protocol"
            )
        protocol = paper if given is None else given.with_sets(names)
        if protocol is None:
            raise ValueError(
                f"the paper's protocol writes sets of waveforms named after a channel, {', '.join(CHANNELS)}; "
                f"there are {', '.join(names)}: rename them, or give a protocol with stages that write them"
            )
        if protocol != paper:
            odd = [name for name in OF_PAPER if getattr(self, name) != _DEFAULTS[name]]
            if odd:
                raise ValueError(
                    f"{odd[0]} belongs to the paper's protocol, and another is given: set it in a stage of the other"
                )
            require_memory(protocol, self.background)
        if protocol.columns.friction and not isinstance(self.friction, CoulombLaw | Frictionless):
            raise ValueError(
                f"the protocol switches friction off, and {type(self.friction).__name__} has no mu to switch"
            )
        object.__setattr__(self, "protocol", protocol)

    def _paper_protocol(self) -> Protocol | None:
        """None where no set of waveforms is called like a channel."""
        if not any(name in CHANNELS for name in self.sets):
            return None
        again = self.background != "sub0"
        paper = memory_protocol(self.rest, self.hold, self.store, second_readout=again, shear=self.shear)
        return paper.with_sets(self.sets)

    @property
    def is_paper(self) -> bool:
        """Whether the protocol is the paper's."""
        return self.protocol == self._paper_protocol()

    @property
    def sets(self) -> dict[str, Signals]:
        """Sets of waveforms by name; the only one is "xy"."""
        return sets_of(self.signals)

    @property
    def waveforms(self) -> Signals:
        """The set of waveforms, if there is only one.

        Raises:
            ValueError: if there are several sets.
        """
        if len(self.sets) > 1:
            raise ValueError(f"this works with one set of waveforms, and the experiment has {', '.join(self.sets)}")
        (one,) = self.sets.values()
        return one

    @property
    def readings(self) -> Readings:
        """The reads and channels of the protocol, and how p_sig is made of their pressures."""
        return Readings(self.protocol, self.background)

    def _check_shapes(self) -> None:
        for name in ("signals", "friction"):
            if jax.tree_util.all_leaves([getattr(self, name)]):
                raise ValueError(
                    f"{name} must be a pytree: register {type(getattr(self, name)).__name__} with "
                    "jax.tree_util.register_dataclass"
                )
        require_data(signals=self.signals, friction=self.friction)
        require_pack(self.pack)
        for name, value in vars(self.material).items():
            if jnp.shape(value) != ():
                raise ValueError(f"material.{name} must be one number, of all replicas; got shape {jnp.shape(value)}")
        for name, value in replica_parameters(self).items():
            if jnp.shape(value) not in ((), (self.replicas,)):
                raise ValueError(
                    f"{name} must be one number or one for each replica, [S + 1] = [{self.replicas}] with the zero "
                    f"signal first; got shape {jnp.shape(value)}"
                )

    def _check_waveforms(self) -> None:
        """Refuse waveforms that are not zero at u = 0 and 1, where the walls would jump; and sets that are all zero."""
        if traced(self.signals):
            return
        loud = []
        for one in self.sets.values():
            with jax.ensure_compile_time_eval():
                ends, within = (np.asarray(values) for values in _probe(one))
                integrals = np.asarray(bin_average(one))
            require_finite_waveforms(ends, integrals)
            if np.max(np.abs(ends)) > _OPEN:
                raise ValueError(f"waveforms must vanish at u = 0 and u = 1; found {np.abs(ends).max():g} there")
            loud.append(np.any(within) or np.any(integrals))
            require_seen(within, integrals)
        if not any(loud):
            raise ValueError("every waveform is zero: there is nothing to recall, and no gain or fidelity")
        if len(self.readings.channels) > 1:
            with jax.ensure_compile_time_eval():
                templates = np.asarray(self.integral())
            require_told_apart(self.readings, templates)

    @property
    def replicas(self) -> int:
        """Number of replicas, S + 1."""
        return self.signals.count + 1

    @property
    def compression(self) -> Scalar:
        """delta0, the pack's own where none is given."""
        return self.pack.delta0 if self.delta0 is None else self.delta0

    @property
    def drag(self) -> Scalar:
        """hold_drag, the default for t0 where none is given, in 1 / t_c."""
        if self.hold_drag is not None:
            return self.hold_drag
        if isinstance(self.t0, float):
            return HOLD_DRAG if self.t0 < 0.999 * PAPER_T0 else 0.0
        return jnp.where(self.t0 < 0.999 * PAPER_T0, HOLD_DRAG, 0.0)

    @property
    def runs_on(self) -> Backend:
        """The backend that runs this law on JAX's default device: "jax" or "native"."""
        return backend_name(self.backend, self.friction)

    @property
    def timing(self) -> Timing:
        """The time step that is used, in t_c: `dt`, or less so that a bin holds whole steps; and the steps in a bin."""
        return Timing(self.t0 / (BINS * self.steps_per_bin), self.steps_per_bin)

    @property
    def phases(self) -> tuple[tuple[Stage, ...], tuple[Stage, ...]]:
        """The stages of the shear-free prefix, run once for all signals; and those from the first sheared one on."""
        phases: tuple[tuple[Stage, ...], tuple[Stage, ...]] = self.protocol.phases
        return phases

    def simulation(self, *, sheared: bool) -> Simulation:
        """Parameters, walls and time step of a rollout, without waveforms (the prefix) or with them (`sheared`)."""
        lower, upper = self.pack.box.lower, self.pack.box.upper
        columns: Columns = self.protocol.columns
        if sheared:
            waveforms = tuple(map(self._waveforms, columns.lanes))
            drive = (self.gamma0, waveforms, self.shear_share, columns.lanes)
        else:
            columns, drive = columns._replace(lanes=()), (0.0, (), 1.0, ())
        dt, steps = self.timing
        return Simulation(
            System(self.pack.clump, self.friction, self.pack.pairs, self.material, self.gravity, self.wall_mu),
            StrainPath(lower, upper, self.compression, *drive, periodic=self.pack.periodic),
            dt,
            self.drag,
            steps=steps,
            backend=self.backend,
            precision=self.precision,
            creep=self.creep,
            creep_fades=self.creep_fades,
            columns=columns,
            observe=self.observe,
        )

    def _waveforms(self, lane: Lane) -> Waveforms:
        drive = lane.drive
        if not drive.fixed:
            return self.sets[str(lane.waveform)]
        if drive.periods:
            return Sine(float(drive.periods))
        with jax.ensure_compile_time_eval():
            return waveform(np.asarray(lane.waveform))

    def begin(self) -> State:
        """The state at the start: one replica of the pack at rest, or S + 1 where parameters differ in the prefix."""
        before = (value for name, value in replica_parameters(self).items() if acts_on_prefix(name))
        wide = self.replicas if any(jnp.ndim(value) for value in before) else 1
        turned = unit(self.pack.quaternion[..., None])
        position, quaternion = replicate((self.pack.position[..., None], turned), wide)
        simulation = self.simulation(sheared=False)
        state = start(simulation.system, position, quaternion, self.pack.box)
        if simulation.columns.pressure:
            state = dataclasses.replace(state, servo=at_rest(simulation, state, self.pack.box))
        bits = jnp.where(self._impossible(), int(Status.IMPOSSIBLE), 0)
        bits |= jnp.where(jnp.all(jnp.asarray(self.timing.dt) <= LONGEST_STEP), 0, int(Status.STEP_TOO_LARGE))
        return dataclasses.replace(state, status=state.status | bits.astype(jnp.int32))

    def _impossible(self) -> jax.Array:
        impossible = out_of_range(self)
        for one in self.sets.values():
            ends = _ends(one)
            impossible |= ~jnp.all(jnp.isfinite(ends) & (jnp.abs(ends) <= _OPEN))
            impossible |= ~jnp.all(jnp.isfinite(one.integral(jnp.asarray(1.0))))
        return impossible

    def fan_out(self, state: State) -> State:
        """The state of one replica copied to S + 1; a state that has all of them already stays as it is."""
        copies: State = replicate(state, self.replicas) if state.replicas == 1 < self.replicas else state
        return copies

    @property
    def scale(self) -> Scalar:
        """E delta0 gamma0, the unit of gains; a scalar, or [S, 1] where it differs between signals."""
        scale = self.compression * self.gamma0
        return scale if jnp.ndim(scale) == 0 else jnp.asarray(scale)[1:, None]

    def integral(self) -> jax.Array:
        """J of every signal averaged over each bin, [S, 256]; [R, C, S, 256] with several reads or channels."""
        return self.readings.integrals(self.sets)

    def recalled(self, pressures: Mapping[str, jax.Array]) -> jax.Array:
        """p_sig of every signal in ascending u, shaped like `integral`, in E.

        Args:
            pressures: wall pressures of each read by the name of its stage, [bins, 3, S + 1], in E.
        """
        return self.readings.recalled(pressures)

    def compare(self, p_sig: jax.Array, window: Scalar | None = None) -> analysis.Match:
        """Gain and fidelity of recalled signals.

        Args:
            p_sig: recalled signals, shaped like `integral`, in E.
            window: time in t0 over which p_sig and J are averaged first; default none.
        """
        return self.readings.compare(p_sig, self.integral(), self.scale, window)

    def _facts(self) -> Facts:
        pack, dt = self.pack, self.timing.dt
        rows = {
            "pack": f"{pack.name}, {pack.grains} grains",
            "signals": f"{self.signals.count}, {type(self.signals).__name__.lower()}",
            **({} if self.is_paper else {"protocol": ", ".join(stage.name for stage in self.protocol)}),
            "friction": f"{type(self.friction).__name__}, mu = {brief(getattr(self.friction, 'mu', 0.0))}",
            "gamma0": self.gamma0,
            "delta0": self.compression,
            "t0 (t_c)": self.t0,
            "dt (t_c)": dt,
            "steps": self.steps_per_bin * self.protocol.bins,
            **{name: getattr(self, name) for name in ("background", "backend", "precision")},
        }
        return "Experiment", rows

    def __repr__(self) -> str:
        return line(self, self._facts)

    def _repr_html_(self) -> str:
        return facts(*self._facts())


_OPEN = 1e-9  # largest |I| of a waveform at u = 0 and u = 1
_DEFAULTS = {entry.name: entry.default for entry in fields(Experiment)}


def _ends(signals: Signals) -> jax.Array:
    return signals.shear(jnp.asarray([0.0, 1.0]))


@jax.jit
def _probe(signals: Signals) -> tuple[jax.Array, jax.Array]:
    """The waveforms at u = 0 and u = 1, and at the centres of the bins."""
    return _ends(signals), signals.shear(jnp.asarray(bin_centres()))


NUMBERS = {entry.name: entry for entry in fields(Experiment) if entry.metadata.get("words")}
"""The numbers and choices of an experiment: fields by name. Metadata of each are `words`, `unit`, `interval`, whether
it `varies` between replicas, and whether it acts only `after_prefix`. Options, names in sweeps and files, checks and
the table of the documentation are made from them."""


def acts_on_prefix(name: str) -> bool:
    """Whether the shear-free prefix depends on the parameter of this dotted name."""
    first = name.split(".")[0]
    return not any(entry.name == first and entry.metadata.get("after_prefix") for entry in fields(Experiment))


def replica_parameters(experiment: Experiment) -> dict[str, Any]:
    """The parameters that may differ between replicas, by name."""
    own = {name: getattr(experiment, name) for name, entry in NUMBERS.items() if entry.metadata.get("varies")}
    law: Any = experiment.friction
    of_law = {f"friction.{field.name}": getattr(law, field.name) for field in fields(law)} if is_dataclass(law) else {}
    numbers = {**own, **of_law}
    return {name: value for name, value in numbers.items() if isinstance(value, float | np.ndarray | jax.Array)}


def require_one_value(what: str, experiment: Experiment) -> None:
    """Refuse parameters that differ between replicas; `what` begins the message, as "a kernel is measured".

    Raises:
        ValueError: naming the first of them.
    """
    for name, value in replica_parameters(experiment).items():
        if jnp.ndim(value):
            raise ValueError(f"{what} at one value of each parameter, not one for each replica as {name} has")
