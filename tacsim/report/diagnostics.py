"""What the diagnostics in an episode say: the timing on live hardware (period, age of pictures, alignment, limits that
were hit), and by its normalisers how trustworthy the observations are."""

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
    MARKERS_SEEN,
    PACKAGES_LOST,
    PICTURES_DAMAGED,
    PICTURES_LOST,
    PICTURES_REPEATED,
    STALE_REFERENCE,
    TRAINING_DISTANCE,
    TRAINING_KNOWN,
)
from tacsim.report.series import Series

PICTURES = {"lost": PICTURES_LOST, "damaged": PICTURES_DAMAGED, "shown again": PICTURES_REPEATED}


def timing(series: Series) -> dict[str, Any] | None:
    """Median, 99th percentile and largest of the period and each picture's age [s]; time from each arm's state to the
    nearest package [s]; how often limits shortened or refused a target of each arm; packages of each arm that are
    missing where they are recorded; frames of each camera that were lost, damaged, or showed a picture again; simulated
    time over wall time.

    None for an episode that was not live.
    """
    done = series.after_reset()
    arms = done.named(ALIGNMENT)
    if len(done) < 2 or not arms:
        return None
    periods = np.diff(done.time)
    median = _spread(periods)["median"]
    return {
        "period": _spread(periods),
        "asked_period": done.meta.spec.period,
        "age": {name: _spread(done.time - exposed) for name, exposed in done.exposed.items()},
        "alignment": {name: _spread(values) for name, values in arms.items()},
        "limits_hit": {name: _newest(done.info.get(LIMITS_HIT + name)) for name in arms},
        "packages_lost": {name: int(np.nansum(values)) for name, values in done.named(PACKAGES_LOST).items()},
        "pictures": {
            word: {name: _newest(values) for name, values in done.named(key).items()} for word, key in PICTURES.items()
        },
        "real_time_factor": done.meta.spec.period / median if median > 0.0 else 0.0,
    }


def _newest(counted: FloatArray | None) -> int:
    """The last of numbers that are counted on."""
    if counted is None or not np.isfinite(counted).any():
        return 0
    return int(counted[np.isfinite(counted)][-1])


def _spread(values: FloatArray) -> dict[str, float]:
    known = values[np.isfinite(values)]
    median, p99, largest = (float(value) for value in np.percentile(known if len(known) else [0.0], [50, 99, 100]))
    return {"median": median, "p99": p99, "max": largest}


def timing_rows(stats: dict[str, Any]) -> list[tuple[str, str]]:
    """:func:`timing` as rows of a table."""
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


def training_range(series: Series) -> dict[str, Any] | None:
    """Whether what a learned policy observed lies in the range of its training: `known`, `largest` distance over the
    limit, and the number of `steps_outside`. None for a policy that is not learned."""
    distance = series.info.get(TRAINING_DISTANCE, np.array([]))
    distance = distance[np.isfinite(distance)]
    if len(distance):
        outside = int(np.count_nonzero(distance > 1.0))
        return {"known": True, "largest": float(distance.max()), "steps_outside": outside, "steps": len(distance)}
    unknown = np.isfinite(series.info.get(TRAINING_KNOWN, np.array([]))).any()
    return {"known": False, "largest": None, "steps_outside": None, "steps": None} if unknown else None


def training_rows(stats: dict[str, Any]) -> list[tuple[str, str]]:
    """:func:`training_range` as rows of a table."""
    if not stats["known"]:
        return [("training range", "unknown: the policy does not say what it observed in training")]
    if not stats["steps_outside"]:
        return [("training range", f"kept (at most {stats['largest']:.2f} of the limit)")]
    words = (
        f"left in {stats['steps_outside']} of {stats['steps']} steps, by up to {stats['largest']:.1f} times the limit"
    )
    return [("training range", f"{words}; the policy has not learned what to do there")]


def trust(series: Series) -> dict[str, dict[str, Any]] | None:
    """By sensor: the number of steps with a stale reference, and the worst of the other values (None where unknown).

    None for an episode whose sensors know their surface by themselves.
    """
    stale = series.named(STALE_REFERENCE)
    if not stale:
        return None

    def worst(key: str, of: Callable[[FloatArray], float]) -> float | None:
        values = series.info.get(key, np.array([]))
        known = values[np.isfinite(values)]
        return float(of(known)) if len(known) else None

    return {
        name: {
            "stale": int(np.count_nonzero(np.nan_to_num(told))),
            "steps": int(np.count_nonzero(~np.isnan(told))),
            "drift": worst(COLOUR_DRIFT + name, np.max),
            "background": worst(BACKGROUND_SLOPE + name, np.max),
            "beyond": worst(COLOURS_OUT_OF_RANGE + name, np.max),
            "kept": worst(MARKERS_SEEN + name, np.min),
        }
        for name, told in stale.items()
    }


def trust_rows(stats: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Warnings for a person; none where all is well."""
    max_beyond, min_kept = 0.01, 0.8  # a warning is given above, and below
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
        if worst["kept"] is not None and worst["kept"] < min_kept:
            warnings.append(f"{name}: only {worst['kept']:.0%} of the markers seen at worst; flow is less sure")
    return [("look at this", warning) for warning in warnings]
