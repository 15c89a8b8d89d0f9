"""Distribution of replicas over all devices that JAX sees, of one process or of several.

The replica axis is padded with copies of replica 0 up to a multiple of the number of devices. A step sends nothing
from one device to another.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from gmem_jax.physics.pytree import map_numbers
from gmem_jax.physics.state import State
from gmem_jax.simulation.loop import Simulation

AXIS = "replicas"


def to_host(array: Any) -> np.ndarray:
    """A numpy array on this host, of an array that may lie on several devices, or on those of other processes."""
    if isinstance(array, jax.Array) and not array.is_fully_addressable:
        array = multihost_utils.process_allgather(array, tiled=True)
    return np.asarray(array)


@dataclass(frozen=True)
class Placement:
    """The distribution of replicas over devices.

    Attributes:
        replicas: number of replicas B.
        mesh: the devices, on one axis.
    """

    replicas: int
    mesh: Mesh

    @property
    def padded(self) -> int:
        """B, rounded up to a multiple of the number of devices."""
        whole: int = -(-self.replicas // self.mesh.size) * self.mesh.size
        return whole

    def _put(self, leaf: Any, *axes: str | None) -> jax.Array:
        placed: jax.Array = jax.device_put(to_host(leaf), NamedSharding(self.mesh, PartitionSpec(*axes)))
        return placed

    def _put_last(self, leaf: Any) -> jax.Array:
        """An array [..., B], padded already or not, padded and split over the devices along its last axis."""
        leaf = to_host(leaf)[..., : self.replicas]
        more = np.repeat(leaf[..., :1], self.padded - leaf.shape[-1], axis=-1)
        wide = np.concatenate([leaf, more], axis=-1)
        return self._put(wide, *(None for _ in wide.shape[1:]), AXIS)

    def put_state(self, state: State) -> State:
        """A state of B replicas, padded and split over the devices."""
        placed: State = jax.tree.map(self._put_last, state)
        return placed

    def put_simulation(self, simulation: Simulation) -> Simulation:
        """A simulation on all devices: arrays in which replicas differ are split, the others are copied to each."""
        system = simulation.system
        reference = system.pairs.reference
        own = self._put_last(reference) if reference.shape[-1] > 1 else self._put(reference)
        numbers = {name: jax.tree.map(self._put_number, getattr(system, name)) for name in ("gravity", "wall_mu")}
        everywhere: Simulation = jax.tree.map(self._put, simulation)
        pairs = replace(everywhere.system.pairs, reference=own)
        mark = jax.tree.map(self._put_last, simulation.mark)
        friction = map_numbers(self._put_number, system.friction, deeper=self._put)
        placed = replace(everywhere.system, pairs=pairs, friction=friction, **numbers)
        return replace(everywhere, system=placed, mark=mark)

    def _put_number(self, leaf: Any) -> Any:
        """A number for all replicas, copied to each device; or one for each replica, [B], split over the devices."""
        return self._put_last(leaf) if np.shape(leaf) in ((self.replicas,), (self.padded,)) else self._put(leaf)

    def gather(self, tree: Any) -> Any:
        """Leaves [..., padded] as numpy arrays [..., B]."""
        return jax.tree.map(lambda leaf: to_host(leaf)[..., : self.replicas], tree)


def placement_of(replicas: int, devices: Sequence[jax.Device] | None = None) -> Placement | None:
    """The distribution of replicas over devices, default all devices; None if one device would hold all replicas."""
    found = list(jax.devices() if devices is None else devices)[:replicas]
    return Placement(replicas, Mesh(np.asarray(found), (AXIS,))) if len(found) > 1 and replicas > 1 else None
