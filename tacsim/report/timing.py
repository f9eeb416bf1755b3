"""Timing of an episode on live hardware: period, age of pictures, alignment, limits that were hit."""

from __future__ import annotations

from typing import Any

import numpy as np

from tacsim.record.episode import Episode

ALIGNMENT, LIMITS = "alignment_", "limits_hit_"  # keys of Step.info, before an arm's name


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
