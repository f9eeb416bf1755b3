"""Diagnostics of an episode: timing on live hardware (period, age of pictures, alignment, limits), and reliability of
the observations from its normalisers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tacsim.interface import FloatArray
from tacsim.record.step_info import (
    ALIGNMENT,
    BACKGROUND_SLOPE,
    COLOUR_DRIFT,
    COLOURS_OUT_OF_RANGE,
    LIMITS_HIT,
    PACKAGES_LOST,
    PICTURES_DAMAGED,
    PICTURES_LOST,
    PICTURES_REPEATED,
    STALE_REFERENCE,
    TRAINING_DISTANCE,
    TRAINING_KNOWN,
    VISIBLE_MARKERS,
)
from tacsim.report.series import Series

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
