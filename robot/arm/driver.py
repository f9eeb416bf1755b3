"""The driver `ur`: a Universal Robots arm, real or mock."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from robot.arm.tuning import BRAKING_REACTION_TIME
from tacsim.interface import HardwareArm, Pose
from tacsim.models.driver import ArmDriver, ArmExamination
from tacsim.models.hardware import UrArmConfig

if TYPE_CHECKING:
    from robot.arm.status import PackageLog
    from robot.arm.ur import URArm


class UrDriver(ArmDriver[UrArmConfig]):
    """A UR arm (CB3 or e-Series) by RTDE, real or mock."""

    config_class = UrArmConfig
    keeps_distances = True

    @property
    def companion(self) -> str | None:
        return None if self.config.mock is None else "robot.mock.cell.cell:MockCell"

    def require(self) -> None:
        from robot.arm.channel import check_host

        check_host(self.config, self.name)

    def open(self) -> URArm:
        from robot.arm.ur import URArm

        return URArm(self.config, self.name, keep_out=self.keep_out)

    def worst_latency(self) -> float:
        return BRAKING_REACTION_TIME

    def examine(self, start: Pose | None, file: str) -> ArmExamination:
        from robot.arm.examine import examine

        return examine(self.name, self.config, start, file)

    def package_log(self, arm: HardwareArm) -> PackageLog:
        return cast("URArm", arm).package_log()
