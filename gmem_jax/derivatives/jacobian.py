"""The Jacobian of the recall of one signal: exact, with one replica for every parameter, and by central differences.

The parameters are the amplitudes a_k of the signal, gamma0, and the friction law's mu and stiffness.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.derivatives.push import push
from gmem_jax.experiment.arguments import require_kind
from gmem_jax.experiment.asked import require_host
from gmem_jax.experiment.changes import replace, value_at
from gmem_jax.experiment.experiment import Experiment, require_one_value
from gmem_jax.experiment.recall import Recall
from gmem_jax.experiment.run import run
from gmem_jax.experiment.signals import Bumps
from gmem_jax.physics.pytree import comparable, short_repr
from gmem_jax.physics.rules import usual_rules
from gmem_jax.simulation.channels import CHANNELS
from gmem_jax.simulation.progress import ProgressChoice, callback, shows_progress, within

LAW = {"mu": "friction.mu", "stiffness": "friction.stiffness"}  # they act on the prefix and the zero signal
SHARE = 0.7  # fraction of the time that the derivatives with respect to amplitudes and gamma0 take


@comparable
@dataclass(frozen=True)
class Jacobian:
    """Derivatives of one recalled signal with respect to n + 3 parameters.

    Attributes:
        names: names of the parameters: "amplitude 1", ..., "amplitude n", "gamma0", "mu", "stiffness".
        values: values of the parameters, [n + 3].
        p_sig: derivative of p_sig with respect to each parameter, [n + 3, 256], in E per unit of the parameter.
        stress: derivative of the stress of the channel (p_x - p_y on "xy") in the sheared replica, in every bin from
            the first stage that writes to the end of the first that reads, [n + 3, bins].
    """

    names: tuple[str, ...]
    values: np.ndarray
    p_sig: np.ndarray
    stress: np.ndarray

    __repr__ = short_repr


def _copies(bumps: Bumps, amplitudes: Any) -> Bumps:
    """The bumps of one signal, repeated with rows of amplitudes [R, n]."""
    return Bumps(amplitudes, jnp.broadcast_to(bumps.centres, jnp.shape(amplitudes)), jnp.reshape(bumps.width, ()))


def _one_signal(experiment: Experiment) -> tuple[Bumps, np.ndarray]:
    bumps = experiment.signals
    if not isinstance(bumps, Bumps) or bumps.count != 1:
        raise ValueError("a Jacobian is taken of one signal made of bumps")
    if experiment.background != "sub0":
        raise ValueError(f"a Jacobian is taken with the background sub0, got {experiment.background}")
    if len(experiment.readings.reads) * len(experiment.readings.channels) > 1:
        raise ValueError("a Jacobian is taken of one read and one channel")
    require_one_value("a Jacobian is taken", experiment)
    law = type(experiment.friction).__name__
    for name, path in LAW.items():
        value = getattr(experiment.friction, path.removeprefix("friction."), None)
        if not isinstance(value, float | jax.Array):
            raise ValueError(f"a Jacobian needs a friction law with the numbers mu and stiffness; {law} has no {name}")
    return bumps, np.asarray(bumps.amplitudes)


def _parameters(experiment: Experiment, row: np.ndarray) -> dict[str, float]:
    """The parameters by name, in the order of the derivatives; `row` has the amplitudes, [1, n]."""
    laws = {name: float(value_at(experiment, path)) for name, path in LAW.items()}
    return {**{f"amplitude {k + 1}": a for k, a in enumerate(row[0])}, "gamma0": float(experiment.gamma0), **laws}


def _stress(experiment: Experiment, pressure: dict[str, np.ndarray]) -> np.ndarray:
    """The stress of the channel from the first stage that writes to the first that reads, [replicas, bins]."""
    (channel,) = experiment.readings.channels
    joined = np.concatenate([pressure[name] for name in experiment.protocol.first_memory])
    return np.asarray(CHANNELS[channel].stress(jnp.asarray(joined))).T


def _recalled(experiment: Experiment, pressure: dict[str, np.ndarray]) -> np.ndarray:
    """p_sig of the second half of the replicas, [half, 256]; the first half are their zero signals."""
    half = next(iter(pressure.values())).shape[-1] // 2
    pairs = ({name: jnp.asarray(p[..., [k, half + k]]) for name, p in pressure.items()} for k in range(half))
    return np.concatenate([experiment.recalled(pair) for pair in pairs])


def _pressures(recall: Recall) -> dict[str, np.ndarray]:
    return {name: np.asarray(sample.pressure) for name, sample in recall.stages.items()}


@usual_rules()
@shows_progress
def exact(experiment: Experiment, *, progress: ProgressChoice = None) -> Jacobian:
    """The derivatives of the recall of one signal with respect to its amplitudes, gamma0, mu and the stiffness.

    It is computed in forward mode, with one replica for each parameter, in two runs: mu and the stiffness act on the
    prefix too.

    Args:
        experiment: an experiment with one signal of n bumps, not traced.
        progress: see `run`.

    Returns:
        `names` and `values` of the n + 3 parameters; the derivatives of `p_sig`, [n + 3, 256], and of the `stress` of
        the channel (p_x - p_y on "xy") in every bin from the first stage that writes to the end of the first that
        reads, [n + 3, bins].

    Raises:
        ValueError: if there is more than one signal, it is not made of bumps, the background is not sub0, there are
            several reads or channels, a parameter has a value for each replica, mu or the stiffness is no number of the
            law, the precision is mixed, or in a call inside a traced function.
        RunFailedError: if the simulation broke down.
    """
    require_kind("jacobian", experiment, Experiment)
    require_host("gm.jacobian", experiment)
    tell = callback(progress)
    bumps, row = _one_signal(experiment)
    n = row.shape[1]
    rows = np.repeat(row, n + 1, axis=0)
    drive = replace(experiment, signals=_copies(bumps, jnp.asarray(rows)), gamma0=jnp.full(n + 2, experiment.gamma0))
    direction = {
        "signals.amplitudes": jnp.asarray(np.eye(n + 1, n)),
        "gamma0": jnp.zeros(n + 2).at[-1].set(1.0),
    }
    pushed = push(drive, direction, progress=within(tell, 0.0, SHARE))
    p_sig, stress = [np.asarray(pushed.p_sig_slope)], [_stress(experiment, pushed.slope)[1:]]
    two = jnp.asarray(np.concatenate([np.zeros_like(row), row, row]))  # 0, 1: no signal; 2, 3: the signal
    wide = {path: jnp.full(4, value_at(experiment, path)) for path in LAW.values()}
    laws = replace(experiment, {**wide, "signals": _copies(bumps, two)})
    direction = {
        "friction.mu": jnp.asarray([1.0, 0.0, 1.0, 0.0]),
        "friction.stiffness": jnp.asarray([0.0, 1.0, 0.0, 1.0]),
    }
    pushed = push(laws, direction, progress=within(tell, SHARE, 1.0))
    p_sig.append(_recalled(experiment, pushed.slope))
    stress.append(_stress(experiment, pushed.slope)[2:])
    known = _parameters(experiment, row)
    return Jacobian(tuple(known), np.asarray([*known.values()]), np.concatenate(p_sig), np.concatenate(stress))


def differences(experiment: Experiment, relative: float) -> Jacobian:
    """Central differences with steps of `relative` times each parameter (amplitudes: times 1), as replicas.

    Raises:
        ValueError: if there is not exactly one signal, it is not made of bumps, the background is not sub0, or there
            are several reads or channels.
        RunFailedError: if the simulation broke down.
    """
    bumps, row = _one_signal(experiment)
    n = row.shape[1]
    steps = relative * np.vstack([np.eye(n), -np.eye(n), np.zeros((2, n))])
    gamma0 = np.full(2 * n + 3, float(experiment.gamma0))
    gamma0[-2:] *= [1.0 + relative, 1.0 - relative]
    drive = replace(experiment, signals=_copies(bumps, jnp.asarray(row + steps)), gamma0=jnp.asarray(gamma0))
    found = run(drive, progress=False)
    recalled, stress = np.asarray(found.p_sig), _stress(experiment, _pressures(found))[1:]
    widths = np.full((n + 1, 1), 2.0 * relative)
    widths[n] *= float(experiment.gamma0)
    up, down = [*range(n), 2 * n], [*range(n, 2 * n), 2 * n + 1]
    slopes = [(recalled[up] - recalled[down]) / widths], [(stress[up] - stress[down]) / widths]
    known = _parameters(experiment, row)
    factor = {"mu": [1.0, -1.0, 0.0, 0.0], "stiffness": [0.0, 0.0, 1.0, -1.0]}
    shifted = {
        path: jnp.asarray(known[name] * (1.0 + relative * np.tile(factor[name], 2))) for name, path in LAW.items()
    }
    rows = jnp.asarray(np.concatenate([np.zeros((3, n)), np.repeat(row, 4, axis=0)]))
    other = replace(experiment, {**shifted, "signals": _copies(bumps, rows)})
    pressure = _pressures(run(other, progress=False))
    signal = _recalled(experiment, pressure)
    stress = _stress(experiment, pressure)[4:]
    widths = 2.0 * relative * np.asarray([known[name] for name in LAW])[:, None]
    slopes[0].append((signal[[0, 2]] - signal[[1, 3]]) / widths)
    slopes[1].append((stress[[0, 2]] - stress[[1, 3]]) / widths)
    return Jacobian(tuple(known), np.asarray([*known.values()]), np.concatenate(slopes[0]), np.concatenate(slopes[1]))


def mismatch(one: Jacobian, other: Jacobian) -> dict[str, float]:
    """|one - other| / |other| for every group of parameters, and for all together, each at its own scale."""
    scale = np.abs(np.where(other.values == 0.0, 1.0, other.values))[:, None]
    scale[: sum(name.startswith("amplitude") for name in other.names)] = 1.0
    rows: dict[str, Sequence[int]] = {
        "amplitudes": [k for k, name in enumerate(other.names) if name.startswith("amplitude")],
        **{name: [k] for k, name in enumerate(other.names) if not name.startswith("amplitude")},
        "all": range(len(other.names)),
    }
    return {
        group: float(
            np.linalg.norm((scale * (one.p_sig - other.p_sig))[list(chosen)])
            / np.linalg.norm((scale * other.p_sig)[list(chosen)])
        )
        for group, chosen in rows.items()
    }
