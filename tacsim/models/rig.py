"""What a rig file may say: clock, scene, task, arms, sensors. No global type: each driver is chosen by itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, Union, get_args

from pydantic import ConfigDict, Field, GetCoreSchemaHandler, model_validator
from pydantic_core import CoreSchema, PydanticCustomError

from tacsim.models.driver import DriversMissing, installed_drivers
from tacsim.models.hardware import (
    ArmConfig,
    Delay,
    GripperConfig,
    KeepOut,
    MountConfig,
    Name,
    Placement,
    ResetConfig,
    SensorConfig,
)
from tacsim.models.limits import ArmLimits, Vector
from tacsim.models.quantity import Angle, Config, Force, Length, Speed, Time
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid, PictureRegion, SensorModel
from tacsim.models.task import TASKS, TaskConfig, task_annotation

Pixels = Annotated[int, Field(ge=16, le=4096)]


class WrenchNoise(Config):
    """Of an arm's force sensor, independent along each axis of the wrench that it reports."""

    force: Annotated[Force, Field(ge=0)] = 0.0  # standard deviation of one reading [N]
    torque: Annotated[float, Field(ge=0)] = 0.0  # the same [N m]
    # The zero wanders from where it is at reset (a random walk): its standard deviation after a minute, in those above.
    drift: Annotated[float, Field(ge=0)] = 0.0
    seed: Annotated[int, Field(ge=0)] = 0


class SimArmConfig(ArmConfig):
    """A simulated arm: reaches every commanded pose exactly, within the motion that one control period allows."""

    driver: Literal["sim"]
    speed: Annotated[Speed, Field(gt=0)] = 20e-3  # longest motion of a control period / period [m/s]
    turn_rate: Annotated[float, Field(gt=0)] = 0.5  # the same for rotation [rad/s]
    # Those of the real arm, so that a policy meets them in simulation too: workspace, planes, speed, turn_rate, force,
    # torque, depth, shear. Accelerations and joints are not simulated; limits are checked once a period.
    limits: ArmLimits | None = None
    # Measured pose of the sensor, relative to its true one: the error that a calibration leaves. An episode begins
    # where the arm measures its start.
    error: Placement = Placement()
    noise: WrenchNoise = WrenchNoise()
    mount: MountConfig = MountConfig()  # between arm and sensor
    delay: Delay = 0  # its states are those of so many control periods ago

    @property
    def is_real(self) -> bool:
        return False


class ReplayArmConfig(ArmConfig):
    """Arm states of a recording: an episode (.mcap), or a CSV file with a row a frame."""

    driver: Literal["replay"]
    source: str | None = None  # None: the recording has no such arm, the rig is opened without it
    force_column: str = "force_N"  # normal force, positive when pressed [N]
    width_column: str | None = "gripper_width_m"  # opening of a parallel gripper [m]

    @property
    def is_real(self) -> bool:
        return False


class ReplayGripperConfig(GripperConfig):
    """The gripper states of an episode (.mcap)."""

    driver: Literal["replay"]
    source: str | None = None  # None: the recording has no such gripper, the rig is opened without it

    @property
    def is_real(self) -> bool:
        return False


class SimSensorConfig(SensorConfig):
    is_simulated: ClassVar[bool] = True
    driver: Literal["sim"]
    arm: Name
    model: SensorModel = SensorModel()
    delay: Delay = 0  # its pictures are those of so many control periods ago

    @property
    def sensor_model(self) -> SensorModel:
        return self.model

    def rendered_model(self, load: Callable[[Path], SensorModel]) -> SensorModel:
        return self.model

    def without_gel_size(self) -> Self:
        model = self.model.model_copy(update={"gel_size": None, "gel_thickness": None})
        return self.model_copy(update={"model": model})


class ReplaySensorConfig(SensorConfig):
    """Recorded frames: an episode (.mcap), a folder of images, a video, or a ROS 2 bag in MCAP."""

    driver: Literal["replay"]
    source: str | None = None
    topic: str | None = None  # of a ROS 2 bag, of type sensor_msgs/msg/CompressedImage; None: its only one
    fps: Annotated[float, Field(gt=0, le=1000)] = 30.0  # of a folder of images
    # Gel corners in the image (u, v) [px]: top left, top right, bottom right, bottom left; None: the whole image.
    corners: tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]] | None = None
    size: tuple[Annotated[Length, Field(gt=0)], Annotated[Length, Field(gt=0)]] = (16e-3, 16e-3)  # between them [m]
    region: PictureRegion | None = None  # part of the picture that shows gel; None: all of it between the corners
    reference: str | None = None  # picture without contact; None: the first frame
    calibration: str | None = None  # bundle of `tacsim calibrate sensor`, instead of corners: height is found by it
    # Distance of the dots printed on the gel [m], instead of corners or calibration: they are found in the reference,
    # say how large the picture is, and are followed. Flow, but no height.
    marker_pitch: Annotated[Length, Field(gt=0)] | None = None

    @property
    def bundle(self) -> str | None:
        return self.calibration

    @model_validator(mode="after")
    def _require_one_geometry(self) -> Self:
        if sum(each is not None for each in (self.corners, self.calibration, self.marker_pitch)) > 1:
            raise ValueError("give one of corners, calibration, marker_pitch: each says where the gel lies")
        if self.region is not None and self.calibration is not None:
            raise ValueError("a calibration brings its own region: give it to `tacsim calibrate sensor --region`")
        return self


