"""The points of figures, claims and choices as one sweep, to estimate their cost."""

import json
from collections.abc import Collection

from gmem_jax.reproduce import choices, claims
from gmem_jax.reproduce.figures import FIGURES, Scale, Values, packs, scale_of, shown_packs
from gmem_jax.sweeps.making import AS_THEY_ARE
from gmem_jax.sweeps.spec import Spec


def spec_of_all(names: Collection[str], scale: str) -> Spec:
    """The sweep of all points that some figures, "claims" or "choices" need, each once.

    Raises:
        ValueError: if there is no such scale.
    """
    size = scale_of(scale)
    wanted = [_at(size, values) for name in names if name in FIGURES for values in FIGURES[name].points(size)]
    if "claims" in names:
        (named,), (spheres,) = packs(size, size.grains, 1), packs(size, size.grains, 1, shape="sphere")
        wanted += [_at(size, values) for values in (*claims.claim_points([named]), spheres)]
    if "choices" in names:
        own = scale_of(scale, choices.SIZES)
        wanted += [_at(own, values) for values in choices.choice_points(packs(own, own.grains, own.few))]
    if list(names) == ["fig03"]:  # it needs only packs; figures 11 and 12b have them, too
        wanted = [_at(size, values) for values in shown_packs(size)]
    once = {json.dumps(values, sort_keys=True): values for values in wanted}
    return Spec(extra=tuple(once.values()), run={AS_THEY_ARE: True})


def _at(size: Scale, values: Values) -> Values:
    return {"t0": size.t0, **values}
