"""Gel pads as tactile sensors: what their cameras see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tacsim.interface import Image
from tacsim.models.scene import Scene
from tacsim.models.sensor import SensorModel
from tacsim.optics.render import Renderer
from tacsim.physics.pads.pads import GelPads


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


class SharedPads:
    """Pads of `count` simulations, so that one launch advances all that have the same timestep. They are made when the
    first is needed: until then a process may fork."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._lists: dict[float, TactilePads] = {}  # by timestep [s]

    def place(self, index: int, scenes: Sequence[Scene], step: float) -> tuple[TactilePads, int]:
        """The pads of simulation number `index`, newly made, one for each scene: in which list, and the number of the
        first. step: timestep [s]. Raises what `GelPads` raises, and ValueError for gels of another lattice than those
        of the first simulation with this timestep."""
        if step not in self._lists:
            self._lists[step] = TactilePads([*scenes] * self._count, step)
        pads, first = self._lists[step], index * len(scenes)
        for number, scene in enumerate(scenes):
            pads.replace(first + number, scene)
        return pads, first


@dataclass(frozen=True, slots=True)
class PadPlace:
    """The pads of one simulation, among those of others."""

    shared: SharedPads
    index: int

    def fill(self, scenes: Sequence[Scene], step: float) -> tuple[TactilePads, int]:
        """See `SharedPads.place`."""
        return self.shared.place(self.index, scenes, step)
