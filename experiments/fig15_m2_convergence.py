"""Fig. 15: M2's force on unloading along the path of Fig. 10, for several numbers of points Q and weights.

python experiments/fig15_m2_convergence.py [-o fig15]
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.path import contact_path, polyline
from gmem_jax.physics.pytree import pytree

CORNERS = np.array([(0.0, 0.0), (0.5, 0.0), (0.5, 0.8), (1.0, 0.8), (1.0, 1.0), (0.0, 1.0)])  # (p, sigma), in R
POINTS = 1000  # to a segment
FREE = {"mu": 1e6, "stiffness": 1.0, "damping_time": 0.0, "p_max": 1.5}
SHOWN = (20, 100, 400)
COUNTS = (20, 35, 60, 100, 180, 400)


@pytree
@dataclass(frozen=True)
class WithoutH(Mindlin):
    """App. D.2 without its h term: the outermost ring counts in full as soon as it is reached."""

    def weights(self, x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """See `Mindlin.weights`."""
        points = jnp.arange(self.points)[:, None, None]
        outermost = jnp.minimum(jnp.floor(x), self.points - 2)
        inside = points <= outermost[:, None]
        return inside, jnp.where(inside, 1.0 - 0.5 * (points == 0), 0.0), outermost + 0.5


FORMS = {
    "paper, without h": lambda count: WithoutH(**FREE, points=count, variant="paper"),
    "paper, with h": lambda count: Mindlin(**FREE, points=count, variant="paper"),
    "exact weights": lambda count: Mindlin(**FREE, points=count, variant="exact"),
    "averaged (default)": lambda count: Mindlin(**FREE, points=count, variant="averaged"),
}


def draw(path: Path, overlap: np.ndarray, exact: np.ndarray, forces: dict, errors: dict) -> None:
    """The force at Q = 20 and 100, its deviation from the exact one, and the mean deviation against Q."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12.5, 3.9))
    left.plot(overlap, exact, color="0.6", linewidth=4, label="exact")
    curves = [("paper, without h", 20), ("paper, with h", 20), ("paper, with h", 100), ("averaged (default)", 20)]
    for color, (form, count) in enumerate(curves):
        left.plot(overlap, forces[form, count], color=f"C{color}", linewidth=1.1, label=f"{form}, Q = {count}")
        middle.plot(overlap, forces[form, count] - exact, color=f"C{color}", linewidth=1.1)
    left.set(xlabel="overlap $p$ ($R$)", ylabel="$f_e / k_M$  ($R^{3/2}$)", title="force on unloading")
    left.legend(frameon=False, fontsize=8)
    middle.axhline(0.0, color="0.6", linewidth=2, zorder=0)
    middle.set(xlabel="overlap $p$ ($R$)", ylabel=r"$(f_e - f_{exact}) / k_M$  ($R^{3/2}$)", title="deviation")
    for number, form in enumerate(FORMS):
        mean = [errors[form, count] for count in COUNTS]
        right.loglog(COUNTS, mean, "osD^"[number] + "-", markersize=4, linewidth=1.1, label=form)
    right.loglog(COUNTS, 0.4 / np.array(COUNTS), ":", color="0.5", label="1 / Q")
    right.set(xlabel="number of points Q", ylabel=r"rms deviation / $k_M$  ($R^{3/2}$)", title="convergence")
    right.set_xticks(COUNTS, [str(count) for count in COUNTS])
    right.minorticks_off()
    right.set_ylim(2e-7, 5e-2)
    right.legend(frameon=False, fontsize=8, loc="lower left")
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main() -> None:
    """Unload one contact with every form of M2."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("fig15"), help="folder to write to")
    output = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    path, displacement = np.asarray(polyline(CORNERS, POINTS)).T
    unloading = slice(4 * POINTS, None)
    overlap = path[unloading]
    exact = 0.8 * np.minimum(np.sqrt(overlap), np.sqrt(0.5)) + 0.2 * np.sqrt(overlap)
    forces, errors = {}, {}
    print("rms deviation from the exact force while unloading, in k_M R^1.5")
    print("     Q  " + "".join(f"{form:>20s}" for form in FORMS))
    for count in COUNTS:
        for form, law in FORMS.items():
            force = np.asarray(contact_path(law(count), path, displacement))[unloading]
            forces[form, count] = force
            errors[form, count] = float(np.sqrt(np.mean((force - exact) ** 2)))
        print(f"{count:6d}  " + "".join(f"{errors[form, count]:20.2e}" for form in FORMS))
    draw(output / "fig15.png", overlap, exact, forces, errors)
    shown = [(form, count) for form in FORMS for count in SHOWN]
    header = ",".join(["p_R", "exact_kM", *(f"{form.replace(', ', ' ')} Q={count}" for form, count in shown)])
    table = np.column_stack([overlap, exact, *(forces[key] for key in shown)])
    np.savetxt(output / "fig15.csv", table, delimiter=",", header=header, comments="", fmt="%.8g")


if __name__ == "__main__":
    main()
