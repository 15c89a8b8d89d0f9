"""Walks on the host: chunks of bins, with what only a host can do: renew a stale list, report progress, stop, go on.

A chunk that ends with a stale list is thrown away, the list is made anew from the chunk's start, and the chunk is done
again. What a chunk is may be changed (`Action`): derivatives in forward and reverse mode go through the same chunks.
"""

import functools
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.devices import Spread, local
from gmem_jax.experiment.frames import Film, Frame, Taken, take
from gmem_jax.experiment.pack import SKIN, pair_finder
from gmem_jax.experiment.protocol import Bin, Stage
from gmem_jax.experiment.stability import cause
from gmem_jax.experiment.walk import Course, walk_some
from gmem_jax.physics.pairs import carry_history, slack, sphere_centres
from gmem_jax.physics.sample import Sample
from gmem_jax.physics.search import PairFinder
from gmem_jax.physics.state import Box, State, Status, explain, together
from gmem_jax.physics.step import System

Progress = Callable[[str, float, float], None]
"""Called with the stage's name, the simulated time so far (t_c) and the fraction of the whole work done (0 to 1)."""

CHUNK = 32  # bins per call: some seconds of work at most, a few milliseconds of overhead
STEP = 1.0  # work of a step beside its replicas', in theirs: 0.9 at 10,240 grains, 1.4 at 3,267 and 2 at 325
WIDEST = 2.0  # skin beyond which a list that goes stale within a bin is a broken run


class Checkpoint:
    """Where an unfinished part of a long run stands. This one keeps nothing; see `gmem_jax.files.parts`."""

    def begun(self) -> Any:
        """What was kept when the run was interrupted; None for a run that begins."""
        return None

    def reached(self, standing: Callable[[], Any], *, milestone: bool = False) -> None:
        """Keep what `standing` gives, a tree of arrays, if enough time has passed; at milestones less is enough."""


NOWHERE = Checkpoint()

Keep = Callable[[str, Callable[[Checkpoint], Any]], Any]
"""Gives the part of a run of that name: as kept earlier, or by running it from its checkpoint on."""


def forget(name: str, run: Callable[[Checkpoint], Any]) -> Any:
    """Run every part, keep none: a `Keep`."""
    return run(NOWHERE)


def under(name: str, keep: Keep) -> Keep:
    """The same `Keep` for one of several runs, whose parts have this name before their own."""
    return lambda part, play: keep(f"{name}-{part}", play)


def remembering(keep: Keep) -> Keep:
    """The same `Keep`, by which a part is run or loaded once, however often it is asked for."""
    found: dict[str, Any] = {}

    def kept(name: str, play: Callable[[Checkpoint], Any]) -> Any:
        if name not in found:
            found[name] = keep(name, play)
        return found[name]

    return kept


def sharing(part: str, once: Keep, own: Keep) -> Keep:
    """`own`, but for one part, which is asked of `once`."""
    return lambda name, play: (once if name == part else own)(name, play)


class RunFailedError(RuntimeError):
    """A run whose numbers are meaningless: a grain escaped, a number overflowed, an overlap left the law's range."""


def silent(stage: str, time: float, fraction: float) -> None:
    """Report nothing."""


def work_of_bin(replicas: int) -> float:
    """What a bin costs, in replica-bins: it takes as long as `STEP` replicas more than there are."""
    return replicas + STEP


def work_of(stages: Iterable[Stage], replicas: int) -> float:
    """What some stages cost, in replica-bins."""
    return sum(stage.bins for stage in stages) * work_of_bin(replicas)


def within(progress: Progress, begun: float, ended: float) -> Progress:
    """`progress` for a part of the work, from one fraction to another."""
    return lambda stage, time, fraction: progress(stage, time, begun + (ended - begun) * fraction)


@functools.cache
def _settings() -> dict[str, Any] | None:
    """Compiler settings that suit this code on the default device.

    On CPUs XLA's newer fusion emitters do not vectorise the contact law over the replicas; the older ones do, and
    make a step of plain JAX 1.3 times faster (8 replicas, jax 0.9.2). Later releases have no others to choose.
    """
    settings = {"xla_cpu_use_fusion_emitters": False}
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda: 0, compiler_options=settings)()
    except jax.errors.JaxRuntimeError:  # no such option
        return None
    return settings


