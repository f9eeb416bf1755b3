"""Episodes of rigs, simulated again with the truth, come out as they were recorded: frames and signs are right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration.materials.fit import Noise, Point, merge_repeated_readings, signals_of
from robot.studies.identify.recordings import Recordings
from robot.studies.identify.simulation import Simulation
from tacsim.config import load_scene
from tests.robot.cli.invoked import tacsim

PRESS = "lower.x,lower.z\n" + "".join(f"{x},{z}\n" for x, z in ((0, -2e-4), (0, 4e-4), (0, 8e-4), (6e-4, 8e-4)))
SQUEEZE = "upper.x,upper.z,lower.z\n" + "".join(
    f"{x},{z},{y}\n" for x, z, y in ((0, 4e-4, 0), (0, 8e-4, 2e-4), (5e-4, 8e-4, 2e-4), (5e-4, 5e-4, 2e-4))
)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("rig", "scene", "table"), [("press", "press", PRESS), ("sim", "squeeze", SQUEEZE)], ids=["gel", "body"]
)
def test_a_recording_simulated_again(
    rig: str, scene: str, table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("motion.csv").write_text(table)
    words = ("--policy", "motion.csv", "--steps", "4", "--set", "scene.preset=learn", "--out", "runs/one")
    recorded = tacsim("run", rig, *words)
    assert recorded.exit_code == 0, recorded.output
    known = load_scene(scene, ["preset=learn"])
    recordings = Recordings(known)
    press = merge_repeated_readings(recordings.read(Path("runs/one/episode.mcap")))
    assert press.name == "one" and {"lower.fx", "lower.fz", "lower.dent"} <= set(press.readings)
    signals = signals_of([press], Noise())
    [again] = Simulation(known, (), (press,), recordings.sensor_views)([Point(np.zeros(0), np.zeros(1))])
    for index, channel in enumerate(signals.channels):
        rows = signals.channel == index
        size = np.abs(signals.values[rows]).max()
        digits = 1e-4 if ".f" in channel else 1e-5  # [N, m]: what is left of forces that symmetry makes zero
        assert again[rows] == pytest.approx(signals.values[rows], abs=max(0.04 * size, digits)), channel
    assert np.abs(press.readings["lower.fz"]).max() > 0.1
