"""What tests of the arm's driver share: a mock controller, patient configurations, and what was really sent to it.

Times are bounded generously: they catch what hangs, not what is slow.
"""

from __future__ import annotations

import gc
import os
import time

import numpy as np

from robot.arm import channel
from robot.arm.channel import HISTORY, Record
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.tuning import FAULT_DECELERATION, MAX_STALL_PERIODS
from robot.arm.ur import URArm
from robot.common.kinematics import Kinematics
from robot.mock import Input, MockState
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.models.hardware import MockArmConfig, Payload, Placement, UrArmConfig
from tacsim.models.limits import ArmLimits, Workspace
from tests.robot.waiting import until

HOST, OTHER = (f"127.{net}.{os.getpid() >> 8 & 255}.{os.getpid() & 255}" for net in (23, 123))
CARRIED = (0.4, 0.0, 0.0, 0.04)  # what a mock has on its flange: mass [kg], centre [m]
SERVO, SERVO_STOP, ZERO = 11, 16, 8  # numbers of the commands servoJ, servoStop and zeroFtSensor in the registers
STILL = 1e-3  # slower than this an arm stands [m/s]
KINEMATICS = Kinematics("ur5e")
TOOL_FROM_SENSOR = Placement(position=(0.01, 0.0, 0.05), rotation=(0.0, 0.0, 0.3))
BASE = Placement(position=(0.2, -0.1, 0.05), rotation=(0.0, 0.0, 0.5))
START = np.array([-0.1, -0.43, 0.48])  # about where the sensor is at the mock's power-on [m]


def config(host: str = HOST, *, realtime: bool = False, **changes: object) -> UrArmConfig:
    """A patient arm: no time-out of it depends on how busy the machine is. Tests of a time-out name their own.
    realtime: its worker asks for real-time priority, to measure timing."""
    limits = {"workspace": Workspace(lower=tuple(START - 0.15), upper=tuple(START + 0.15)), "speed": 0.1}
    limits |= dict(changes.pop("limits", {}))  # type: ignore[call-overload]
    made = UrArmConfig(
        driver="ur",
        host=host,
        world_from_base=BASE,
        flange_from_tool=Placement(position=(0.0, 0.0, 0.03), rotation=(0.1, 0.0, 0.0)),
        tool_from_sensor=TOOL_FROM_SENSOR,
        payload=Payload(mass=CARRIED[0], centre=CARRIED[1:]),
        limits=ArmLimits(**limits),  # type: ignore[arg-type]
        link_timeout=1.0,
        action_timeout=30.0,
        mock=MockArmConfig(realtime=realtime),
    )
    # model_copy does not validate: a watchdog of 1 Hz leaves the worker a second of starvation.
    return made.model_copy(update={"watchdog": 1.0, **changes})


