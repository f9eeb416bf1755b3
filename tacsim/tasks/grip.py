"""Grip: close the sensors until they feel a firm contact, then hold. Needs images only, and so runs on any rig."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tacsim import pose as se3
from tacsim.control import contact_signal
from tacsim.interface import Action, Needs, Observation, Pose, RigSpec
from tacsim.tasks.tuning import CLOSING_STEP, FIRM_GRIP_SIGNAL


class Grip:
    """Moves every sensor along its own z until the mean contact signal reaches the target, then holds to the end.

    On a recording, its actions are what it would have done. A sensor that no arm carries is addressed by its own name,
    with a target relative to where it is.

    Args:
        spec: of the rig; says which arm carries which sensor.
        target: contact signal (tacsim.control) that ends the closing [-].
        step: motion of each sensor in a control period [m].
    """

    def __init__(self, spec: RigSpec, target: float = FIRM_GRIP_SIGNAL, step: float = CLOSING_STEP) -> None:
        if not target > 0 or not step > 0:
            raise ValueError(f"grip: target and step must be positive, got target {target}, step {step} m")
        self._carriers: Mapping[str, str | None] = {name: sensor.arm for name, sensor in spec.sensors.items()}
        self._target, self._step = target, step
        self._holding = False

    @property
    def needs(self) -> Needs:
        return Needs()

    def reset(self) -> None:
        self._holding = False

    def __call__(self, observation: Observation) -> Action:
        signals = [contact_signal(touch) for touch in observation.tactile.values()]
        self._holding = self._holding or float(np.mean(signals)) >= self._target
        if self._holding:
            return Action({arm or sensor: None for sensor, arm in self._carriers.items()})
        return Action(
            {
                arm or sensor: se3.translated_along_z(Pose() if arm is None else observation.arms[arm].pose, self._step)
                for sensor, arm in self._carriers.items()
            }
        )
