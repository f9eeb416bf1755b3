"""What a rig in MuJoCo simulates: the cell of its present scene."""

from __future__ import annotations

from collections.abc import Callable

from tacsim.interface import FloatArray, Pose, Truth
from tacsim.models.scene import GelSurface, Scene
from tacsim.sim.cell.cell import Cell
from tacsim.sim.cell.drives import State
from tacsim.sim.scene_world import require_same_gels


class SceneCell:
    """The cell of the present scene. It is made when it is first needed; `set_scene` exchanges the scene between
    episodes.

    Args:
        make: a new cell of a scene.
    """

    def __init__(self, scene: Scene, make: Callable[[Scene], Cell]) -> None:
        self.scene, self._make = scene, make
        self._cell: Cell | None = None
        self._begin: State = {}

    def set_scene(self, scene: Scene) -> None:
        """From the next `rewind` on. Raises ValueError for a scene without an object, or whose gels are cut
        otherwise."""
        if scene != self.scene:
            require_same_gels(self.scene, scene)
            self.scene, self._cell = scene, None

    @property
    def cell(self) -> Cell:
        if self._cell is None:
            self._cell = self._make(self.scene)
            self._begin = self._cell.snapshot()
        return self._cell

    def rewind(self) -> None:
        """The cell as it was made: gels undeformed, the object on what it stands on."""
        if self._cell is None:
            self._cell = self.cell
        else:
            self._cell.restore(self._begin)

    # ---------------------------------------------------- as arms and sensors see it

    @property
    def sensors(self) -> tuple[str, ...]:
        return self.cell.sensors

    def pose(self, name: str) -> Pose:
        return self.cell.pose(name)

    def wrench(self, name: str) -> FloatArray:
        return self.cell.wrench(name)

    def surface(self, name: str) -> GelSurface:
        return self.cell.surface(name)

    def truth(self) -> Truth:
        return self.cell.truth()
