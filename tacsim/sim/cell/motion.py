"""How a cell gets through one control period."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from tacsim.interface import Pose
from tacsim.sim.cell.cell import Cell


class CellMotion(Protocol):
    """Advances a cell by a control period: all that is different between the words of a rig's `motion`."""

    def advance(self, cell: Cell, targets: Mapping[str, Pose], seconds: float) -> None:
        """Arms go to the poses of their tools `targets`, by name, within `seconds`; others to their last
        targets. Grippers follow their own targets.

        Raises ObjectDropped, LimitExceeded for a pose out of reach or an object on the housing of a gel, and
        SimulationDiverged.
        """
        ...


class DynamicMotion:
    """`dynamic`: everything is lived through in MuJoCo's timesteps, the object's inertia included."""

    def advance(self, cell: Cell, targets: Mapping[str, Pose], seconds: float) -> None:
        cell.begin(targets, seconds)
        for number in range(cell.steps_of(seconds)):
            cell.step(number * cell.timestep)
        cell.refresh()


@dataclass(frozen=True, slots=True, eq=False)
class CellPeriod:
    """One control period of a cell that is to pass."""

    motion: CellMotion
    cell: Cell
    targets: Mapping[str, Pose]
    seconds: float

    def advance(self) -> None:
        """See `CellMotion.advance`."""
        self.motion.advance(self.cell, self.targets, self.seconds)


MOTIONS: dict[str, type[CellMotion]] = {"dynamic": DynamicMotion}  # by RigConfig.motion
