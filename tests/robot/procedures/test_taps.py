"""Taps that measure the latency of a camera: their schedule, the rig file entries, and a measured delay."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from calibration.poses.latency import Latency
from robot.fixtures import mock_host, rig_addresses
from robot.mock import MockCamera, MockState
from robot.procedures.session import CannotCalibrate
from robot.procedures.taps import (
    CONTACT_TIME,
    LIFTED_TIME,
    PAUSE_TIME,
    TapPlan,
    latency_entries,
    schedule,
    without_latency,
)
from tacsim.config import load_rig
from tacsim.models.hardware import UrArmConfig
from tests.robot.cli.invoked import tacsim
from tests.robot.procedures.seen_arm import SeenArm

WIDTH, HEIGHT = 64, 48
DELAY = 0.15  # of the camera [s]
SLACK = 0.05  # what a busy machine may add on either side: the test's own hand between arm and camera [s]


def arm_config(latency: float = 0.0) -> UrArmConfig:
    found = load_rig("mock").config.arms["upper"]
    assert isinstance(found, UrArmConfig)
    return found.model_copy(update={"latency": latency})


def latency(seconds: float) -> Latency:
    return Latency(seconds=seconds, uncertainty=1e-3, correlation=0.99, samples=200)


def test_schedule_taps_have_uneven_intervals_and_pauses() -> None:
    travel = 0.1
    moves = schedule(TapPlan(taps=6), travel)
    times, down = [time for time, _ in moves], [each for _, each in moves]
    assert down == [True, False] * 6 + [False]
    assert times[0] == PAUSE_TIME and times[-1] - times[-2] >= PAUSE_TIME + travel + LIFTED_TIME[0]
    pauses = np.diff(times[:-1])
    assert (pauses[::2] >= travel + CONTACT_TIME[0]).all() and (pauses[1::2] >= travel + LIFTED_TIME[0]).all()
    assert np.ptp(np.diff(times[:-1:2])) > 0.1  # regular taps fit several latencies
    assert schedule(TapPlan(taps=6), travel) == moves
    assert schedule(TapPlan(taps=6, seed=1), travel) != moves


@pytest.mark.parametrize(
    ("clock", "seconds", "known", "wanted"),
    [
        ("arrival", 0.120, 0.0, {"sensors.upper.latency": 0.120}),
        ("arrival", 0.120, 0.010, {"sensors.upper.latency": 0.130}),  # the arm keeps its own
        ("arrival", -0.020, 0.0, {"sensors.upper.latency": 0.0, "arms.upper.latency": 0.020}),
        ("stamp", -0.008, 0.0, {"arms.upper.latency": 0.008}),
        ("device", 0.001, 0.0, {"arms.upper.latency": 0.0}),
    ],
)
def test_latency_entries_align_both_times(clock: str, seconds: float, known: float, wanted: dict[str, float]) -> None:
    found = latency_entries(latency(seconds), clock, "upper", arm_config(known), "upper")  # type: ignore[arg-type]
    assert found == pytest.approx(wanted)
    camera = found.get("sensors.upper.latency", 0.0 if clock != "arrival" else None)
    assert camera is not None
    if clock == "arrival":  # with these entries a second measurement would find the pictures in time
        assert seconds - camera + found.get("arms.upper.latency", known) == pytest.approx(0.0)


def test_without_latency_sets_known_latencies_to_zero() -> None:
    config = load_rig("mock", overrides=["arms.upper.latency=10 ms", "sensors.upper.latency=50 ms"]).config
    bare = without_latency(config, "upper", "upper")
    assert bare.contact == "hertz"
    assert bare.arms["upper"].latency == bare.sensors["upper"].latency == 0.0  # type: ignore[union-attr]
    assert not bare.lock_step and bare.arms["lower"] == config.arms["lower"]


@pytest.mark.parametrize(
    ("rig", "arm", "sensor", "words"),
    [
        ("sim", "upper", "upper", "'upper' is not a hardware arm, real or mock; such arms: none"),
        ("mock", "third", "upper", "'third' is not a hardware arm.*lower, upper"),
        ("mock", "upper", "third", "'third' is not a sensor with a camera.*lower, upper"),
        ("mock", "upper", "lower", "carried by lower, not by 'upper'"),
    ],
)
def test_without_latency_unsuitable_parts_raise(rig: str, arm: str, sensor: str, words: str) -> None:
    with pytest.raises(CannotCalibrate, match=words):
        without_latency(load_rig(rig).config, arm, sensor)
    done = tacsim("calibrate", "latency", rig, "--arm", arm, "--sensor", sensor)
    assert done.exit_code == 2


RIG = """
name: tapper
clock: wall
arms:
  upper:
    driver: ur
    host: {host}
    world_from_base: {{ position: [-450 mm, 0, -300 mm] }}
    limits:
      workspace: {{ lower: [-20 mm, -20 mm, -20 mm], upper: [20 mm, 20 mm, 20 mm] }}
      acceleration: 2 m/s^2
    start: {{ position: [0, 0, 0] }}
    link_timeout: 2 s
    watchdog: 0.4
    latency: 100 ms  # wrong on purpose: it must not enter what is measured, but what is written
    mock: {{}}
sensors:
  upper: {{ driver: camera, source: '{source}', arm: upper, width: 64, height: 48, fps: 60, max_age: 10 s }}
"""


class Hand(SeenArm):
    """Draws what a camera in the gel would see: the deeper the arm, the brighter the picture."""

    def draw(self, state: MockState) -> None:
        deep = max(0.0, state.pose[2] - 0.3)  # the base stands 300 mm below the surface [m]
        self._camera.push(np.full((HEIGHT, WIDTH, 3), 100 + min(100, int(1e5 * deep)), np.uint8))


@pytest.mark.slow
@pytest.mark.skipif(find_spec("rtde_control") is None, reason="ur_rtde has no wheel for this Python and machine")
def test_command_camera_delay_is_measured_and_printed(tmp_path: Path) -> None:
    host = mock_host(31)
    with MockCamera(host, width=WIDTH, height=HEIGHT, fps=60.0, stamped=False) as camera:
        (tmp_path / "tapper.yaml").write_text(RIG.format(host=host, source=camera.url))
        camera.delay(DELAY)
        words = ["calibrate", "latency", str(tmp_path / "tapper.yaml"), "--arm", "upper", "--sensor", "upper"]
        with Hand(host, camera):
            done = tacsim(*words, "--depth", "1 mm", "--taps", "5")
    assert done.exit_code == 0, done.output
    said = done.stdout.split()
    found = float(said[said.index("is") + 1])
    assert abs(found - 1e3 * DELAY) < 1e3 * SLACK, done.output
    written = float(said[said.index("sensors.upper.latency:") + 1])
    assert written == pytest.approx(found + 100.0, abs=0.11)


@pytest.mark.deep
@pytest.mark.skipif(find_spec("rtde_control") is None, reason="ur_rtde has no wheel for this Python and machine")
def test_taps_mock_rig_uses_hertz_contact() -> None:
    addresses = [word for override in rig_addresses() for word in ("--set", override)]
    words = ["calibrate", "latency", "mock", "--arm", "upper", "--sensor", "upper", "--taps", "4", *addresses]
    done = tacsim(*words)
    assert done.exit_code == 0, done.output
    assert "sensors.upper is" in done.stdout
