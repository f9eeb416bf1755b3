"""Objects held by tactile sensors: what the cameras of the pads see."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from tacsim.interface import Image
from tacsim.models.scene import Gel, Preset
from tacsim.models.sensor import SensorModel
from tacsim.optics.render import Renderer
from tacsim.physics.grip.model import HeldObject
from tacsim.physics.grip.tuning import EARTH
from tacsim.physics.grip.world import GripWorld


class HeldObjects(GripWorld):
    """Objects held at rest by gel pads, with pictures: see `step`."""

    _instead = "HeldObjects(objects) and restore(held.snapshot())"

    def __init__(
        self, objects: Sequence[HeldObject], gel: Gel | Sequence[Gel] | None = None, *, pads: int = 2,
        preset: Preset = "learn", substeps: int | None = None, gravity: ArrayLike = EARTH,
        sensor: SensorModel | None = None,
    ) -> None:  # fmt: skip
        """sensor: whose pictures are rendered; None: no pictures. The rest: see :class:`GripWorld`."""
        super().__init__(objects, gel, pads=pads, preset=preset, substeps=substeps, gravity=gravity)
        self._sensor, self._renderers = sensor, dict[tuple[float, float], Renderer]()

    def picture(self, index: int, pad: int) -> Image:
        """(H, W, 3) uint8 RGB of a pad's camera, without its noise. The renderer is made when it is first needed.

        Raises ValueError without a sensor.
        """
        if self._sensor is None:
            raise ValueError("these pads have no camera: give them `sensor`, such as load_sensor('gelsight-mini')")
        size = self.gel_size(index)
        if size not in self._renderers:
            self._renderers[size] = Renderer(self._sensor, size)
        return self._renderers[size](self.surface(index, pad))
