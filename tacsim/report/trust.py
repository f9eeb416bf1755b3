"""How trustworthy an episode's observations are, by the diagnostics of its normalisers at each step."""

from __future__ import annotations

from typing import Any

from tacsim.record.episode import Episode

# Keys of Step.info, before a sensor's name
STALE = "stale_"  # 1: the reference does not fit any more
DRIFT = "drift_"  # change of the untouched gel's colour since the reference [-]
BACKGROUND = "background_"  # mean slope that a drift of the light would look like [degrees]
BEYOND = "beyond_"  # share of the picture whose colours lie beyond the calibrated slopes
KEPT = "kept_"  # share of the markers that were seen
MUCH_BEYOND, FEW_KEPT = 0.01, 0.8  # a warning is given above, and below


def trust(episode: Episode) -> dict[str, dict[str, Any]] | None:
    """By sensor: the number of steps with a stale reference, and the worst of the other values (None where unknown).

    None for an episode whose sensors know their surface by themselves.
    """
    sensors = [
        key.removeprefix(STALE) for key in (episode.steps[0].info if episode.steps else {}) if key.startswith(STALE)
    ]
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
    rows = []
    for name, worst in stats.items():
        if worst["stale"]:
            most = "" if worst["drift"] is None else f", colour of the untouched gel off by up to {worst['drift']:.0%}"
            rows.append(
                (
                    "look at this",
                    f"{name}: stale reference in {worst['stale']} of {worst['steps']} observations{most}; the light "
                    "has drifted, slopes are less sure: reset for a fresh one, and let the sensor warm up",
                )
            )
        if worst["beyond"] is not None and worst["beyond"] > MUCH_BEYOND:
            rows.append(
                (
                    "look at this",
                    f"{name}: up to {worst['beyond']:.0%} of the picture beyond the calibrated slopes, height too low "
                    "there; calibrate with a deeper press or a smaller ball",
                )
            )
        if worst["kept"] is not None and worst["kept"] < FEW_KEPT:
            rows.append(
                ("look at this", f"{name}: only {worst['kept']:.0%} of the markers seen at worst; flow is less sure")
            )
    return rows
