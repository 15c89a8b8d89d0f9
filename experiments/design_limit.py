"""What limits a design: its slopes to both sides, and the effect of steps along them.

python experiments/design_limit.py tetra-325-c docs/results/designs/tetra-325-c.csv [--t0 5400] [--bumps 63]
    [--width 0.06]

Every bump of the signal with the largest miss is made a little larger and a little smaller, in two runs. The script
prints how much the slopes of both sides differ; how much of the miss lies along directions that the recall follows
well, badly and not at all; and the miss that corrections with less and less damping should leave and do leave. It takes
some 150 runs of a signal: four minutes of one core for 325 grains at t0 = 5,400.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from console import in_one_line

import gmem_jax as gm
from gmem_jax.design.kernel import bumps, nearest
from gmem_jax.design.waveforms import correction, sampled
from gmem_jax.files.waveforms import named_signals

STEP = 0.01  # in I
DAMPINGS = (0.05, 0.02, 0.01, 0.005, 0.002)  # in parts of the largest singular value
KINDS = ((1.0, 0.02), (0.02, 0.005), (0.005, 0.0))  # singular values, in parts of the largest


def main() -> None:
    """Measure the slopes and try the steps."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pack")
    parser.add_argument("waveforms", help="written by gmem design, for the six signals")
    parser.add_argument("--t0", type=float, default=5.4e3)
    parser.add_argument("--bumps", type=int, default=63)
    parser.add_argument("--width", type=float, default=0.06)
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    n, width = arguments.bumps, arguments.width
    experiment = gm.Experiment(gm.load_pack(arguments.pack), gm.six_signals(), t0=arguments.t0)

    def recalled(amplitudes: np.ndarray) -> np.ndarray:
        """Recalls of rows of amplitudes; their bumps are sampled as in a file of waveforms."""
        return np.asarray(gm.run(gm.replace(experiment, signals=sampled(bumps(amplitudes, width))), batch=64).p_sig)

    amplitudes = nearest(
        sampled(bumps(np.eye(n), width)), gm.replace(experiment, signals=named_signals(arguments.waveforms)).waveforms
    )
    found = recalled(amplitudes)
    match = experiment.compare(jnp.asarray(found))
    wanted = float(match.gain * experiment.scale) * np.asarray(experiment.integral())
    number = int(np.argmax(np.linalg.norm(wanted - found, axis=1)))
    own, here, target = amplitudes[number], found[number], wanted[number]
    missed, size = target - here, np.linalg.norm(target)
    print(f"F = {match.fidelity:.4f}; signal {number + 1} misses {np.linalg.norm(missed) / size:.4f} of its target")

    both = recalled(own + STEP * np.concatenate([np.eye(n), -np.eye(n)])) - here
    more, less = both[:n] / STEP, -both[n:] / STEP
    slope = 0.5 * (more + less)
    print(f"slopes of larger and smaller bumps differ by {np.linalg.norm(more - less) / np.linalg.norm(slope):.3f}")

    _, values, along = np.linalg.svd(slope, full_matrices=False)
    share, values = (along @ missed) ** 2 / np.sum(missed**2), values / values[0]
    for high, low in KINDS:
        part = share[(values <= high) & (values > low)].sum()
        print(
            f"{part:.3f} of the square of the miss along directions recalled with {low:g} to {high:g} of the strongest"
        )
    print(f"{1.0 - share.sum():.3f} of it beyond {n} bumps")

    steps = np.concatenate(
        [correction(slope[None], missed[None], np.full((1, 1), part * np.linalg.norm(slope, 2))) for part in DAMPINGS]
    )
    for part, step, p_sig in zip(DAMPINGS, steps, recalled(own + steps), strict=True):
        left = [np.linalg.norm(rest) / size for rest in (missed - step @ slope, target - p_sig)]
        print(
            f"damped by {part:g}: by up to {np.abs(step).max():.3f}, miss {left[0]:.4f} foreseen, {left[1]:.4f} found"
        )


if __name__ == "__main__":
    in_one_line(main)
