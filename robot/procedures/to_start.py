"""Arms are led to where an episode begins: zeroed, then moved, one after the other, each step after a person's yes."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from robot.arm.rtde import read_controller
from robot.arm.start_arm import StartArm
from robot.arm.status import ArmStatus
from robot.errors import DeviceError
from robot.procedures.start_way import Way, find_way, require_clear
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.models.hardware import UrArmConfig
from tacsim.models.rig import RigConfig

OFF_FORCE = 1.0  # a sensor that feels more at rest is to be zeroed [N]
TRIAL = 0.1  # share of a way that is gone first, and at most so many radians of the fastest joint
TRIAL_TURN = 0.05
REPEAT = 10e-3  # between two commands on a way [s]
PATIENCE = 10.0  # longest time without getting on [s]
PROGRESS = 10.0  # the time that is left is estimated from the progress in the last so many seconds
BRAKING = 2.0  # longest time to come to rest [s]


class Halted(Exception):
    """Somebody stopped the motion; the arm stands on its way."""


@dataclass(frozen=True, slots=True)
class Guide:
    """The person at the rig.

    ask: a question; True for yes. tell: is told what happens, a sentence at a time.
    show: is told, again and again, what an arm is doing. stop: True once somebody wants the motion to end.
    """

    ask: Callable[[str], bool]
    tell: Callable[[str], None]
    show: Callable[[str], None] = lambda words: None
    stop: Callable[[], bool] = lambda: False


def lead_to_start(config: RigConfig, starts: Mapping[str, Pose], guide: Guide) -> dict[str, float]:
    """Leads every arm of a rig to its start, if the person wants it; how far each then stands from there [m].

    Raises NoWay before anything is connected, Halted, and the error of an arm that is stopped; all arms brake then.
    """
    arms = {name: arm for name, arm in config.arms.items() if isinstance(arm, UrArmConfig)}
    missing = [name for name in arms if name not in starts]
    if missing:
        raise DeviceError(
            f"arms.{missing[0]}.start is missing: give the sensor's world pose at the start of an episode"
        )
    ways = {name: find_way(name, arm, read_controller(arm.host), starts[name]) for name, arm in arms.items()}
    if not guide.ask(
        "Connect, with a hand at the emergency stop and nobody in reach? Nothing moves yet; the controllers are told "
        "the TCP and the payload of the file."
    ):
        return {}
    with ExitStack() as stack:
        opened: dict[str, StartArm] = {}
        for name, arm in arms.items():
            way = ways[name]
            opened[name] = stack.enter_context(StartArm(arm, name, way.begin, way.end, keep_out=config.kept_out(name)))
        for each in opened.values():
            _zero(each, guide)
        for name, each in opened.items():
            others = {other: _place(arm) for other, arm in opened.items() if other != name}
            require_clear(name, ways[name], others, config.kept_out(name))
            _lead(each, ways[name], guide)
        return {name: se3.pose_distance(each.state().pose, starts[name])[0] for name, each in opened.items()}


def _zero(arm: StartArm, guide: Guide) -> None:
    """Offers to zero the force sensor of an arm at rest."""
    force = float(np.linalg.norm(arm.state().wrench[:3]))
    too_much = arm.status() == ArmStatus.FORCE_LIMIT
    if force <= OFF_FORCE and not too_much:
        return
    question = f"Arm '{arm.name}' feels {force:.1f} N at rest. Does its sensor touch nothing, and shall it be zeroed?"
    if guide.ask(question):
        arm.zero_wrench()
        if too_much:
            arm.recover()
        force = float(np.linalg.norm(arm.state().wrench[:3]))
        guide.tell(f"Arm '{arm.name}' is zeroed and feels {force:.1f} N.")
    elif too_much:
        guide.tell(f"Arm '{arm.name}' feels more than its limits and cannot be moved: see what it touches, or zero it.")


def _lead(arm: StartArm, way: Way, guide: Guide) -> None:
    if way.is_there:
        guide.tell(f"Arm '{arm.name}' stands at its start.")
        return
    if arm.status() == ArmStatus.FORCE_LIMIT:
        return
    trial = min(TRIAL, TRIAL_TURN / float(np.abs(way.end - way.begin).max()))
    guide.tell(f"Arm '{arm.name}': {way.describe()}.")
    guide.tell("Only the sensors' places and the forces are watched. Has the whole arm room, elbow and cables too?")
    for share, question in (
        (trial, f"Move arm '{arm.name}' the first {100 * trial:.0f} % of this way (Ctrl-C brakes it)?"),
        (1.0, f"Did arm '{arm.name}' go the right way, and shall it go on to its start (Ctrl-C brakes it)?"),
    ):
        if not guide.ask(question):
            guide.tell(f"Arm '{arm.name}' stays where it is.")
            return
        _move(arm, share, way.seconds, guide)
    guide.tell(f"Arm '{arm.name}' stands at its start.")


class Progress:
    """Estimates the time that a path takes, from the progress measured last; `seconds`: planned for the whole path."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._samples: deque[tuple[float, float]] = deque()  # time [s], share

    def add(self, now: float, share: float) -> None:
        """Takes the share of the path that lies behind at the time `now` [s]."""
        self._samples.append((now, share))
        while now - self._samples[0][0] > PROGRESS:
            self._samples.popleft()

    def seconds_left(self, goal: float) -> float:
        """Until the share `goal` of the path [s]: as planned in the first seconds, infinite if there is no progress."""
        (begun, first), (now, last) = self._samples[0], self._samples[-1]
        if now - begun < 0.2 * PROGRESS:
            return max(0.0, goal - last) * self._seconds
        return max(0.0, goal - last) * (now - begun) / (last - first) if last > first else math.inf


def _move(arm: StartArm, share: float, seconds: float, guide: Guide) -> None:
    """Goes on until this share of the way. Whatever ends it brakes the arm."""
    farthest, deadline, progress = -1.0, time.monotonic() + PATIENCE, Progress(seconds)
    try:
        while not arm.has_gone(share):
            if guide.stop():
                raise Halted(f"arm '{arm.name}' was stopped on its way to the start")
            arm.go_on(share)
            gone, now = arm.gone(), time.monotonic()
            if gone > farthest + 1e-3:
                farthest, deadline = gone, now + PATIENCE
            if now > deadline:
                raise DeviceError(
                    f"arm '{arm.name}' does not get on, {100 * gone:.0f} % of its way gone; it {arm.explain()}. Is its "
                    "speed slider low, or the other arm near?"
                )
            progress.add(now, gone)
            left = progress.seconds_left(share)
            estimate = f"about {left:.0f} s left" if math.isfinite(left) else "no progress"
            guide.show(f"arm '{arm.name}': {100 * max(0.0, gone):.0f} % of the way, {estimate} (Ctrl-C brakes)")
            time.sleep(REPEAT)
    except BaseException:
        arm.stop()
        until = time.monotonic() + BRAKING
        while time.monotonic() < until and not arm.status().is_fault and not arm.at_rest():
            time.sleep(REPEAT)
        raise
    arm.stop()


def _place(arm: StartArm) -> FloatArray:
    return arm.state().pose.position
