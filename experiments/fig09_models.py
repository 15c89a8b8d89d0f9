"""Fig. 9: the recall under the three friction laws, on the same packs: H, M1, M2 (and M2 in the paper's own weights).

    python experiments/fig09_models.py [--pack NAME_OR_FILE ...] [-o fig09]

Writes fig09.csv (G and F of every pack and law) and fig09.png (the recalled signals of the first pack), and prints
means with their standard errors.
"""

import argparse
import csv
from pathlib import Path

import jax
import matplotlib

import gmem_jax as gm
from gmem_jax.experiment.analysis import spread

matplotlib.use("Agg")
import matplotlib.pyplot as plt

LAWS = {
    "H": gm.Hooke(),
    "M1": gm.MindlinRescaled(),
    "M2": gm.Mindlin(),
    "M2 (paper's weights)": gm.Mindlin(variant="paper"),
}


def draw(path: Path, recalls: dict[str, gm.Recall], title: str) -> None:
    """The six recalled signals, a curve per law."""
    figure, axes = plt.subplots(2, 3, figsize=(10, 5.4), sharex=True, sharey=True)
    for number, axis in enumerate(axes.flat):
        for name, recall in recalls.items():
            axis.plot(recall.u, 1e7 * recall.p_sig[number], label=f"{name}, F = {float(recall.fidelity):.2f}", lw=1)
        axis.set_title(f"signal {number + 1}", fontsize=9)
    axes[0, 0].legend(fontsize=7, frameon=False)
    for axis in axes[-1]:
        axis.set_xlabel("compression variable u")
    for axis in axes[:, 0]:
        axis.set_ylabel("recalled $p_{sig}$ (Pa)")
    figure.suptitle(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def main() -> None:
    """Run every law on every pack."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pack", nargs="+", default=gm.list_packs(), help="shipped names or pack files")
    parser.add_argument("--law", nargs="+", choices=list(LAWS), default=["H", "M1", "M2"])
    parser.add_argument("--t0", type=float, default=1.8e3, help="duration of one compression, t_c")
    parser.add_argument("-o", "--output", type=Path, default=Path("fig09"), help="folder to write to")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    arguments.output.mkdir(parents=True, exist_ok=True)

    rows = []
    for number, name in enumerate(arguments.pack):
        pack = gm.load_pack(name)
        recalls = {}
        for law in arguments.law:
            recall = recalls[law] = gm.run(gm.Experiment(pack, gm.six_signals(), LAWS[law], t0=arguments.t0))
            row = (pack.name, law, float(recall.gain), float(recall.fidelity), int(recall.status.max()))
            rows.append(row)
            print(f"{row[0]}  {law:22s} G = {row[2]:.3f}  F = {row[3]:.3f}  {gm.explain(row[4])}", flush=True)
        if number == 0:
            draw(arguments.output / "fig09.png", recalls, f"{pack.name}: recall under each friction law")
    with (arguments.output / "fig09.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("pack", "law", "gain", "fidelity", "status"), *rows])
    for law in arguments.law:
        gains, fidelities = ([row[k] for row in rows if row[1] == law] for k in (2, 3))
        (gain, _, gain_error), (fidelity, _, error) = spread(gains), spread(fidelities)
        print(f"{law:22s} G = {gain:.3f} +- {gain_error:.3f}  F = {fidelity:.3f} +- {error:.3f}  ({len(gains)} packs)")


if __name__ == "__main__":
    main()
