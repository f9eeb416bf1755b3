"""How a cell gets through one control period."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from tacsim.interface import Pose
from tacsim.sim.cell.cell import Cell
from tacsim.sim.cell.grip import grip_in_time
from tacsim.sim.cell.resting import PERIOD_ERRORS, PeriodError, RestingCell, move_together


class CellMotion(Protocol):
    """Advances a cell by a control period: all that is different between the words of a rig's `motion`."""

    def grip(self, cell: Cell, arm_of_gripper: Mapping[str, str], force: float) -> None:
        """Closes grippers until they hold the object with `force` [N], takes away what it stands on, and lifts it.
        arm_of_gripper: name of the arm, by gripper. Raises NoTouch, LimitExceeded, ObjectDropped."""
        ...

    def advance_together(self, periods: Sequence[CellPeriod]) -> list[PeriodError | None]:
        """`advance` of several cells; one that fails leaves the others alone. Returns what each would raise."""
        ...

    def advance(self, cell: Cell, targets: Mapping[str, Pose], seconds: float) -> None:
        """Arms go to the poses of their tools `targets`, by name, within `seconds`; others to their last
        targets. Grippers follow their own targets.

        Raises ObjectDropped, LimitExceeded for a pose out of reach or an object on the housing of a gel, and
        SimulationDiverged.
        """
        ...


class DynamicMotion:
    """`dynamic`: everything is lived through in MuJoCo's timesteps, the object's inertia included."""

    def grip(self, cell: Cell, arm_of_gripper: Mapping[str, str], force: float) -> None:
        """See CellMotion."""
        grip_in_time(cell, arm_of_gripper, force, partial(self.advance, cell))

    def advance(self, cell: Cell, targets: Mapping[str, Pose], seconds: float) -> None:
        cell.begin(targets, seconds)
        for number in range(cell.steps_of(seconds)):
            cell.step(number * cell.timestep)
        cell.refresh()

    def advance_together(self, periods: Sequence[CellPeriod]) -> list[PeriodError | None]:
        """See CellMotion. One after the other: MuJoCo and the coupling take most of the time, not the launches."""
        failures: list[PeriodError | None] = [None] * len(periods)
        for number, period in enumerate(periods):
            try:
                period.advance()
            except PERIOD_ERRORS as failure:
                failures[number] = failure
        return failures


@dataclass(frozen=True, slots=True)
class RestingMotion:
    """`settled`, `flowing`: object and gels come to rest in each period (RestingCell), settled until forces balance,
    flowing as far as a fixed number of substeps goes."""

    settle: bool

    def grip(self, cell: Cell, arm_of_gripper: Mapping[str, str], force: float) -> None:
        """See CellMotion."""
        assert isinstance(cell, RestingCell)
        cell.grip(force)

    def advance(self, cell: Cell, targets: Mapping[str, Pose], seconds: float) -> None:
        """See CellMotion."""
        assert isinstance(cell, RestingCell)
        cell.move(targets, seconds, settle=self.settle)

    def advance_together(self, periods: Sequence[CellPeriod]) -> list[PeriodError | None]:
        """See CellMotion: cells that share one world of grips, in one launch."""
        cells = [period.cell for period in periods if isinstance(period.cell, RestingCell)]
        motions = [cell.motion(each.targets, each.seconds) for cell, each in zip(cells, periods, strict=True)]
        return move_together(cells, motions, settle=self.settle)


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


# By RigConfig.motion
MOTIONS: dict[str, CellMotion] = {
    "dynamic": DynamicMotion(),
    "flowing": RestingMotion(settle=False),
    "settled": RestingMotion(settle=True),
}
