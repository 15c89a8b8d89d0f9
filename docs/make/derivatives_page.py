"""docs/derivatives.md: every input of an experiment, whether it can be differentiated by, how exactly, at what cost.

python docs/make/derivatives_page.py

Errors are measured on 27 grains, costs on 325. A slope that is 0 has its reason in the table, or nothing is written.
"""

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gmem_jax as gm
from gmem_jax.bench.table import into
from gmem_jax.derivatives.push import push
from gmem_jax.experiment.changes import value_at
from gmem_jax.experiment.experiment import acts_on_prefix

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "derivatives.md"
STEP = 1e-7  # of a difference, over the size of a number: contacts of 27 grains hardly change within it
DIRECTIONS = 5  # the median over these is not that of a step in which a contact began to slide
LARGEST_ERROR = 2e-2  # as in tests/derivatives/test_gradient.py
PLAIN = {"pack.clump.sizes": "plain JAX"}
ZERO = {  # inputs whose slope is 0, and why
    "material.radius": "a unit",
    "material.modulus": "a unit",
    "material.density": "a unit",
    "pack.delta0": "what `delta0` is where that is not given",
    "pack.ringing_period": "of F over T1 only",
    "pack.clump.diameter": "of lists only",
    "pack.pairs.": "of lists only",
}


def experiments() -> Iterator[tuple[str, gm.Experiment]]:
    """Experiments that have among them every continuous input, each with what it adds."""
    pack = gm.load_pack(str(ROOT / "tests" / "data" / "tetra-27.h5"))
    bumps = gm.Bumps(jnp.asarray([[1.0, -0.6]]), jnp.asarray([[0.3, 0.7]]), 0.2)
    short: dict[str, Any] = {"t0": 60.0, "rest": 0.02, "hold": 0.02, "store": 0.02, "delta0": 0.05, "hold_drag": 0.04}
    yield "law H, bumps", gm.Experiment(pack, bumps, gm.Hooke(mu=0.8, spinning=0.9), **short)
    yield "law M1", gm.Experiment(pack, bumps, gm.MindlinRescaled(mu=0.8), **short)
    yield "law M2", gm.Experiment(pack, bumps, gm.Mindlin(mu=0.8), **short)
    yield "creep", gm.Experiment(pack, bumps, creep=1e-3, creep_fades=5.0, **short)
    yield "gravity", gm.Experiment(pack, bumps, gravity=1e-4, **short)
    yield "friction of walls", gm.Experiment(pack, bumps, wall_mu=0.5, **short)
    sizes = 1.0 + 0.05 * np.random.default_rng(0).normal(size=pack.grains)
    yield "grains of sizes", gm.Experiment(dataclasses.replace(pack, clump=gm.sized(pack.clump, sizes)), bumps, **short)
    radii = dataclasses.replace(pack.clump, radii=jnp.asarray([1.0, 1.01, 0.99, 1.0]))
    yield "unequal spheres", gm.Experiment(dataclasses.replace(pack, clump=radii), bumps, **short)
    yield "a spline", gm.Experiment(pack, gm.waveform(jnp.sin(jnp.linspace(0.2, 3.0, 8))), **short)


def names_of(experiment: gm.Experiment) -> list[str]:
    """The dotted names of all floats of an experiment."""
    leaves = jax.tree_util.tree_leaves_with_path(experiment)
    floats = [path for path, leaf in leaves if jnp.issubdtype(jnp.result_type(leaf), jnp.floating)]
    return [jax.tree_util.keystr(path).removeprefix(".") for path in floats]


def score(experiment: gm.Experiment, p_sig: jax.Array) -> jax.Array:
    """A smooth number of everything in a recall."""
    return 1e6 * jnp.sum(p_sig * jnp.linspace(0.0, 1.0, p_sig.shape[-1]))


def errors(experiment: gm.Experiment, name: str, slope: Any) -> tuple[float, float]:
    """How far a slope is from central differences, and from that of forward mode; relative."""
    value = np.asarray(value_at(experiment, name))
    found: list[float] = []
    forward: list[float] = []
    for seed in range(DIRECTIONS):
        toss: Any = np.random.default_rng(seed).normal(size=value.shape) * (np.abs(value).mean() + 1e-3)
        toss = np.where(value == 0.0, 0.0, toss) if name == "signals.nodes" else toss  # a waveform vanishes at its ends
        changed = [gm.replace(experiment, {name: jnp.asarray(value + by * toss)}) for by in (STEP, -STEP)]
        up, down = (float(score(one, gm.run(one, progress=False).p_sig)) for one in changed)
        along = float(np.vdot(np.asarray(slope), toss))
        found.append(abs(along - (up - down) / (2.0 * STEP)) / max(abs(along), 1e-300))
        if not forward:
            pushed = push(experiment, {name: jnp.asarray(toss)}).p_sig_slope
            forward.append(abs(float(score(experiment, jnp.asarray(pushed))) - along) / max(abs(along), 1e-300))
    return float(np.median(found)), forward[0]


def costs() -> dict[str, float]:
    """CPU time of a gradient over that of a run, by what it goes through; 325 grains, six signals, t0 = 450."""
    experiment = gm.Experiment(gm.load_pack("tetra-325-a"), gm.six_signals(), t0=450.0)

    def spent(run: Any) -> float:
        run()
        began = time.process_time()
        run()
        return time.process_time() - began

    forward = spent(lambda: gm.run(experiment, progress=False))
    kinds = {"after": "signals.amplitudes", "through": "friction.mu"}
    return {
        kind: spent(lambda by=name: gm.value_and_grad(experiment, [by], progress=False)) / forward
        for kind, name in kinds.items()
    }


def rows() -> list[str]:
    """The table as Markdown."""
    head = ["input", "of", "backend", "reverse against differences", "against forward", "cost"]
    lines, cost = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"], costs()
    known: set[str] = set()
    for what, experiment in experiments():
        names = [name for name in names_of(experiment) if name not in known]
        slopes = gm.value_and_grad(experiment, names, loss=score, progress=False).slope
        for name in names:
            known.add(name)
            if not np.any(np.asarray(slopes[name])):
                reason = next(words for start, words in ZERO.items() if name.startswith(start))
                lines.append(f"| `{name}` | {what} | both | 0: {reason} | | |")
                continue
            by_differences, by_forward = errors(experiment, name, slopes[name])
            if by_differences > LARGEST_ERROR:
                raise SystemExit(f"{name}: differences are {by_differences:.1e} away")
            paid = cost["through" if acts_on_prefix(name) else "after"]
            told = [PLAIN.get(name, "both"), f"{by_differences:.0e}", f"{by_forward:.0e}"]
            price = "that of plain JAX" if name in PLAIN else f"{paid:.1f}"
            lines.append(f"| `{name}` | {what} | {' | '.join(told)} | {price} |")
            print(lines[-1], flush=True)
    return lines


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    made = "\n".join(["", *rows(), "", ""])
    PAGE.write_text(into(PAGE.read_text(), made, "docs/make/derivatives_page.py"))
