"""Several experiments on one pack as one run, if they differ only in what may differ between replicas.

The shear-free prefix is run once for each set of the parameters that act on it. The other stages are run once for each
signal of each experiment and for its zero signal. The numbers are those of the experiments run one by one.
"""

import dataclasses
import time
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.changes import replace, value_at
from gmem_jax.experiment.experiment import NOT_OF_PAPER, Experiment, acts_on_prefix, replica_parameters
from gmem_jax.experiment.identity import identity
from gmem_jax.experiment.pack_warnings import warn_of_another_preparation
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.record import describe
from gmem_jax.experiment.run import PREFIX, finished, runner_of
from gmem_jax.experiment.signals import ChosenSignals, Signals, SignalSets, bin_average
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.checkpoints import Checkpoint, ResultCache, no_cache
from gmem_jax.simulation.progress import Progress, silent, work_of
from gmem_jax.simulation.sharding import placement_of


def match(one: Experiment, other: Experiment) -> bool:
    """Whether two experiments may run side by side: the same pack, material, protocol, law, steps and arithmetic.

    The pack must be the same object. Parameters that differ must be one number in each experiment. mu = 0 matches only
    mu = 0: replicas without friction drift apart, and all replicas would share their longer neighbour lists (a run of
    six mu with 0 among them takes twice the time).
    """
    alike = ("protocol", "steps_per_bin", "background", "backend", "precision", "material")
    laws = [identity(_alike(each)) for each in (one, other)]
    scalars = all(jnp.ndim(value) == 0 for each in (one, other) for value in replica_parameters(each).values())
    slips = [float(np.min(getattr(each.friction, "mu", 1.0))) == 0.0 for each in (one, other)]
    same = slips[0] == slips[1] and all(getattr(one, name) == getattr(other, name) for name in alike)
    kinds = [[getattr(each, name) is None for name in NOT_OF_PAPER] for each in (one, other)]
    same = same and kinds[0] == kinds[1]
    alone = not any(isinstance(each.signals, SignalSets) or each.observe for each in (one, other))
    return alone and scalars and same and one.pack is other.pack and laws[0] == laws[1]


def _alike(experiment: Experiment) -> Any:
    """The law without the numbers that may differ between replicas. A user's law may hold others, which must agree."""
    own = replica_parameters(experiment)

    def kept(path: tuple[Any, ...], leaf: Any) -> Any:
        return None if len(path) == 1 and f"friction.{getattr(path[0], 'name', '')}" in own else leaf

    return jax.tree_util.tree_map_with_path(kept, experiment.friction)


class _Side:
    """The replicas of several experiments in one run.

    Attributes:
        prefix: number of each experiment's replica in the prefix, [experiments].
        first: number of each experiment's zero signal after the prefix, and the number of all replicas,
            [experiments + 1].
    """

    def __init__(self, experiments: Sequence[Experiment]) -> None:
        self.experiments = experiments
        # The names of all experiments: a parameter that is None in one may be a number in another.
        self.names = list(dict.fromkeys(name for each in experiments for name in replica_parameters(each)))
        values = [tuple(float(value_at(each, name)) for name in self.names) for each in experiments]
        acting = [acts_on_prefix(name) for name in self.names]
        own = [tuple(value for value, acts in zip(row, acting, strict=True) if acts) for row in values]
        kinds = list(dict.fromkeys(own))
        self.prefix = np.asarray([kinds.index(row) for row in own])
        self.first = np.cumsum([0, *(each.replicas for each in experiments)])
        self.values = np.asarray(values).T

    def wide(self, owners: np.ndarray, signals: Signals) -> Experiment:
        """One experiment of which each replica has the parameters of its owner; owners are numbers, [replicas]."""
        own = dict(zip(self.names, self.values[:, owners], strict=True))
        changes = {name: row if np.any(row != row[0]) else float(row[0]) for name, row in own.items()}
        changes = {name: jnp.asarray(row) if isinstance(row, np.ndarray) else row for name, row in changes.items()}
        first = self.experiments[0]
        return replace(first, {**changes, "signals": signals, "steps": first.steps_per_bin})

    def signals(self) -> ChosenSignals:
        """The waveforms of all experiments, each set after its zero signal; the first zero signal is replica 0."""
        sets: list[Signals] = []
        begun: dict[int, int] = {}
        numbers: list[int] = []
        for each in self.experiments:
            if id(each.signals) not in begun:
                begun[id(each.signals)] = 1 + sum(one.count for one in sets)
                sets.append(each.waveforms)
            numbers += [0, *(begun[id(each.signals)] + np.arange(each.signals.count)).tolist()]
        return ChosenSignals(tuple(sets), jnp.asarray(numbers[1:]))


