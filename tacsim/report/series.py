"""An episode as numbers over its steps, read in one pass: the pictures stay in the recording."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray
from tacsim.record.episode import Episode, EpisodeMeta
from tacsim.record.step_info import (
    ARM_KEYS,
    CONTACT_SIGNAL,
    MAX_DEPTH,
    MAX_FLOW,
    MAX_SLOPE,
    SENSOR_KEYS,
    SETTLED,
    TACTILE_DISTANCE,
    TRAINING_DISTANCE,
    TRAINING_KNOWN,
)

_STEP_FIELDS = ("time", "seconds", "reward", "distance")


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Arrays with an entry for each step, in order; NaN where a step has no such number."""

    meta: EpisodeMeta
    index: NDArray[np.int64]
    time: FloatArray  # rig clock [s]
    seconds: FloatArray  # wall time of the step [s]
    reward: FloatArray
    distance: FloatArray  # [m]
    force: dict[str, FloatArray]  # |Fz| by arm: normal force between object and sensor [N]
    exposed: dict[str, FloatArray]  # exposure by sensor, rig clock [s]
    info: dict[str, FloatArray]  # Step.info by key

    @classmethod
    def from_episode(cls, episode: Episode) -> Self:
        """The numbers for a report, of the arms and sensors in the episode's metadata."""
        count, spec = len(episode.steps), episode.meta.spec
        shown = {
            SETTLED,
            TACTILE_DISTANCE,
            TRAINING_DISTANCE,
            TRAINING_KNOWN,
            *(key + name for key in ARM_KEYS for name in spec.arms),
        }
        shown |= {key + name for key in SENSOR_KEYS for name in spec.sensors}
        index = np.zeros(count, np.int64)
        own = {name: np.full(count, np.nan) for name in _STEP_FIELDS}
        force, exposed, info = (_Columns(count, names) for names in (spec.arms, spec.sensors, shown))
        for at, step in enumerate(episode.steps):
            index[at] = step.index
            for name, column in own.items():
                value = getattr(step, name)
                if value is not None and _is_known(value):
                    column[at] = value
            force.set_row(at, {name: abs(float(state.wrench[2])) for name, state in step.arms.items()})
            exposed.set_row(at, step.exposed)
            info.set_row(at, step.info)
        return cls(meta=episode.meta, index=index, force=force.found, exposed=exposed.found, info=info.found, **own)

    def __len__(self) -> int:
        return len(self.index)

    def after_reset(self) -> Series:
        """The control steps, without the state after reset."""
        done = self.index > 0

        def part(group: dict[str, FloatArray]) -> dict[str, FloatArray]:
            return {name: column[done] for name, column in group.items() if not np.isnan(column[done]).all()}

        return Series(
            self.meta,
            self.index[done],
            self.time[done],
            self.seconds[done],
            self.reward[done],
            self.distance[done],
            part(self.force),
            part(self.exposed),
            part(self.info),
        )

    @property
    def sensors(self) -> list[str]:
        """Sensors with pictures, from top to bottom: `upper` first, then by name."""
        return sort_upper_first(self.exposed)

    @property
    def tactile_distance(self) -> FloatArray:
        """The tactile estimate of the distance from the goal [m]."""
        return self.info.get(TACTILE_DISTANCE, np.full(len(self), np.nan))

    @property
    def signals(self) -> dict[str, FloatArray]:
        """The contact signal of every sensor that has one."""
        return self.with_prefix(CONTACT_SIGNAL)

    @property
    def max_depth(self) -> dict[str, FloatArray]:
        """The largest height of every gel whose height is known [m]."""
        return self.with_prefix(MAX_DEPTH)

    @property
    def max_slope(self) -> dict[str, FloatArray]:
        """The largest slope of every gel whose height is known [-]."""
        return self.with_prefix(MAX_SLOPE)

    @property
    def max_flow(self) -> dict[str, FloatArray]:
        """The largest displacement of a marker, of every gel whose flow is known [m]."""
        return self.with_prefix(MAX_FLOW)

    def with_prefix(self, prefix: str) -> dict[str, FloatArray]:
        """Columns of `info` whose keys begin with `prefix`, by the rest of the key."""
        keys = sorted(key for key in self.info if key.startswith(prefix))
        return {key.removeprefix(prefix): self.info[key] for key in keys}

    def steps_with_image(self, sensor: str) -> list[int]:
        """The positions of the steps that have a picture of this sensor."""
        return [int(at) for at in np.flatnonzero(~np.isnan(self.exposed[sensor]))]


class _Columns:
    """Columns of numbers, filled step by step, for some of the `names`."""

    def __init__(self, count: int, names: Collection[str]) -> None:
        self.found: dict[str, FloatArray] = {}
        self._count, self._names = count, set(names)

    def set_row(self, at: int, row: Mapping[str, float]) -> None:
        for name in self._names & row.keys():
            if _is_known(row[name]):
                if name not in self.found:
                    self.found[name] = np.full(self._count, np.nan)
                self.found[name][at] = row[name]


def _is_known(value: float) -> bool:
    max_known = 1e15  # larger values, infinity and NaN in a recording count as unknown
    return abs(value) <= max_known  # False for NaN


def sort_upper_first(names: Iterable[str]) -> list[str]:
    """Names in the order of display: `upper` first, then alphabetical."""
    return sorted(names, key=lambda name: (name != "upper", name))
