"""One contact along the paper's path (Fig. 10), and M2 with more and more points (Fig. 15, App. D.2)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.files.atomic import atomic
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.contact.path import contact_path, polyline
from gmem_jax.physics.pytree import pytree
from gmem_jax.show.render_matplotlib import pyplot, save_picture

CORNERS = np.array([(0.0, 0.0), (0.5, 0.0), (0.5, 0.8), (1.0, 0.8), (1.0, 1.0), (0.0, 1.0)])  # (p, sigma), in R
FREE: dict[str, Any] = {
    "mu": 1e6,
    "stiffness": 1.0,
    "damping_time": 0.0,
}  # never slides; forces in units of the stiffness
P_MAX = 1.5
M2, M2_PAPER = "M2", "M2, paper's weights"
DRIVEN_LAWS: dict[str, FrictionLaw] = {
    "H": Hooke(**FREE),
    "M1": MindlinRescaled(**FREE),
    M2: Mindlin(**FREE, p_max=P_MAX),
    M2_PAPER: Mindlin(**FREE, p_max=P_MAX, variant="paper"),
}
POINT_COUNTS = (20, 35, 60, 100, 180, 400)  # numbers of points of M2
DRAWN_LAWS = (("paper, without h", 20), ("paper, with h", 20), ("paper, with h", 100), ("averaged (default)", 20))


def closed_form(law: str, overlap: np.ndarray) -> np.ndarray:
    """The elastic force on the last segment of the path, in units of the stiffness."""
    root: np.ndarray = np.sqrt(overlap)
    if law == "H":
        return np.ones_like(root)
    if law == "M1":
        return float(0.8 * np.sqrt(0.5) + 0.2) * root
    force: np.ndarray = 0.8 * np.minimum(root, np.sqrt(0.5)) + 0.2 * root
    return force


def _force(law: FrictionLaw, overlap: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    return np.asarray(contact_path(law, jnp.asarray(overlap), jnp.asarray(displacement)))


def led(points: int) -> tuple[np.ndarray, np.ndarray, slice]:
    """Overlap and displacement along the path, with `points` points on each segment; and the last segment's slice."""
    overlap, displacement = np.asarray(polyline(jnp.asarray(CORNERS), points)).T
    return overlap, displacement, slice((len(CORNERS) - 2) * points, None)


