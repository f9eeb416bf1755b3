"""What a simulated arm believes, and what comes late."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tacsim import pose as se3
from tacsim.interface import Pose, SensorSpec
from tacsim.models.limits import ArmLimits, Workspace
from tacsim.sim.arm import SimArm
from tacsim.sim.clock import SimClock
from tacsim.sim.sensor import SimSensor

ERROR = se3.from_rotation_vector([1e-3, -2e-3, 0.5e-3], [0.02, 0.0, -0.03])
SPEC = SensorSpec((4, 4), height=False, flow=False, arm="lower")


def down(pose: Pose, distance: float) -> Pose:
    return Pose(pose.position - [0.0, 0.0, distance], pose.quaternion)


def test_an_arm_with_an_error_goes_where_it_believes_the_target_to_be(spring_world: Any) -> None:
    clock = SimClock(spring_world, 0.1)
    arm = SimArm(spring_world, clock, "upper", 1.0, 1.0, error=ERROR)
    real, believed = spring_world.pose("upper"), arm.state().pose
    assert se3.pose_distance(believed, se3.compose(real, ERROR)) == pytest.approx((0.0, 0.0), abs=1e-12)
    sent = arm.command(down(believed, 0.4e-3))
    clock.tick()
    assert sent is not None
    assert se3.pose_distance(arm.state().pose, sent) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert spring_world.pose("upper").position == pytest.approx(real.position - [0, 0, 0.4e-3], abs=1e-9)


def test_it_feels_the_same_force_written_in_the_frame_that_it_believes(spring_world: Any) -> None:
    clock = SimClock(spring_world, 0.1)
    exact = SimArm(spring_world, clock, "upper", 1.0, 1.0)
    wrong = SimArm(spring_world, clock, "upper", 1.0, 1.0, error=ERROR)
    exact.command(down(exact.state().pose, 2e-3))
    clock.tick()
    felt, believed = exact.state().wrench, wrong.state().wrench
    assert np.linalg.norm(felt[:3]) > 0.1
    assert se3.rotate(ERROR, believed[:3]) == pytest.approx(felt[:3])
    # In world the force is the same, about the point that it believes to be the sensor's origin.
    assert se3.transform_wrench(ERROR, believed) == pytest.approx(felt)


def test_limits_hold_where_it_believes_to_be(spring_world: Any) -> None:
    clock = SimClock(spring_world, 0.1)
    limits = ArmLimits(workspace=Workspace(lower=(-0.1, -0.1, 5e-3), upper=(0.1, 0.1, 0.1)))
    error = Pose(np.array([0.0, 0.0, 1e-3]))  # of a sensor that faces down: it believes to be 1 mm lower
    arm = SimArm(spring_world, clock, "upper", 1.0, 1.0, limits, error=error)
    arm.command(down(arm.state().pose, 20e-3))
    clock.tick()
    assert arm.state().pose.position[2] == pytest.approx(5e-3)
    assert spring_world.pose("upper").position[2] == pytest.approx(6e-3)


def test_what_is_delayed_is_of_so_many_periods_ago_and_never_of_another_episode(spring_world: Any) -> None:
    clock = SimClock(spring_world, 0.1)
    arm = SimArm(spring_world, clock, "upper", 1.0, 1.0, delay=2)
    driver = SimArm(spring_world, clock, "upper", 1.0, 1.0)
    start = float(arm.state().pose.position[2])
    seen = []
    for step in range(1, 5):
        driver.command(down(driver.state().pose, 0.1e-3))
        clock.tick()
        seen.append((start - float(arm.state().pose.position[2])) / 0.1e-3)
        assert arm.state().time == pytest.approx(0.1 * max(0, step - 2))
        assert arm.state() is arm.state()  # looked at twice, it is no older
    assert seen == pytest.approx([0, 0, 1, 2], abs=1e-6)
    clock.restart()
    assert start - arm.state().pose.position[2] == pytest.approx(0.4e-3)


def test_delayed_pictures_tell_their_age(spring_world: Any) -> None:
    clock = SimClock(spring_world, 0.1)
    shown = iter(range(100))
    sensor = SimSensor(
        spring_world, clock, "lower", SPEC,
        lambda surface: np.full((4, 4, 3), next(shown), np.uint8), lambda surface: None,  # type: ignore[arg-type, return-value]
        delay=1,
    )  # fmt: skip
    driver = SimArm(spring_world, clock, "lower", 1.0, 1.0)
    first = sensor.read(0.0)
    frames = []
    for _ in range(3):
        driver.command(Pose(driver.state().pose.position + [0, 0, 2e-3], driver.state().pose.quaternion))
        clock.tick()
        frames.append(sensor.read(0.0))
    assert frames[0] is first
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.1, 0.2])
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [0, 1, 2]
    sensor.restart()
    clock.restart()
    assert sensor.read(0.0).index == 0
