"""The way of an arm to its start is checked before anything moves; two arms are led one after the other."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from robot.arm.connections import ControllerReading
from robot.common.kinematics import Kinematics, pose
from robot.common.tcp import ArmFrames
from robot.procedures.to_start import (
    PROGRESS_WINDOW,
    JointPath,
    NoPathToStart,
    Operator,
    Progress,
    find_joint_path,
    move_to_start,
    require_clear,
)
from tacsim import pose as se3
from tacsim.config import load_rig
from tacsim.interface import FloatArray, Pose
from tacsim.models.hardware import Placement, UrArmConfig
from tacsim.models.limits import Plane
from tests.robot.cli.lab import Lab, copy_of
from tests.robot.cli.test_start import AWAY, fast

KINEMATICS = Kinematics("ur5e")
TURNED = np.array([0.5, -0.2, 0.1, 0.0, 0.1, 0.3])  # from the start to where the arm stands [rad]


def shipped(**limits: object) -> UrArmConfig:
    found = load_rig("ur5e-one").config.arms["arm"]
    assert isinstance(found, UrArmConfig)
    return found.model_copy(update={"limits": found.limits.model_copy(update=limits)})


def start_of(config: UrArmConfig) -> Pose:
    assert config.start is not None
    return config.start.pose


def standing(config: UrArmConfig, joints: FloatArray, calibration: FloatArray | None = None) -> ControllerReading:
    """calibration: the true flange, seen from that of the nominal lengths (4, 4)."""
    tcp = se3.to_matrix(config.flange_from_tool.pose)
    flange = KINEMATICS.forward(joints) @ (np.eye(4) if calibration is None else calibration)
    return ControllerReading(joints, pose(flange @ tcp), np.zeros(6), 1, 0.3, np.zeros(3), pose(tcp), 1.0)


def at_start(config: UrArmConfig) -> FloatArray:
    flange = ArmFrames.of(config).flange(se3.to_matrix(start_of(config)))
    # Postures come in pairs that are equally far from a singularity: the first, whatever the last digits say.
    return max(KINEMATICS.solutions(flange, np.zeros(6)), key=lambda joints: round(KINEMATICS.singularity(joints), 6))


def way(config: UrArmConfig) -> JointPath:
    return find_joint_path("arm", config, standing(config, at_start(config) + TURNED), start_of(config))


def test_a_way_leads_to_the_nearest_posture_and_is_described() -> None:
    config = shipped()
    found = way(config)
    assert np.allclose(found.end, at_start(config), atol=1e-9) and np.allclose(found.begin - found.end, TURNED)
    assert np.allclose(found.sensor_positions[-1], start_of(config).position, atol=1e-9)
    words = found.describe()
    assert "turns most is base, by -29 deg" in words and "to [-130, -490, 200] mm" in words
    length = np.linalg.norm(np.diff(found.sensor_positions, axis=0), axis=1).sum()
    assert found.seconds > length / config.limits.speed  # 20 mm/s


def test_the_lengths_of_a_real_arm_are_allowed_for() -> None:
    """The sensor of an arm that is a millimetre longer than its model stands at its start by the controller's pose."""
    config, calibration = shipped(), np.eye(4)
    calibration[:3, 3] = [0.5e-3, -0.3e-3, 1e-3]
    found = find_joint_path("arm", config, standing(config, at_start(config) + TURNED, calibration), start_of(config))
    flange = KINEMATICS.forward(found.end) @ calibration
    assert np.allclose(flange, ArmFrames.of(config).flange(se3.to_matrix(start_of(config))), atol=1e-9)


@pytest.mark.parametrize("share_a_second", [0.02, 0.005, 0.0])
def test_the_time_that_is_left_follows_the_measured_progress(share_a_second: float) -> None:
    """Planned for 50 s: as planned at first; an arm that then creeps needs as long as it creeps."""
    progress, gone = Progress(50.0), 0.0
    for second in range(61):
        progress.add(100.0 + second, gone)
        if second == 0:
            assert progress.seconds_left(1.0) == 50.0
        if second == 30:  # half as fast, or as slow, as before
            share_a_second /= 2.0
        gone += share_a_second
    left = progress.seconds_left(1.0)
    reached = gone - share_a_second
    expected = (1.0 - reached) / share_a_second if share_a_second else np.inf
    assert left == pytest.approx(expected) and PROGRESS_WINDOW < 30.0


