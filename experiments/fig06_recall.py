"""Fig. 6: the six recalled waveforms beside their scaled integrals, from the library.

python experiments/fig06_recall.py [--pack tetra-325-a] [-o fig06]
"""

import argparse
from pathlib import Path

import jax

import gmem_jax as gm
from gmem_jax.show.figures import recall_figure


def main() -> None:
    """Run one recall and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pack", default="tetra-325-a", help="a shipped pack's name or a pack file")
    parser.add_argument("--t0", type=float, default=1.8e3, help="duration of one compression, t_c (the paper's: 18000)")
    parser.add_argument("-o", "--output", type=Path, default=Path("fig06"), help="folder to write to")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    arguments.output.mkdir(parents=True, exist_ok=True)

    pack = gm.load_pack(arguments.pack)
    experiment = gm.Experiment(pack, gm.six_signals(), t0=arguments.t0)
    recall = gm.run(experiment)
    recall_figure(arguments.output / "fig06.png", recall, experiment.scale, pack.name)
    print(
        f"{pack.name}: G = {recall.gain:.3f}, F = {recall.fidelity:.3f}, status: {gm.explain(int(recall.status.max()))}"
    )


if __name__ == "__main__":
    main()
