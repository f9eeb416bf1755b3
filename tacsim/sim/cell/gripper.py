"""A gripper of a cell, behind the contract."""

from __future__ import annotations

from tacsim.interface import GripperState, GripperTarget
from tacsim.limits import limit_gripper_target
from tacsim.sim.cell.clock import CellClock
from tacsim.sim.cell.scene_cell import SceneCell


class CellGripper:
    """A parallel gripper in MuJoCo. Its force is that of its fingers' motor, which at rest is the normal force of
    each gel.

    Args:
        width_range, force_range: least and greatest width [m] and force [N]; targets are brought into them.
    """

    def __init__(
        self, scene_cell: SceneCell, clock: CellClock, name: str, width_range: tuple[float, float],
        force_range: tuple[float, float],
    ) -> None:  # fmt: skip
        self._scene_cell, self._clock, self._name = scene_cell, clock, name
        self._width_range, self._force_range = width_range, force_range

    @property
    def width_range(self) -> tuple[float, float]:
        return self._width_range

    @property
    def force_range(self) -> tuple[float, float]:
        return self._force_range

    def state(self) -> GripperState:
        drive = self._scene_cell.cell.grippers[self._name]
        return GripperState(drive.width, drive.force, self._clock.now())

    def command(self, target: GripperTarget | None) -> GripperTarget | None:
        """Takes effect at the next tick, and holds until there is another."""
        if target is None:
            return None
        allowed = limit_gripper_target(target, self._width_range, self._force_range)
        self._scene_cell.cell.grippers[self._name].command(allowed.width, allowed.force)
        return allowed

    def stop(self) -> None:
        """It goes on holding what it holds."""

    def recover(self) -> None:
        """Nothing stops it."""

    def close(self) -> None:
        """Nothing is held open."""
