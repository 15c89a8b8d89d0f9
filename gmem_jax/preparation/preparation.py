"""Preparation of a pack without friction: gas, pressure, compression cycles, rest (paper, Sec. II)."""

import json
import math
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax import native
from gmem_jax.experiment.drive import Drive
from gmem_jax.experiment.frames import Film, Frames, joined, places
from gmem_jax.experiment.host import (
    Checkpoint,
    Compiled,
    Keep,
    Progress,
    RunFailedError,
    Walker,
    forget,
    refuse,
    require_x64,
    silent,
    work_of_bin,
    worst,
)
from gmem_jax.experiment.pack import Pack, find_pairs, pair_finder, smallest_box
from gmem_jax.experiment.protocol import Stage, preparation_cycle
from gmem_jax.experiment.signals import BINS
from gmem_jax.experiment.walk import Course
from gmem_jax.files.provenance import provenance
from gmem_jax.physics import chance, rotation
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.grain import Clump, tetra
from gmem_jax.physics.material import Material
from gmem_jax.physics.sample import Sample
from gmem_jax.physics.state import Grains, still_box
from gmem_jax.physics.step import System, accelerate, start
from gmem_jax.preparation.piston import BLOCK, Pressed, Servo, largest_speed, press
from gmem_jax.preparation.ringing import ringing_period

FREE_SKIN = 1.0  # neighbour-list skin while grains fly, in R: fewer rebuilds for more candidates
FREE_CANDIDATES = 68  # a grain of a pressed pack with that skin: one program for all lists
FREE_CONTACTS = 48  # a sphere
SETTLING = 500.0  # t_c that coming to rest took per R of a dense pack's height (170 to 880, N = 325 to 10,240)
DENSE_SKIN = 0.5  # of a pressed pack: half of the candidates, half of the time; yet frictionless grains turn freely, so
# that a list lasts only some 50 t_c of a cycle
CYCLE_CHUNK = 8  # bins per compiled call during the cycles
FEWEST = 12  # grains of the smallest pack that was prepared
CALL = 128  # blocks per compiled call: the progress bar moves every few seconds at the largest sizes
DENSE = 0.72  # filling of a large pressed pack, which decides the lattice: with it all six are the paper's

_press = Compiled(press, static_argnames=("march",))


