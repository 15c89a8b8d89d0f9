"""Preparation of a pack without friction: gas, pressure, compression cycles, rest (paper, Sec. II)."""

import json
import math
from dataclasses import asdict, fields, is_dataclass, replace
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.errors import NotAtRestError, RunFailedError, warn_caller
from gmem_jax.experiment.arguments import require_friction, require_kind
from gmem_jax.experiment.asked import require_walls
from gmem_jax.experiment.pack import Pack, find_pairs
from gmem_jax.experiment.provenance import provenance
from gmem_jax.native.backend import backend_name
from gmem_jax.physics import chance, rotation
from gmem_jax.physics.boundary import periodic_axes
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.frictionless import Frictionless
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.grain import Clump, tetra
from gmem_jax.physics.material import Material
from gmem_jax.physics.numbers import require_whole, said
from gmem_jax.physics.rules import usual_rules
from gmem_jax.physics.state import Grains, still_box
from gmem_jax.physics.step import accelerate, start
from gmem_jax.physics.system import System
from gmem_jax.preparation.piston import STEPS_PER_CHECK, Pressed, Servo, largest_speed, press
from gmem_jax.preparation.recipe import (
    FREE_SKIN,
    SLOWEST_BINS,
    Recipe,
    bins_outside,
    cycles_of,
    graded,
    last_rest,
    pressure_over_wanted,
    sites_of,
    stepping,
)
from gmem_jax.preparation.ringing import ringing_period
from gmem_jax.simulation.checkpoints import Checkpoint, ResultCache, no_cache
from gmem_jax.simulation.compiled import Compiled, require_x64
from gmem_jax.simulation.frames import FrameRecorder, Frames, FrameSchedule, concatenate, places
from gmem_jax.simulation.loop import Simulation
from gmem_jax.simulation.neighbors import pair_finder
from gmem_jax.simulation.observers import Chunk
from gmem_jax.simulation.progress import Progress, ProgressChoice, callback, shows_progress, work_of, work_of_bin
from gmem_jax.simulation.runner import Runner, raise_if_fatal, status_of
from gmem_jax.simulation.sample import Sample
from gmem_jax.simulation.stage import Stage
from gmem_jax.simulation.strain import StrainPath, smallest_box

FREE_CANDIDATES = 68  # candidates of a grain in a pressed pack with `FREE_SKIN`: one program serves all lists
FREE_CONTACTS = 48  # candidates of a sphere, likewise
# Skin of a pressed pack: half of the candidates take half of the time. Frictionless grains turn freely, so that a list
# lasts only some 50 t_c of a cycle.
DENSE_SKIN = 0.5
CYCLE_CHUNK = 8  # bins per compiled call during the cycles
CALL = 128  # blocks per compiled call: the progress bar moves every few seconds at the largest sizes
MET = 0.8, 1.25  # p_z of the finished pack over the wanted one; shipped packs have 0.84 to 1.00

_press = Compiled(press, static_argnames=("backend",))


def _gas(recipe: Recipe, clump: Clump) -> tuple[np.ndarray, jax.Array, jax.Array, jax.Array, np.ndarray]:
    """Positions [N, 3], quaternions [N, 4], velocities and spins [N, 3], and box lengths [3] of the lattice."""
    sites, spacing = sites_of(recipe, clump)
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in sites), indexing="ij"), axis=-1).reshape(-1, 3)
    cells = cells[np.argsort(cells[:, 2], kind="stable")][: recipe.grains]  # a last layer may be incomplete
    turn_key, velocity_key, spin_key = jax.random.split(chance.key(recipe.seed), 3)
    scale, shape = recipe.gas_speed / math.sqrt(3.0), (recipe.grains, 3)
    velocity = scale * jax.random.normal(velocity_key, shape)
    drift = jnp.where(jnp.asarray(periodic_axes(recipe.boundary)), jnp.mean(velocity, axis=0), 0.0)
    return (
        (cells + 0.5) * spacing,
        rotation.uniform(turn_key, recipe.grains),
        velocity - drift,  # without walls nothing would stop a drift
        scale * jax.random.normal(spin_key, shape),
        np.asarray(sites) * spacing,
    )


