"""Pre-distorted waveforms for the six integrals on shipped packs: before and after, verified in a run of their own.

python experiments/design_waveforms.py [-o designed] [--packs tetra-325-a,tetra-325-b,...]

By default on the five packs of 325 grains; some ten minutes a pack on two cores.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
from console import in_one_line, new_folder, say
from packs import FIVE, called

import gmem_jax as gm
from gmem_jax.show.figures import design_figure, history_figure
from gmem_jax.show.render_matplotlib import to_matplotlib


def main() -> None:
    """Design, verify and draw, pack by pack."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=new_folder, default="designed", help="folder to write to")
    parser.add_argument("--packs", type=called, default=FIVE)
    parser.add_argument("--iterations", type=int, default=3)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    histories: dict[str, tuple[float, ...]] = {}
    for name in arguments.packs:
        began = time.perf_counter()
        experiment = gm.Experiment(gm.load_pack(name), gm.six_signals())
        design = gm.design_waveforms(experiment, iterations=arguments.iterations, progress=say)
        seconds = time.perf_counter() - began
        gm.save_waveforms(arguments.output / f"{name}.csv", design.signals)
        again = gm.waveform(gm.load_waveforms(arguments.output / f"{name}.csv"))
        p_sig = gm.run(gm.replace(experiment, signals=again)).p_sig
        verified, unit = experiment.compare(jnp.asarray(p_sig)).fidelity, float(experiment.scale)
        miss = np.linalg.norm(p_sig - design.gain * unit * design.target, axis=1)
        each = 1.0 - miss / np.linalg.norm(p_sig, axis=1)
        print(
            f"{name}: F {design.before:.4f} -> {float(verified):.4f}, G {design.gain:.3f}, {seconds:.0f} s; by signal "
            + " ".join(f"{value:.3f}" for value in each),
            flush=True,
        )
        to_matplotlib(design_figure(design, unit, name)).save(arguments.output / f"{name}.png")
        histories[name] = design.history
    to_matplotlib(history_figure(histories)).save(arguments.output / "history.png")


if __name__ == "__main__":
    in_one_line(main)
