"""A device that gives the same strokes again and again, in the place of a gamepad: `--teleop.device=script`."""

import os
from dataclasses import dataclass
from typing import Any

from lerobot.teleoperators import Teleoperator, TeleoperatorConfig


@TeleoperatorConfig.register_subclass("script")
@dataclass(kw_only=True)
class ScriptConfig(TeleoperatorConfig):
    """Strokes of each step by SCRIPTED_STROKES: x,y,z."""


class Script(Teleoperator):
    config_class = ScriptConfig
    name = "script"
    feedback_features: dict[str, type] = {}
    action_features = dict.fromkeys(("delta_x", "delta_y", "delta_z", "gripper"), float)
    is_calibrated = True
    is_connected = False

    def __init__(self, config: ScriptConfig) -> None:
        super().__init__(config)
        self._strokes = [float(each) for each in os.environ.get("SCRIPTED_STROKES", "0,0,1").split(",")]

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, Any]:
        return dict(zip(self.action_features, [*self._strokes, 1.0], strict=True))  # a gamepad gives a gripper, too

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...

    def disconnect(self) -> None:
        self.is_connected = False
