"""A simulated sensor on a real or mock arm: what the gel at the arm's measured pose would look like."""

from __future__ import annotations

import time

from robot.mock.cell.cell import MockBench
from tacsim.interface import SensorSpec, TactileFrame
from tacsim.models.rig import SimSensorConfig


class TwinSensor:
    """A TactileSource that looks at the simulated bench without a camera between: no stream, no compression."""

    def __init__(self, bench: MockBench, name: str, config: SimSensorConfig) -> None:
        geometry = config.model.geometry
        self._bench, self._name = bench, name
        self.spec = SensorSpec(
            image_shape=(geometry.height, geometry.width), height=True, flow=config.model.markers is not None,
            arm=config.arm,
        )  # fmt: skip

    def read(self, timeout: float) -> TactileFrame:
        """The picture of the newest simulated state. Raises TimeoutError when there is none within `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while (scenery := self._bench.scenery) is None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"sensor '{self._name}': the simulated bench has shown nothing within {timeout:g} s")
            time.sleep(1e-3)
        surface = scenery.surfaces[self._name]
        return TactileFrame(scenery.images[self._name], scenery.time, scenery.index, surface)

    def close(self) -> None:
        """The bench is closed by the rig."""
