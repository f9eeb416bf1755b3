"""An episode as numbers over its steps, read in one pass: the pictures stay in the recording. And diagnostics of them:
timing on live hardware (period, age of pictures, alignment, limits), and reliability of the observations."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray
from tacsim.record.episode import (
    ALIGNMENT,
    ARM_KEYS,
    BACKGROUND_SLOPE,
    COLOUR_DRIFT,
    COLOURS_OUT_OF_RANGE,
    CONTACT_SIGNAL,
    LIMITS_HIT,
    MAX_DEPTH,
    MAX_FLOW,
    MAX_SLOPE,
    PACKAGES_LOST,
    PICTURES_DAMAGED,
    PICTURES_LOST,
    PICTURES_REPEATED,
    SENSOR_KEYS,
    SETTLED,
    STALE_REFERENCE,
    TACTILE_DISTANCE,
    TRAINING_DISTANCE,
    TRAINING_KNOWN,
    VISIBLE_MARKERS,
    Episode,
    EpisodeMeta,
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


PICTURES = {"lost": PICTURES_LOST, "damaged": PICTURES_DAMAGED, "shown again": PICTURES_REPEATED}


def timing_statistics(series: Series) -> dict[str, Any] | None:
    """Median, 99th percentile and largest value of the period and of each picture's age [s]; time from each arm's state
    to the nearest package [s]; number of targets of each arm that limits shortened or refused; number of missing
    packages of each arm, if they are recorded; number of frames of each camera that were lost, damaged, or repeated;
    simulated time over wall time.

    None for an episode that was not live.
    """
    done = series.after_reset()
    arms = done.with_prefix(ALIGNMENT)
    if len(done) < 2 or not arms:
        return None
    periods = np.diff(done.time)
    median = _percentiles(periods)["median"]
    return {
        "period": _percentiles(periods),
        "asked_period": done.meta.spec.period,
        "age": {name: _percentiles(done.time - exposed) for name, exposed in done.exposed.items()},
        "alignment": {name: _percentiles(values) for name, values in arms.items()},
        "limits_hit": {name: _last_known(done.info.get(LIMITS_HIT + name)) for name in arms},
        "packages_lost": {name: int(np.nansum(values)) for name, values in done.with_prefix(PACKAGES_LOST).items()},
        "pictures": {
            word: {name: _last_known(values) for name, values in done.with_prefix(key).items()}
            for word, key in PICTURES.items()
        },
        "real_time_factor": done.meta.spec.period / median if median > 0.0 else 0.0,
    }


def _last_known(counted: FloatArray | None) -> int:
    """The last known value of a counter."""
    if counted is None or not np.isfinite(counted).any():
        return 0
    return int(counted[np.isfinite(counted)][-1])


def _percentiles(values: FloatArray) -> dict[str, float]:
    known = values[np.isfinite(values)]
    median, p99, largest = (float(value) for value in np.percentile(known if len(known) else [0.0], [50, 99, 100]))
    return {"median": median, "p99": p99, "max": largest}


def timing_rows(stats: dict[str, Any]) -> list[tuple[str, str]]:
    """:func:`timing_statistics` as rows of a table."""
    period = stats["period"]
    ages = "; ".join(
        f"{name} {1e3 * age['median']:.0f} (at most {1e3 * age['max']:.0f}) ms" for name, age in stats["age"].items()
    )
    off = max((spread["max"] for spread in stats["alignment"].values()), default=0.0)
    hits, lost = (
        ", ".join(f"{name} {count}" for name, count in stats[key].items()) for key in ("limits_hit", "packages_lost")
    )
    rows = [
        ("period", f"median {period['median']:.3f}, p99 {period['p99']:.3f}, longest {period['max']:.3f} s"),
        ("real-time factor", f"{stats['real_time_factor']:.2f} (periods of {stats['asked_period']:g} s asked)"),
        ("age of pictures", ages or "–"),
        ("arm to picture", f"states at most {1e3 * off:.1f} ms from a package"),
        ("limits hit", hits or "–"),
    ]
    if lost:
        rows.append(("arm packages lost", lost))
    for word, counts in stats["pictures"].items():
        if any(counts.values()):
            rows.append((f"pictures {word}", ", ".join(f"{name} {count}" for name, count in counts.items())))
    return rows


def training_range_statistics(series: Series) -> dict[str, Any] | None:
    """Distance of a learned policy's observations from its training range: `known`, `largest` distance over the limit,
    and number of `steps_outside`. None for a policy that is not learned."""
    distance = series.info.get(TRAINING_DISTANCE, np.array([]))
    distance = distance[np.isfinite(distance)]
    if len(distance):
        outside = int(np.count_nonzero(distance > 1.0))
        return {"known": True, "largest": float(distance.max()), "steps_outside": outside, "steps": len(distance)}
    unknown = np.isfinite(series.info.get(TRAINING_KNOWN, np.array([]))).any()
    return {"known": False, "largest": None, "steps_outside": None, "steps": None} if unknown else None


def training_rows(stats: dict[str, Any]) -> list[tuple[str, str]]:
    """:func:`training_range_statistics` as rows of a table."""
    if not stats["known"]:
        return [("training range", "unknown: the policy does not say what it observed in training")]
    if not stats["steps_outside"]:
        return [("training range", f"kept (at most {stats['largest']:.2f} of the limit)")]
    words = (
        f"left in {stats['steps_outside']} of {stats['steps']} steps, by up to {stats['largest']:.1f} times the limit"
    )
    return [("training range", f"{words}; the policy has not learned what to do there")]


def sensor_diagnostics(series: Series) -> dict[str, dict[str, Any]] | None:
    """By sensor: the number of steps with a stale reference, and the worst of the other values (None if unknown).

    None for an episode whose sensors give their surface directly.
    """
    stale = series.with_prefix(STALE_REFERENCE)
    if not stale:
        return None

    def worst(key: str, of: Callable[[FloatArray], float]) -> float | None:
        values = series.info.get(key, np.array([]))
        known = values[np.isfinite(values)]
        return float(of(known)) if len(known) else None

    return {
        name: {
            "stale": int(np.count_nonzero(np.nan_to_num(flags))),
            "steps": int(np.count_nonzero(~np.isnan(flags))),
            "drift": worst(COLOUR_DRIFT + name, np.max),
            "background": worst(BACKGROUND_SLOPE + name, np.max),
            "beyond": worst(COLOURS_OUT_OF_RANGE + name, np.max),
            "kept": worst(VISIBLE_MARKERS + name, np.min),
        }
        for name, flags in stale.items()
    }


def sensor_warnings(stats: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Warnings for the user; empty if there are none."""
    max_beyond, min_visible = 0.01, 0.8  # limits of the warnings
    warnings = []
    for name, worst in stats.items():
        if worst["stale"]:
            most = "" if worst["drift"] is None else f", colour of the untouched gel off by up to {worst['drift']:.0%}"
            warnings.append(
                f"{name}: stale reference in {worst['stale']} of {worst['steps']} observations{most}; the light "
                "has drifted, slopes are less sure: reset for a fresh one, and let the sensor warm up"
            )
        if worst["beyond"] is not None and worst["beyond"] > max_beyond:
            warnings.append(
                f"{name}: up to {worst['beyond']:.0%} of the picture beyond the calibrated slopes, height too low "
                "there; calibrate with a deeper press or a smaller ball"
            )
        if worst["kept"] is not None and worst["kept"] < min_visible:
            warnings.append(f"{name}: only {worst['kept']:.0%} of the markers seen at worst; flow is less sure")
    return [("look at this", warning) for warning in warnings]
