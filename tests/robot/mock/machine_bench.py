"""A machine without sockets, in simulated time, and a client that writes its registers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from robot.common.kinematics import pose
from robot.mock.ur.machine.arm import PERIOD, Arm
from robot.mock.ur.machine.machine import Machine
from robot.mock.ur.machine.program import COMMANDS
from tacsim.interface import FloatArray
from tests.robot.mock.wire_client import control_script

DOWN = (-0.4, -0.2, 0.3, 0.0, math.pi, 0.0)


class Bench:
    """A machine that runs the control script, and its client."""

    def __init__(self, script: str | None = None) -> None:
        self.machine = Machine()
        self.arm: Arm = self.machine.arm
        assert self.machine.start(script or control_script())
        self.tick()

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            self.machine.tick()

    def until(self, done: Callable[[], bool], limit: float = 20.0) -> int:
        """Ticks until it holds."""
        for count in range(round(limit / PERIOD)):
            if done():
                return count
            self.machine.tick()
        raise AssertionError(f"not within {limit} s; log: {list(self.machine.log)}")

    def write(self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()) -> None:
        self.machine.in_int[: 1 + len(integers)] = [command, *integers]
        self.machine.in_double[: len(doubles)] = [float(value) for value in doubles]
        self.machine.on_int_register(0)

    def call(self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()) -> int:
        """One command to its end; ticks it took."""
        self.write(command, doubles, integers)
        if COMMANDS[command].every_cycle:
            self.tick()
            return 1
        count = self.until(lambda: self.machine.out_int[0] == 2 or self.machine.program is None)
        self.write(0)
        self.tick()
        return count

    @property
    def answer(self) -> FloatArray:
        return np.array(self.machine.out_double[:6])

    @property
    def integer(self) -> int:
        return self.machine.out_int[1]

    def shifted(self, *step: float) -> list[float]:
        """The pose of the TCP, moved by so much."""
        return list(pose(self.arm.target_frame) + np.array([*step, *[0.0] * (6 - len(step))]))
