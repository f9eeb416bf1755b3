"""The driver `sim`: simulated arms and sensors. A simulated rig makes them (sim_rig.py). On hardware, a mock cell
simulates the sensor at its arm's pose."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Normaliser, SensorSpec, TactileSource
from tacsim.models.driver import ArmPart, Check, Companion, SensorDriver
from tacsim.models.rig import SimArmConfig, SimSensorConfig

SAMPLE_RATE = 10.0  # minimum of a sensor that is simulated on hardware [Hz]


class SimSensorDriver(SensorDriver[SimSensorConfig]):
    """A simulated sensor: its picture is rendered from the deformed gel."""

    config_class = SimSensorConfig
    clocks = ("sim", "wall")

    @property
    def companion(self) -> str | None:
        return "robot.mock.cell.cell:MockCell"

    def normaliser(self, untouched: NDArray[np.uint8] | None = None) -> Normaliser:
        from calibration.normaliser import normaliser_for_simulation

        if self.gel_size is None:
            raise ValueError(f"sensors.{self.name} is simulated, but the rig has no scene; give scene, or a task")
        return normaliser_for_simulation(self.config.model, self.gel_size, self.grid)

    def spec(self, normaliser: Normaliser) -> SensorSpec:
        model = self.config.model
        return SensorSpec(
            model.image_shape,
            height=True,
            flow=model.markers is not None,
            arm=self.config.arm,
            gripper=self.config.gripper,
        )

    def open(self, spec: SensorSpec, companion: Companion | None) -> TactileSource:
        assert companion is not None
        return companion.sensor(self.name, spec)

    def sample_rate(self) -> float:
        return SAMPLE_RATE

    def worst_latency(self) -> float:
        return 1.0 / SAMPLE_RATE

    def checks(self) -> Iterable[Check]:
        return []


class SimArmPart(ArmPart[SimArmConfig]):
    """A simulated arm: it reaches each target within a control step."""

    config_class = SimArmConfig
    clocks = ("sim",)
