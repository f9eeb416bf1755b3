"""How a cell gets through one control period."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from tacsim.interface import Pose
from tacsim.limits import LimitExceeded
from tacsim.sim.cell.cell import Cell, PeriodError, step_cells
from tacsim.sim.cell.grip import grip_in_time
from tacsim.sim.cell.resting import RestingCell, move_together


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
        """See CellMotion."""
        (failure,) = self.advance_together([CellPeriod(self, cell, targets, seconds)])
        if failure is not None:
            raise failure

    def advance_together(self, periods: Sequence[CellPeriod]) -> list[PeriodError | None]:
        """See CellMotion: the gels of cells whose pads are in one list advance in one launch a timestep."""
        failures: list[PeriodError | None] = [None] * len(periods)
        lists: dict[int, list[int]] = {}  # numbers of the periods, by the list of their pads
        for number, period in enumerate(periods):
            lists.setdefault(id(period.cell.touch.pads), []).append(number)
        for numbers in lists.values():
            for number, failure in zip(numbers, _advance([periods[each] for each in numbers]), strict=True):
                failures[number] = failure
        return failures


def _advance(periods: Sequence[CellPeriod]) -> list[PeriodError | None]:
    """One control period, of the same length, of cells whose pads are in one list. Returns how each has failed."""
    failures: list[PeriodError | None] = [None] * len(periods)
    steps = periods[0].cell.steps_of(periods[0].seconds)
    running: dict[int, Cell] = {}
    for number, period in enumerate(periods):
        try:
            period.cell.begin(period.targets, period.seconds)
            running[number] = period.cell
        except LimitExceeded as failure:
            failures[number] = failure
    for step in range(steps):
        if not running:
            break
        ends = step_cells(list(running.values()), step * periods[0].cell.timestep)
        for number, end in zip(list(running), ends, strict=True):
            if end is not None:
                failures[number] = end
                del running[number]
    for cell in running.values():
        cell.refresh()
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
