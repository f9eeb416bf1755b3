"""Where an arm stands, what it feels and carries, against its rig file: told before anything moves or is set."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robot.arm.connections import ControllerReading, read_controller
from robot.arm.examine import MAX_ZERO_FORCE, check_placement, measure_placement, pendant_pose
from robot.arm.ur import URArm
from robot.camera.driver import CameraDriver
from robot.common.kinematics import Kinematics, matrix, pose
from robot.common.tcp import ArmFrames
from robot.doctor import check_keep_out, examine_rig
from robot.errors import DeviceNotConnectedError
from robot.fixtures import mock_host
from robot.mock import MockUR
from tacsim import pose as se3
from tacsim.config import ConfigError, config_root, load_rig
from tacsim.models.driver import Check
from tacsim.models.hardware import KeepOut, Placement, UrArmConfig
from tests.robot.mock.wire_client import RtdeClient

HOST = mock_host(77)
SERIAL = "20195501234"
JOINTS = [0.3, -1.4, 1.6, -1.7, -1.6, 0.1]  # far outside the box of the shipped file
CARRIED = (0.8, 0.0, 0.0, 0.05)  # what hangs on the flange, of which nobody has told: mass [kg], centre [m]
OFFSET = 24.0  # what the force sensor is off by [N]


def shipped() -> UrArmConfig:
    found = load_rig("ur5e-one").config.arms["arm"]
    assert isinstance(found, UrArmConfig)
    return found


@pytest.fixture(scope="module")
def mock() -> Iterator[MockUR]:
    """A mock that passes for a real robot, as its pendant has left it."""
    with MockUR(HOST, joints=JOINTS, payload=CARRIED, serial=SERIAL) as running:
        running.faults.wrench([0.0, OFFSET, 0.0, 0.0, 0.0, 0.0])
        yield running


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A copy of the shipped file, the host changed."""
    text = (config_root() / "rigs" / "ur5e-one.yaml").read_text(encoding="utf-8")
    text = text.replace("192.168.1.101", HOST).replace("simulator: false", "simulator: true")
    path = tmp_path / "my.yaml"
    path.write_text(text.replace("serial: null", "serial: 20190000001"), encoding="utf-8")
    return path


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks}


def test_an_arm_out_of_its_box_is_told_with_all_that_differs_from_the_file(
    mock: MockUR, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CameraDriver, "checks", lambda driver: [Check(driver.name, "ok", "")])
    before = mock.faults.received().last
    found = by_name(examine_rig(load_rig(file).config, "my.yaml"))
    assert mock.faults.received().last == before and not mock.faults.state().program  # it has only looked
    told = {name.removeprefix("arm: "): check for name, check in found.items()}
    box = told["workspace"]
    assert box.state == "fail" and "mm beyond the workspace's" in box.found and "on the pendant" in box.found
    assert "`tacsim start my.yaml` moves it to its start" in box.advice
    assert told["force"].state == "fail"
    for untold, words in ((CARRIED[0], "of 20 N"), (CARRIED[0] - 0.3, "N, ")):  # now, and with the file's payload
        assert f"{np.hypot(OFFSET, 9.82 * untold):.1f} {words}" in told["force"].found
    assert "no run can start" in told["force"].advice and "`tacsim start my.yaml`" in told["force"].advice
    assert told["serial number"].state == "fail"
    assert told["serial number"].found == f"the robot has {SERIAL}, the file says 20190000001"
    assert told["payload"].state == "warn" and "has 0 kg" in told["payload"].found
    assert "says 0.3 kg at [0, 0, 30] mm" in told["payload"].found
    assert told["TCP"].state == "warn" and "Z 60.0 mm" in told["TCP"].found
    assert told["speed slider"].state == "ok" and "program STOPPED" in told["ready"].found


def test_the_path_to_the_start_is_that_of_the_pendant(mock: MockUR) -> None:
    """Jogging by the difference that is told brings the pendant's pose to the one that is told, and the sensor to its
    start, whatever TCP the pendant has."""
    config = shipped()
    told = pose(se3.to_matrix(Placement(position=(10e-3, 0.0, 80e-3), rotation=(0.2, 0.0, 0.0)).pose))
    flange = Kinematics("ur5e").forward(JOINTS)
    reading = read_controller(HOST)
    assert np.allclose(reading.joints, JOINTS) and reading.tcp is not None
    now = measure_placement(config, _with(reading, tcp=told, tcp_pose=pose(flange @ matrix(told))))
    assert config.start is not None
    target = pendant_pose(config, now, config.start.pose)
    frames = ArmFrames.of(config)
    sensor = frames.world_from_base @ matrix(target) @ np.linalg.inv(matrix(told))
    sensor = sensor @ frames.flange_from_tool @ frames.tool_from_sensor
    assert np.allclose(sensor, se3.to_matrix(config.start.pose), atol=1e-9)
    path = by_name(list(check_placement("arm", config, now, config.start.pose, "f")))["arm: path to start"]
    for axis, value in zip("XYZ", target[:3] - now.reading.tcp_pose[:3], strict=True):
        assert f"{axis} {round(1e3 * value):+d}" in path.found
    assert f"X {1e3 * target[0]:.1f} Y {1e3 * target[1]:.1f} Z {1e3 * target[2]:.1f} mm" in path.found


def _with(reading: ControllerReading, **changes: object) -> ControllerReading:
    facts = {name: getattr(reading, name) for name in ControllerReading.__slots__}
    return ControllerReading(**{**facts, **changes})