@usual_rules()
def run_several(
    experiments: Sequence[Experiment], *, cache: ResultCache = no_cache, progress: Progress = silent
) -> list[Recall]:
    """Run experiments side by side, as replicas of one run; the recall of each.

    Args:
        experiments: experiments that `match` each other.
        cache: keeps the finished parts of a long run, so that it can be resumed (see `gmem_jax.files.checkpoints`).
        progress: called after every chunk, as in `run`.

    Raises:
        ValueError: if they do not match, there is none, or 64-bit mode is off.
        RunFailedError: if the simulation of any of them broke down; then all are lost.
    """
    if not experiments or not all(match(experiments[0], each) for each in experiments):
        raise ValueError("experiments side by side must differ only in what may differ between replicas")
    began, side = time.perf_counter(), _Side(experiments)
    common, own = experiments[0].phases
    for each in experiments:
        warn_of_another_preparation(each)
    one_each = np.unique(side.prefix, return_index=True)[1]
    owners = np.repeat(np.arange(len(experiments)), np.diff(side.first))
    sets = side.signals().sets
    loud = 1 + int(np.argmax(np.any(np.asarray(bin_average(sets[0])), axis=1)))  # the prefix applies none of them
    silence = ChosenSignals(sets, jnp.full(max(1, len(one_each) - 1), loud))
    everything = side.wide(owners, side.signals())
    on = runner_of(side.wide(one_each, silence), progress=progress)
    on.total_work = work_of(common, on.state.replicas) + work_of(own, len(owners))

    def rest(checkpoint: Checkpoint) -> Any:
        # One replica if nothing that acts on the prefix differs.
        place = side.prefix[owners] if on.state.replicas > 1 else np.zeros(len(owners), int)
        pairs = on.simulation.system.pairs
        if pairs.reference.shape[-1] > 1:
            pairs = dataclasses.replace(pairs, reference=jnp.asarray(pairs.reference)[..., place])
        on.simulation = everything.simulation(sheared=True).with_pairs(pairs)
        on.state = jax.tree.map(lambda leaf: jnp.asarray(leaf)[..., place], on.state)
        on.place_on(placement_of(len(owners)))
        samples = on.run_stages(*own, checkpoint=checkpoint)
        return samples, on.gather(on.state.status)

    before = on.run_cached(PREFIX, cache, *common)
    on = on.fork()
    after, status = cache("after", rest)
    found = []
    for number, each in enumerate(experiments):
        begun, ended = side.first[number : number + 2]
        wide = any(np.shape(sample.pressure)[-1] > 1 for sample in before.values())
        alone = int(side.prefix[number]) if wide else 0
        samples = OrderedDict(
            [(name, jax.tree.map(lambda leaf, at=alone: leaf[..., at : at + 1], before[name])) for name in before]
            + [(name, jax.tree.map(lambda leaf, a=begun, b=ended: leaf[..., a:b], after[name])) for name in after]
        )
        recall: Recall = finished(each, samples, jnp.asarray(status)[begun:ended])
        found.append(recall.described(describe(each, (time.perf_counter() - began) / len(experiments))))
    return found
