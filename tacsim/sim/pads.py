"""Gel pads as tactile sensors: what their cameras see."""

from __future__ import annotations

from collections.abc import Sequence

from tacsim.interface import Image
from tacsim.models.scene import Scene
from tacsim.models.sensor import SensorModel
from tacsim.optics.render import Renderer
from tacsim.physics.worlds.pads import GelPads


class TactilePads(GelPads):
    """Gel pads that follow an engine of rigid bodies, with pictures. No engine is known here: see `step`."""

    _instead = "TactilePads(scenes, step) and restore(pads.snapshot())"

    def __init__(
        self, scenes: Sequence[Scene], step: float, substeps: int | None = None, *, sensor: SensorModel | None = None
    ) -> None:
        """sensor: whose pictures are rendered; None: no pictures. The rest: see :class:`GelPads`."""
        super().__init__(scenes, step, substeps)
        self._sensor, self._renderers = sensor, dict[tuple[float, float], Renderer]()

    def picture(self, index: int) -> Image:
        """(H, W, 3) uint8 RGB of a pad's camera, without its noise. The renderer is made when it is first needed.

        Raises ValueError without a sensor.
        """
        if self._sensor is None:
            raise ValueError("these pads have no camera: give them `sensor`, such as load_sensor('gelsight-mini')")
        size = self.scenes[index].gel.size[:2]
        if size not in self._renderers:
            self._renderers[size] = Renderer(self._sensor, size)
        return self._renderers[size](self.surface(index))
