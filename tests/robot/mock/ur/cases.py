"""What each public call of ur_rtde 1.6.5 does against a mock, and the process that tries one of them.

A case is a function that calls some methods of one class of ur_rtde and asserts what came of it: by effect, seen in the
packages of another connection, wherever there is one. `python -m tests.robot.mock.ur.cases HOST NAME` runs one.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np

from robot.common.kinematics import Kinematics, displacement, matrix
from robot.mock import FaultClient
from tacsim.interface import FloatArray

PATIENCE = 60.0  # for anything that has to happen [s]
CLASSES = {
    "RTDEControlInterface": "rtde_control",
    "RTDEReceiveInterface": "rtde_receive",
    "RTDEIOInterface": "rtde_io",
    "DashboardClient": "dashboard_client",
}


class Verdict(Enum):
    """What a call comes to; the value is what the documentation says."""

    ROBOT = "as a robot"
    LIBRARY = "as a robot; behaviour of ur_rtde"
    CONSTANT = "constant"
    REFUSED = "refused"
    NOT_THERE = "not there"


@dataclass(frozen=True)
class Case:
    """Some methods of one class, what they come to, and what tries them."""

    of: str
    methods: tuple[str, ...]
    verdict: Verdict
    note: str
    run: Callable[[Robot], None]


CASES: dict[str, Case] = {}


def case(of: str, methods: str, verdict: Verdict = Verdict.ROBOT, note: str = "") -> Callable[[Any], Any]:
    """Enters a function into CASES by its name."""

    def enter(run: Callable[[Robot], None]) -> Callable[[Robot], None]:
        assert run.__name__ not in CASES
        CASES[run.__name__] = Case(of, tuple(methods.split()), verdict, note, run)
        return run

    return enter


class Robot:
    """The four clients of one mock, each made when it is first asked for, and the mock's faults."""

    def __init__(self, host: str) -> None:
        self.host, self.faults = host, FaultClient(host)
        self.kinematics = Kinematics()

    @cached_property
    def control(self) -> Any:
        return import_module("rtde_control").RTDEControlInterface(self.host)

    @cached_property
    def receive(self) -> Any:
        return import_module("rtde_receive").RTDEReceiveInterface(self.host)

    @cached_property
    def io(self) -> Any:
        return import_module("rtde_io").RTDEIOInterface(self.host)

    @cached_property
    def dashboard(self) -> Any:
        client = import_module("dashboard_client").DashboardClient(self.host)
        client.connect()
        return client

    def until(self, done: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < end, f"not in time; the mock: {self.faults.state()}, {self.faults.log()[-3:]}"
            time.sleep(0.002)

    def rest(self) -> FloatArray:
        """Waits until the arm rests; the pose of its TCP."""
        self.until(lambda: max(map(abs, self.receive.getActualQd())) < 1e-9)
        return np.array(self.receive.getActualTCPPose())

    def at(self, pose: Sequence[float] | FloatArray, within: float = 1e-7) -> None:
        """Waits until the arm rests, which must be at this pose."""
        off = displacement(matrix(self.rest()), matrix(pose))
        assert np.abs(off).max() < within, off

    def shifted(self, *step: float) -> list[float]:
        pose: list[float] = self.receive.getTargetTCPPose()
        return [value + change for value, change in zip(pose, [*step, *[0.0] * (6 - len(step))], strict=True)]

    def again(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """The second answer: the library returns at once what the registers held before."""
        call(*arguments)
        begun = self.receive.getTimestamp()
        self.until(lambda: self.receive.getTimestamp() > begun + 0.2)
        return call(*arguments)

    @contextlib.contextmanager
    def refused(self, words: str) -> Iterator[None]:
        """The program ends, and the mock says why."""
        with contextlib.suppress(Exception):
            yield
        self.until(lambda: not self.faults.state().program)
        assert words in self.faults.state().stop_reason, self.faults.state().stop_reason


def main(host: str, name: str) -> None:
    """Runs one case, and leaves without the destructors of the library, which take a second."""
    robot = Robot(host)
    robot.faults.reset()
    try:
        CASES[name].run(robot)
    except BaseException as error:
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        raise
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    from tests.robot.mock.ur import arm_cases, cases, control_cases, other_cases  # noqa: F401  # they enter CASES

    cases.main(*sys.argv[1:])
