"""The validated configuration of a recall, as given on the command line and stored with the result."""

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from gmem_jax import native
from gmem_jax.experiment.pack import Pack
from gmem_jax.experiment.signals import LONGEST_WORD, Signals, six_signals, waveform, words
from gmem_jax.files.provenance import provenance
from gmem_jax.files.storage import load_waveforms
from gmem_jax.physics.contact.friction import FrictionLaw
from gmem_jax.physics.contact.hooke import Hooke
from gmem_jax.physics.contact.mindlin import Mindlin
from gmem_jax.physics.contact.mindlin_rescaled import MindlinRescaled
from gmem_jax.physics.material import Material


class RecallConfig(BaseModel):
    """One `gmem recall`: times in t_c (lengths of holds in t0), stiffness in E R."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    pack: str
    signals: str = "six"
    friction: Literal["hooke", "m1", "m2"] = "hooke"
    mu: float = Field(1.0, ge=0.0)
    stiffness: float | None = Field(None, gt=0.0)
    p_max: float = Field(0.2, gt=0.0)
    points: int = Field(100, ge=3)
    delta0: float | None = Field(None, gt=0.0, lt=0.5)
    gamma0: float = Field(1e-3, gt=0.0, lt=0.5)
    t0: float = Field(1.8e3, gt=0.0)
    dt: float = Field(0.3, gt=0.0, le=0.5)
    backend: Literal["auto", "jax", "native"] = "auto"
    background: Literal["sub0", "sub2", "sub2-bl"] = "sub0"
    rest: float = Field(0.2, ge=0.0)
    hold: float = Field(0.2, ge=0.0)
    store: float = Field(2.0, ge=0.0)
    hold_drag: float | None = Field(None, ge=0.0)
    batch: int | None = Field(None, ge=1)

    @field_validator("signals")
    @classmethod
    def _known_signals(cls, value: str) -> str:
        kind, _, length = value.partition(":")
        if kind == "words":
            if not length.isdecimal() or not 1 <= int(length) <= LONGEST_WORD:
                raise ValueError(f"words need a length from 1 to {LONGEST_WORD}, as in words:3")
        elif value != "six" and Path(value).suffix.lower() not in (".csv", ".npy"):
            raise ValueError('must be "six", "words:L" or a .csv or .npy file')
        return value

    def waveforms(self) -> Signals:
        """The signals named; reads the file if it is one."""
        if self.signals == "six":
            return six_signals()
        kind, _, length = self.signals.partition(":")
        return words(int(length)) if kind == "words" else waveform(load_waveforms(Path(self.signals)))

    def law(self) -> FrictionLaw:
        """The friction law."""
        own: dict[str, Any] = {} if self.stiffness is None else {"stiffness": self.stiffness}
        if self.friction == "m1":
            return MindlinRescaled(mu=self.mu, **own)
        if self.friction == "m2":
            return Mindlin(mu=self.mu, p_max=self.p_max, points=self.points, **own)
        return Hooke(mu=self.mu, **own)

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of `run_memory`."""
        names = ("delta0", "gamma0", "t0", "dt", "background", "backend", "rest", "hold", "store", "hold_drag")
        return {"friction": self.law(), **{name: getattr(self, name) for name in names}}

    def key(self, pack: Pack, batch: int) -> dict[str, Any]:
        """What the numbers of the run depend on, and no more: for parts of a run that may be resumed."""
        fields = self.model_dump(exclude={"pack", "batch", "backend"})
        content = hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(pack))).hexdigest()
        facts = provenance()
        same = {"versions": facts["versions"], "commit": facts["commit"]}
        return {**fields, "batch": batch, "pack": content, "backend": native.name(self.backend, self.law()), **same}

    def resolved(self, pack: Pack, seconds: float) -> dict[str, Any]:
        """All that is needed to repeat the run, for the file."""
        return {
            **self.model_dump(),
            "delta0": self.delta0 if self.delta0 is not None else float(pack.delta0),
            "grains": pack.grains,
            "grain": {
                "shape": pack.clump.shape,
                "mass": float(pack.clump.mass),
                "diameter": float(pack.clump.diameter),
            },
            "law": repr(self.law()),
            "pack_record": pack.info,
            "material": asdict(Material()),
            "seconds": seconds,
            **provenance(),
            "backend": native.name(self.backend, self.law()),
        }
