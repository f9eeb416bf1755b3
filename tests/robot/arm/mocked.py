"""What tests of the arm's driver share: a mock controller, patient configurations, and what was really sent to it.

Times are bounded generously: they catch what hangs, not what is slow.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import numpy as np

from robot.arm import shared_ring
from robot.arm.trajectory import PERIOD
from robot.arm.ur import URArm
from robot.common.kinematics import Kinematics
from robot.mock import Input
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.limits import region
from tacsim.models.hardware import ArmLimits, MockArmConfig, Payload, Placement, UrArmConfig, Workspace

HOST, OTHER = (f"127.{net}.{os.getpid() >> 8 & 255}.{os.getpid() & 255}" for net in (23, 123))
PATIENCE = 20.0  # for anything that has to happen [s]
KINEMATICS = Kinematics("ur5e")
TOOL_FROM_SENSOR = Placement(position=(0.01, 0.0, 0.05), rotation=(0.0, 0.0, 0.3))
BASE = Placement(position=(0.2, -0.1, 0.05), rotation=(0.0, 0.0, 0.5))
START = np.array([-0.1, -0.43, 0.48])  # about where the sensor is at the mock's power-on [m]


def config(host: str = HOST, **changes: object) -> UrArmConfig:
    """A patient arm: no time-out of them depends on how busy the machine is. Tests of a time-out name their own."""
    limits = {"workspace": Workspace(lower=tuple(START - 0.15), upper=tuple(START + 0.15)), "speed": 0.1}
    limits |= dict(changes.pop("limits", {}))  # type: ignore[call-overload]
    made = UrArmConfig(
        driver="ur",
        host=host,
        world_from_base=BASE,
        flange_from_tool=Placement(position=(0.0, 0.0, 0.03), rotation=(0.1, 0.0, 0.0)),
        tool_from_sensor=TOOL_FROM_SENSOR,
        payload=Payload(mass=0.4, centre=(0.0, 0.0, 0.04)),
        limits=ArmLimits(**limits),  # type: ignore[arg-type]
        link_timeout=1.0,
        action_timeout=30.0,
        mock=MockArmConfig(),
    )
    # model_copy does not validate: a watchdog of 1 Hz leaves the worker a second of starvation.
    return made.model_copy(update={"watchdog": 1.0, **changes})


def until(done: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE} s"
        time.sleep(1e-3)


def moved(pose: Pose, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(pose.position + [x, y, z], pose.quaternion)


def go(arm: URArm, target: Pose) -> None:
    sent = arm.command(target)
    assert sent is not None

    def there() -> bool:
        assert not arm.status().is_fault, arm.explain()
        return arm.arrived(sent)

    until(there, "arrival")


def in_motion(arm: URArm, target: Pose) -> None:
    """Commands `target` and comes back when the arm is on its way."""
    start = arm.state().pose.position
    arm.command(target)
    until(lambda: float(np.linalg.norm(arm.state().pose.position - start)) > 2e-3, "motion")


def servo_targets(entries: tuple[Input, ...]) -> np.ndarray:
    """Joints (n, 6) of the servoJ calls among the received packages."""
    rows = [
        [entry.values[f"input_double_register_{k}"] for k in range(6)]
        for entry in entries
        if entry.values.get("input_int_register_0") == 11
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def sensor_path(arm: URArm, joints: np.ndarray) -> np.ndarray:
    """world_from_sensor (n, 4, 4) of joint targets, by forward kinematics alone."""
    flange_from_sensor = se3.to_matrix(se3.compose(arm.config.flange_from_tool.pose, arm.config.tool_from_sensor.pose))
    base = se3.to_matrix(arm.config.world_from_base.pose)
    return np.array([base @ KINEMATICS.forward(q) @ flange_from_sensor for q in joints])


def check_path(arm: URArm, joints: np.ndarray) -> None:
    """Box, planes, speed, acceleration and joint steps of what was really sent."""
    limits = arm.config.limits
    path = sensor_path(arm, joints)
    walls = region(limits.workspace.lower, limits.workspace.upper, [(p.point, p.normal) for p in limits.planes])
    assert walls.excess(path[:, :3, 3]).max() <= 1e-8
    assert np.abs(np.diff(joints, axis=0)).max() <= limits.joint_speed * PERIOD * (1 + 1e-9)
    velocity = np.diff(path[:, :3, 3], axis=0) / PERIOD
    assert np.linalg.norm(velocity, axis=1).max() <= limits.speed * (1 + 1e-4)
    change = np.diff(velocity, axis=0) / PERIOD
    assert np.linalg.norm(change, axis=1).max() <= limits.acceleration * (1 + 1e-2)


def leftovers(name: str) -> list[str]:
    return [path.name for path in shared_ring.FOLDER.glob(f"{shared_ring.PREFIX}-{os.getpid()}-{name}")]
