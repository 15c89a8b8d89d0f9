"""Rendered pictures of packs: spheres with a depth buffer, in parallel projection."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gmem_jax.experiment.pack import Pack
from gmem_jax.physics.grain import radii_of_spheres
from gmem_jax.physics.pairs import sphere_places
from gmem_jax.show.render_matplotlib import pyplot, save_picture

VIEW = (np.deg2rad(-35.0), np.deg2rad(25.0))  # azimuth and elevation of the eye
LIGHT = np.array([-0.4, 0.5, 0.77])  # direction to the light: right, up, towards the eye
GOLDEN = 0.618034  # difference of hue between a grain and the next


def camera(azimuth: float, elevation: float) -> np.ndarray:
    """The directions right, up and towards the eye, as rows, [3, 3]."""
    (ca, sa), (ce, se) = ((np.cos(angle), np.sin(angle)) for angle in (azimuth, elevation))
    return np.array([[ca, sa, 0.0], [sa * se, -ca * se, ce], [sa * ce, -ca * ce, se]])


def colours(grains: int) -> np.ndarray:
    """A pale colour for each grain, [N, 3]."""
    hue = (GOLDEN * np.arange(grains)) % 1.0
    return 0.72 + 0.24 * np.cos(2.0 * np.pi * (hue[:, None] + np.array([0.0, 1.0, 2.0]) / 3.0))


def rendered(centres: np.ndarray, colour: np.ndarray, pixels: int = 700, radii: np.ndarray | None = None) -> np.ndarray:
    """An image of spheres.

    Args:
        centres: centres of the spheres, [S, 3].
        colour: red, green and blue of each sphere, from 0 to 1, [S, 3].
        pixels: length of the longer side.
        radii: radii of the spheres, [S]; default 1.

    Returns:
        Red, green, blue and opacity, [height, width, 4], the first row on top.
    """
    seen = centres @ camera(*VIEW).T
    own = np.ones(len(seen)) if radii is None else radii
    widest = float(own.max())
    low, high = seen[:, :2].min(axis=0) - 1.05 * widest, seen[:, :2].max(axis=0) + 1.05 * widest
    scale = pixels / float(np.max(high - low))
    width, height = np.ceil(scale * (high - low)).astype(int)
    depth, image = np.full((height, width), -np.inf), np.zeros((height, width, 4))
    radius = int(np.ceil(scale * widest)) + 1
    step = np.arange(-radius, radius + 1)
    for centre, tint, size in zip(seen, colour, own, strict=True):
        place = scale * (centre[:2] - low)
        columns, rows = (np.round(one).astype(int) + step for one in place)
        columns, rows = columns[(columns >= 0) & (columns < width)], rows[(rows >= 0) & (rows < height)]
        x, y = (one / size for one in np.meshgrid((columns + 0.5 - place[0]) / scale, (rows + 0.5 - place[1]) / scale))
        outwards = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
        window = np.ix_(rows, columns)
        nearer = (outwards > 0.0) & (centre[2] + size * outwards > depth[window])
        light = 0.35 + 0.65 * np.maximum(LIGHT[0] * x + LIGHT[1] * y + LIGHT[2] * outwards, 0.0)
        depth[window] = np.where(nearer, centre[2] + size * outwards, depth[window])
        shaded = np.concatenate([np.minimum(light[..., None] * tint, 1.0), np.ones((*light.shape, 1))], axis=-1)
        image[window] = np.where(nearer[..., None], shaded, image[window])
    return image[::-1]


def pack_image(pack: Pack, pixels: int = 700) -> np.ndarray:
    """An image of a pack; see `rendered`."""
    clump = pack.clump
    centres = sphere_places(pack.position, pack.quaternion, clump.offsets, clump.sizes)
    radii = radii_of_spheres(pack.grains, clump.spheres, clump.radii, clump.sizes)
    return rendered(centres, np.repeat(colours(pack.grains), clump.spheres, axis=0), pixels, radii)


def packs_figure(path: Path, packs: Sequence[Pack], title: str, columns: int = 4) -> None:
    """Write a picture of packs beside each other, each as large as its panel, with size, shape and filling.

    Raises:
        OSError: if it cannot be written.
    """
    lines = -(-len(packs) // columns)
    figure, axes = pyplot().subplots(lines, columns, figsize=(3.0 * columns, 3.3 * lines + 0.3), squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, pack in zip(axes.flat, packs, strict=False):
        axis.imshow(pack_image(pack), interpolation="bilinear")
        filling = float(pack.clump.volume(pack.grains)) / float(np.prod(np.asarray(pack.upper - pack.lower)))
        axis.set_title(f"{pack.grains:,} {pack.clump.shape}, $\\phi$ = {filling:.3f}", fontsize=9)
    figure.suptitle(title, fontsize=10)
    save_picture(path, figure)