SimMotion = Literal["settled", "flowing", "dynamic"]


class ViewConfig(Config):
    """A camera that looks at the scene of a rig in MuJoCo."""

    position: Vector  # world [m]
    target: Vector = (0.0, 0.0, 0.0)  # in the middle of its picture, world [m]
    field_of_view: Annotated[Angle, Field(gt=0.01, lt=2.8)] = math.pi / 4  # from the top to the bottom [rad]
    size: tuple[Pixels, Pixels] = (320, 240)  # width, height [px]

    @model_validator(mode="after")
    def _require_direction(self) -> Self:
        if math.dist(self.position, self.target) < 1e-6:
            raise ValueError("position and target are the same point; it must look somewhere")
        return self


class RecordConfig(Config):
    """What a recording holds beyond pictures, states and actions."""

    arm_packages: bool = False  # every package of the controllers of UR arms, as it came (500 Hz)
    # Of simulated rigs: some thousand particles of the body a step, to look at (60 kB). None: `tacsim run` records them
    # where there is a body, data sets do not
    body: bool | None = None


class RigConfig(Config):
    """One rig file. Its arms, grippers and sensors are of the installed drivers, which are looked up when the first rig
    is read or made (tacsim.models.driver)."""

    model_config = ConfigDict(defer_build=True)

    name: str
    clock: Literal["sim", "mujoco", "wall", "replay"]
    period: Annotated[Time, Field(gt=0)] = 0.1  # control period; a replay takes that of its recording [s]
    task: TaskConfig | None = None
    scene: Scene | None = None  # overrides the task's scene
    arms: dict[Name, ArmConfig] = {}
    grippers: dict[Name, GripperConfig] = {}
    sensors: dict[Name, SensorConfig] = Field(min_length=1)
    # Cameras that look at the scene of a rig in MuJoCo: `Observation.views`, rendered when they are looked at
    cameras: dict[Name, ViewConfig] = Field(default={}, max_length=8)
    canonical: CanonicalGrid = CanonicalGrid()
    motion: SimMotion = "settled"  # of simulated rigs, during a control period; a reset always settles
    # Mock rigs: a control period ends when the arms rest and the picture of just that pose is rendered.
    lock_step: bool = True
    # Mock rigs: wrenches and pictures come from the simulator, or from a ball's contact in closed form: in real time,
    # but without a body, for tests of timing.
    contact: Literal["simulated", "hertz"] = "simulated"
    keep_out: tuple[KeepOut, ...] = Field(default=(), max_length=16)
    start: ResetConfig = ResetConfig()  # reset of rigs of hardware, real or mock
    record: RecordConfig = RecordConfig()

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return handler(rig_model())

    @model_validator(mode="after")
    def _require_consistent(self) -> Self:
        if self.cameras and self.clock != "mujoco":
            raise PydanticCustomError(
                "no_views",
                "only a rig with clock 'mujoco' has cameras that look at its scene; cameras of gels are sensors",
                {"at": ("cameras",)},
            )
        for name, sensor in self.sensors.items():
            if sensor.arm is not None:
                self._require_arm(sensor.arm, "sensors", name, sensor.driver, "arm")
            if sensor.gripper is not None:
                self._require_gripper(sensor, "sensors", name, sensor.driver, "gripper")
        for name, gripper in self.grippers.items():
            if gripper.arm is not None:
                self._require_arm(gripper.arm, "grippers", name, gripper.driver, "arm")
        for index, apart in enumerate(self.keep_out):
            for name in apart.arms:
                self._require_arm(name, "keep_out", index, "arms")
        if self.record.arm_packages and not any(arm.records_packages for arm in self.arms.values()):
            raise PydanticCustomError(
                "no_packages",
                "this rig has no UR arm, whose packages could be recorded; leave it out",
                {"at": ("record", "arm_packages")},
            )
        if self.record.body and not self._has_body():
            raise PydanticCustomError(
                "no_body", "only a simulated rig with a body knows its body; leave it out", {"at": ("record", "body")}
            )
        for name, arm in self.arms.items():
            limits = arm.stop_limits
            if self.task is not None and limits is not None and not self.task.touch_force < limits.force:
                raise PydanticCustomError(
                    "touch_beyond_limit",
                    "arm '{arm}' stops at {force} N, and a reset presses by task.touch_force, {touch} N; give more",
                    {
                        "arm": name,
                        "force": f"{limits.force:g}",
                        "touch": f"{self.task.touch_force:g}",
                        "at": ("arms", name, arm.driver, "limits", "force"),
                    },
                )
            mount = getattr(getattr(arm, "mock", None), "mount", None)
            if not self.lock_step and mount is not None and mount.stiffness is not None:
                raise PydanticCustomError(
                    "free_mount",
                    "a mock mount gives way once in a control period, so it needs lock_step: true; or leave it out",
                    {"at": ("arms", name, arm.driver, "mock", "mount")},
                )
        for name, load in ({} if self.task is None else self.task.held_loads).items():
            self._check_load(name, load)
        return self

    @property
    def records_body(self) -> bool:
        """Whether the particles of the body are recorded."""
        return self._has_body() if self.record.body is None else self.record.body

    def _has_body(self) -> bool:
        return self.clock == "sim" and self.scene is not None and self.scene.body is not None

    def _require_arm(self, arm: str, *at: str | int) -> None:
        """`at`: the entry that names the arm, as pydantic writes locations (tacsim.config shows its line)."""
        if arm not in self.arms:
            context = {"arm": arm, "arms": ", ".join(self.arms) or "(none)", "at": at}
            raise PydanticCustomError("no_such_arm", "no arm '{arm}'; allowed: {arms}", context)

    def _require_gripper(self, sensor: SensorConfig, *at: str | int) -> None:
        """As `_require_arm`, of the gripper that carries a sensor."""
        context = {"gripper": sensor.gripper, "grippers": ", ".join(self.grippers) or "(none)", "at": at}
        if sensor.gripper not in self.grippers:
            raise PydanticCustomError("no_such_gripper", "no gripper '{gripper}'; allowed: {grippers}", context)
        if sensor.arm is not None:
            raise PydanticCustomError(
                "two_carriers",
                "gripper '{gripper}' carries this sensor; leave out `arm`, which is the gripper's",
                context,
            )

    def _check_load(self, name: str, load: float) -> None:
        """The arm that holds a load of the task must exist, and must not stop at that force."""
        assert self.task is not None
        at = ("task", self.task.kind, "loads", name)
        self._require_arm(name, *at)
        arm = self.arms[name]
        limits = arm.stop_limits
        if limits is not None and not load < limits.force:
            raise PydanticCustomError(
                "load_beyond_limit",
                "arm '{arm}' stops at limits.force, {force} N; give a load below it",
                {"arm": name, "force": f"{limits.force:g}", "at": at},
            )

    def keep_out_distances(self, arm: str) -> dict[str, float]:
        """Least distances [m] of `arm` to other arms, by their names."""
        found: dict[str, float] = {}
        for apart in self.keep_out:
            if arm in apart.arms:
                other = apart.arms[1 - apart.arms.index(arm)]
                found[other] = max(apart.distance, found.get(other, 0.0))
        return found


