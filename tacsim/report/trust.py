"""How far an episode's observations are to be trusted, by what their sensors said of themselves at each step."""

from __future__ import annotations

from typing import Any

from tacsim.record.episode import Episode

STALE = "stale_"  # 1: the reference does not fit any more; beginnings of names in Step.info, before a sensor's name
DRIFT = "drift_"  # change of the untouched gel's colour since the reference [-]
BACKGROUND = "background_"  # mean slope that the drift of the light would be taken for [degrees]
BEYOND = "beyond_"  # share of the picture whose colours lie beyond the calibrated slopes
KEPT = "kept_"  # share of the markers that were seen
MUCH_BEYOND = 0.01  # worth a word
FEW_KEPT = 0.8


def trust(episode: Episode) -> dict[str, dict[str, Any]] | None:
    """By sensor: in how many steps its reference was stale, and the worst of the rest (null where not told).

    None for an episode whose sensors know their surface by themselves: nothing had to be found in pictures.
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
    """What a person should look at; nothing where all is well."""
    rows = []
    for name, told in stats.items():
        if told["stale"]:
            most = "" if told["drift"] is None else f", colour of the untouched gel off by up to {told['drift']:.0%}"
            rows.append(
                (
                    "look at this",
                    f"{name}: stale reference in {told['stale']} of {told['steps']} observations{most}; the light has "
                    "drifted, slopes are less sure: reset for a fresh one, and let the sensor warm up",
                )
            )
        if told["beyond"] is not None and told["beyond"] > MUCH_BEYOND:
            rows.append(
                (
                    "look at this",
                    f"{name}: up to {told['beyond']:.0%} of the picture beyond the calibrated slopes, height too low "
                    "there; calibrate with a deeper press or a smaller ball",
                )
            )
        if told["kept"] is not None and told["kept"] < FEW_KEPT:
            rows.append(
                ("look at this", f"{name}: only {told['kept']:.0%} of the markers seen at worst; flow is less sure")
            )
    return rows