class Compiled:
    """`jax.jit` with settings chosen when it is first called: importing must not start a backend."""

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:
        self._function, self._options = function, options

    @functools.cached_property
    def program(self) -> Any:
        """What `jax.jit` made."""
        return jax.jit(self._function, compiler_options=_settings(), **self._options)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call it."""
        return self.program(*args, **kwargs)


def require_x64() -> None:
    """Refuse to simulate in single precision: a contact slides about 1e-6 R in a step.

    Raises:
        ValueError: if JAX's 64-bit mode is off.
    """
    if jax.dtypes.canonicalize_dtype(np.float64) != np.float64:
        raise ValueError(
            'float64 is needed but JAX runs in 32 bits: call jax.config.update("jax_enable_x64", True) first'
        )


def worst(state: State) -> int:
    """All status bits of all replicas."""
    return together(local(state.status))


def refuse(status: int, where: str, course: Course | None = None) -> None:
    """Raise if `status` says that the numbers are meaningless.

    Raises:
        RunFailedError: naming the stage and what happened; and why, where a number of the course tells.
    """
    if Status(status).fatal:
        why = "" if course is None else cause(course)
        raise RunFailedError("; ".join(filter(None, (f"{where}: {explain(status)}", why))))


forward = Compiled(walk_some, static_argnames="most")
"""`walk_some`, compiled once for all chunks and stages of one structure."""


@Compiled
def _room(system: System, state: State, box: Box) -> jax.Array:
    """What the list still allows for, [B], in R: its skin at first; see `pairs.slack`."""
    return slack(system.pairs, sphere_centres(state.grains, system.clump), box)


Move = Callable[[Any, Any], Any]
"""From a history of an old list and a blank one of the new, to the history of the new: linear in both."""


class Action:
    """What is done with a chunk: here, going forwards. Others remember it, or carry a tangent along."""

    def chunk(self, course: Course, state: State, first: Bin, count: int, most: int) -> tuple[State, Sample, Any]:
        """Do `count` bins; the third result is handed to `accept` if the chunk stands."""
        return *forward(course, state, first, count, most), None

    def accept(self, course: Course, state: State, stage: Stage, first: Bin, count: int, more: Any) -> None:
        """The chunk that began with `state` stands."""

    def renew(self, history: Any, move: Move, blank: Any) -> None:
        """The list was made anew: `history` becomes `move(history, blank)`."""


def _same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def _joined(samples: list[Sample]) -> Sample:
    """The samples of a stage's chunks as one."""
    joined: Sample = jax.tree.map(lambda *parts: np.concatenate(parts), *samples)
    return joined


