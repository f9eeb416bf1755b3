"""STOP of a served rig: brakes every arm at once and keeps commands from them until an operator starts again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from robot.rig.commanded_arm import CommandedArm
from robot.serve.errors import describe


class StopSwitch:
    """All methods may be called in any thread; none waits for an arm.

    report: gets a text when an arm does not take the stop.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._arms: Mapping[str, CommandedArm] = {}
        self._is_pressed = False
        self._count = 0

    @property
    def is_pressed(self) -> bool:
        return self._is_pressed

    @property
    def count(self) -> int:
        """How often it was pressed."""
        return self._count

    def connect(self, arms: Mapping[str, CommandedArm]) -> None:
        """Sets the arms to halt, by name. Those of a simulation end with their episode."""
        with self._lock:
            self._arms = dict(arms)

    def press(self) -> None:
        """Halts every arm, each in a thread of its own: an arm that does not answer delays no other."""
        with self._lock:
            self._count += 1
            self._is_pressed = True
            arms = self._arms
            for arm in arms.values():
                arm.refuse_commands()
        for name, arm in arms.items():
            threading.Thread(target=self._halt, args=(name, arm), name=f"stop {name}", daemon=True).start()

    def release(self, count: int) -> bool:
        """Accepts commands again. False, and nothing changes, if it was pressed after `count` was read."""
        with self._lock:
            if self._count != count:
                return False
            for arm in self._arms.values():
                arm.accept_commands()
            self._is_pressed = False
            return True

    def _halt(self, name: str, arm: CommandedArm) -> None:
        try:
            arm.halt()
        except Exception as failure:
            self._report(f"arm '{name}' did not take STOP: {describe(failure)}. Press its emergency stop")
