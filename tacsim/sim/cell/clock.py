"""Simulated time of a cell."""

from __future__ import annotations

from collections.abc import Mapping

from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.sim.cell.motion import CellMotion, CellPeriod
from tacsim.sim.cell.scene_cell import SceneCell


class CellClock:
    """`tick` lets a cell move for one control period: arms to their commanded poses, and all else as it does.

    name_of_pad: of the sensors on the pads, by frame, for `diagnostics`.
    """

    def __init__(
        self, scene_cell: SceneCell, period: float, motion: CellMotion, name_of_pad: Mapping[str, str] | None = None
    ) -> None:
        self._scene_cell, self._motion, self._name_of_pad = scene_cell, motion, dict(name_of_pad or {})
        self.period = period  # [s]
        self.periods = self.episode = self.version = 0  # see StateClock
        self.velocities: Mapping[str, FloatArray] = {}
        self._targets: dict[str, Pose] = {}
        self._limited: dict[str, bool] = {}
        self._before: dict[str, Pose] = {}  # of arms, at the beginning of the period
        self._time = 0.0

    def now(self) -> float:
        return self._time

    def command(self, frame: str, pose: Pose, limited: bool) -> None:
        """Sets the pose of an arm's tool at the end of the period; `limited`: a guard has changed the command."""
        self._targets[frame], self._limited[frame] = pose, limited

    def commanded(self, frame: str) -> Pose | None:
        return self._targets.get(frame)

    def drop_commands(self) -> None:
        self._targets = {}

    def tick(self) -> None:
        """One period. Raises what `CellMotion.advance` raises."""
        self.begin().advance()
        self.finish()

    def begin(self) -> CellPeriod:
        """Takes the commands of this period. After its `advance`, call `finish`; if that fails, the period does not
        pass."""
        targets, self._targets = self._targets, {}
        cell = self._scene_cell.cell
        self._before = {name: cell.pose(name) for name in cell.arms}
        return CellPeriod(self._motion, cell, targets, self.period)

    def finish(self, outcome: None = None) -> None:
        """The period is over."""
        cell = self._scene_cell.cell
        self.velocities = {
            name: se3.pose_difference(old, cell.pose(name)) / self.period for name, old in self._before.items()
        }
        self._time += self.period
        self.periods += 1
        self.version += 1

    def restart(self, episode: int | None = None) -> None:
        """Time zero, in a cell whose state was restored. `episode`: of another one, the seed of its noise."""
        self._time, self._targets, self._limited, self.velocities = 0.0, {}, {}, {}
        self.periods, self.episode = 0, self.episode if episode is None else episode
        self.version += 1

    def diagnostics(self) -> Mapping[str, float]:
        """Of the last period: `shortened`, how many commands the limits changed, and those of the cell."""
        return {"shortened": float(sum(self._limited.values())), **self._scene_cell.cell.diagnostics(self._name_of_pad)}