def moved(pose: Pose, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(pose.position + [x, y, z], pose.quaternion)


def go(arm: URArm, target: Pose) -> None:
    sent = arm.command(target)
    assert sent is not None

    def there() -> bool:
        assert not arm.status().is_fault, arm.explain()
        return arm.arrived(sent)

    until(there, "arrival", why=lambda: f"{arm.explain()} at {arm.state()}; {sent} was asked")


def in_motion(arm: URArm, target: Pose) -> float:
    """Commands `target` and returns when the arm moves: the time of the command, monotonic clock [s]."""
    return _beyond(arm, target, 2e-3)


def at_full_speed(arm: URArm, target: Pose) -> float:
    """Commands `target`; returns after one and a half times the path that the arm needs to reach full speed.

    (Not when a speed is measured: a loop that misses periods on a busy machine does not make up for them.)"""
    return _beyond(arm, target, 0.75 * arm.config.limits.speed**2 / arm.config.limits.acceleration)


def _beyond(arm: URArm, target: Pose, distance: float) -> float:
    start, asked = arm.state().pose.position, 0.0

    def there() -> bool:
        nonlocal asked
        assert not arm.status().is_fault, arm.explain()
        newest = arm._channel.states.latest()
        assert newest is not None
        followed = newest["commands_read"] == arm._channel.commands.count
        if asked == 0.0 or (followed and newest["status"] == ArmStatus.HOLD):  # its time-out has passed in between
            asked = time.monotonic()
            arm.command(target)
        return float(np.linalg.norm(arm.state().pose.position - start)) > distance

    until(there, "motion")
    return asked


def records(arm: URArm) -> Record:
    """What the worker wrote in the last two seconds, oldest first, without those before the first package."""
    found = arm._channel.states.recent(HISTORY)
    kept: Record = found[found["stamp"] != 0.0]
    return kept


def heights_in_a_fault(arm: URArm, status: ArmStatus) -> tuple[float, float]:
    """How low the target of an arm that went down may be from this fault on, and how low once it has been led back [m].

    By what the worker itself knew, however late it or its packages came: the target stands until a package tells where
    the arm is, and brakes from there. If no package arrives in time, it keeps standing."""
    seen = records(arm)
    found = int(np.argmax(seen["status"] == status))
    assert seen["status"][found] == status and found > 0, "the records do not go back to the fault"
    seen = seen[found:]
    held = float(seen["target"][0, 2])
    led_back = np.flatnonzero((seen["target"] != seen["target"][0]).any(axis=1))
    if not len(led_back):
        if seen["resting"][0] == 0:  # on a busy machine it may have arrived before the fault
            rests = seen[seen["resting"] == 1][0]
            assert rests["cycles"] - seen["cycles"][0] >= MAX_STALL_PERIODS  # not before it has waited
        return held, held
    before = seen[: led_back[0]]  # the last of these is of the package from which it brakes
    assert len(np.unique(before["stamp"])) <= MAX_STALL_PERIODS
    speed = float(np.linalg.norm(before["tcp_speed"][-1, :3]))
    return held, float(before["position"][-1, 2]) - speed**2 / (2 * FAULT_DECELERATION)


def stands(state: MockState) -> bool:
    """True if the tool of a mock is slower than 1 mm/s."""
    return float(np.linalg.norm(state.tcp_speed[:3])) < STILL


def servo_targets(entries: tuple[Input, ...]) -> np.ndarray:
    """Joints (n, 6) of the servoJ calls among the received packages."""
    rows = [[entry.values[f"input_double_register_{k}"] for k in range(6)] for entry in _servo(entries)]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def servo_ticks(entries: tuple[Input, ...]) -> np.ndarray:
    """Control periods (n,) of the mock in which those calls arrived."""
    return np.array([entry.tick for entry in _servo(entries)])


def _servo(entries: tuple[Input, ...]) -> list[Input]:
    return [entry for entry in entries if entry.values.get("input_int_register_0") == SERVO]


def sensor_path(arm: URArm, joints: np.ndarray) -> np.ndarray:
    """world_from_sensor (n, 4, 4) of joint targets, by forward kinematics alone."""
    flange_from_sensor = se3.to_matrix(se3.compose(arm.config.flange_from_tool.pose, arm.config.tool_from_sensor.pose))
    base = se3.to_matrix(arm.config.world_from_base.pose)
    return np.array([base @ KINEMATICS.forward(q) @ flange_from_sensor for q in joints])


def of_limits(arm: URArm, joints: np.ndarray) -> dict[str, float]:
    """What was really sent, in parts of the limits of speed, acceleration and joint speed; see `restarts`."""
    limits = arm.config.limits
    velocity, change, around = _changes(arm, joints)
    held = np.where(change > 1.01 * limits.acceleration, around, change)
    return {
        "speed": float(np.linalg.norm(velocity, axis=1).max()) / limits.speed,
        "acceleration": float(held.max()) / limits.acceleration,
        "joint step": float(np.abs(np.diff(joints, axis=0)).max()) / (limits.joint_speed * PERIOD),
    }


def restarts(arm: URArm, joints: np.ndarray, ticks: np.ndarray) -> int:
    """How often targets were slowed down at once, though no control period was without one: after missed periods they
    go on with the speed that the arm has kept."""
    velocity, change, _ = _changes(arm, joints)
    speed = np.linalg.norm(velocity, axis=1)
    sudden = (change > 1.01 * arm.config.limits.acceleration) & (speed[1:] < speed[:-1])
    return int((sudden & (np.diff(ticks)[1:] < 2)).sum())


def _changes(arm: URArm, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocities (n, 3) of the sensor's origin in targets of successive periods [m/s], and their changes (n - 1,)
    [m/s^2]: all of it, and what is not a mere slowing down of the motion before."""
    velocity = np.diff(sensor_path(arm, joints)[:, :3, 3], axis=0) / PERIOD
    moves = np.where(velocity.any(axis=1), np.arange(len(velocity)), 0)
    before = velocity[np.maximum.accumulate(moves)][:-1]  # of the last period in which the target moved
    square = np.maximum((before**2).sum(axis=1), 1e-30)
    share = np.clip((velocity[1:] * before).sum(axis=1) / square, 0.0, 1.0)[:, None]
    change, around = np.diff(velocity, axis=0) / PERIOD, (velocity[1:] - share * before) / PERIOD
    return velocity, np.linalg.norm(change, axis=1), np.linalg.norm(around, axis=1)


def outside(arm: URArm, joints: np.ndarray) -> int:
    """How many of the targets that were really sent lie outside box and planes."""
    return int((~(arm.config.limits.region.excess(sensor_path(arm, joints)[:, :3, 3]) <= 1e-8)).sum())


def check_path(arm: URArm, joints: np.ndarray) -> None:
    """Box, planes, speed, acceleration and joint steps of what was really sent."""
    assert outside(arm, joints) == 0
    share = of_limits(arm, joints)
    assert share["joint step"] <= 1 + 1e-9, share
    assert share["speed"] <= 1 + 1e-4, share
    assert share["acceleration"] <= 1 + 1e-2, f"{share}, speeds around it [m/s]: {_around_worst(arm, joints)}"


def _around_worst(arm: URArm, joints: np.ndarray) -> list[float]:
    velocity, change, around = _changes(arm, joints)
    worst = int(np.where(change > 1.01 * arm.config.limits.acceleration, around, 0.0).argmax())
    speeds: list[float] = np.linalg.norm(velocity[max(0, worst - 5) : worst + 6], axis=1).round(4).tolist()
    return speeds


def leftovers() -> int:
    """How many memories of arms this process still has."""
    gc.collect()
    return len(channel._segments)
