"""An arm that is led to its start from wherever it stands: the driver's side of robot.arm.start_servo."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from robot.arm.channel import CommandKind
from robot.arm.status import ArmStatus
from robot.arm.ur import URArm
from robot.errors import DeviceError
from tacsim.interface import FloatArray, Pose
from tacsim.models.hardware import UrArmConfig

THERE = 3e-3  # a joint this near to where it shall be is there [rad]


class StartArm(URArm):
    """As URArm, for one way: straight in joint space from `begin` to `end` (6,) [rad]. It may stand outside its
    workspace, and be opened while it feels more than its limits; then it can be zeroed, and does not move before
    `recover`."""

    _bearable = (ArmStatus.FORCE_LIMIT,)

    def __init__(
        self,
        config: UrArmConfig,
        name: str,
        begin: FloatArray,
        end: FloatArray,
        *,
        keep_out: Mapping[str, float] | None = None,
    ) -> None:
        self._way = np.array(begin, dtype=np.float64), np.array(end, dtype=np.float64)
        super().__init__(config, name, keep_out=keep_out)

    def command(self, target: Pose | None, speed: float | None = None) -> Pose | None:
        """Only None, which holds."""
        if target is not None:
            raise DeviceError(f"arm '{self.name}' is being led to its start and follows no targets")
        return super().command(None)

    def go_on(self, share: float) -> None:
        """Goes along the way up to this share of it; must be repeated within `action_timeout`, else the arm holds.

        Raises the error of its status when it cannot.
        """
        with self._lock:
            self._require_able()
            self._send(CommandKind.GO_ON, share=share)

    def gone(self) -> float:
        """The share of the way that lies behind it."""
        assert self._way is not None
        begin, end = self._way
        joints = self.state().joints
        assert joints is not None
        along = end - begin
        return float((joints - begin) @ along / max(float(along @ along), 1e-12))

    def has_gone(self, share: float) -> bool:
        """True if it rests at this share of its way."""
        assert self._way is not None
        begin, end = self._way
        joints = self.state().joints
        assert joints is not None
        return float(np.abs(begin + share * (end - begin) - joints).max()) < THERE and self.at_rest()
