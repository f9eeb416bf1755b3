"""How an episode in a cell begins: open grippers around the object, references, then a grip and a lift."""

from __future__ import annotations

from collections.abc import Mapping

from tacsim import pose as se3
from tacsim.control import NoTouch
from tacsim.geometry.shapes import rotated_bounding_size
from tacsim.interface import Pose, TactileFrame
from tacsim.limits import LimitExceeded
from tacsim.sim.arm import SimArm
from tacsim.sim.cell import tuning
from tacsim.sim.cell.cell import Cell
from tacsim.sim.cell.clock import CellClock
from tacsim.sim.cell.motion import CellMotion, DynamicMotion
from tacsim.sim.cell.scene_cell import SceneCell
from tacsim.sim.reset import find_starts, start_key
from tacsim.sim.scene_world import StatePool
from tacsim.sim.sensor import SimSensor


class CellReset:
    """Starts an episode in a cell, with each hand where it measures its start. A grip that was made before, in the same
    scene and from the same pose, is not made again.

    Args:
        arms: of the rig. As on a robot, an arm with an error of its pose measures that it is at its start, and is not.
        touch_force: with which grippers grip the object [N]; None leaves them open.
        placement: grippers start at most this far from the object along world x and y, drawn from the seed [m].
        arm_of_gripper: of the grippers that begin around the object, by name; others stay where they are, open.
        motion: of the rig, which closes the grippers; None: dynamic.
    """

    def __init__(
        self, scene_cell: SceneCell, clock: CellClock, sensors: Mapping[str, SimSensor],
        arms: Mapping[str, SimArm], arm_of_gripper: Mapping[str, str], touch_force: float | None,
        placement: float = 0.0, pool: StatePool | None = None, motion: CellMotion | None = None,
    ) -> None:  # fmt: skip
        self._scene_cell, self._clock, self._sensors = scene_cell, clock, sensors
        self._arms, self._arm_of_gripper = arms, dict(arm_of_gripper)
        self._touch_force, self._placement = touch_force, placement
        self._pool = StatePool() if pool is None else pool
        self._motion = DynamicMotion() if motion is None else motion
        self._starts: dict[str, Pose] = {}  # of arms that do not begin where the scene has them

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        """Raises ValueError for an object that is wider than a gripper opens."""
        self._scene_cell.rewind()
        cell = self._scene_cell.cell
        before = {name: cell.pose(name) for name in self._arms}
        around = self._arm_of_gripper.values()
        self._starts = find_starts(cell.pose, self._arms.values(), around, self._placement, seed)
        for name, start in self._starts.items():
            cell.place(name, start)
        for gripper, name in self._arm_of_gripper.items():
            open_around(cell, gripper, name, float(se3.relative_position(before[name], cell.pose(name))[0]))
        self._clock.restart(episode=seed)
        for sensor in self._sensors.values():
            sensor.restart(seed)
        return {name: sensor.read(0.0) for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """Raises NoTouch where no grip is found that holds the object, ObjectDropped for one that slips."""
        if self._touch_force is None or not self._arm_of_gripper:
            return
        start = start_key(self._scene_cell.scene, self._starts, self._touch_force)
        touched = self._pool.find(start)
        if touched is None:
            try:
                self._motion.grip(self._scene_cell.cell, self._arm_of_gripper, self._touch_force)
            except LimitExceeded as failure:  # the object reaches the housing of a gel
                raise NoTouch(f"no grip with touch_force {self._touch_force:g} N: {failure}") from failure
            self._pool.store(start, self._scene_cell.cell.snapshot(), None)
        else:
            self._scene_cell.cell.restore(touched[0])
        self._clock.restart()


def open_around(cell: Cell, gripper: str, arm: str, aside: float = 0.0) -> None:
    """Opens a gripper by a gap on both sides of the object, which is `aside` of its middle [m]. Raises ValueError for
    an object that is too wide for it."""
    turn = se3.relative_pose(cell.pose(arm), cell.object_pose()).quaternion
    size = float(rotated_bounding_size(cell.item.geometry, turn)[0])
    width, drive = size + 2 * (tuning.OPEN_GAP + abs(aside)), cell.grippers[gripper]
    if width > drive.max_width:
        raise ValueError(
            f"the object is {size * 1e3:.4g} mm wide where gripper '{gripper}' closes, {abs(aside) * 1e3:.3g} mm "
            f"from its middle; with gaps of {tuning.OPEN_GAP * 1e3:g} mm it must open by {width * 1e3:.4g} mm, and "
            f"opens by {drive.max_width * 1e3:.4g} mm: turn the object, or take a smaller one"
        )
    drive.place(width)
    cell.refresh()
