"""What sensors say of themselves, from made-up steps to the words that a person reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacsim.interface import RigSpec, SensorSpec, TactileFrame
from tacsim.record.episode import Episode, EpisodeMeta, Step
from tacsim.record.reader import read_episode
from tacsim.record.writer import Recorder
from tacsim.report.report import summarise, summary_table, write_report
from tacsim.report.series import Series, sensor_diagnostics, sensor_warnings

IMAGE = np.zeros((40, 40, 3), np.uint8)


def episode(*infos: dict[str, float]) -> Episode:
    spec = RigSpec({"left_2": SensorSpec((40, 40), False, False, None)}, (), truth=False, period=0.1)
    steps = [
        Step(
            index=k,
            time=0.1 * k,
            frames={"left_2": TactileFrame(IMAGE, time=0.1 * k, index=k)},
            arms={},
            info={"contact_signal_left_2": 0.0} | info,
        )
        for k, info in enumerate(infos)
    ]
    return Episode(EpisodeMeta("bench", None, "none", 0, spec, {}), steps)


def plain_text(given: Episode) -> dict[str, dict[str, Any]] | None:
    return sensor_diagnostics(Series.from_episode(given))


FINE = {"stale_left_2": 0.0, "drift_left_2": 0.01, "background_left_2": 0.4, "beyond_left_2": 0.0, "kept_left_2": 1.0}
BAD = {"stale_left_2": 1.0, "drift_left_2": 0.12, "background_left_2": 4.25, "beyond_left_2": 0.06, "kept_left_2": 0.5}


def test_worst_values_of_episode_are_reported() -> None:
    config = plain_text(episode(FINE, BAD, FINE))
    assert config == {
        "left_2": {"stale": 1, "steps": 3, "drift": 0.12, "background": 4.25, "beyond": 0.06, "kept": 0.5}
    }
    words = [value for _, value in sensor_warnings(config)]
    assert len(words) == 3 and all(each.startswith("left_2: ") for each in words)
    assert "stale reference in 1 of 3 observations, colour of the untouched gel off by up to 12%" in words[0]
    assert "6% of the picture beyond the calibrated slopes" in words[1]
    assert "only 50% of the markers" in words[2]


def test_no_warning_without_faults_or_without_diagnostics() -> None:
    config = plain_text(episode(FINE, FINE))
    assert config is not None and sensor_warnings(config) == []
    assert plain_text(episode({}, {})) is None and plain_text(episode()) is None
    blind = plain_text(episode({"stale_left_2": 1.0}))  # a sensor without slopes and markers
    assert blind is not None and blind["left_2"]["background"] is None
    assert [value.startswith("left_2: stale reference in 1 of 1") for _, value in sensor_warnings(blind)] == [True]


@pytest.mark.parametrize("infos", [(FINE, FINE), (FINE, BAD)], ids=["fine", "bad"])
def test_it_survives_the_record_and_stands_in_the_report(infos, tmp_path: Path) -> None:
    made = episode(*infos)
    with Recorder(tmp_path / "episode.mcap", made.meta) as recorder:
        for step in made.steps:
            assert recorder.write(step)
    read = read_episode(tmp_path / "episode.mcap")
    assert plain_text(read) == plain_text(made)
    paths = write_report(read, tmp_path / "report")
    assert json.loads(paths["summary.json"].read_text())["trust"] == plain_text(made)
    shown = [str(cell) for cell in summary_table(summarise(Series.from_episode(read)), []).columns[1].cells]
    assert any("stale reference in 1 of 2" in cell for cell in shown) == (BAD in infos)
    assert ("stale reference in 1 of 2" in paths["report.html"].read_text()) == (BAD in infos)