@dataclass(frozen=True)
class Recipe:
    """The numbers of a preparation; what the paper leaves open is a field here (docs/physics.md, "Preparation").

    Attributes:
        grains: number of grains N.
        seed: of orientations, velocities and spins.
        delta0: areal compression of the cycles.
        t0: duration of one compression, in t_c.
        dt: largest time step, in t_c.
        filling: of the lattice the gas starts from.
        gas_speed: rms of each grain's initial velocity, and of its spin times R, in R / t_c.
        gas_time: duration of the gas, in t_c.
        pressure: p_z, in E.
        piston_speed: largest speed of the +z wall, in R / t_c.
        piston_gain: its speed per relative pressure error, in R / t_c.
        cycles: number of compress/decompress cycles.
        rest: rests at u = 0, in t0.
        hold: hold at u = 1, in t0.
        drag: viscous drag once the piston has met its pressure, and whenever the walls stand still, 1 / t_c. More of it
            comes to rest later: soft frictionless modes are then overdamped.
        settled_speed: largest grain speed at which the piston is fixed, in R / t_c.
        quiet: largest grain speed of the finished pack, in R / t_c.
        pressure_error: relative error of p_z at which the piston is fixed.
        patience: longest time spent on coming to rest, in t_c; four times what 100,450 grains should need (`SETTLING`).
    """

    grains: int = 325
    seed: int = 1
    delta0: float = 0.05
    t0: float = 1.8e3
    dt: float = 0.3
    filling: float = 0.30
    gas_speed: float = 0.02
    gas_time: float = 6.0e3
    pressure: float = 2.0e-3
    piston_speed: float = 0.02
    piston_gain: float = 0.005
    cycles: int = 2
    rest: float = 0.2
    hold: float = 0.2
    drag: float = 0.01
    settled_speed: float = 1.0e-5
    quiet: float = 1.0e-6
    pressure_error: float = 0.01
    patience: float = 2.0e5

    def __post_init__(self) -> None:
        if self.grains < FEWEST:
            raise ValueError(f"grains must be at least {FEWEST} to jam between six walls, got {self.grains}")
        if self.seed < 0:
            raise ValueError(f"seed must be a whole number from 0, got {self.seed}")
        if not 0.0 < self.delta0 < 0.5:
            raise ValueError(f"delta0 must be in (0, 0.5), got {self.delta0}")
        if not 0.0 < self.filling < 0.6:
            raise ValueError(f"filling of the gas must be in (0, 0.6), got {self.filling}")
        if not 0.0 < self.dt <= 0.5:
            raise ValueError(f"dt must be in (0, 0.5] t_c, got {self.dt}")
        for name in ("cycles", "drag", "rest", "hold"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        for name in (
            "t0",
            "pressure",
            "gas_speed",
            "gas_time",
            "piston_speed",
            "piston_gain",
            "settled_speed",
            "quiet",
            "pressure_error",
            "patience",
        ):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


def lattice(grains: int, filling: float = 0.30) -> tuple[int, int, int]:
    """Sites (n, n, n_z) of a lattice of this filling that becomes about a cube when pressed (325 = 5 x 5 x 13)."""
    side = max(2, round((grains * filling / DENSE) ** (1.0 / 3.0)))
    return side, side, math.ceil(grains / side**2)


def _gas(recipe: Recipe, clump: Clump) -> tuple[np.ndarray, jax.Array, jax.Array, jax.Array, np.ndarray]:
    """Positions [N, 3], quaternions [N, 4], velocities and spins [N, 3], and box lengths [3] of the lattice."""
    spacing = _spacing(recipe, clump)
    sites = lattice(recipe.grains, recipe.filling)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in sites), indexing="ij"), axis=-1).reshape(-1, 3)
    cells = cells[np.argsort(cells[:, 2], kind="stable")][: recipe.grains]  # a last layer may be incomplete
    turn_key, velocity_key, spin_key = jax.random.split(chance.key(recipe.seed), 3)
    scale, shape = recipe.gas_speed / math.sqrt(3.0), (recipe.grains, 3)
    return (
        (cells + 0.5) * spacing,
        rotation.uniform(turn_key, recipe.grains),
        scale * jax.random.normal(velocity_key, shape),
        scale * jax.random.normal(spin_key, shape),
        np.asarray(sites) * spacing,
    )


def expected_time(recipe: Recipe, height: float) -> float:
    """How long a preparation will take about, in t_c; `height` is that of the gas, in R."""
    dense = height * recipe.filling / DENSE
    fall = (height - dense) / min(recipe.piston_speed, recipe.piston_gain)
    cycles = recipe.cycles * (2.0 + recipe.rest + recipe.hold) + recipe.rest
    return recipe.gas_time + fall + SETTLING * dense + cycles * recipe.t0


def grain_steps(recipe: Recipe, clump: Clump) -> float:
    """What a preparation will cost about: grains times steps."""
    height = lattice(recipe.grains, recipe.filling)[2] * _spacing(recipe, clump)
    return recipe.grains * expected_time(recipe, height) / recipe.dt


def _spacing(recipe: Recipe, clump: Clump) -> float:
    """Of the lattice's sites, in R."""
    side: float = (float(clump.mass) / recipe.filling) ** (1.0 / 3.0)
    return max(side, 1.02 * float(clump.diameter))


FILMED = ("gas", "press", "settle")  # stages after which a configuration is taken, if any are


