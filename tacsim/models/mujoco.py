"""What a rig file says of arms, grippers and sensors that MuJoCo moves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from tacsim.models.hardware import ArmConfig, Delay, GripperConfig, Name, Placement, SensorConfig
from tacsim.models.limits import ArmLimits
from tacsim.models.quantity import Force, Length, Speed
from tacsim.models.rig import WrenchNoise
from tacsim.models.sensor import SensorModel

ElementName = Annotated[str, Field(min_length=1, max_length=200)]  # in a model of MuJoCo


class MujocoArmConfig(ArmConfig):
    """An arm in MuJoCo, which carries a gripper: a free flange without an arm, a UR5e, or a model of the user."""

    driver: Literal["mujoco"]
    # free: reaches every commanded pose exactly; ur5e: its joints are controlled; or the path of an MJCF file
    # (.xml), with the names of the joints that move it
    model: Annotated[str, Field(min_length=1, max_length=4096)] = "free"
    joints: tuple[ElementName, ...] = Field(default=(), max_length=32)  # of an MJCF file, from the base
    flange: ElementName = "flange"  # of an MJCF file: the site that carries a gripper, z away from the arm
    world_from_base: Placement = Placement()  # of what is not free
    speed: Annotated[Speed, Field(gt=0)] = 50e-3  # longest motion of a control period / period [m/s]
    turn_rate: Annotated[float, Field(gt=0)] = 0.5  # the same for rotation [rad/s]
    # world_from_gripper where an episode begins; None: around the object, which the reset then grips
    start: Placement | None = None
    limits: ArmLimits | None = None  # as of a simulated arm (SimArmConfig)
    error: Placement = Placement()
    noise: WrenchNoise = WrenchNoise()
    delay: Delay = 0

    @property
    def is_real(self) -> bool:
        return False

    @property
    def file(self) -> str | None:
        """The MJCF file of the user, where `model` is one."""
        return None if self.model in ("free", "ur5e") else self.model

    @property
    def joint_count(self) -> int:
        return {"free": 0, "ur5e": 6}.get(self.model, len(self.joints))

    @model_validator(mode="after")
    def _require_model(self) -> Self:
        if self.file is not None and not self.file.endswith(".xml"):
            raise ValueError(f"model is '{self.model}'; allowed: free, ur5e, or the path of an MJCF file (.xml)")
        if (self.file is not None) != bool(self.joints):
            fits = "name the joints of the file that move it" if self.file else "only those of an MJCF file have names"
            raise ValueError(f"joints: {fits}")
        return self


class MujocoGripperConfig(GripperConfig):
    """A parallel gripper in MuJoCo, with a gel on each finger; or fingers of the user's MJCF file."""

    driver: Literal["mujoco"]
    arm: Name
    # parallel: light, forces from 0 N up; 2f85: as wide, strong and fast as a 2F-85; null: in the arm's MJCF file
    model: Literal["parallel", "2f85"] | None = "parallel"
    width: tuple[Annotated[Length, Field(ge=0)], Annotated[Length, Field(gt=0)]] | None = None  # least, greatest [m]
    force: tuple[Annotated[Force, Field(ge=0)], Annotated[Force, Field(gt=0)]] | None = None  # least, greatest [N]
    speed: Annotated[Speed, Field(gt=0, le=1)] | None = None  # of each finger [m/s]
    # In an MJCF file: slide joints of the left and the right finger, 0 where the pads touch and growing as they open;
    # the site of the tool, between the pads (z along the fingers, x from left to right); and the sites of the pads.
    joints: tuple[ElementName, ElementName] | None = None
    tool: ElementName | None = None
    pads: tuple[ElementName, ElementName] | None = None

    @property
    def is_real(self) -> bool:
        return False

    @model_validator(mode="after")
    def _require_consistent(self) -> Self:
        named = [key for key in ("joints", "tool", "pads") if getattr(self, key) is not None]
        if self.model is not None and named:
            raise ValueError(f"{named[0]}: only a gripper in the arm's MJCF file has it; set model: null, or leave out")
        needed = [key for key in ("joints", "tool", "pads", "width", "force", "speed") if getattr(self, key) is None]
        if self.model is None and needed:
            raise ValueError(f"{needed[0]} is missing: a gripper in the arm's MJCF file (model: null) needs it")
        for key in ("width", "force"):
            given = getattr(self, key)
            if given is not None and not given[0] < given[1]:
                raise ValueError(f"{key}: the least, {given[0]:g}, must be below the greatest, {given[1]:g}")
        return self


class MujocoSensorConfig(SensorConfig):
    """A tactile sensor on a finger of a gripper in MuJoCo."""

    is_simulated: ClassVar[bool] = True
    driver: Literal["mujoco"]
    gripper: Name
    side: Literal["left", "right"]  # its finger
    model: SensorModel = SensorModel()
    delay: Delay = 0
    # Where height and flow come from. gel: the simulated gel; picture: found in its picture, as on a robot
    surface: Literal["gel", "picture"] = "gel"

    @property
    def sensor_model(self) -> SensorModel | None:
        return self.model

    def rendered_model(self, load: Callable[[Path], SensorModel]) -> SensorModel:
        return self.model

    def without_gel_size(self) -> Self:
        model = self.model.model_copy(update={"gel_size": None, "gel_thickness": None})
        return self.model_copy(update={"model": model})
