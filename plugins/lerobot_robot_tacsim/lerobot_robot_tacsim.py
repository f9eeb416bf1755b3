"""LeRobot's robot `tacsim`: any rig of tacsim, with its limits and its own process for the arms (docs/lerobot.md)."""

from dataclasses import dataclass, field

from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.robots import Robot, RobotConfig

from robot import LeRobotRig


@RobotConfig.register_subclass("tacsim")
@dataclass(kw_only=True)
class TacsimRobotConfig(RobotConfig):
    """The rig by its name ("sim", "mock", "ur5e" ...) or the path of its file; `overrides` change values of it
    ("period=50 ms"). fps: LeRobot's own rate, which it does not tell; refused when it is not the rig's."""

    rig: str
    task: str | None = None
    overrides: list[str] = field(default_factory=list)
    fps: float | None = None


class TacsimRobot(Robot):
    """Connecting resets the rig: the arms approach until they touch, after a person's yes where they are real."""

    config_class = TacsimRobotConfig
    name = "tacsim"

    def __init__(self, config: TacsimRobotConfig) -> None:
        super().__init__(config)
        self._rig = LeRobotRig(config.rig, task=config.task, overrides=config.overrides, fps=config.fps)
        self.cameras = dict.fromkeys(self._rig.config.sensors)  # counted by lerobot-record

    @property
    def observation_features(self) -> dict[str, type | tuple[int, ...]]:
        return dict(self._rig.observation_features)

    @property
    def action_features(self) -> dict[str, type]:
        return self._rig.action_features

    @property
    def is_connected(self) -> bool:
        return self._rig.connected

    @property
    def is_calibrated(self) -> bool:
        return True  # by `tacsim calibrate`

    def connect(self, calibrate: bool = True) -> None:
        self._rig.connect()

    def calibrate(self) -> None:
        """The rig file names the calibrations."""

    def configure(self) -> None:
        """The rig file says it all."""

    def get_observation(self) -> RobotObservation:
        return self._rig.observe()

    def send_action(self, action: RobotAction) -> RobotAction:
        return self._rig.send(action)

    def disconnect(self) -> None:
        self._rig.close()
