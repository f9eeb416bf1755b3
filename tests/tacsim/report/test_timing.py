"""How an episode kept time, from made-up steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tacsim.interface import RigSpec, SensorSpec, TactileFrame
from tacsim.record.episode import Episode, EpisodeMeta, Step
from tacsim.report.series import Series, timing_rows, timing_statistics

FRAMES = {"pictures_lost_lower": 0.0, "pictures_damaged_lower": 3.0}
IMAGE = np.zeros((4, 4, 3), np.uint8)


def episode(times: list[float], age: float = 0.03, live: bool = True) -> Episode:
    spec = RigSpec({"lower": SensorSpec((4, 4), False, False, "left")}, ("left",), truth=False, period=0.1)
    steps = [
        Step(
            index=k,
            time=time,
            frames={"lower": TactileFrame(IMAGE, time=time - age, index=k)},
            arms={},
            info={"alignment_left": 1e-3 * k, "limits_hit_left": float(2 * k), **FRAMES} if live else {},
        )
        for k, time in enumerate(times)
    ]
    return Episode(EpisodeMeta("bench", None, "none", 0, spec, {}), steps)


def plain_text(given: Episode) -> dict[str, Any] | None:
    return timing_statistics(Series.from_episode(given))


def test_period_age_alignment_and_limits() -> None:
    config = plain_text(episode([50.0, 50.1, 50.2, 50.3, 50.7]))
    assert config is not None
    assert config["period"]["median"] == pytest.approx(0.1)
    assert config["period"]["max"] == pytest.approx(0.4)
    assert config["age"]["lower"]["median"] == pytest.approx(0.03)
    assert config["alignment"]["left"]["max"] == pytest.approx(4e-3)
    assert config["limits_hit"] == {"left": 8}  # counted on, not summed up
    assert config["real_time_factor"] == pytest.approx(1.0)
    words = dict(timing_rows(config))
    assert words["age of pictures"] == "lower 30 (at most 30) ms"
    assert "4.0 ms" in words["arm to picture"] and words["limits hit"] == "left 8"
    assert words["pictures damaged"] == "lower 3" and "pictures lost" not in words


def test_a_slow_twin_shows_in_the_real_time_factor() -> None:
    config = plain_text(episode([0.0, 0.4, 0.8, 1.2]))
    assert config is not None and config["real_time_factor"] == pytest.approx(0.25)


def test_what_is_not_live_has_no_timing() -> None:
    assert plain_text(episode([0.0, 0.1, 0.2], live=False)) is None
    assert plain_text(replace_steps(episode([0.0, 0.1, 0.2]), 1)) is None


def replace_steps(given: Episode, number: int) -> Episode:
    return replace(given, steps=given.steps[:number])