FILMED = ("gas", "press", "settle")  # stages after which a configuration is recorded, if any are wanted


def preparation_frames(recipe: Recipe, frames: int) -> FrameSchedule:
    """The schedule of the configurations in the cycles: `frames` less the lattice, the ends of `FILMED` and the pack.

    Raises:
        ValueError: if `frames` is too many or too few.
    """
    always, stages = len(FILMED) + 2, cycles_of(recipe)
    bins = sum(stage.bins for stage in stages)
    if frames and not always <= frames <= always + bins:
        raise ValueError(f"frames must be 0 for none, or {always} to {always + bins} for this recipe; got {frames}")
    if frames <= always:
        return FrameSchedule()
    wanted = places(stages, frames - always + 1, CYCLE_CHUNK)
    wanted[stages[0].name].remove(0)  # the end of "settle", which is recorded anyway
    return FrameSchedule(wanted)


def _require_lighter(recipe: Recipe, clump: Clump, lengths: np.ndarray) -> None:
    """Refuse grains whose weight alone makes p_z as large as wanted: the piston would leave them and never settle."""
    alone = 0.5 * recipe.gravity * float(clump.volume(recipe.grains)) / float(lengths[0] * lengths[1])
    if alone >= recipe.pressure:
        raise ValueError(
            f"gravity = {recipe.gravity:g} makes p_z = {alone:.2g} E by the weight of the grains alone (the mean of "
            f"floor and lid), and {recipe.pressure:g} is wanted: ask for a larger pressure, or for less gravity"
        )