def _at_start(config: UrArmConfig, **changes: object) -> dict[str, Check]:
    """The checks of an arm at its start, all as its file says but for `changes`."""
    assert config.start is not None
    kinematics, frames = Kinematics(config.model), ArmFrames.of(config)
    flange = frames.flange(se3.to_matrix(config.start.pose))
    tcp = pose(se3.to_matrix(config.flange_from_tool.pose))
    plain = ControllerReading(
        joints=kinematics.solutions(flange, np.zeros(6))[0],
        tcp_pose=pose(flange @ matrix(tcp)),
        tcp_force=np.zeros(6),
        program_state=1,
        payload=config.payload.mass,
        payload_centre=np.array(config.payload.centre),
        tcp=tcp,
        speed_slider=1.0,
    )
    checks = check_placement(
        "arm", config, measure_placement(config, _with(plain, **changes)), config.start.pose, "my.yaml"
    )
    return {check.name.removeprefix("arm: "): check for check in checks}


def test_an_arm_at_its_start_with_all_as_in_its_file_is_well() -> None:
    assert {check.state for check in _at_start(shipped()).values()} == {"ok"}


def test_what_an_old_controller_does_not_tell_is_said() -> None:
    unknown = {"payload": None, "payload_centre": None, "tcp": None, "speed_slider": None}
    found = _at_start(shipped(), **unknown)
    assert {check.state for check in found.values()} == {"ok"}
    assert all("not reported" in found[name].found for name in ("payload", "TCP", "speed slider"))


@pytest.mark.parametrize(("newtons", "state"), [(0.9, "ok"), (1.5, "warn"), (19.0, "warn"), (20.5, "fail")])
def test_a_force_at_rest_is_judged(newtons: float, state: str) -> None:
    assert MAX_ZERO_FORCE == 1.0
    force = _at_start(shipped(), tcp_force=np.array([0.0, newtons, 0.0, 0.0, 0.0, 0.0]))["force"]
    assert force.state == state and f"{newtons:.1f} of 20 N" in force.found


def test_a_force_is_judged_with_the_payload_that_connecting_sets() -> None:
    """Whether the weight was taken off with another payload before."""
    config, other = shipped(), {"payload": 2.5, "payload_centre": np.array([0.0, 0.0, 0.03])}
    zeroed = _at_start(config, **other)
    expected = (2.5 - config.payload.mass) * 9.82
    assert zeroed["force"].state == "fail" and f"{expected:.1f} N," in zeroed["force"].found
    assert zeroed["payload"].state == "warn" and "2.5 kg" in zeroed["payload"].found
    weighed = np.array(
        [0.0, 0.0, expected, 0.0, 0.0, 0.0]
    )  # the controller takes off too much: it feels an upward pull
    assert _at_start(config, **other, tcp_force=weighed)["force"].state == "ok"


def test_a_slow_slider_is_a_warning() -> None:
    slider = _at_start(shipped(), speed_slider=0.35)["speed slider"]
    assert slider.state == "warn" and slider.found == "35 %" and "100 %" in slider.advice


def test_joints_of_another_model_are_told() -> None:
    found = _at_start(shipped(), joints=np.array(JOINTS))["pose"]
    assert found.state == "fail" and "from the position for model ur5e" in found.found


def test_connecting_refuses_another_robot_than_the_pinned_one(mock: MockUR, file: Path) -> None:
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this Python")
    config = load_rig(file).config.arms["arm"]
    assert isinstance(config, UrArmConfig) and config.serial == "20190000001"  # written without quotes
    before = mock.faults.received().last
    with pytest.raises(DeviceNotConnectedError, match=f"serial number {SERIAL}, .* says serial: 20190000001"):
        URArm(config, "arm")
    assert mock.faults.received().last == before


@pytest.mark.parametrize("serial", ["true", "[1, 2]", "''"])
def test_what_is_no_serial_number_is_refused(file: Path, serial: str) -> None:
    with pytest.raises(ConfigError, match="serial"):
        load_rig(file, overrides=[f"arms.arm.serial={serial}"])


def test_the_slider_is_read_from_the_controller(mock: MockUR) -> None:
    with RtdeClient(HOST) as pendant:
        assert pendant.protocol()
        recipe, _ = pendant.inputs("speed_slider_mask", "speed_slider_fraction")
        pendant.start()
        for fraction in (0.4, 1.0):
            pendant.send(recipe, 1, fraction)
            deadline = time.monotonic() + 60.0
            while (slider := read_controller(HOST).speed_slider) != fraction:
                assert time.monotonic() < deadline, slider


def test_sensors_nearer_than_their_keep_out_fail() -> None:
    config = shipped()
    reading = read_plain(config)
    shifted = reading.tcp_pose + [2e-3, 0.0, 0.0, 0.0, 0.0, 0.0]
    stands = {
        "left": measure_placement(config, reading),
        "right": measure_placement(config, _with(reading, tcp_pose=shifted)),
    }
    poses = {name: se3.from_matrix(each.sensor) for name, each in stands.items()}
    for distance, state in ((3e-3, "fail"), (1e-3, "ok")):
        assert check_keep_out(KeepOut(arms=("left", "right"), distance=distance), poses, "f").state == state


def read_plain(config: UrArmConfig) -> ControllerReading:
    flange = Kinematics(config.model).forward(JOINTS)
    tcp = pose(se3.to_matrix(config.flange_from_tool.pose))
    return ControllerReading(np.array(JOINTS), pose(flange @ matrix(tcp)), np.zeros(6), 1, 0.3, np.zeros(3), tcp, 1.0)


def test_values_that_are_not_numbers_end_in_an_error(mock: MockUR) -> None:
    mock.faults.nan_state(True)
    try:
        with pytest.raises(DeviceNotConnectedError, match="no RTDE data"):
            read_controller(HOST, 0.5)
    finally:
        mock.faults.nan_state(False)
