"""The points of figures, claims and choices, as sweeps: to run them, and to estimate the cost of several."""

import json
from collections.abc import Collection

from gmem_jax.reproduce import choices, claims
from gmem_jax.reproduce.figures import FIGURES, GALLERY, SCALES, packs, scale_of, shown_packs
from gmem_jax.sweeps.making import AS_THEY_ARE
from gmem_jax.sweeps.spec import Spec


def spec_for(name: str, scale: str) -> Spec:
    """The sweep of all points that a figure of `FIGURES`, the packs of `GALLERY`, "claims" or "choices" need.

    The last points of the claims are those of more packs, half of them of spheres, for the claim on rearrangement. All
    values of a choice are run on the same packs.

    Raises:
        ValueError: if there is no such scale.
    """
    size = scale_of(scale, choices.SIZES if name == "choices" else SCALES)
    if name == "claims":
        own, *others = packs(size, size.grains, size.packs)
        points = [*claims.claim_points([own]), *others, *packs(size, size.grains, size.packs, shape="sphere")]
    elif name == "choices":
        points = choices.choice_points(packs(size, size.grains, size.few))
    else:
        points = shown_packs(size) if name == GALLERY else FIGURES[name].points(size)
    return Spec(shared={"t0": size.t0}, extra=tuple(points), run={AS_THEY_ARE: True} if name == "choices" else {})


def spec_for_all(names: Collection[str], scale: str) -> Spec:
    """The sweep of all points that several of these need, each once.

    Raises:
        ValueError: if there is no such scale.
    """
    needed = [name for name in names if name != GALLERY] or names  # figures 11 and 12b have the packs of the gallery
    specs = [spec_for(name, scale) for name in needed]
    wanted = [{**spec.shared, **values} for spec in specs for values in spec.extra]
    once = {json.dumps(values, sort_keys=True): values for values in wanted}
    return Spec(extra=tuple(once.values()), run={AS_THEY_ARE: True})
