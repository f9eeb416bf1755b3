"""What the diagnostics in an episode say: the timing on live hardware (period, age of pictures, alignment, limits that
were hit), and by its normalisers how trustworthy the observations are."""

from __future__ import annotations

from typing import Any

import numpy as np

from tacsim.record.episode import Episode

ALIGNMENT, LIMITS = "alignment_", "limits_hit_"  # keys of Step.info, before an arm's name
# Keys of Step.info, before a sensor's name
STALE = "stale_"  # 1: the reference does not fit any more
DRIFT = "drift_"  # change of the untouched gel's colour since the reference [-]
BACKGROUND = "background_"  # mean slope that a drift of the light would look like [degrees]
BEYOND = "beyond_"  # share of the picture whose colours lie beyond the calibrated slopes
KEPT = "kept_"  # share of the markers that were seen
MUCH_BEYOND, FEW_KEPT = 0.01, 0.8  # a warning is given above, and below


def timing(episode: Episode) -> dict[str, Any] | None:
    """Median, 99th percentile and largest of the period and each picture's age [s]; time from each arm's state to the
    nearest package [s]; how often limits shortened or refused a target of each arm; simulated time over wall time.

    None for an episode that was not live.
    """
    done = [step for step in episode.steps if step.index > 0]
    arms = [name.removeprefix(ALIGNMENT) for name in (done[0].info if done else {}) if name.startswith(ALIGNMENT)]
    if len(done) < 2 or not arms:
        return None
    periods = np.diff([step.time for step in done])
    ages = {name: [step.time - step.frames[name].time for step in done] for name in done[0].frames}
    return {
        "period": _spread(periods),
        "asked_period": episode.meta.spec.period,
        "age": {name: _spread(values) for name, values in ages.items()},
        "alignment": {name: _spread([step.info[ALIGNMENT + name] for step in done]) for name in arms},
        "limits_hit": {name: int(done[-1].info.get(LIMITS + name, 0)) for name in arms},
        "real_time_factor": float(episode.meta.spec.period / np.median(periods)),
    }


def _spread(values: Any) -> dict[str, float]:
    median, p99, largest = (float(value) for value in np.percentile(values, [50, 99, 100]))
    return {"median": median, "p99": p99, "max": largest}


def timing_rows(stats: dict[str, Any]) -> list[tuple[str, str]]:
    """:func:`timing` as rows of a table."""
    period = stats["period"]
    ages = "; ".join(
        f"{name} {1e3 * age['median']:.0f} (at most {1e3 * age['max']:.0f}) ms" for name, age in stats["age"].items()
    )
    off = max((spread["max"] for spread in stats["alignment"].values()), default=0.0)
    hits = ", ".join(f"{name} {count}" for name, count in stats["limits_hit"].items())
    return [
        ("period", f"median {period['median']:.3f}, p99 {period['p99']:.3f}, longest {period['max']:.3f} s"),
        ("real-time factor", f"{stats['real_time_factor']:.2f} (periods of {stats['asked_period']:g} s asked)"),
        ("age of pictures", ages or "–"),
        ("arm to picture", f"states at most {1e3 * off:.1f} ms from a package"),
        ("limits hit", hits or "–"),
    ]


def trust(episode: Episode) -> dict[str, dict[str, Any]] | None:
    """By sensor: the number of steps with a stale reference, and the worst of the other values (None where unknown).

    None for an episode whose sensors know their surface by themselves.
    """
    first = episode.steps[0].info if episode.steps else {}
    sensors = [key.removeprefix(STALE) for key in first if key.startswith(STALE)]
    if not sensors:
        return None

    def all_of(key: str) -> list[float]:
        return [step.info[key] for step in episode.steps if key in step.info]

    return {
        name: {
            "stale": sum(bool(value) for value in all_of(STALE + name)),
            "steps": len(all_of(STALE + name)),
            "drift": max(all_of(DRIFT + name), default=None),
            "background": max(all_of(BACKGROUND + name), default=None),
            "beyond": max(all_of(BEYOND + name), default=None),
            "kept": min(all_of(KEPT + name), default=None),
        }
        for name in sensors
    }


def trust_rows(stats: dict[str, dict[str, Any]]) -> list[tuple[str, str]]:
    """Warnings for a person; none where all is well."""
    warnings = []
    for name, worst in stats.items():
        if worst["stale"]:
            most = "" if worst["drift"] is None else f", colour of the untouched gel off by up to {worst['drift']:.0%}"
            warnings.append(
                f"{name}: stale reference in {worst['stale']} of {worst['steps']} observations{most}; the light "
                "has drifted, slopes are less sure: reset for a fresh one, and let the sensor warm up"
            )
        if worst["beyond"] is not None and worst["beyond"] > MUCH_BEYOND:
            warnings.append(
                f"{name}: up to {worst['beyond']:.0%} of the picture beyond the calibrated slopes, height too low "
                "there; calibrate with a deeper press or a smaller ball"
            )
        if worst["kept"] is not None and worst["kept"] < FEW_KEPT:
            warnings.append(f"{name}: only {worst['kept']:.0%} of the markers seen at worst; flow is less sure")
    return [("look at this", warning) for warning in warnings]
