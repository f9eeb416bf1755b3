"""Limits of an arm: workspace, planes, speeds, forces, indentation."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from tacsim.limits import Region, box_region
from tacsim.models.quantity import Acceleration, Config, Force, Length, Speed

Vector = tuple[Length, Length, Length]


class Workspace(Config):
    """A box along the world axes. The origin of the sensor (the middle of its gel) must stay inside."""

    lower: Vector  # corner of the least x, y, z [m]
    upper: Vector  # the opposite corner [m]

    @model_validator(mode="after")
    def _require_volume(self) -> Self:
        for axis, low, high in zip("xyz", self.lower, self.upper, strict=True):
            if not low < high:
                raise ValueError(f"no inside: {axis} runs from {low:g} to {high:g} m; lower must be below upper")
        return self


class Plane(Config):
    """The origin of the sensor must stay on the side of this plane to which the normal points. World axes."""

    point: Vector  # any point of the plane [m]
    normal: tuple[float, float, float]  # of any length

    @model_validator(mode="after")
    def _require_normal(self) -> Self:
        if float(np.linalg.norm(self.normal)) < 1e-9:
            raise ValueError("normal must not be zero")
        return self


class ArmLimits(Config):
    """What an arm may do. These limits guard the work, not people: they are no safety function.

    The workspace has no default, because none suits every cell. Speeds and accelerations are those of the sensor's
    origin; force and torque are what the object does to the sensor.
    """

    workspace: Workspace
    planes: tuple[Plane, ...] = Field(default=(), max_length=16)
    speed: Annotated[Speed, Field(gt=0, le=1.0)] = 50e-3  # [m/s]
    turn_rate: Annotated[float, Field(gt=0, le=3.0)] = 0.5  # [rad/s]
    acceleration: Annotated[Acceleration, Field(gt=0, le=10.0)] = 0.5  # [m/s^2]
    turn_acceleration: Annotated[float, Field(gt=0, le=50.0)] = 5.0  # [rad/s^2]
    joint_speed: Annotated[float, Field(gt=0, le=3.14)] = 1.0  # of any joint; bounds the step of each period [rad/s]
    force: Annotated[Force, Field(gt=0, le=250.0)] = 30.0  # |force| beyond it stops the arm [N]
    torque: Annotated[float, Field(gt=0, le=50.0)] = 3.0  # |torque| about the sensor's origin [N m]
    # How far the arm may be from where it was sent, its usual lag not counted; beyond it stops. None: as
    # `max_following_error` and `max_following_turn` say.
    following_error: Annotated[Length, Field(gt=0)] | None = None  # of the sensor's origin [m]
    following_turn: Annotated[float, Field(gt=0)] | None = None  # of its axes [rad]
    depth: Annotated[Length, Field(gt=0)] | None = None  # deepest the gel may be pressed; None: not monitored [m]
    shear: Annotated[Length, Field(gt=0)] | None = None  # farthest its surface may be dragged; None: not monitored [m]

    @property
    def max_following_error(self) -> float:
        """`following_error`, or 1 mm + `speed` x 10 ms + `acceleration` x (50 ms)^2 [m]: servoJ leads joints that
        accelerate fast a little off the straight line."""
        usual = 1e-3 + 10e-3 * self.speed + 50e-3**2 * self.acceleration
        return usual if self.following_error is None else self.following_error

    @property
    def max_following_turn(self) -> float:
        """`following_turn`, or 0.01 rad + `turn_rate` x 10 ms + `max_following_error` / 0.4 m [rad]."""
        usual = 0.01 + 10e-3 * self.turn_rate + self.max_following_error / 0.4
        return usual if self.following_turn is None else self.following_turn

    @property
    def region(self) -> Region:
        """Where the sensor's origin may be: the workspace, cut by the planes."""
        return box_region(
            self.workspace.lower, self.workspace.upper, [(each.point, each.normal) for each in self.planes]
        )
