"""LeRobot's teleoperator `tacsim`: a gamepad or keys of LeRobot move the arms of a rig of tacsim (docs/lerobot.md)."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, make_teleoperator_from_config

from robot import Jog, LeRobotRig

STROKES = ("delta_x", "delta_y", "delta_z")


@TeleoperatorConfig.register_subclass("tacsim")
@dataclass(kw_only=True)
class TacsimTeleoperatorConfig(TeleoperatorConfig):
    """device: type of a teleoperator that gives delta_x, delta_y and delta_z, as gamepad and keyboard_ee do. rig, task,
    overrides: as for the robot. step: of a full stroke [m]. arms: that move, each along its own sensor's axes; none
    named: all."""

    device: str = "gamepad"  # not a configuration: one of its own kind inside would let LeRobot's parser run for ever
    rig: str
    task: str | None = None
    overrides: list[str] = field(default_factory=list)
    step: float = 0.05e-3
    arms: list[str] = field(default_factory=list)


class TacsimTeleoperator(Teleoperator):
    """LeRobot records only what has the names of the robot's own actions, which those of its devices have not."""

    config_class = TacsimTeleoperatorConfig
    name = "tacsim"

    def __init__(self, config: TacsimTeleoperatorConfig) -> None:
        super().__init__(config)
        self._jog = Jog(LeRobotRig(config.rig, task=config.task, overrides=config.overrides), config.step, config.arms)
        known = TeleoperatorConfig.get_known_choices()
        if config.device not in known:
            raise ValueError(f"no teleoperator '{config.device}'; there are {', '.join(sorted(known))}")
        self._device: Any = make_teleoperator_from_config(known[config.device]())

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(self._jog.names, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return dict(self._device.feedback_features)

    @property
    def is_connected(self) -> bool:
        return bool(self._device.is_connected)

    @property
    def is_calibrated(self) -> bool:
        return bool(self._device.is_calibrated)

    def connect(self, calibrate: bool = True) -> None:
        self._jog.reset()
        self._device.connect(calibrate)

    def calibrate(self) -> None:
        self._device.calibrate()

    def configure(self) -> None:
        self._device.configure()

    def get_action(self) -> RobotAction:
        found = self._device.get_action()
        if lacking := [name for name in STROKES if name not in found]:
            raise ValueError(f"device '{self._device.name}' gives no {lacking[0]}; take gamepad or keyboard_ee")
        return self._jog([float(found[name]) for name in STROKES])

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        self._device.send_feedback(feedback)

    def disconnect(self) -> None:
        self._device.disconnect()
