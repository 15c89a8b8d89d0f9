"""Protocols: stages one after the other, and which of them write, read and come first."""

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from gmem_jax.physics.pytree import static_record
from gmem_jax.simulation.channels import CHANNELS
from gmem_jax.simulation.stage import Columns, Drive, Role, Stage, columns_of


@static_record
@dataclass(frozen=True, init=False)
class Protocol:
    """Stages one after the other.

    Args:
        stages: stages, or tuples of them, as `gm.cycle` and `gm.train` return. A stage without `start` begins at the u
            at which the one before ends; the first begins at u = 0. If several stages have one name, the second becomes
            NAME-2, and so on.

    Raises:
        ValueError: if there is no stage, the walls would jump from one stage to the next, a waveform would not end at
            zero, or a stage reads what was not written before.
    """

    stages: tuple[Stage, ...]

    def __init__(self, *stages: Stage | Iterable[Any]) -> None:
        u, made, names, given = 0.0, list[Stage](), Counter[str](), list(_flat(stages))
        taken = {stage.name for stage in given}
        for stage in given:
            names[stage.name] += 1
            name, number = stage.name, names[stage.name]
            while number > 1 and (name := f"{stage.name}-{number}") in taken:
                number += 1
            taken.add(name)
            start = u if stage.start is None else float(stage.start)
            if made and start != u:
                raise ValueError(
                    f"the walls would jump: stage {made[-1].name!r} ends at u = {u:g}, and {name!r} begins at "
                    f"u = {start:g}"
                )
            u = start if stage.stop is None else float(stage.stop)
            made.append(replace(stage, name=name, start=start, stop=u))
            _require_closed(made[-1])
        if not made:
            raise ValueError("a protocol has at least one stage")
        object.__setattr__(self, "stages", tuple(made))
        self._require_readable()

    def _require_readable(self) -> None:
        for place, stage in enumerate(self.stages):
            if stage.role != "read":
                continue
            before = [earlier for earlier in self.stages[:place] if earlier.role == "write"]
            if not before:
                raise ValueError(f"stage {stage.name!r} reads before anything was written")
            if stage.of is not None and stage.of not in [earlier.name for earlier in before]:
                raise ValueError(
                    f"stage {stage.name!r} is compared with {stage.of!r}, and what was written before it is "
                    f"{', '.join(earlier.name for earlier in before)}"
                )

    def __iter__(self) -> Iterator[Stage]:
        return iter(self.stages)

    def __len__(self) -> int:
        return len(self.stages)

    @property
    def bins(self) -> int:
        """Number of bins of all stages."""
        return sum(stage.bins for stage in self.stages)

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the stages that read."""
        return tuple(stage.name for stage in self.stages if stage.role == "read")

    @property
    def before_read(self) -> str:
        """Name of the stage before the first that reads. The grain speeds at its end are `Recall.residual_speed`."""
        return self.stages[max(0, self._place("read") - 1)].name

    @property
    def first_memory(self) -> tuple[str, ...]:
        """Names of the stages from the first that writes to the first that reads."""
        return tuple(stage.name for stage in self.stages[self._place("write") : self._place("read") + 1])

    def stage(self, name: str) -> Stage:
        """The stage of this name.

        Raises:
            KeyError: if there is none.
        """
        return {stage.name: stage for stage in self.stages}[name]

    def _place(self, role: Role) -> int:
        for place, stage in enumerate(self.stages):
            if stage.role == role:
                return place
        raise ValueError(f"the protocol has no stage whose role is {role!r}")

    @property
    def phases(self) -> tuple[tuple[Stage, ...], tuple[Stage, ...]]:
        """The stages before the first with a waveform, which are run once for all replicas; and those from it on."""
        common = tuple(itertools.takewhile(lambda stage: not stage.drives, self.stages))
        return common, self.stages[len(common) :]

    @property
    def begins(self) -> dict[str, int]:
        """Number of bins before each stage, by name."""
        firsts = itertools.accumulate((stage.bins for stage in self.stages), initial=0)
        return {stage.name: first for stage, first in zip(self.stages, firsts, strict=False)}

    @property
    def columns(self) -> Columns:
        """The columns of its table of bins."""
        return columns_of(self.stages)

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels on which replicas write waveforms of their own, in the order of `CHANNELS`."""
        written = {drive.channel for stage in self.stages if stage.role == "write" for drive in stage.own}
        return tuple(channel for channel in CHANNELS if channel in written)

    def written(self, read: str) -> dict[str, Drive]:
        """The drives with which a stage that reads is compared, by channel: of its stage `of`, or the last before it.

        Raises:
            ValueError: if there is no stage of this name.
        """
        place = [stage.name for stage in self.stages].index(read)
        of = self.stages[place].of
        before = [stage for stage in self.stages[:place] if stage.role == "write" and of in (None, stage.name)]
        return {drive.channel: drive for stage in before for drive in stage.own}

    def with_sets(self, names: Iterable[str]) -> "Protocol":
        """The same protocol, in which every drive has a channel and one of the sets of waveforms with these names.

        Raises:
            ValueError: if a drive names a set that does not exist, or no set has the name of a channel.
        """
        names = tuple(names)
        return Protocol(replace(stage, drives=_named_drives(stage, names)) for stage in self.stages)

    def with_value(self, path: str, value: Any) -> "Protocol":
        """The same protocol with another value of one field of a stage.

        Args:
            path: stage and field, like "store.length"; "amplitude" is that of all drives of the stage.
            value: the new value.

        Raises:
            ValueError: if there is no such stage or field, or the new protocol is impossible.
        """
        name, _, field = path.rpartition(".")
        known = [entry.name for entry in fields(Stage)]
        if name not in [stage.name for stage in self.stages]:
            raise ValueError(f"the protocol has no stage {name!r}; it has {', '.join(s.name for s in self.stages)}")
        if field == "amplitude":
            return Protocol(
                replace(s, drives=tuple(replace(d, amplitude=value) for d in s.drives)) if s.name == name else s
                for s in self.stages
            )
        if field not in known:
            raise ValueError(f"a stage has no {field!r}; it has {', '.join(known)} and amplitude")
        return Protocol(replace(s, **{field: value}) if s.name == name else s for s in self.stages)

    def to_list(self) -> list[dict[str, Any]]:
        """The stages as dictionaries that JSON can hold, without fields that have their default."""
        return [_without_defaults(stage) for stage in self.stages]

    @classmethod
    def from_list(cls, stages: Iterable[Mapping[str, Any]]) -> "Protocol":
        """The protocol whose `to_list` this is.

        Raises:
            ValueError: if a stage has unknown fields, two stages have one name, or they make no protocol.
        """
        try:
            made = [
                Stage(**{**stage, "drives": tuple(Drive(**drive) for drive in stage.get("drives", ()))})
                for stage in stages
            ]
        except (TypeError, AttributeError) as error:
            raise ValueError(f"not the stages of a protocol: {error}") from None
        name, times = Counter(stage.name for stage in made).most_common(1)[0] if made else ("", 0)
        if times > 1:
            raise ValueError(f"the stages of a protocol have different names; {name!r} is there {times} times")
        return cls(*made)


