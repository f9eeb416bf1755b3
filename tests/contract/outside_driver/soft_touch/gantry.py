"""The driver `gantry`: one arm in software, which goes straight to its targets."""

from __future__ import annotations

import math
import time
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from tacsim import (
    ActionError,
    ArmConfig,
    ArmDriver,
    ArmExamination,
    ArmLimits,
    ArmState,
    Check,
    GelReading,
    Placement,
    Pose,
)
from tacsim import pose as se3

STIFFNESS = 2e3  # of gel and table [N/m]
OPEN: dict[str, Gantry] = {}


class GantryConfig(ArmConfig):
    driver: Literal["gantry"]
    limits: ArmLimits
    start: Placement
    table: Annotated[float, Field(lt=0)] = -5e-3  # height of the table, in world z [m]

    @property
    def is_real(self) -> bool:
        return False


class Gantry:
    latency = alignment = 0.0

    def __init__(self, config: GantryConfig, name: str) -> None:
        self._config, self._name = config, name
        start = config.start.pose
        self._paths = [(time.monotonic(), start, start, config.limits.speed)]  # since when, from, to, how fast
        self._zero = 0.0
        self._stopped = ""
        OPEN[name] = self

    def pose_at(self, moment: float) -> tuple[Pose, bool]:
        """Where it is, and whether it rests."""
        paths = [path for path in self._paths if path[0] <= moment] or self._paths[:1]
        begun, origin, target, speed = paths[-1]
        length = se3.pose_distance(origin, target)[0]
        share = min(1.0, max(0.0, (moment - begun) * speed / max(length, 1e-12)))
        return se3.interpolate_pose(origin, target, share), share == 1.0

    def depth_at(self, moment: float) -> float:
        """How deep the table presses the gel [m]."""
        return max(0.0, self._config.table - float(self.pose_at(moment)[0].position[2]))

    def state(self, at: float | None = None) -> ArmState:
        moment = time.monotonic() if at is None else at
        wrench = np.zeros(6)
        wrench[2] = -STIFFNESS * self.depth_at(moment) - self._zero
        return ArmState(self.pose_at(moment)[0], np.zeros(6), wrench, None, moment)

    def command(self, target: Pose | None, speed: float | None = None) -> Pose | None:
        now = time.monotonic()
        here = self.pose_at(now)[0]
        if self._stopped:
            raise RuntimeError(f"gantry '{self._name}' is stopped: {self._stopped}")
        if target is None:
            self._paths.append((now, here, here, 1.0))
            return None
        box = self._config.limits.workspace
        if (target.position < box.lower).any() or (target.position > box.upper).any():
            raise ActionError(f"gantry '{self._name}': {target.position} m is outside its workspace")
        self._paths = [*self._paths[-500:], (now, here, target, min(speed or math.inf, self._config.limits.speed))]
        return target

    def at_rest(self) -> bool:
        return self.pose_at(time.monotonic())[1]

    def arrived(self, target: Pose, *, within: float, turn: float) -> bool:
        return self.at_rest() and se3.pose_distance(self.state().pose, target)[0] <= within

    def zero_wrench(self) -> None:
        self._zero += float(self.state().wrench[2])

    def report_tactile(self, reading: GelReading | None) -> None:
        depth = self._config.limits.depth
        if reading is not None and depth is not None and reading.depth > depth:
            self.stop()
            self._stopped = f"its gel is pressed {1e3 * reading.depth:.2f} mm deep"

    def explain(self) -> str:
        return f"gantry '{self._name}' {self._stopped or 'is well'}"

    def stop(self) -> None:
        now = time.monotonic()
        here = self.pose_at(now)[0]
        self._paths.append((now, here, here, 1.0))

    def recover(self) -> None:
        self._stopped = ""

    def close(self) -> None:
        OPEN.pop(self._name, None)


class GantryDriver(ArmDriver[GantryConfig]):
    config_class = GantryConfig

    def open(self) -> Gantry:
        return Gantry(self.config, self.name)

    def worst_latency(self) -> float:
        return 0.02

    def examine(self, start: Pose | None, file: str) -> ArmExamination:
        return ArmExamination([Check(f"{self.name}: gantry", "ok", f"referenced; see {file}")], start)