class _Preparation:
    """A running preparation: a `Runner` with one replica and no friction, and the present walls."""

    def __init__(
        self,
        recipe: Recipe,
        clump: Clump,
        material: Material,
        backend: str,
        frames: int,
        cache: ResultCache,
        progress: Progress,
    ) -> None:
        position, quaternion, velocity, spin, lengths = _gas(recipe, clump)
        _require_lighter(recipe, clump, lengths)
        self.recipe, self.cache, self.filmed, self.lengths = recipe, cache, frames > 0, lengths
        self.known = *cycles_of(recipe), last_rest(recipe)
        self.frames = FrameRecorder(preparation_frames(recipe, frames))
        self.periodic = periodic_axes(recipe.boundary)
        self.box = still_box(jnp.zeros((3, 1)), jnp.asarray(lengths)[:, None], self.periodic)
        steps, self.dt = stepping(max(recipe.t0, SLOWEST_BINS), recipe.dt)
        finder = pair_finder(
            clump, lengths, FREE_SKIN, capacity=FREE_CANDIDATES * recipe.grains, per_sphere=FREE_CONTACTS
        )
        at = jnp.asarray(position)[..., None]
        still = jnp.zeros_like(at)
        grains = Grains(at, quaternion[..., None], velocity[..., None], spin[..., None], still, still)
        system = System(clump, Frictionless(), finder(grains, clump, self.box), material, recipe.gravity or None)
        state = start(system, at, grains.quaternion, self.box)
        state = accelerate(system, replace(state, grains=grains), self.box)
        expected = bins_outside(recipe, clump) * work_of_bin(1) + work_of(cycles_of(recipe), 1)
        simulation = Simulation(system, self._path(), self.dt, recipe.drag, steps=steps, backend=backend)
        self.runner = Runner(
            simulation, state, finder=finder, progress=progress, total_work=expected, observers=(self.frames,)
        )
        self.log: dict[str, Sample] = {}
        self.record("gas")

    def _path(self) -> StrainPath:
        return StrainPath(self.box.lower, self.box.upper, self.recipe.delta0, periodic=self.periodic)

    def record(self, name: str) -> None:
        """Record the present configuration, at u = 0, if configurations are wanted."""
        if self.filmed:
            runner, still = self.runner, Stage(name, 0.0, 0.0, 0.0, "hold")
            now = Chunk(runner.simulation, runner.state, still, 0, 0, runner.time, runner.gather)
            self.frames.record(now, runner.state, np.asarray(self.box.lower), np.asarray(self.box.upper), 0.0)

    def press(self, name: str, servo: Servo, duration: float, drag: float) -> Pressed:
        """Run the servo until it has settled or `duration` is over; the list is made anew as often as needed."""
        kept, pressed = self.cache(name, lambda checkpoint: self._press(checkpoint, name, servo, duration, drag))
        self.runner.restore(kept)
        self.box = pressed.box
        self.record(name)
        return cast(Pressed, pressed)

    def _press(
        self, checkpoint: Checkpoint, name: str, servo: Servo, duration: float, drag: float
    ) -> tuple[Any, Pressed]:
        runner = self.runner
        block, per_bin = STEPS_PER_CHECK * self.dt, STEPS_PER_CHECK / runner.simulation.steps
        no = jnp.asarray(False)
        pressed = Pressed(runner.state, self.box, jnp.zeros(1), jnp.asarray(0), no, no)
        spent, allowed = 0, math.ceil(duration / block)
        if saved := checkpoint.restore():
            runner.restore(saved["runner"])
            pressed, spent = saved["pressed"], int(saved["spent"])

        def standing() -> dict[str, Any]:
            return {"runner": runner.snapshot(), "pressed": pressed, "spent": np.asarray(spent)}

        while spent < allowed:
            simulation, blocks = runner.simulation, min(CALL, allowed - spent)
            backend = simulation.resolved
            pressed = _press(simulation.system, pressed, servo, self.dt, drag, blocks=blocks, backend=backend)
            raise_if_fatal(status_of(pressed.state), name, runner.simulation)
            runner.state, self.box = pressed.state, pressed.box
            done = int(pressed.blocks)
            spent += done
            # The servo may take longer than was estimated; the work after it is known.
            least = runner.work + done * per_bin * work_of_bin(1) + work_of(self.known, 1)
            runner.total_work = max(runner.total_work, least)
            runner.report(name, done * per_bin, float(done * block))
            if bool(pressed.settled):
                break
            if bool(pressed.crowded):
                runner.renew(self.box)
                pressed = replace(pressed, state=runner.state)
            checkpoint.maybe_save(standing)
        if 0.0 < servo.quiet < math.inf and not bool(pressed.settled):  # a servo that is to bring the pack to rest
            checkpoint.save(standing)
            raise NotAtRestError(
                f"{name}: p_z = {float(pressed.pressure[0]):.3e} E and largest speed "
                f"{float(largest_speed(pressed.state)):.1e} R/t_c after {duration:g} t_c; more patience lets it go on"
            )
        return runner.snapshot(), pressed

    def compact(self) -> None:
        """Run the gas, press it until the pack is at rest under the pressure, and fix the wall."""
        recipe = self.recipe
        closed = Servo(recipe.pressure, 0.0, 0.0, 0.0, 0.0)
        self.press("gas", closed, recipe.gas_time, 0.0)
        height = float(self.box.lengths[2, 0])
        approach = Servo(recipe.pressure, recipe.piston_speed, recipe.piston_gain, 0.1, math.inf)
        slowest = min(recipe.piston_speed, recipe.piston_gain)
        self.press("press", approach, 4.0 * height / slowest, 0.0)
        settle = replace(approach, error=recipe.pressure_error, quiet=recipe.settled_speed)
        self.runner.finder = pair_finder(self.runner.simulation.system.clump, self.lengths, DENSE_SKIN)
        self.runner.renew(self.box)
        self.press("settle", settle, recipe.patience, recipe.drag)
        self.box = still_box(self.box.lower, self.box.upper, self.periodic)
        clump = self.runner.simulation.system.clump
        lengths, diameter = np.asarray(self.box.lengths)[:, 0], float(clump.diameter * clump.largest)
        if lengths.min() < diameter:
            raise RunFailedError(
                f"settle: the pack is {' x '.join(f'{edge:.1f}' for edge in lengths)} R, flatter than a grain "
                f"({diameter:.1f} R); take more grains or less pressure"
            )

    def cycle(self) -> None:
        """Run frictionless compress/decompress cycles of the x and y walls, then rest until the pack is quiet."""
        recipe, runner, outside = self.recipe, self.runner, self.runner.simulation
        steps, dt = stepping(recipe.t0, recipe.dt)
        runner.simulation = replace(outside, path=self._path(), steps=steps, dt=dt)
        runner.finder, runner.skin, runner.chunk, runner.foresees = None, DENSE_SKIN, CYCLE_CHUNK, True
        runner.smallest = smallest_box(
            np.asarray(self.box.lower)[:, 0], np.asarray(self.box.upper)[:, 0], recipe.delta0
        )
        runner.renew(self.box)
        # The time that the pack took to come to rest was an estimate; from here on the work that is left is known.
        runner.total_work = runner.work + work_of(self.known, 1)
        self.log |= runner.run_cached("cycles", self.cache, *cycles_of(recipe))
        runner.simulation = replace(runner.simulation, steps=outside.steps, dt=outside.dt)
        rest = last_rest(recipe)
        last, kept = self.cache(rest.name, lambda checkpoint: self._until_quiet(checkpoint, rest))
        runner.restore(kept)
        self.log |= last
        self.record(rest.name)

    def _until_quiet(self, checkpoint: Checkpoint, rest: Stage) -> tuple[Any, Any]:
        """Repeat the rest until the pack is quiet; return the samples of the last rest, and the runner's snapshot."""
        recipe, runner, waited = self.recipe, self.runner, 0.0
        if saved := checkpoint.restore():
            runner.restore(saved["runner"])
            waited = float(saved["waited"])

        def standing() -> dict[str, Any]:
            return {"runner": runner.snapshot(), "waited": np.asarray(waited)}

        while True:
            last = runner.run_stages(rest)
            waited += rest.bins * runner.simulation.steps * self.dt
            speed = float(largest_speed(runner.state))
            if speed <= recipe.quiet:
                return last, runner.snapshot()
            if waited > recipe.patience:
                checkpoint.save(standing)
                raise NotAtRestError(
                    f"rest: largest speed {speed:.1e} R/t_c after {waited:g} t_c; more patience lets it go on"
                )
            checkpoint.maybe_save(standing)


