"""What the rate of the drive does to a recall of 31,680 grains: docs/results/large_pack.png.

python docs/make/rates_picture.py

`docs/results/large_pack_curves.csv` has the third of the six waveforms, recalled at three rates: u, its integral J, and
p_sig in E, as it is and after a running mean over the ringing period T1.
"""

import csv
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.analysis import compare
from gmem_jax.reproduce.draw import OURS
from gmem_jax.show.render_matplotlib import pyplot, save_picture

HERE = Path(__file__).parents[1] / "results"
SCALE = 0.05 * 1e-3  # delta0 gamma0
UNIT = 1e6  # p_sig is shown in millionths of E


def main() -> None:
    """Draw a panel for each rate."""
    with (HERE / "large_pack_curves.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    rates = sorted({float(row["t0"]) for row in rows})
    figure, axes = pyplot().subplots(1, len(rates), figsize=(11, 3.6), sharey=True)
    for axis, t0 in zip(axes, rates, strict=True):
        own = [row for row in rows if float(row["t0"]) == t0]
        u, integral, signal, mean = (np.array([float(row[name]) for row in own]) for name in own[0] if name != "t0")
        gain = float(compare(jnp.asarray(mean), jnp.asarray(integral), SCALE)[0])
        axis.plot(u, UNIT * signal, color="0.7", lw=1, label="recalled $p_{sig}$")
        axis.plot(u, UNIT * mean, color=OURS, label="its running mean over $T_1$")
        axis.plot(u, UNIT * gain * SCALE * integral, "--", color="#d1491b", label=r"$G E \delta_0 \gamma_0 J$")
        axis.set(xlabel="compression variable u", title=f"$t_0$ = {t0:,.0f} $t_c$, G = {gain:.3f}")
    axes[0].set_ylabel("stress (1e-6 E)")
    axes[-1].legend(fontsize=8, frameon=False, loc="lower right")
    figure.suptitle("31,680 grains, the third of the six waveforms", fontsize=11)
    save_picture(HERE / "large_pack.png", figure)


if __name__ == "__main__":
    main()
