"""Packs that a sweep prepares, and packs that were prepared for other parameters."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from gmem_jax.experiment.experiment import Experiment
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.provenance import sources
from gmem_jax.physics import grain
from gmem_jax.physics.material import Material
from gmem_jax.preparation.recipe import Recipe, graded, grain_steps
from gmem_jax.sweeps.plan import digest
from gmem_jax.sweeps.spec import PREPARE

GRAIN = {"shape": "tetra", "overlap": 0.6}  # default grain of packs to be made
FOLLOW = ("delta0", "wall_rigidity")  # parameters of an experiment with which its pack is prepared, too
AS_THEY_ARE = "packs_as_they_are"  # in [run]: allow packs that were prepared with other values of these


def clump_of(shape: Mapping[str, Any]) -> grain.Clump:
    """A grain from its shape and overlap."""
    return grain.sphere() if shape["shape"] == "sphere" else grain.tetra(float(shape["overlap"]))


def recipe_of(values: Mapping[str, Any], *, follow: bool = True) -> tuple[Recipe, dict[str, Any], Material]:
    """The recipe, the grain and the material with which the pack of a point is made.

    Args:
        values: values of the point; those of [prepare] have its prefix, and override those of the experiment.
        follow: whether the parameters `FOLLOW` of the experiment are used for the preparation, too.

    Raises:
        ValueError: for an unknown name or an impossible value.
    """
    own = {name: values[name] for name in FOLLOW if follow and values.get(name) is not None}
    own |= {name.removeprefix(PREPARE): value for name, value in values.items() if name.startswith(PREPARE)}
    if own.get("shape") == "sphere" and "overlap" in own:
        raise ValueError("prepare.overlap does nothing with prepare.shape = 'sphere'; it is of tetra grains")
    shape = {name: own.pop(name, default) for name, default in GRAIN.items()}
    material = Material(**{name: own.pop(name) for name in ("wall_rigidity",) if name in own})
    known = {field.name: field for field in fields(Recipe)}
    if unknown := sorted(set(own) - set(known)):
        raise ValueError(f"a preparation has no {unknown[0]!r}; it has {', '.join((*GRAIN, 'wall_rigidity', *known))}")
    if shape["shape"] not in ("tetra", "sphere"):
        raise ValueError(f"shape must be tetra or sphere, got {shape['shape']!r}")
    return Recipe(**own), shape, material


def pack_job(values: Mapping[str, Any], *, follow: bool = True) -> dict[str, Any]:
    """The job of making the pack of a point; arguments and errors are those of `recipe_of`."""
    recipe, shape, material = recipe_of(values, follow=follow)
    made = {"recipe": asdict(recipe), "grain": shape, "material": asdict(material)}
    work = grain_steps(recipe, graded(recipe, clump_of(shape)))
    return {"kind": "pack", "name": digest({**made, **sources()}), "work": work, "replicas": 1, **made}


def require_prepared(experiment: Experiment, pack: str) -> None:
    """Refuse an experiment on a pack that was prepared with other values of `FOLLOW`.

    Args:
        experiment: the experiment.
        pack: name of its pack in the sweep.

    Raises:
        ValueError: saying which value differs, and what can be done.
    """
    own = experiment.pack
    asked = {"delta0": experiment.compression, "wall_rigidity": experiment.material.wall_rigidity}
    for name, was in _prepared_with(own).items():
        if not np.allclose(np.asarray(asked[name]), was):
            raise ValueError(
                f"{name} = {np.max(np.asarray(asked[name])):g}, and {pack} was prepared with {was:g}: "
                f"name no pack and have packs made with a table [prepare] (grains = {own.grains}), "
                f"or say {AS_THEY_ARE} = true in [run]"
            )


def _prepared_with(pack: Pack) -> dict[str, float]:
    """The values of `FOLLOW` with which a pack was prepared; an imported pack has no rigidity of walls."""
    material = pack.info.get("material")
    walls = {} if material is None else {"wall_rigidity": float(material["wall_rigidity"])}
    return {"delta0": float(pack.delta0), **walls}