def test_an_arm_at_its_start_has_no_way_to_go() -> None:
    config = shipped()
    assert find_joint_path("arm", config, standing(config, at_start(config)), start_of(config)).is_at_start


def test_a_start_out_of_reach_is_refused() -> None:
    far = Placement(position=(2.0, 0.0, 0.2)).pose
    with pytest.raises(NoPathToStart, match="out of reach"):
        find_joint_path("arm", shipped(), standing(shipped(), at_start(shipped())), far)


def test_a_way_behind_a_wall_is_refused_and_one_from_behind_it_is_not() -> None:
    config = shipped()
    path = way(config).sensor_positions
    chord = path[-1] - path[0]
    middle = path[len(path) // 2]
    # the way is no straight line
    bulge = middle - path[0] - chord * float((middle - path[0]) @ chord / (chord @ chord))
    assert np.linalg.norm(bulge) > 5e-3
    between = tuple(middle - 0.5 * bulge)
    with pytest.raises(NoPathToStart, match=r"its sensor would come .* mm beyond plane 0; jog it nearer"):
        way(shipped(planes=(Plane(point=between, normal=tuple(-bulge)),)))
    way(shipped(planes=(Plane(point=between, normal=tuple(bulge)),)))  # it begins behind this one, and comes out


def test_a_way_that_sinks_is_refused_where_the_file_has_no_table() -> None:
    config = shipped()
    turned = at_start(config) + [0.0, -1.3, 1.3, 1.4, 0.0, -1.3]
    with pytest.raises(NoPathToStart, match=r"would sink 37 mm below .*give the table as a plane"):
        find_joint_path("arm", config, standing(config, turned), start_of(config))
    table = Plane(point=(0.0, 0.0, -0.5), normal=(0.0, 0.0, 1.0))
    low = shipped(planes=(table,))
    sinks = find_joint_path("arm", low, standing(low, turned), start_of(low)).sensor_positions[:, 2]
    assert sinks.min() < min(sinks[0], sinks[-1], 0.15) - 10e-3


def test_a_way_past_another_sensor_is_refused() -> None:
    found = way(shipped())
    middle = found.sensor_positions[len(found.sensor_positions) // 2]
    with pytest.raises(NoPathToStart, match=r"within 0 mm of that of arm 'other'; jog one of them away"):
        require_clear("arm", found, {"other": middle}, {"other": 3e-3})
    require_clear("arm", found, {"other": middle + [0.0, 0.0, 0.2]}, {"other": 3e-3})
    require_clear("arm", found, {"other": found.sensor_positions[-1]}, {"other": 3e-3})  # starts may be near each other


needs_arms = pytest.mark.skipif(find_spec("rtde_control") is None, reason="ur_rtde has no wheel for this Python")


@needs_arms
@pytest.mark.deep
def test_two_arms_are_led_one_after_the_other(tmp_path: Path) -> None:
    file = fast(copy_of("ur5e", tmp_path, 86))
    with Lab(file, offset=AWAY) as lab:
        config = load_rig(file).config
        said: list[str] = []
        moved: list[set[str]] = []
        last = {name: np.array(faults.state().joints) for name, faults in lab.faults.items()}

        def look(words: str) -> None:
            now = {name: np.array(faults.state().joints) for name, faults in lab.faults.items()}
            moved.append({name for name in now if np.abs(now[name] - last[name]).max() > 1e-4})
            last.update(now)

        def ask(question: str) -> bool:
            look("")
            moved.clear()
            return True

        away = move_to_start(config, lab.starts, Operator(ask, said.append, look))
        assert all(distance < 2e-3 for distance in away.values()) and set(away) == {"lower", "upper"}
        assert all(len(names) <= 1 for names in moved), moved  # since the last question
        assert sum("stands at its start" in words for words in said) == 2