@usual_rules()
@shows_progress
def prepare(
    recipe: Recipe | None = None,
    grain: Clump | None = None,
    *,
    material: Material | None = None,
    friction: FrictionLaw | None = None,
    name: str = "",
    backend: str = "auto",
    cache: ResultCache = no_cache,
    progress: ProgressChoice = None,
    log: dict[str, Sample] | None = None,
    frames: int = 0,
    film: list[Frames] | None = None,
    **changes: Any,
) -> Pack:
    """Prepare a pack without friction: a gas is compressed to a pressure, cycled, and brought to rest (Sec. II).

    A `UserWarning` says if the cycles left p_z below 0.8 or above 1.25 times the pressure that was asked for.

    Args:
        recipe: the parameters of the preparation; default `Recipe()`.
        grain: the grain; default `tetra(0.6)`. `gm.sized` gives it sizes, one for each grain of the pack.
        material: the elastic solid; default `Material()`.
        friction: law under which the ringing period of the finished pack is measured; default `Hooke()`.
        name: name of the pack; default from grain, number of grains and seed.
        backend: "auto", "jax" or "native", as in `Experiment`.
        cache: see `run`.
        progress: see `run`.
        log: a dictionary that is filled with the `Sample` of every stage of the cycles, by name.
        frames: number of configurations to keep: the lattice, the ends of gas, pressing and settling, the pack, and
            from six on some of the cycles. The pack is the same with and without; 0 for none.
        film: a list to which they are appended, as one `Frames`; needed with `frames`.
        **changes: fields of the recipe that differ, for example ``prepare(grains=64, seed=3)``.

    Raises:
        ValueError: for impossible numbers, or if 64-bit mode is off.
        RunFailedError: if the simulation broke down, or pressed the pack flatter than a grain.
        NotAtRestError: if it did not come to rest; with the same `cache` and more `patience` it goes on.
    """
    tell = callback(progress)
    require_x64()
    require_kind("prepare", recipe or Recipe(), Recipe)
    grain, material, friction = grain or tetra(), material or Material(), Hooke() if friction is None else friction
    require_friction(friction)
    if not isinstance(grain, Clump):
        raise ValueError(f"grain must be a grain, as gm.tetra(0.6); got {said(grain)}")
    if not isinstance(material, Material):
        raise ValueError(f"material must be a gm.Material; got {said(material)}")
    if log is not None and not isinstance(log, dict):
        raise ValueError(f"log must be a dictionary to fill, got {said(log)}")
    if not isinstance(film, list | None) or (require_whole("frames", frames) and film is None):
        raise ValueError(f"frames go into film: give a list for them; got {said(film)}")
    if not isinstance(name, str) or not name.isprintable():
        raise ValueError(f"name must be a line of text, got {said(name)}")
    for entry, given in (
        (entry, getattr(one, entry.name)) for one in (material, friction) if is_dataclass(one) for entry in fields(one)
    ):
        if "interval" in entry.metadata and np.ndim(given):
            raise ValueError(f"{entry.name} of a pack must be one number, got {said(given)}")
    recipe = replace(recipe or Recipe(), **changes)
    clump = graded(recipe, grain)
    require_walls(periodic_axes(recipe.boundary), material)
    preparation = _Preparation(recipe, clump, material, backend, frames, cache, tell)
    preparation.compact()
    preparation.cycle()
    if log is not None:
        log.update(preparation.log)
    if film is not None and frames:
        centre = np.asarray(0.5 * (preparation.box.lower + preparation.box.upper))[:, 0]  # the origin of the pack
        film.append(concatenate(preparation.frames.recorded, clump, centre=centre, periodic=preparation.periodic))
    pack = _finish(preparation, material, friction, name)
    _warn_of_another_pressure(pack)
    return pack