def _cycles(recipe: Recipe) -> tuple[Stage, ...]:
    cycle = preparation_cycle(recipe.rest, recipe.hold)
    return tuple(
        replace(stage, name=f"cycle {n}: {stage.name}") for n in range(1, recipe.cycles + 1) for stage in cycle
    )


def film_of(recipe: Recipe, frames: int) -> Film:
    """What is to be taken of the cycles: of `frames` configurations those beside the lattice, `FILMED` and the pack.

    Raises:
        ValueError: for too many or too few.
    """
    always, stages = len(FILMED) + 2, _cycles(recipe)
    bins = sum(stage.bins for stage in stages)
    if frames and not always <= frames <= always + bins:
        raise ValueError(f"frames must be 0 for none, or {always} to {always + bins} for this recipe; got {frames}")
    if frames <= always:
        return Film()
    wanted = places(stages, frames - always + 1, CYCLE_CHUNK)
    wanted[stages[0].name].remove(0)  # where "settle" ended
    return Film(wanted)


class _Preparation:
    """One preparation on its way: a `Walker` with one replica and no friction, and the walls as they are now."""

    def __init__(
        self,
        recipe: Recipe,
        clump: Clump,
        material: Material,
        backend: str,
        frames: int,
        keep: Keep,
        progress: Progress,
    ) -> None:
        position, quaternion, velocity, spin, lengths = _gas(recipe, clump)
        self.recipe, self.keep, self.filmed, self.lengths = recipe, keep, frames > 0, lengths
        film = film_of(recipe, frames)
        self.box = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None])
        steps = max(1, math.ceil(recipe.t0 / (BINS * recipe.dt) * (1.0 - 1e-12)))
        self.dt = recipe.t0 / (BINS * steps)
        finder = pair_finder(
            clump, lengths, FREE_SKIN, capacity=FREE_CANDIDATES * recipe.grains, per_sphere=FREE_CONTACTS
        )
        at = jnp.asarray(position)[..., None]
        still = jnp.zeros_like(at)
        grains = Grains(at, quaternion[..., None], velocity[..., None], spin[..., None], still, still)
        system = System(clump, Frictionless(), finder(grains, clump, self.box), material)
        state = start(system, at, grains.quaternion, self.box)
        state = accelerate(system, replace(state, grains=grains), self.box)
        expected = expected_time(recipe, float(lengths[2])) / (self.dt * steps) * work_of_bin(1)
        self.march = native.marcher(native.name(backend, system.friction))
        course = Course(system, self._drive(), self.dt, recipe.drag, steps=steps, backend=backend)
        self.walker = Walker(course, state, finder=finder, progress=progress, total_work=expected, film=film)
        self.log: dict[str, Sample] = {}
        self.take("gas")

    def _drive(self) -> Drive:
        return Drive(self.box.lower, self.box.upper, self.recipe.delta0)

    def take(self, name: str) -> None:
        """Keep the configuration that there is now, at u = 0, if any are to be kept."""
        if self.filmed:
            self.walker.take(name, self.walker.state, np.asarray(self.box.lower), np.asarray(self.box.upper), 0.0)

    def press(self, name: str, servo: Servo, duration: float, drag: float) -> Pressed:
        """Run the servo until it has settled or `duration` is over; the list is made anew as often as needed."""
        kept, pressed = self.keep(name, lambda checkpoint: self._press(checkpoint, name, servo, duration, drag))
        self.walker.restore(kept)
        self.box = pressed.box
        self.take(name)
        return cast(Pressed, pressed)

    def _press(
        self, checkpoint: Checkpoint, name: str, servo: Servo, duration: float, drag: float
    ) -> tuple[Any, Pressed]:
        walker = self.walker
        block, per_bin = BLOCK * self.dt, BLOCK / walker.course.steps
        no = jnp.asarray(False)
        pressed = Pressed(walker.state, self.box, jnp.zeros(1), jnp.asarray(0), no, no)
        left = math.ceil(duration / block)
        if begun := checkpoint.begun():
            walker.restore(begun["walker"])
            pressed, left = begun["pressed"], int(begun["left"])

        def standing() -> dict[str, Any]:
            return {"walker": walker.kept(), "pressed": pressed, "left": np.asarray(left)}

        while left > 0:
            system = walker.course.system
            pressed = _press(system, pressed, servo, self.dt, drag, blocks=min(CALL, left), march=self.march)
            refuse(worst(pressed.state), name)
            walker.state, self.box = pressed.state, pressed.box
            done = int(pressed.blocks)
            left -= done
            walker.report(name, done * per_bin, float(done * block))
            if bool(pressed.settled):
                break
            if bool(pressed.crowded):
                walker.renew(self.box)
                pressed = replace(pressed, state=walker.state)
            checkpoint.reached(standing)
        return walker.kept(), pressed

    def compact(self) -> float:
        """Gas, then pressure: returns p_z once the pack is at rest under it and the wall is fixed."""
        recipe = self.recipe
        closed = Servo(recipe.pressure, 0.0, 0.0, 0.0, 0.0)
        self.press("gas", closed, recipe.gas_time, 0.0)
        height = float(self.box.lengths[2, 0])
        approach = Servo(recipe.pressure, recipe.piston_speed, recipe.piston_gain, 0.1, math.inf)
        self.press("press", approach, 4.0 * height / recipe.piston_speed, 0.0)
        settle = replace(approach, error=recipe.pressure_error, quiet=recipe.settled_speed)
        self.walker.finder = pair_finder(self.walker.course.system.clump, self.lengths, DENSE_SKIN)
        self.walker.renew(self.box)
        pressed = self.press("settle", settle, recipe.patience, recipe.drag)
        if not bool(pressed.settled):
            raise RunFailedError(
                f"settle: p_z = {float(pressed.pressure[0]):.3e} E and largest speed "
                f"{float(largest_speed(pressed.state)):.1e} R/t_c after {recipe.patience:g} t_c; allow more patience"
            )
        self.box = still_box(self.box.lower, self.box.upper)
        return float(pressed.pressure[0])

    def cycle(self) -> None:
        """Frictionless compress/decompress cycles of the x and y walls, then rest until quiet."""
        recipe, walker = self.recipe, self.walker
        walker.course = replace(walker.course, drive=self._drive())
        walker.finder, walker.skin, walker.chunk, walker.foresees = None, DENSE_SKIN, CYCLE_CHUNK, True
        walker.smallest = smallest_box(
            np.asarray(self.box.lower)[:, 0], np.asarray(self.box.upper)[:, 0], recipe.delta0
        )
        walker.renew(self.box)
        self.log |= walker.play_part("cycles", self.keep, *_cycles(recipe))
        rest = Stage("rest", 0.0, 0.0, max(recipe.rest, 0.1))
        last, kept = self.keep(rest.name, lambda checkpoint: self._until_quiet(checkpoint, rest))
        walker.restore(kept)
        self.log |= last
        self.take(rest.name)

    def _until_quiet(self, checkpoint: Checkpoint, rest: Stage) -> tuple[Any, Any]:
        """Rest as often as needed: the samples of the last time, and where the walker stands."""
        recipe, walker, waited = self.recipe, self.walker, 0.0
        if begun := checkpoint.begun():
            walker.restore(begun["walker"])
            waited = float(begun["waited"])

        def standing() -> dict[str, Any]:
            return {"walker": walker.kept(), "waited": np.asarray(waited)}

        while True:
            last = walker.play(rest)
            waited += rest.length * recipe.t0
            speed = float(largest_speed(walker.state))
            if speed <= recipe.quiet:
                return last, walker.kept()
            if waited > recipe.patience:
                raise RunFailedError(f"rest: largest speed {speed:.1e} R/t_c after {waited:g} t_c")
            checkpoint.reached(standing)