def register_task_config(config: type[TaskConfig]) -> None:
    """Files and rigs may have tasks of this kind from now on. Raises ValueError for one without a kind of its own."""
    kinds = get_args(config.model_fields["kind"].annotation)
    if len(kinds) != 1:
        raise ValueError(f"{config.__name__} must derive from tacsim.TaskConfig and say its kind: Literal['...']")
    same = [each for each in TASKS if get_args(each.model_fields["kind"].annotation) == kinds]
    if any(_config_path(each) != _config_path(config) for each in same):
        raise ValueError(
            f"{config.__name__}: there is a task of kind '{kinds[0]}' already, {_config_path(same[0])}; "
            "name it otherwise"
        )
    TASKS[:] = [each for each in TASKS if each not in same] + [config]
    rebuild_rig_config()


def rebuild_rig_config() -> None:
    """RigConfig takes the tasks that TASKS lists."""
    RigConfig.model_rebuild(force=True)


def rig_model() -> type[RigConfig]:
    """RigConfig, whose annotations name the configurations of all known tasks and installed drivers. Raises
    DriversMissing."""
    RigConfig.model_fields["task"].annotation = task_annotation() | None
    for kind, configs in ((kind, _config_classes(kind)) for kind in ("arm", "gripper", "sensor")):
        part: Any = Annotated[Union[tuple(configs)], Field(discriminator="driver")]  # noqa: UP007  # of as many as there are
        RigConfig.model_fields[f"{kind}s"].annotation = dict[Name, part]
    return RigConfig


def _config_classes(kind: str) -> list[type[Config]]:
    found: list[type[Config]] = [driver.config_class for driver in installed_drivers().usable[kind].values()]
    if not found:  # tacsim brings some of each kind
        raise DriversMissing
    return found


def _config_path(config: type[TaskConfig]) -> str:
    return f"{config.__module__}.{config.__qualname__}"