@dataclass
class Walker:
    """A pack on its way through the stages of a protocol.

    Attributes:
        course: changes only in its list.
        state: now.
        smallest: smallest box of the motion to come, [3], for the neighbour list; default the present one.
        skin: of lists that are made anew, in R.
        chunk: bins per call at most; fewer where a list does not last as long.
        action: what is done with a chunk.
        progress: see `Progress`.
        finder: makes lists; made when first needed if not given.
        time: simulated time so far, in t_c.
        work: work done so far; `total_work` is all there is to do.
        rebuilds: lists made anew so far.
        spread: where the replicas are put, if on several devices.
        film: which configurations are kept.
        taken: those that were, so far.
        foresees: whether lists are made anew before they go stale rather than after, for walks on which none lasts:
            every second or third chunk would be thrown away.
    """

    course: Course
    state: State
    smallest: np.ndarray | None = None
    skin: float = SKIN
    chunk: int = CHUNK
    action: Action = field(default_factory=Action)
    progress: Progress = silent
    finder: PairFinder | None = None
    time: float = 0.0
    work: float = 0.0
    total_work: float = 1.0
    rebuilds: int = 0
    spread: Spread | None = None
    film: Film = field(default_factory=Film)
    taken: Taken = field(default_factory=dict)
    foresees: bool = False
    _renewed_at: tuple[str, float] | None = None
    _lasted: int = 0  # bins since the list was made

    def afresh(self, **changes: Any) -> "Walker":
        """A walk that begins where this one is, whatever lists were made on the way here."""
        return replace(self, **{"finder": None, "skin": SKIN, "chunk": CHUNK, **changes})

    def put_on(self, spread: Spread | None) -> None:
        """Put the replicas on several devices; None leaves them where they are."""
        self.spread = spread
        if spread:
            self.state, self.course = spread.put_state(self.state), spread.put_course(self.course)

    def _here(self, tree: Any) -> Any:
        """Arrays with the replica axis last, as numpy arrays on this host."""
        return jax.tree.map(np.asarray, tree) if self.spread is None else self.spread.back(tree)

    def kept(self) -> dict[str, Any]:
        """All that `restore` needs to go on from here to the same bits, as a tree of arrays."""
        counters = np.asarray([self.time, self.work, self.rebuilds, self.skin, self.chunk, self._lasted], float)
        finder = {} if self.finder is None else self.finder.kept()
        pairs = self.course.system.pairs
        if self.spread and pairs.reference.shape[-1] > 1:
            pairs = replace(pairs, reference=self._here(pairs.reference))
        return {
            "state": self._here(self.state) if self.spread else self.state,
            "pairs": jax.tree.map(local, pairs) if self.spread else pairs,
            "counters": counters,
            "finder": finder,
            "taken": OrderedDict(self.taken),
        }

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Stand where a walk on the same course stood when it gave `kept`."""
        self.state, self.course = kept["state"], self.course.with_pairs(kept["pairs"])
        self.put_on(self.spread)
        self.time, self.work, rebuilds, self.skin, chunk, lasted = kept["counters"].tolist()
        self.rebuilds, self.chunk, self._lasted, self.taken = int(rebuilds), int(chunk), int(lasted), kept["taken"]
        if not _same(kept["finder"], self.finder.kept() if self.finder else {}):
            self.finder = pair_finder(self.course.system.clump, **kept["finder"]) if kept["finder"] else None

    def play(self, *stages: Stage, checkpoint: Checkpoint = NOWHERE) -> OrderedDict[str, Sample]:
        """Run stages one after the other.

        Args:
            stages: with names of their own.
            checkpoint: where to go on, and where to keep how far it is.

        Returns:
            Their samples by name, numpy arrays with a leading axis of bins.

        Raises:
            RunFailedError: if the numbers became meaningless.
        """
        played: OrderedDict[str, list[Sample]] = OrderedDict()
        if begun := checkpoint.begun():
            self.restore(begun["walker"])
            played.update((name, [sample]) for name, sample in begun["played"].items())

        def standing() -> dict[str, Any]:
            return {"walker": self.kept(), "played": OrderedDict((name, _joined(played[name])) for name in played)}

        for stage in stages:
            samples = played.setdefault(stage.name, [])
            for milestone in self._play(stage, samples):
                checkpoint.reached(standing, milestone=milestone)
        return OrderedDict((stage.name, _joined(played[stage.name])) for stage in stages)

    def play_part(self, name: str, keep: Keep, *stages: Stage) -> OrderedDict[str, Sample]:
        """Run stages as one part of a long run, and stand at its end, also where it was kept; see `play`."""

        def part(checkpoint: Checkpoint) -> Any:
            return self.play(*stages, checkpoint=checkpoint), self.kept()

        samples, kept = keep(name, part)
        self.restore(kept)
        found: OrderedDict[str, Sample] = samples
        return found

    def status(self) -> np.ndarray:
        """The status of every replica, [B]."""
        found: np.ndarray = self._here(self.state.status)
        return found

    def _play(self, stage: Stage, samples: list[Sample]) -> Iterator[bool]:
        """Play what is left of a stage and add to its samples; after each chunk, whether it was the last."""
        done, most = sum(len(sample.pressure) for sample in samples), CHUNK
        if done == 0 and stage.name == self.film.from_the_beginning:
            drive = self.course.drive
            self.take(stage.name, self.state, np.asarray(drive.lower), np.asarray(drive.upper), stage.start)
        while done < stage.bins:
            first = stage.bin(done)
            count = min(self.chunk, stage.bins - done)
            state, sample, more = self.action.chunk(self.course, self.state, first, count, most)
            status = worst(state)
            if status & Status.STALE_PAIRS:
                self._renew_again(stage, first)
                continue
            refuse(status, stage.name, self.course)
            self.action.accept(self.course, self.state, stage, first, count, more)
            for bins in self.film.between(stage.name, done, done + count):
                self._take_after(stage, done, bins - done, count, state, sample)
            self.state = state
            done += count
            self._lasted += count
            samples.append(jax.tree.map(lambda leaf, count=count: leaf[:count], self._here(sample)))
            self.report(stage.name, count, self._moment(count))
            if self.foresees and done < stage.bins:
                self._foresee(stage, done)
            yield done == stage.bins

    def _take_after(self, stage: Stage, done: int, bins: int, count: int, state: State, sample: Sample) -> None:
        """Take a configuration `bins` after the `done` ones of a stage, within a chunk of `count` that ended so."""
        if bins < count:
            state, sample, _ = self.action.chunk(self.course, self.state, stage.bin(done), bins, CHUNK)
        half = 0.5 * self._here(sample.lengths)[bins - 1]
        drive = self.course.drive
        centre = 0.5 * np.asarray(drive.lower + drive.upper)
        u = stage.start + (stage.stop - stage.start) * (done + bins) / stage.bins
        self.take(stage.name, state, centre - half, centre + half, u, self._moment(bins))

    def take(self, name: str, state: State, lower: np.ndarray, upper: np.ndarray, u: float, later: float = 0.0) -> None:
        """Keep a configuration.

        Args:
            name: of the stage.
            state: on this walk.
            lower: planes of the box, [3, 1] or [3, B].
            upper: planes, likewise.
            u: compression.
            later: time from now to then, in t_c.
        """
        one, system = self.film.replica if state.replicas > 1 else 0, self.course.system
        own = (state.replicas,)
        friction, dt = jax.tree.map(
            lambda leaf: local(leaf)[one : one + 1] if np.shape(leaf) == own else local(leaf),
            (system.friction, self.course.dt),
        )
        state, lower, upper = jax.tree.map(
            lambda leaf: leaf[..., one : one + 1] if np.shape(leaf)[-1] > 1 else leaf, (self._here(state), lower, upper)
        )
        time = (self.time + later) * float(np.max(dt)) / float(np.max(local(self.course.dt)))
        system = replace(jax.tree.map(local, system), friction=friction)
        frame: Frame = take(system, state, lower[:, 0], upper[:, 0], time, u)
        self.taken = OrderedDict({**self.taken, name: (*self.taken.get(name, ()), frame)})

    def _moment(self, bins: int) -> float:
        return bins * self.course.steps * float(np.max(local(self.course.dt)))

    def report(self, name: str, bins: float, time: float) -> None:
        """Count finished bins and tell the progress callback."""
        self.work += bins * work_of_bin(self.state.replicas)
        self.time += time
        self.progress(name, self.time, min(1.0, self.work / self.total_work))

    def renew(self, box: Box) -> None:
        """Make the neighbour list anew where the grains are now, between the walls as they are now."""
        spread, self.spread = self.spread, None
        if spread:  # the search is the host's
            kept = replace(self, spread=spread).kept()
            self.state, self.course = kept["state"], self.course.with_pairs(kept["pairs"])
            box = jax.tree.map(local, box)
        system, replicas = self.course.system, self.state.replicas
        if self.finder is None:
            self.finder = pair_finder(system.clump, np.asarray(box.lengths).max(axis=1), self.skin)
        pairs = self.finder(self.state.grains, system.clump, box, self.smallest)
        blank = system.friction.init(pairs.capacity, replicas, self.state.grains.position.dtype)
        move = functools.partial(carry_history, old=system.pairs, new=pairs)
        self.action.renew(self.state.history, move, blank)
        self.state = replace(self.state, history=move(self.state.history, blank))
        self.course = self.course.with_pairs(pairs)
        self.rebuilds += 1
        self._lasted = 0
        self.put_on(spread)

    def _box_before(self, bin_: Bin) -> Box:
        """The walls at the beginning of a bin; lengths alone count here: time and duration are in bins."""
        return self.course.drive.box_at(bin_, jnp.asarray(float(bin_.number)), float(bin_.bins))

    def _foresee(self, stage: Stage, done: int) -> None:
        """Renew a list that would not last for another chunk, if grains went on using it up as they have."""
        first, count = stage.bin(done), min(self.chunk, stage.bins - done)
        box = self._box_before(first)
        room = float(jnp.min(_room(self.course.system, self.state, box)))
        if (self.skin - room) * (1.0 + count / self._lasted) > self.skin:
            self._renewed_at = (stage.name, self.time)
            self.renew(box)

    def _renew_again(self, stage: Stage, first: Bin) -> None:
        """Renew a stale list before its chunk is redone; if that was just done, shorten the chunk or widen the skin.

        Frictionless grains turn and fly freely in their cages: what a list must allow for grows with the time it lasts.
        """
        if self._renewed_at == (stage.name, self.time):
            if self.chunk > 1:
                self.chunk = max(1, self.chunk // 4)
                return
            self.skin *= 1.5
            self.finder = None
            if self.skin > WIDEST:
                why = cause(self.course) or "the steps are unstable; use a smaller dt, or check pack and friction law"
                raise RunFailedError(f"{stage.name}: grains moved by most of R within one bin: {why}")
        self._renewed_at = (stage.name, self.time)
        self.renew(self._box_before(first))