def prepare(
    recipe: Recipe | None = None,
    grain: Clump | None = None,
    *,
    material: Material | None = None,
    friction: FrictionLaw | None = None,
    name: str = "",
    backend: str = "auto",
    keep: Keep = forget,
    progress: Progress = silent,
    log: dict[str, Sample] | None = None,
    frames: int = 0,
    film: list[Frames] | None = None,
    **changes: Any,
) -> Pack:
    """Prepare a pack: gas, pressure, frictionless cycles, rest.

    Args:
        recipe: the numbers; default `Recipe()`.
        grain: the grain; default `tetra(0.6)`.
        material: the elastic solid.
        friction: law under which the ringing period of the finished pack is measured; default `Hooke()`.
        name: of the pack; default from grain, size and seed.
        backend: "auto", "jax" or "native".
        keep: asked for every part, so that a long preparation can be resumed (see `gmem_jax.files.parts`).
        progress: told about every chunk.
        log: filled with the samples of every cycle stage, if given.
        frames: configurations to keep: the lattice, the ends of gas, pressing and settling, the pack, and from six on
            some of the cycles (see `frames.places`). The pack stays as it is.
        film: where to put them.
        **changes: fields of the recipe that differ, for example ``prepare(grains=64, seed=3)``.

    Raises:
        ValueError: for impossible numbers, or if 64-bit mode is off.
        RunFailedError: if the simulation broke down or did not come to rest.
    """
    require_x64()
    recipe = replace(recipe or Recipe(), **changes)
    clump, material = grain or tetra(), material or Material()
    preparation = _Preparation(recipe, clump, material, backend, frames, keep, progress)
    preparation.compact()
    preparation.cycle()
    if log is not None:
        log.update(preparation.log)
    if film is not None and frames:
        centre = np.asarray(0.5 * (preparation.box.lower + preparation.box.upper))[:, 0]  # the origin of the pack
        film.append(joined(preparation.walker.taken, np.asarray(clump.offsets), centre=centre))
    return _finish(preparation, material, friction or Hooke(), name)