def laws_figure(path: Path, points: int = 200) -> dict[str, float]:
    """Draw the path, the force of every law along it, and the unloading beside the closed forms; also write a CSV.

    Returns:
        The largest deviation from the closed form by law, in units of the stiffness.

    Raises:
        OSError: if they cannot be written.
    """
    overlap, displacement, last = led(points)
    forces = {name: _force(law, overlap, displacement) for name, law in DRIVEN_LAWS.items()}
    figure, (left, middle, right) = pyplot().subplots(1, 3, figsize=(11.5, 3.7))
    left.plot(*CORNERS.T, "o-", color="0.3", markersize=4)
    for number, (p, sigma) in enumerate(CORNERS):
        left.annotate(str(number), (p, sigma), textcoords="offset points", xytext=(5, -11), fontsize=9)
    left.set(xlabel="overlap $p$ ($R$)", ylabel=r"displacement $\sigma$ ($R$)", title="path")
    left.margins(0.1)
    for colour, (name, force) in enumerate(forces.items()):
        style = "--" if name in (M2, M2_PAPER) else "-"
        middle.plot(np.arange(overlap.size) / points, force, style, color=f"C{colour}", label=name)
        right.plot(overlap[last], force[last], style, color=f"C{colour}")
        if name != M2_PAPER:
            some = overlap[last][10 :: points // 10]
            label = f"{name}, closed form"
            right.plot(some, closed_form(name, some), "o", color=f"C{colour}", ms=4, fillstyle="none", label=label)
    unit = "$f_e / k$  (H: $R$;  M1, M2: $R^{3/2}$)"
    middle.set(xlabel="position on the path (corner number)", ylabel=unit, title="along the path")
    right.set(xlabel="overlap $p$ ($R$)", ylabel=unit, title="unloading, 4 to 5")
    middle.set_ylim(top=1.4)  # room for the legend
    middle.legend(frameon=False, fontsize=7, loc="upper left")
    right.legend(frameon=False, fontsize=8)
    caption = (
        "One contact, led along a path of overlap and tangential displacement (left): the friction force of every law "
        "along it (middle), and on unloading beside the closed forms (right). M2 remembers at which overlap it was "
        "displaced."
    )
    save_picture(path, figure, also=(".svg",), caption=caption)
    names = [f"force_{name.replace(', ', '_').replace(' ', '_')}_k" for name in forces]
    write_columns(path.with_suffix(".csv"), ["p_R", "sigma_R", *names], [overlap, displacement, *forces.values()])
    inside = slice(last.start, -1)  # at p = 0 there is no contact any more
    return {n: float(np.abs(f[inside] - closed_form(n, overlap[inside])).max()) for n, f in forces.items()}


@pytree
@dataclass(frozen=True)
class WithoutH(Mindlin):
    """M2 of App. D.2 without its h term: the outermost ring counts in full as soon as it is reached."""

    def weights(self, x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """See `Mindlin.weights`."""
        points = jnp.arange(self.points)[:, None, None]
        outermost = jnp.minimum(jnp.floor(x), self.points - 2)
        inside = points <= outermost[:, None]
        return inside, jnp.where(inside, 1.0 - 0.5 * (points == 0), 0.0), outermost + 0.5


def _form(name: str, count: int) -> Mindlin:
    if name == "paper, without h":
        return WithoutH(**FREE, p_max=P_MAX, points=count, variant="paper")
    variants = {"paper, with h": "paper", "exact weights": "exact", "averaged (default)": "averaged"}
    return Mindlin(**FREE, p_max=P_MAX, points=count, variant=variants[name])  # type: ignore[arg-type]


FORMS = ("paper, without h", "paper, with h", "exact weights", "averaged (default)")


def convergence_figure(path: Path, points: int = 1000) -> dict[str, list[float]]:
    """Draw M2's force on unloading for several numbers of points and kinds of weights, and its error; also write a CSV.

    Returns:
        The root mean square deviation from the exact force by kind of weights, for each of `POINT_COUNTS`, in
        k_M R^1.5.

    Raises:
        OSError: if they cannot be written.
    """
    led_overlap, displacement, last = led(points)
    overlap = led_overlap[last]
    exact = closed_form(M2, overlap)
    forces = {
        (form, count): _force(_form(form, count), led_overlap, displacement)[last]
        for form in FORMS
        for count in POINT_COUNTS
    }
    figure, (left, middle, right) = pyplot().subplots(1, 3, figsize=(12.5, 3.9))
    left.plot(overlap, exact, color="0.6", linewidth=4, label="exact")
    for colour, (form, count) in enumerate(DRAWN_LAWS):
        left.plot(overlap, forces[form, count], color=f"C{colour}", linewidth=1.1, label=f"{form}, Q = {count}")
        middle.plot(overlap, forces[form, count] - exact, color=f"C{colour}", linewidth=1.1)
    left.set(xlabel="overlap $p$ ($R$)", ylabel="$f_e / k_M$  ($R^{3/2}$)", title="force on unloading")
    left.legend(frameon=False, fontsize=8)
    middle.axhline(0.0, color="0.6", linewidth=2, zorder=0)
    middle.set(xlabel="overlap $p$ ($R$)", ylabel=r"$(f_e - f_{exact}) / k_M$  ($R^{3/2}$)", title="deviation")
    errors = {}
    for number, form in enumerate(FORMS):
        errors[form] = [float(np.sqrt(np.mean((forces[form, count] - exact) ** 2))) for count in POINT_COUNTS]
        right.loglog(POINT_COUNTS, errors[form], "osD^"[number] + "-", markersize=4, linewidth=1.1, label=form)
    right.loglog(POINT_COUNTS, 0.4 / np.array(POINT_COUNTS), ":", color="0.5", label="1 / Q")
    right.set(xlabel="number of points Q", ylabel=r"rms deviation / $k_M$  ($R^{3/2}$)", title="convergence")
    right.set_xticks(POINT_COUNTS, [str(count) for count in POINT_COUNTS])
    right.minorticks_off()
    right.set_ylim(2e-7, 5e-2)  # room for the legend
    right.legend(frameon=False, fontsize=8, loc="lower left")
    caption = (
        "How many points Q of its history law M2 needs: the force on unloading (left), its deviation from the exact "
        "one (middle), and the root mean square of that against Q (right), for the paper's weights, with and without "
        "its h term, and ours."
    )
    save_picture(path, figure, also=(".svg",), caption=caption)
    shown = {f"{form.replace(', ', ' ')} Q={count}": forces[form, count] for form in FORMS for count in (20, 100, 400)}
    write_columns(path.with_suffix(".csv"), ["p_R", "exact_kM", *shown], [overlap, exact, *shown.values()])
    return errors


def write_columns(path: Path, names: list[str], columns: list[np.ndarray]) -> None:
    """Write columns as CSV.

    Raises:
        OSError: if it cannot be written.
    """
    with atomic(path) as temporary:
        np.savetxt(
            temporary,
            np.column_stack(columns),
            delimiter=",",
            header=",".join(names),
            comments="",
            fmt="%.8g",
            encoding="utf-8",
        )
