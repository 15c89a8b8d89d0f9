"""How far a run is: what is told to whoever waits for it, and in which unit."""

from collections.abc import Callable, Iterable

from gmem_jax.simulation.protocol import Stage

Progress = Callable[[str, float, float], None]
"""Called with the stage's name, the simulated time so far (t_c) and the fraction of the whole work done (0 to 1)."""

STEP = 1.0  # work of a step beside its replicas', in theirs: 0.9 at 10,240 grains, 1.4 at 3,267 and 2 at 325


def silent(stage: str, time: float, fraction: float) -> None:
    """Report nothing."""


def within(progress: Progress, begun: float, ended: float) -> Progress:
    """`progress` for a part of the work, from one fraction to another."""
    return lambda stage, time, fraction: progress(stage, time, begun + (ended - begun) * fraction)


def work_of_bin(replicas: int) -> float:
    """What a bin costs, in replica-bins: it takes as long as `STEP` replicas more than there are."""
    return replicas + STEP


def work_of(stages: Iterable[Stage], replicas: int) -> float:
    """What some stages cost, in replica-bins."""
    return sum(stage.bins for stage in stages) * work_of_bin(replicas)
