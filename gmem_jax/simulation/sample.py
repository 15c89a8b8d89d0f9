"""Samples: the quantities that are recorded of every bin; and the checks at its end."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gmem_jax.physics.census import Census, TakeCensus, take_census
from gmem_jax.physics.contact.friction import largest_overlap
from gmem_jax.physics.contact.wall import wall_kinematics
from gmem_jax.physics.forces import sphere_table
from gmem_jax.physics.pairs import slack_of
from gmem_jax.physics.pytree import Scalar, pytree, short_repr
from gmem_jax.physics.rotation import matrix
from gmem_jax.physics.state import Box, State, Status
from gmem_jax.physics.system import System
from gmem_jax.simulation.stage import BINS


class Measured(NamedTuple):
    """The description of a field of a `Sample`, for files, pictures, pages and docs/files.md.

    Attributes:
        unit: unit of the values.
        description: the quantity in words.
        dimensions: names of the axes of the values in one bin.
        plot: name of the picture of it; "" for none.
        label: label of its axis in pictures.
        log: whether the axis is logarithmic.
        symbol: symbol of one component, for vectors.
    """

    unit: str
    description: str
    dimensions: tuple[str, ...] = ("replica",)
    plot: str = ""
    label: str = ""
    log: bool = False
    symbol: str = ""


def measured(unit: str, description: str, *more: Any, **named: Any) -> Any:
    """A field of a `Sample`; the arguments are those of `Measured`."""
    return field(metadata={"measured": Measured(unit, description, *more, **named)})


_VECTOR = ("axis", "replica")


@pytree
@dataclass(frozen=True)
class Sample:
    """The quantities that are recorded of one bin: arrays [B], or [3, B] for x, y and z.

    In `Recall.stages` they have a leading axis of bins. docs/files.md lists the fields with their units. `observed` is
    a dictionary of the values of the observers by name, arrays [..., B]; None without observers.
    """

    u: jax.Array = measured("1", "compression variable at the end of the bin", ())
    pressure: jax.Array = measured(
        "E",
        "p_x, p_y, p_z of the walls, or by the virial, averaged over the steps of the bin",
        _VECTOR,
        plot="pressure",
        label="pressure",
        symbol="p",
    )
    lengths: jax.Array = measured(
        "R", "edges of the box at the end of the bin", _VECTOR, plot="box", label="edge of the box", symbol="L"
    )
    kinetic_energy: jax.Array = measured(
        "E R^3",
        "translation and rotation, at the end of the bin",
        plot="energy",
        label="kinetic energy",
        log=True,
    )
    largest_speed: jax.Array = measured(
        "R/t_c", "of a grain, at the end of the bin", plot="speed", label="largest speed of a grain", log=True
    )
    coordination: jax.Array = measured(
        "1",
        "Z, touching grain pairs per grain times two, rattlers included, walls not",
        plot="Z",
        label="coordination Z",
    )
    contacts: jax.Array = measured(
        "1",
        "touching sphere pairs per grain times two",
        plot="contacts",
        label="touching spheres per grain, times two",
    )
    wall_contacts: jax.Array = measured(
        "1",
        "spheres touching a wall per grain, once for each wall; NaN if not counted",
        plot="wall_contacts",
        label="spheres at walls per grain",
    )
    filling: jax.Array = measured(
        "1", "phi, volume of the grains over that of the box", plot="phi", label=r"filling $\phi$"
    )
    largest_overlap: jax.Array = measured(
        "R", "deepest sphere-sphere contact at the end of the bin", plot="overlap", label="largest overlap"
    )
    inertial_number: jax.Array = measured(
        "1",
        "I = strain rate of x times sqrt(m / (D p)), p = (p_x + p_y) / 2; 0 without pressure",
        plot="inertial",
        label="inertial number I",
        log=True,
    )
    observed: dict[str, Any] | None = None

    __repr__ = short_repr

    @property
    def contacts_per_grain(self) -> jax.Array:
        """Number of contacts per grain, each counted once, those with walls included, [B].

        Compare it with the paper's "average number of contacts on a grain": in a compression it grows as much as that,
        and `coordination` half as much (docs/physics.md).
        """
        return 0.5 * self.contacts + self.wall_contacts


MEASURED: dict[str, Measured] = {
    entry.name: entry.metadata["measured"] for entry in fields(Sample) if "measured" in entry.metadata
}
"""The descriptions of the fields of a `Sample`, by name."""


def ends_of_bins(stages: Mapping[str, Sample], begins: Mapping[str, int] | None = None) -> dict[str, np.ndarray]:
    """The end of every bin of stages, by name, in t0 since the run began.

    Args:
        stages: samples by stage, in order.
        begins: number of bins before each stage, since some may not be recorded; by default the stages follow each
            other from the beginning.
    """
    counts = [len(sample.filling) for sample in stages.values()]
    firsts = itertools.accumulate(counts, initial=0) if begins is None else map(begins.__getitem__, stages)
    return {
        name: (first + np.arange(1, count + 1)) / BINS
        for name, count, first in zip(stages, counts, firsts, strict=False)
    }


def check(system: System, state: State, box: Box, census: Census) -> State:
    """Set the status bits for what a census shows: stale list, escaped grain, non-finite number."""
    radii = system.clump.sphere_radii(system.pairs.incidence.shape[0])
    bits = (
        jnp.where(slack_of(system.pairs, census.deviation, box, radii) <= 0.0, int(Status.STALE_PAIRS), 0)
        | jnp.where(census.outside > 0.0, int(Status.OUTSIDE_BOX), 0)
        | jnp.where(census.finite > 0.0, 0, int(Status.NOT_FINITE))
    ).astype(jnp.int32)
    return replace(state, status=state.status | bits)


def measure(system: System, state: State, box: Box, pressure: jax.Array, u: Scalar, census: Census) -> Sample:
    """The `Sample` of a state with a given census, bin-averaged pressure [3, B] and u."""
    grains, clump = state.grains, system.clump
    count = grains.position.shape[0]
    body_spin = jnp.sum(matrix(grains.quaternion) * grains.spin[:, :, None], axis=1)
    inertia = clump.scaled(clump.inertia[:, None], 5)
    energy = jnp.sum(inertia * body_spin**2, axis=1, keepdims=True)
    energy = clump.masses * jnp.sum(grains.velocity**2, axis=1, keepdims=True) + energy
    lengths = jnp.broadcast_to(box.lengths, pressure.shape)
    rate = jnp.abs(box.upper_velocity[0] - box.lower_velocity[0]) / lengths[0]
    squeezing = 0.5 * (pressure[0] + pressure[1])
    loaded = squeezing > 0.0
    inertial = rate * jnp.sqrt(clump.mass / (clump.diameter * jnp.where(loaded, squeezing, 1.0)))
    return Sample(
        u=jnp.broadcast_to(u, pressure.shape[1:]),
        pressure=pressure,
        lengths=lengths,
        kinetic_energy=0.5 * jnp.sum(energy, axis=(0, 1)),
        largest_speed=census.largest_speed,
        coordination=2.0 * census.grain_contacts / count,
        contacts=2.0 * census.sphere_contacts / count,
        wall_contacts=census.wall_contacts / count,
        filling=clump.volume(count) / jnp.prod(lengths, axis=0),
        largest_overlap=census.largest_overlap,
        inertial_number=jnp.where(loaded, inertial, 0.0),
    )


def _deepest_at_walls(system: System, state: State, box: Box) -> jax.Array:
    """The largest overlap of a sphere with a wall, [B], in R."""
    table, _ = sphere_table(system.clump, lax.stop_gradient(state.grains))
    radii = system.clump.sphere_radii(len(table))
    kin = wall_kinematics(table, box, system.material, jnp.zeros(()), radii)
    return jnp.max(jnp.where(kin.touching, kin.overlap, 0.0), axis=(0, 1))


def end_bin(
    system: System, state: State, box: Box, pressure: jax.Array, u: Scalar, counted: TakeCensus = take_census
) -> tuple[State, Sample]:
    """Check the state at the end of a bin and take its sample.

    Args:
        system: the system.
        state: the state at the end of the bin.
        box: the walls at the end of the bin.
        pressure: pressure on the walls, averaged over the bin, [3, B].
        u: compression variable.
        counted: the function that takes the census.
    """
    census = counted(system, state, box)
    state = check(system, state, box, census)
    sample = measure(system, state, box, pressure, u, census)
    deepest = sample.largest_overlap
    if system.wall_mu is not None:
        deepest = jnp.maximum(deepest, _deepest_at_walls(system, state, box))
    beyond = deepest > largest_overlap(system.friction)
    bits = jnp.where(beyond, int(Status.OVERLAP_RANGE), 0).astype(jnp.int32)
    return replace(state, status=state.status | bits), sample
