"""A rig through LeRobot's eyes, without LeRobot: its features, what is really sent, and what is refused."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import robot.rig.reset
from robot.export.lerobot_mapping import LeRobotMapping
from robot.export.lerobot_rig import Jog, LeRobotRig
from robot.open import open_rig, rig_spec
from tacsim import pose as se3
from tacsim.config import load_rig
from tacsim.gym.features import SCALES, decode_pose_change, encode_pose_change
from tacsim.interface import IncompatibleRig, Pose, RigSpec
from tacsim.limits import ActionError
from tacsim.models.sensor import CanonicalGrid
from tests.robot.export.made_up import record, turned
from tests.robot.rig.bare_rig import bare_file, cameras_of

PATIENT = {"link_timeout": 20.0, "watchdog": 0.05, "action_timeout": 5.0, "observation_timeout": 60.0}


@pytest.fixture(autouse=True)
def _no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot.rig.reset, "SETTLING_TIME", 0.02)


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LeRobotRig]:
    """Two mock arms and cameras, period 50 ms."""
    file = bare_file(tmp_path_factory.mktemp("rig"), first=91)
    config = load_rig(file).config
    arms = {name: arm.model_copy(update=PATIENT) for name, arm in config.arms.items()}  # which does not validate
    with cameras_of(config):
        made = LeRobotRig(config.model_copy(update={"arms": arms}), fps=20)
        yield made
        made.close()


def test_numbers_of_a_pose_are_that_pose() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        start, pose = turned(rng, 1.0), turned(rng, 1.0)
        assert max(se3.pose_distance(decode_pose_change(start, encode_pose_change(start, pose)), pose)) < 1e-12


@pytest.mark.parametrize("rig", ["sim", "mock", "ur5e", "ur5e-one"])
def test_features_are_known_before_anything_is_opened(rig: str) -> None:
    made = LeRobotRig(rig)
    config = made.config
    assert not made.connected
    numbers = [name for name, kind in made.observation_features.items() if kind is float]
    pictures = {name: kind for name, kind in made.observation_features.items() if kind is not float}
    assert pictures == dict.fromkeys(config.sensors, (128, 128, 3))
    assert len(made.action_features) == 9 * len(config.arms) and set(made.action_features.values()) == {float}
    assert all(name.endswith((".pos", ".vel")) for name in numbers)  # others never reach a policy in LeRobot's rollout
    assert [name for name in numbers if name.endswith(".pos")] == list(made.action_features)


def test_a_rig_is_known_before_it_is_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    record("a.mcap", 3)
    file = tmp_path / "again.yaml"
    file.write_text("clock: replay\nname: again\nsensors: {lower: {driver: replay, source: a.mcap}}\n")
    with open_rig(file) as rig:
        assert rig_spec(load_rig(file).config) == rig.spec


@pytest.mark.slow
def test_what_is_sent_is_what_the_limits_let_through(bare: LeRobotRig) -> None:
    with pytest.raises(RuntimeError, match="not connected"):
        bare.observe()
    bare.connect()
    with pytest.raises(RuntimeError, match="connected already"):
        bare.connect()
    seen = bare.observe()
    assert list(seen) == list(bare.observation_features)
    assert all(isinstance(seen[name], float) for name, kind in bare.observation_features.items() if kind is float)
    picture = seen["east"]
    assert isinstance(picture, np.ndarray) and picture.dtype == np.uint8
    assert picture.shape == bare.observation_features["east"]
    asked: dict[str, float] = {name: float(seen[name]) for name in bare.action_features}
    near = bare.send(asked)
    assert list(near) == list(asked) and np.allclose(list(near.values()), list(asked.values()), atol=1e-4)
    far = bare.send(asked | {"moved_x_west.pos": 1e4})  # 10 m and more: the workspace ends at 30 mm
    start = Pose()
    unit = encode_pose_change(start, Pose(np.array([30e-3, 0.0, 0.0])))[0]
    assert far["moved_x_west.pos"] == pytest.approx(unit, rel=1e-3)
    for _ in range(200):
        found = bare.observe()["moved_x_west.pos"]
        bare.send(far)
        if abs(float(found) - unit) < 1e-2 * unit:  # type: ignore[arg-type]
            break
    else:
        pytest.fail(f"the arm stands at {found}, and was sent to {unit}")


def test_no_action_is_refused_in_words(bare: LeRobotRig) -> None:
    if not bare.connected:
        bare.connect()
    still = {name: float(value) for name, value in bare.observe().items() if name in bare.action_features}  # type: ignore[arg-type]
    with pytest.raises(ActionError, match=r"moved_x_east\.pos is missing"):
        bare.send({name: value for name, value in still.items() if name != "moved_x_east.pos"})
    with pytest.raises(ActionError, match=r"delta_x is none of them"):
        bare.send(still | {"delta_x": 0.0})
    with pytest.raises(ActionError, match=r"the action of arm 'west'.*is no pose"):
        bare.send(still | {"moved_y_west.pos": float("nan")})
    flat = {
        f"turn_{column}{axis}_west.pos": -float(column == axis) / SCALES["turn"] for column in "xy" for axis in "xyz"
    }
    with pytest.raises(ActionError, match="span no plane"):
        bare.send(still | flat)


def test_another_rate_is_refused_where_it_is_told(tmp_path: Path) -> None:
    words = r"control period of 50 ms, which is fps=20, not 30;.*period=33\.33 ms"
    with pytest.raises(IncompatibleRig, match=words):
        LeRobotRig(bare_file(tmp_path, first=93), fps=30)
    LeRobotRig("sim", overrides=["period=33.333 ms"], fps=30)


@pytest.mark.slow
def test_another_rate_is_noticed_where_it_is_not(bare: LeRobotRig, caplog: pytest.LogCaptureFixture) -> None:
    bare.close()
    bare.connect()  # it is said once a connection
    bare.config = bare.config.model_copy(update={"period": 1000.0})
    with caplog.at_level(logging.WARNING):
        for _ in range(40):
            bare.observe()
    (told,) = [each.getMessage() for each in caplog.records]
    assert "the control period of rig 'bare' is 1e+06 ms" in told and "--dataset.fps=0.001" in told


def test_a_rig_that_makes_no_robot_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "eye.yaml"
    sensor = "{driver: camera, source: pictures, width: 80, height: 60}"
    file.write_text(f"name: eye\nclock: wall\nsensors: {{eye: {sensor}}}\n")
    with pytest.raises(IncompatibleRig, match="no arm: LeRobot's policies learn from pictures and actions of arms"):
        LeRobotRig(file)
    with pytest.raises(ValueError, match="no sensor"):
        LeRobotMapping(RigSpec({}, ("arm",), truth=False, period=0.1), CanonicalGrid())


def test_simulated_time_passes_with_each_action() -> None:
    small = [
        "scene.preset=learn",
        "scene.gel.size=[8 mm, 8 mm, 4 mm]",
        "scene.body.geometry.size=[3 mm, 3 mm, 3 mm]",
        "task.goal=2 mm",
    ]
    made = LeRobotRig("sim", task="squeeze", overrides=small, fps=10)
    made.connect()
    try:
        before = made.observe()
        step = made.config.period
        asked = {name: float(before[name]) for name in made.action_features}  # type: ignore[arg-type]
        asked["moved_z_lower.pos"] += float(encode_pose_change(Pose(), Pose(np.array([0.0, 0.0, 0.05e-3])))[2])
        begin = made._opened().now()
        sent = made.send(asked)
        assert made._opened().now() - begin == pytest.approx(step)
        after = made.observe()
        assert after["moved_z_lower.pos"] == pytest.approx(sent["moved_z_lower.pos"], abs=1e-6)
        assert float(after["force_z_lower.vel"]) < float(before["force_z_lower.vel"])  # type: ignore[arg-type]  # presses
    finally:
        made.close()


def test_steps_add_up_along_the_sensors_axes() -> None:
    rig = LeRobotRig("sim")
    jog = Jog(rig, 0.1e-3, ["upper"])
    jog([0.0, 0.0, 1.0])
    action = jog([-0.5, 0.0, 9.0])  # a stroke is at most 1
    assert list(action) == list(rig.action_features)
    gone = {name: value * SCALES["moved"] for name, value in action.items() if value != 0.0}
    assert gone == {"moved_x_upper.pos": pytest.approx(-0.05e-3), "moved_z_upper.pos": pytest.approx(0.2e-3)}
    jog.reset()
    assert set(jog([0.0, 0.0, 0.0]).values()) == {0.0}
    assert {name for name, value in Jog(rig, 0.1e-3)([1.0, 0.0, 0.0]).items() if value != 0.0} == {
        "moved_x_lower.pos",
        "moved_x_upper.pos",
    }
    with pytest.raises(IncompatibleRig, match="rig 'sim' has no arm 'left'; it has lower, upper"):
        Jog(rig, 0.1e-3, ["left"])
    with pytest.raises(ValueError, match="below 10 mm"):
        Jog(rig, 0.1, [])
