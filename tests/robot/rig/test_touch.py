"""The approach of real arms: at its declared speed, and with the gels pressed no deeper than camera and speed allow."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from robot.arm.channel import HISTORY, Record
from robot.arm.trajectory import PERIOD
from robot.camera.camera import StaleFrame
from robot.camera.driver import CameraDriver
from robot.open import open_rig
from robot.rig import reset
from robot.rig.commanded_arm import CommandedArm
from tacsim.interface import TactileSource
from tacsim.rig import Rig
from tests.robot.cli.lab import Lab, copy_of

if find_spec("rtde_control") is None:
    pytest.skip("ur_rtde has no wheel for this Python and machine", allow_module_level=True)

pytestmark = pytest.mark.usefixtures("no_pause")
SPEED = 2e-3  # as shipped [m/s]
LATEST = 0.75  # no picture for 2.5 periods of 0.1 s, no action for 0.2 s: then the arm waits; and its own lag [s]


@dataclass
class Opened:
    lab: Lab
    rig: Rig
    reports: list[str] = field(default_factory=list)

    @property
    def arm(self) -> CommandedArm:
        arm = self.rig.arms["arm"]
        assert isinstance(arm, CommandedArm)
        return arm

    @property
    def depth(self) -> float:
        return self.lab.depth("arm", self.lab.faults["arm"].state().pose)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    file = copy_of("ur5e-one", tmp_path_factory.mktemp("rig"), 65)
    reports: list[str] = []
    with Lab(file) as lab, open_rig(file, confirm=lambda question: True, report=reports.append) as rig:
        yield Opened(lab, rig, reports)


@pytest.mark.deep
def test_approach_keeps_its_speed_and_stops_at_contact(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    states, tell = opened.arm.driver._channel.states, opened.rig._reset._report  # type: ignore[attr-defined]
    looks: list[Record] = []

    def look(words: str) -> None:
        if words.startswith("approach"):
            looks.append(states.recent(HISTORY))
        tell(words)

    monkeypatch.setattr(opened.rig._reset, "_report", look)
    opened.rig.reset()
    depth = opened.depth
    # By the periods of the arm's own loop: neither a busy machine nor a controller that misses ticks on it changes how
    # far the arm is sent in a period.
    records = np.concatenate([*looks, states.recent(HISTORY)])
    records = records[np.unique(records["cycles"], return_index=True)[1]]
    records = records[records["cycles"] > looks[0]["cycles"][-1]]
    periods = np.diff(records["cycles"]) * PERIOD
    speeds = np.linalg.norm(np.diff(records["target"], axis=0), axis=1) / periods
    speeds = speeds[: np.flatnonzero(speeds)[-1]]  # until it stopped
    print(f"{1e3 * speeds.mean():.2f} mm/s on the mean of {periods.sum():.1f} s; depth {1e3 * depth:.3f} mm")
    assert speeds.max() <= SPEED * 1.001
    assert (speeds > 0.999 * SPEED).mean() > 0.2  # it waits only where no pictures come: more often on a busy machine
    assert 0.0 < depth < SPEED * LATEST
    assert any("mm of at most 40 mm" in words for words in opened.reports)


@pytest.mark.deep
def test_approach_without_images_waits_then_fails(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera falls silent a millimetre on, three before the touch."""
    camera, faults = opened.lab.cameras["finger"], opened.lab.faults["arm"]
    places: list[float] = []

    def stall(words: str) -> None:
        if not places and (found := re.match(r"approach: ([\d.]+) mm", words)) and float(found[1]) > 1.0:
            camera.stall(True)
            places.append(opened.depth)

    monkeypatch.setattr(opened.rig._reset, "_report", stall)
    try:
        with pytest.raises(StaleFrame):
            opened.rig.reset()
    finally:
        camera.stall(False)
    assert faults.state().rests
    assert opened.depth < places[0] + SPEED * LATEST < 0.0


def test_too_fast_approach_speed_is_refused(tmp_path: Path) -> None:
    """Before anything is opened: nothing answers at these addresses."""
    file = copy_of("ur5e", tmp_path, 67)
    text = file.read_text().replace("approach_speed: 2 mm/s", "approach_speed: 20 mm/s")
    text = text.replace("depth: null", "depth: 1 mm").replace("model: null", "model: ideal")
    text = text.replace("width: 640", "width: 320").replace("height: 480", "height: 240")
    file.write_text(re.sub(r"corners: .*", "", text))
    said = "20 mm/s is too fast: .*140 ms late, with its gel 2.8 mm deep, and limits.depth.* is 1 mm. At most 7.1 mm/s"
    with pytest.raises(ValueError, match=said):
        open_rig(file)


@pytest.mark.parametrize("stated", [math.nan, math.inf, 0.0, -0.1])
def test_invalid_latency_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stated: float) -> None:
    """One that is not stated at all is refused when the rig file is read: tests/contract/test_outside_driver.py."""
    file = copy_of("ur5e", tmp_path, 67)
    text = file.read_text().replace("depth: null", "depth: 1 mm").replace("model: null", "model: ideal")
    text = text.replace("width: 640", "width: 320").replace("height: 480", "height: 240")
    file.write_text(re.sub(r"corners: .*", "", text))
    monkeypatch.setattr(CameraDriver, "worst_latency", lambda driver: stated)
    with pytest.raises(ValueError, match=r"sensors\.lower: the driver 'camera' states a worst latency of"):
        open_rig(file)


def test_nan_contact_signal_is_not_hidden_by_other_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    signals = iter([0.5, math.nan, 0.2])
    monkeypatch.setattr(reset, "contact_signal", lambda seen: next(signals))
    frame = SimpleNamespace(index=1, time=0.0)
    sensor = SimpleNamespace(spec=SimpleNamespace(arm="arm"), read=lambda timeout: frame)
    sensors = dict.fromkeys("abc", cast(TactileSource, sensor))
    sense = reset.PictureTouch(sensors, dict.fromkeys("abc", lambda *_: None), lambda seen: None, 1.0, 0.1)  # type: ignore[arg-type]
    assert math.isnan(sense.measure_touch(guarded=False).pressed["arm"])
