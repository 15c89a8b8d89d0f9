"""Fig. 10: the elastic force of H, M1 and M2 along one path of overlap and displacement, beside the closed forms.

python experiments/fig10_contact_path.py [-o fig10]
"""

import argparse
from pathlib import Path

import jax
import matplotlib
import numpy as np

import gmem_jax as gm
from gmem_jax.physics.contact.path import contact_path, polyline

CORNERS = np.array([(0.0, 0.0), (0.5, 0.0), (0.5, 0.8), (1.0, 0.8), (1.0, 1.0), (0.0, 1.0)])  # (p, sigma), in R
POINTS = 200  # to a segment
FREE = {"mu": 1e6, "stiffness": 1.0, "damping_time": 0.0}  # never slides; force in units of the stiffness
LAWS = {"H": gm.Hooke(**FREE), "M1": gm.MindlinRescaled(**FREE), "M2": gm.Mindlin(**FREE, p_max=1.5)}


def unloading(name: str, overlap: np.ndarray) -> np.ndarray:
    """The closed form on the last segment, in units of the stiffness."""
    root = np.sqrt(overlap)
    return {
        "H": np.ones_like(root),
        "M1": (0.8 * np.sqrt(0.5) + 0.2) * root,
        "M2": 0.8 * np.minimum(root, np.sqrt(0.5)) + 0.2 * root,
    }[name]


def draw(path: Path, overlap: np.ndarray, displacement: np.ndarray, forces: dict[str, np.ndarray]) -> None:
    """The path, the force along it, and the force while the contact unloads."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11.5, 3.7))
    left.plot(*CORNERS.T, "o-", color="0.3", markersize=4)
    for number, (p, sigma) in enumerate(CORNERS):
        left.annotate(str(number), (p, sigma), textcoords="offset points", xytext=(5, -11), fontsize=9)
    left.set(xlabel="overlap $p$ ($R$)", ylabel=r"displacement $\sigma$ ($R$)", title="path")
    left.margins(0.1)
    corner = np.arange(overlap.size) / POINTS
    last = slice(4 * POINTS, None)
    for color, (name, force) in enumerate(forces.items()):
        middle.plot(corner, force, "--" if name == "M2" else "-", color=f"C{color}", label=name)
        right.plot(overlap[last], force[last], color=f"C{color}", label=name)
        some = overlap[last][10::20]
        closed = unloading(name, some)
        right.plot(some, closed, "o", color=f"C{color}", markersize=4, fillstyle="none", label=f"{name}, closed form")
    unit = "$f_e / k$  (H: $R$;  M1, M2: $R^{3/2}$)"
    middle.set(xlabel="position on the path (corner number)", ylabel=unit, title="along the path")
    right.set(xlabel="overlap $p$ ($R$)", ylabel=unit, title="unloading, 4 to 5")
    middle.legend(frameon=False, fontsize=9)
    right.legend(frameon=False, fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main() -> None:
    """Lead one contact along the path with each law."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("fig10"), help="folder to write to")
    output = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)

    overlap, displacement = np.asarray(polyline(CORNERS, POINTS)).T
    forces = {name: np.asarray(contact_path(law, overlap, displacement)) for name, law in LAWS.items()}
    draw(output / "fig10.png", overlap, displacement, forces)
    table = np.column_stack([overlap, displacement, *forces.values()])
    header = "p_R,sigma_R," + ",".join(f"force_{name}_k" for name in forces)
    np.savetxt(output / "fig10.csv", table, delimiter=",", header=header, comments="", fmt="%.10g")
    inside = slice(4 * POINTS, -1)  # at p = 0 there is no contact any more
    for name, force in forces.items():
        error = np.abs(force[inside] - unloading(name, overlap[inside])).max()
        print(f"{name}: largest deviation from the closed form while unloading {error:.1e} k")


if __name__ == "__main__":
    main()
