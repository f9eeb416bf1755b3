"""A simulated sensor on a real or mock arm: what the gel at the arm's measured pose would look like."""

from __future__ import annotations

import time

from robot.mock.cell.cell import MockCell
from tacsim.interface import SensorSpec, TactileFrame
from tacsim.models.rig import SimSensorConfig


class TwinSensor:
    """A TactileSource that looks at the simulated cell without a camera between: no stream, no compression."""

    def __init__(self, cell: MockCell, name: str, config: SimSensorConfig) -> None:
        geometry = config.model.geometry
        self._cell, self._name = cell, name
        self.spec = SensorSpec(
            image_shape=(geometry.height, geometry.width), height=True, flow=config.model.markers is not None,
            arm=config.arm,
        )  # fmt: skip

    def read(self, timeout: float) -> TactileFrame:
        """The picture of the newest simulated state. Raises TimeoutError when there is none within `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while (scene_frame := self._cell.scene_frame) is None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"sensor '{self._name}': the simulated cell has shown nothing within {timeout:g} s")
            time.sleep(1e-3)
        surface = scene_frame.surfaces[self._name]
        return TactileFrame(scene_frame.images[self._name], scene_frame.time, scene_frame.index, surface)

    def close(self) -> None:
        """The cell is closed by the rig."""