def _flat(parts: Iterable[Any]) -> Iterator[Stage]:
    for part in parts:
        if isinstance(part, Stage):
            yield part
        elif isinstance(part, Iterable) and not isinstance(part, str | Mapping):
            yield from _flat(part)
        else:
            raise ValueError(f"a protocol is made of stages, as gm.cycle() and gm.hold(2.0) give; got {part!r}")


def _require_closed(stage: Stage) -> None:
    """Refuse a stage at whose ends a waveform does not vanish: the walls would jump there."""
    ends = {stage.start, stage.stop}
    if stage.moves and stage.length == 0.0:
        raise ValueError(f"the walls would jump: stage {stage.name!r} changes u in no time")
    if stage.drives and not stage.timed and not ends <= {0.0, 1.0}:
        raise ValueError(
            f"stage {stage.name!r} goes from u = {stage.start:g} to {stage.stop:g}, and waveforms vanish only at u = 0 "
            "and 1: use along='time', by which a waveform is gone through from its beginning to its end"
        )


def _named_drives(stage: Stage, names: tuple[str, ...]) -> tuple[Drive, ...]:
    """The drives of a stage, each with its channel and set of waveforms."""
    found: list[Drive] = []
    for drive in stage.drives:
        if drive.fixed:
            found.append(drive)
            continue
        wanted = (drive.waveform,) if drive.waveform else tuple(name for name in names if name in CHANNELS)
        if not drive.waveform and drive.channel:
            wanted = (drive.channel,) if drive.channel in names else names[:1]
        if not wanted or any(name not in names for name in wanted):
            raise ValueError(
                f"stage {stage.name!r} writes {drive.waveform or 'the sets called like a channel'!r}, and the sets of "
                f"waveforms are {', '.join(names)}"
            )
        for name in map(str, wanted):
            channel = drive.channel or (name if name in CHANNELS else "xy")
            found.append(replace(drive, channel=channel, waveform=name))
    return tuple(found)


def _without_defaults(made: Any) -> dict[str, Any]:
    kept = {entry.name: getattr(made, entry.name) for entry in fields(made)}
    kept = {e.name: kept[e.name] for e in fields(made) if e.name in _ALWAYS or kept[e.name] != e.default}
    if "drives" in kept:
        kept["drives"] = [_without_defaults(drive) for drive in kept["drives"]]
    return {name: list(value) if isinstance(value, tuple) else value for name, value in kept.items()}


_ALWAYS = ("name", "start", "stop", "length", "role")
