"""STOP: reaches each arm at once, and keeps queued starts from moving."""

from __future__ import annotations

import threading
from typing import Any, cast

import pytest

from robot.errors import DeviceError
from robot.rig.commanded_arm import ArmHalted, CommandedArm
from robot.serve.stop_switch import StopSwitch
from tacsim.interface import HardwareArm, Pose
from tests.robot.waiting import PATIENCE, until

HERE = Pose([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])


class Driver:
    """A driver of an arm; `block` keeps its stop from returning, `failure` is what its stop raises."""

    def __init__(self, failure: Exception | None = None) -> None:
        self.calls: list[str] = []
        self.block, self.failure = threading.Event(), failure
        self.block.set()

    def command(self, target: Pose | None, speed: float | None = None) -> Pose | None:
        self.calls.append("command")
        return target

    def stop(self) -> None:
        assert self.block.wait(PATIENCE)
        self.calls.append("stop")
        if self.failure is not None:
            raise self.failure


def make_arm(driver: Driver) -> CommandedArm:
    return CommandedArm(cast(HardwareArm, cast(Any, driver)))


@pytest.mark.promise(16)
def test_an_arm_that_does_not_answer_delays_no_other() -> None:
    blocked, free = Driver(), Driver()
    blocked.block.clear()
    switch = StopSwitch(pytest.fail)
    arms = {"blocked": make_arm(blocked), "free": make_arm(free)}
    switch.connect(arms)
    switch.press()
    until(lambda: free.calls == ["stop"])
    assert blocked.calls == []
    for arm in arms.values():  # also of the one that has not answered yet
        with pytest.raises(ArmHalted, match="start again"):
            arm.send(HERE)
    blocked.block.set()
    until(lambda: blocked.calls == ["stop"])


@pytest.mark.promise(16)
def test_commands_pass_again_after_release() -> None:
    driver = Driver()
    switch, arm = StopSwitch(pytest.fail), make_arm(driver)
    switch.connect({"arm": arm})
    switch.press()
    until(lambda: driver.calls == ["stop"])
    assert switch.is_pressed and switch.release(switch.count) and not switch.is_pressed
    assert arm.send(HERE) is HERE


@pytest.mark.promise(16)
def test_a_start_before_a_stop_does_not_end_it() -> None:
    driver = Driver()
    switch, arm = StopSwitch(pytest.fail), make_arm(driver)
    switch.connect({"arm": arm})
    count = switch.count  # a start is accepted here, and carried out later
    switch.press()
    assert not switch.release(count) and switch.is_pressed
    with pytest.raises(ArmHalted):
        arm.send(HERE)


@pytest.mark.promise(16)
def test_an_arm_that_does_not_take_the_stop_is_reported() -> None:
    reported: list[str] = []
    switch = StopSwitch(reported.append)
    switch.connect({"upper": make_arm(Driver(DeviceError("the line is cut")))})
    switch.press()
    until(lambda: bool(reported))
    assert reported == ["arm 'upper' did not take STOP: the line is cut. Press its emergency stop"]
