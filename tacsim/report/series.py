"""An episode as numbers over its steps, gathered in one pass: the pictures stay in the recording."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray
from tacsim.record.episode import Episode, EpisodeMeta

# Keys of Step.info, before an arm's name
ALIGNMENT = "alignment_"  # time from its state to the nearest package [s]
LIMITS = "limits_hit_"  # targets that were shortened or refused so far
LOST = "packages_lost_"  # packages of its controller that are missing in this step
# Keys of Step.info, before a sensor's name
PICTURES_LOST = "pictures_lost_"  # frames of its camera that never arrived, so far
PICTURES_DAMAGED = "pictures_damaged_"  # frames that could not be read, so far
PICTURES_REPEATED = "pictures_repeated_"  # frames that showed the picture of the one before again, so far
SIGNAL = "contact_signal_"
STALE = "stale_"  # 1: the reference does not fit any more
DRIFT = "drift_"  # change of the untouched gel's colour since the reference [-]
BACKGROUND = "background_"  # mean slope that a drift of the light would look like [degrees]
BEYOND = "beyond_"  # share of the picture whose colours lie beyond the calibrated slopes
KEPT = "kept_"  # share of the markers that were seen
DEEPEST = "deepest_"  # of the height of its gel [m]
STEEPEST = "steepest_"  # slope of its gel [-]
LONGEST = "flow_"  # of its markers' displacements [m]
SETTLED = "settled"
TRAINING = "training_distance"  # of what the policy observed from its training's range, over the limit
TRAINING_KNOWN = "training_range_known"  # 0: a learned policy that does not say what it observed in training
FELT = "felt_distance"  # from the goal, by touch alone [m]
_OF_ARMS = (ALIGNMENT, LIMITS, LOST)
_SURFACE = (DEEPEST, STEEPEST, LONGEST)
_OF_SENSORS = (
    SIGNAL,
    *_SURFACE,
    STALE,
    DRIFT,
    BACKGROUND,
    BEYOND,
    KEPT,
    PICTURES_LOST,
    PICTURES_DAMAGED,
    PICTURES_REPEATED,
)
LARGEST = 1e15  # what a recording says beyond that, infinite or not a number, counts as unknown
_OWN = ("time", "seconds", "reward", "distance")


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Arrays with an entry for each step, in order; NaN where a step has no such number."""

    meta: EpisodeMeta
    index: NDArray[np.int64]
    time: FloatArray  # rig clock [s]
    seconds: FloatArray  # wall time of the step [s]
    reward: FloatArray
    distance: FloatArray  # [m]
    force: dict[str, FloatArray]  # |Fz| by arm: how hard object and sensor press on each other [N]
    exposed: dict[str, FloatArray]  # exposure by sensor, rig clock [s]
    info: dict[str, FloatArray]  # Step.info by key

    @classmethod
    def of(cls, episode: Episode) -> Self:
        """The numbers that a report shows, of the arms and sensors that the episode's metadata name."""
        count, spec = len(episode.steps), episode.meta.spec
        shown = {SETTLED, FELT, TRAINING, TRAINING_KNOWN, *(key + name for key in _OF_ARMS for name in spec.arms)}
        shown |= {key + name for key in _OF_SENSORS for name in spec.sensors}
        index = np.zeros(count, np.int64)
        own = {name: np.full(count, np.nan) for name in _OWN}
        force, exposed, info = (_Columns(count, names) for names in (spec.arms, spec.sensors, shown))
        for at, step in enumerate(episode.steps):
            index[at] = step.index
            for name, column in own.items():
                value = getattr(step, name)
                if value is not None and _is_known(value):
                    column[at] = value
            force.put(at, {name: abs(float(state.wrench[2])) for name, state in step.arms.items()})
            exposed.put(at, step.exposed)
            info.put(at, step.info)
        return cls(meta=episode.meta, index=index, force=force.found, exposed=exposed.found, info=info.found, **own)

    def __len__(self) -> int:
        return len(self.index)

    def after_reset(self) -> Series:
        """The control steps alone, without the state after reset."""
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
        """Sensors with pictures, top to bottom as they stand on the bench: `upper` first, then by name."""
        return upper_first(self.exposed)

    @property
    def felt(self) -> FloatArray:
        """The distance from the goal by touch alone [m]."""
        return self.info.get(FELT, np.full(len(self), np.nan))

    @property
    def signals(self) -> dict[str, FloatArray]:
        """The contact signal of every sensor that has one."""
        return self.named(SIGNAL)

    @property
    def deepest(self) -> dict[str, FloatArray]:
        """The deepest point of every gel whose height is known [m]."""
        return self.named(DEEPEST)

    @property
    def steepest(self) -> dict[str, FloatArray]:
        """The steepest slope of every gel whose height is known [-]."""
        return self.named(STEEPEST)

    @property
    def flow(self) -> dict[str, FloatArray]:
        """The longest displacement of a marker, of every gel whose flow is known [m]."""
        return self.named(LONGEST)

    def named(self, prefix: str) -> dict[str, FloatArray]:
        """Columns of `info` whose keys begin so, by the rest of the key."""
        keys = sorted(key for key in self.info if key.startswith(prefix))
        return {key.removeprefix(prefix): self.info[key] for key in keys}

    def seen(self, sensor: str) -> list[int]:
        """The positions of the steps that have a picture of this sensor."""
        return [int(at) for at in np.flatnonzero(~np.isnan(self.exposed[sensor]))]


class _Columns:
    """Columns of numbers that come step by step, under some of the `names`."""

    def __init__(self, count: int, names: Collection[str]) -> None:
        self.found: dict[str, FloatArray] = {}
        self._count, self._names = count, set(names)

    def put(self, at: int, row: Mapping[str, float]) -> None:
        for name in self._names & row.keys():
            if _is_known(row[name]):
                if name not in self.found:
                    self.found[name] = np.full(self._count, np.nan)
                self.found[name][at] = row[name]


def _is_known(value: float) -> bool:
    return abs(value) <= LARGEST  # False for what is not a number


def upper_first(names: Iterable[str]) -> list[str]:
    """Names as they are shown: `upper` first, then by the alphabet."""
    return sorted(names, key=lambda name: (name != "upper", name))