def _finish(preparation: _Preparation, material: Material, friction: FrictionLaw, name: str) -> Pack:
    """The pack at rest, with what was measured on it."""
    recipe, walker, box = preparation.recipe, preparation.walker, preparation.box
    grains, clump = walker.state.grains, walker.course.system.clump
    position, quaternion = np.asarray(grains.position)[..., 0], np.asarray(grains.quaternion)[..., 0]
    centre = np.asarray(0.5 * (box.lower + box.upper))
    box = still_box(box.lower - centre, box.upper - centre)
    position = position - centre[:, 0]
    pairs = find_pairs(clump, position, quaternion, box, recipe.delta0)
    system = System(clump, friction, pairs, material)
    backend = "jax" if walker.course.backend == "jax" else "auto"  # the experiment's law may be one of the user's own
    at_rest = jnp.asarray(position)[..., None], grains.quaternion, box
    period = ringing_period(system, *at_rest, preparation.dt, backend=backend)
    last = jax.tree.map(lambda leaf: leaf[-1, ..., 0].tolist(), preparation.log["rest"])
    record = {
        "recipe": asdict(recipe),
        "grain": clump.shape,
        "material": asdict(material),
        "rebuilds": walker.rebuilds,
        "simulated_time": walker.time,
        "at_rest": asdict(last),
        **provenance(),
        "backend": native.name(walker.course.backend, Frictionless()),
    }
    return Pack(
        clump=clump,
        position=jnp.asarray(position),
        quaternion=jnp.asarray(quaternion),
        lower=box.lower[:, 0],
        upper=box.upper[:, 0],
        delta0=jnp.asarray(recipe.delta0),
        ringing_period=jnp.asarray(period),
        pairs=pairs,
        name=name or f"{clump.shape}-{recipe.grains}-seed{recipe.seed}",
        record=json.dumps(record),
    )
