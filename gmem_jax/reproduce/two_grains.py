"""The two-grain picture of the memory (Fig. 7): a contact keeps the shear at which it formed in the compression.

Two grains move with the walls; between them is a gap that the compression closes at u = u_c. From then on their
friction force follows the shear: k (gamma(u) - gamma(u_c)) R. At u = 1 the shear is zero again and the force is
-k gamma(u_c) R: one contact keeps one value of the waveform. On decompression it breaks at u_c, and the force vanishes.
Contacts of all u_c together hold the integral of gamma. They lose it from its end, which reads it out reversed.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gmem_jax.experiment.analysis import compare
from gmem_jax.experiment.signals import Signals, bin_average, part, six_signals
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.path import contact_path
from gmem_jax.reproduce.figures import DELTA0
from gmem_jax.reproduce.single_contact import write_columns
from gmem_jax.show.render_matplotlib import pyplot, save_picture
from gmem_jax.simulation.stage import BINS, bin_centres

STORE = 0.2  # t0, duration of the storage in the picture
POINTS_PER_BIN = 4  # points in a bin
DRAWN_AT = (0.3, 0.5, 0.7)  # u_c of the contacts whose force is drawn
SIGNAL = 5


@dataclass(frozen=True)
class Story:
    """The history of M contacts at T times.

    Attributes:
        closes: u at which each contact forms, [M].
        time: time since the compression began, [T], in t0; the compression ends at 1, then storage and decompression.
        u: compression variable, [T].
        shear: shear strain gamma, [T].
        force: friction force that resists the shear, [T, M], in E R^2.
    """

    closes: np.ndarray
    time: np.ndarray
    u: np.ndarray
    shear: np.ndarray
    force: np.ndarray

    @property
    def recalled(self) -> np.ndarray:
        """The mean force on decompression in each bin of ascending u, with the sign of a recalled signal, [256]."""
        back = self.force[-BINS * POINTS_PER_BIN :].mean(axis=1)
        binned: np.ndarray = -back.reshape(BINS, POINTS_PER_BIN).mean(axis=1)[::-1]
        return binned


def tell(closes: np.ndarray, signal: Signals, law: FrictionLaw | None = None, gamma0: float = 1e-3) -> Story:
    """Compress contacts along the box's diagonal in a sheared box, hold them, and decompress them, quasi-statically.

    Args:
        closes: u at which the two grains of each pair touch, [M], within (0, 1).
        signal: one waveform, for all contacts.
        law: friction law; default `Hooke()`.
        gamma0: shear amplitude.
    """
    closes = np.asarray(closes, float)
    way = (np.arange(BINS * POINTS_PER_BIN) + 1.0) / (BINS * POINTS_PER_BIN)
    u = np.concatenate([[0.0], way, np.ones(round(STORE * BINS * POINTS_PER_BIN)), 1.0 - way])
    time = np.arange(len(u)) / (BINS * POINTS_PER_BIN)
    shear = np.where(time <= 1.0, gamma0 * np.asarray(signal.shear(jnp.asarray(u)))[:, 0], 0.0)
    # Affine motion: centres 2 R apart come closer by 2 R times the strain of an axis, and slide by R gamma.
    overlap = 2.0 * (1.0 - np.sqrt(1.0 - DELTA0)) * (u[:, None] - closes)
    law = Hooke() if law is None else law
    force = jax.vmap(lambda p: contact_path(law, p, jnp.asarray(shear)), in_axes=1, out_axes=1)(jnp.asarray(overlap))
    return Story(closes, time, u, shear, np.asarray(force))


def two_grains_figure(path: Path, count: int = 96, gamma0: float = 1e-3) -> dict[str, float]:
    """Draw the two grains, the force in three such contacts, and the recall of many contacts; also write a CSV.

    Args:
        path: file to write.
        count: number of contacts, which form at equally spaced u.
        gamma0: shear amplitude.

    Returns:
        Fidelity of the recall of all contacts.

    Raises:
        OSError: if they cannot be written.
    """
    signal = part(six_signals(), SIGNAL - 1, SIGNAL)
    story = tell((np.arange(count) + 0.5) / count, signal, gamma0=gamma0)
    integral = np.asarray(bin_average(signal))
    match = compare(jnp.asarray(story.recalled)[None], jnp.asarray(integral), 1.0)
    u = bin_centres()
    figure, (left, middle, right) = pyplot().subplots(1, 3, figsize=(12.0, 3.8), width_ratios=(0.9, 1.6, 1.2))
    _sketch(left)
    shown = [int(np.argmin(np.abs(story.closes - value))) for value in DRAWN_AT]
    scale = np.abs(story.force[:, shown]).max() / gamma0
    middle.fill_between(story.time, scale * story.shear, color="0.9", label=r"shear $\gamma$, scaled")
    for colour, contact in enumerate(shown):
        label = f"forms and breaks at u = {story.closes[contact]:.2f}"
        middle.plot(story.time, story.force[:, contact], color=f"C{colour}", linewidth=1.2, label=label)
    for edge in (1.0, 1.0 + STORE):
        middle.axvline(edge, color="0.7", linewidth=0.7)
    middle.set(xlabel="time ($t_0$): compression, storage, decompression", ylabel="friction force ($E R^2$)")
    middle.set_ylim(top=1.5 * middle.get_ylim()[1])  # room for the legend
    middle.legend(frameon=False, fontsize=7)
    right.plot(u, story.recalled, label=f"mean force in {count} contacts, reversed")
    right.plot(u, float(match.gain) * integral[0], "C3--", label=r"$\propto J(u)$, the integral of the shear")
    right.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
    right.set(xlabel="u (decompression goes to the left)", ylabel="force ($E R^2$)")
    right.set_title(f"decompression: F = {float(match.fidelity):.3f}", fontsize=9)
    right.legend(frameon=False, fontsize=7, loc="upper left")
    right.set_ylim(top=1.45 * story.recalled.max())
    caption = (
        "How a contact keeps the shear. Left: two grains that the compression brings together at u = $u_c$. Middle: "
        "the friction forces of three such contacts follow the shear from then on; what is left at u = 1 is released "
        f"where it was taken up. Right: the mean of {count} contacts on the way back is the integral of the waveform."
    )
    save_picture(path, figure, also=(".svg",), caption=caption)
    names = [f"force_{story.closes[contact]:.3f}_ER2" for contact in shown]
    columns = [story.time, story.u, story.shear, *story.force[:, shown].T]
    write_columns(path.with_suffix(".csv"), ["time_t0", "u", "gamma", *names], columns)
    return {"fidelity": float(match.fidelity)}


def _sketch(axis: Any) -> None:
    """Draw two grains in the corners of their box, before and after they touch."""
    plt = pyplot()
    for place, edge, words in ((0.0, 3.75, "u < $u_c$: apart"), (4.9, 3.3, "u > $u_c$: in contact")):
        axis.add_patch(plt.Rectangle((place, -0.5 * edge), edge, edge, fill=False, linewidth=1.5))
        for x, y in ((place + 1.0, 1.0 - 0.5 * edge), (place + edge - 1.0, 0.5 * edge - 1.0)):
            axis.add_patch(plt.Circle((x, y), 1.0, facecolor="0.85", edgecolor="0.3"))
        axis.text(place + 0.5 * edge, -0.5 * edge - 0.35, words, ha="center", va="top", fontsize=8)
    centre = 4.9 + 0.5 * 3.3
    for sign in (1.0, -1.0):
        start_ = (centre + 0.18 * sign, 0.18 * sign)
        end = (start_[0] - 0.7 * sign, start_[1] + 0.7 * sign)
        axis.annotate("", end, start_, arrowprops={"arrowstyle": "->", "color": "C3"})
    axis.set(xlim=(-0.4, 8.6), ylim=(-3.0, 2.4), aspect="equal")
    axis.axis("off")
