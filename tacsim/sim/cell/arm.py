"""An arm of a cell, behind the contract."""

from __future__ import annotations

from typing import cast

from tacsim.interface import FloatArray
from tacsim.sim.arm import SimArm
from tacsim.sim.cell.scene_cell import SceneCell


class CellArm(SimArm):
    """An arm in MuJoCo, with all that simulated arms have: limits, errors, noise, delays. Its pose is that of its
    gripper."""

    def _joints(self) -> FloatArray | None:
        return cast(SceneCell, self._world).cell.arms[self.frame].joints