def _warn_of_another_pressure(pack: Pack) -> None:
    met = pressure_over_wanted(pack.info)
    if met is not None and not MET[0] < met < MET[1]:
        recipe = pack.info["recipe"]
        warn_caller(
            f"{pack.name}: p_z is {met:.2g} times the wanted {recipe['pressure']:g} E: cycling by "
            f"delta0 = {recipe['delta0']:g} changed it after it was met; ask for another pressure, or for less delta0"
        )


def _finish(preparation: _Preparation, material: Material, friction: FrictionLaw, name: str) -> Pack:
    """The pack at rest, with its ringing period and its record."""
    recipe, runner, box = preparation.recipe, preparation.runner, preparation.box
    grains, clump = runner.state.grains, runner.simulation.system.clump
    position, quaternion = np.asarray(grains.position)[..., 0], np.asarray(grains.quaternion)[..., 0]
    centre = np.asarray(0.5 * (box.lower + box.upper))
    box = still_box(box.lower - centre, box.upper - centre, box.periodic)
    position = position - centre[:, 0]
    edges = np.asarray(box.lengths)[:, 0]
    position = position - np.where(box.periodic, edges * np.rint(position / edges), 0.0)
    pairs = find_pairs(clump, position, quaternion, box, recipe.delta0)
    system = System(clump, friction, pairs, material, recipe.gravity or None)
    backend = (
        "jax" if runner.simulation.backend == "jax" else "auto"
    )  # the experiment's law may be one of the user's own
    at_rest = jnp.asarray(position)[..., None], grains.quaternion, box
    period = ringing_period(system, *at_rest, preparation.dt, backend=backend)
    last = jax.tree.map(lambda leaf: leaf[-1, ..., 0].tolist(), preparation.log["rest"])
    record = {
        "recipe": asdict(recipe),
        "grain": clump.shape,
        "material": asdict(material),
        "rebuilds": runner.rebuilds,
        "simulated_time": runner.time,
        "at_rest": asdict(last),
        **provenance(),
        "backend": backend_name(runner.simulation.backend, Frictionless()),
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
        periodic=box.periodic,
        name=name or f"{clump.shape}-{recipe.grains}-seed{recipe.seed}",
        record=json.dumps(record),
    )
