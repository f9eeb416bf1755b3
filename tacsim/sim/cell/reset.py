"""How an episode in a cell begins: open grippers around the object, references, then a grip and a lift."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tacsim import pose as se3
from tacsim.control import NoTouch
from tacsim.geometry.shapes import rotated_bounding_size
from tacsim.interface import Pose, TactileFrame
from tacsim.limits import LimitExceeded
from tacsim.sim.cell import tuning
from tacsim.sim.cell.cell import Cell
from tacsim.sim.cell.clock import CellClock
from tacsim.sim.cell.motion import CellMotion, DynamicMotion
from tacsim.sim.cell.scene_cell import SceneCell
from tacsim.sim.scene_world import StatePool
from tacsim.sim.sensor import SimSensor


class CellReset:
    """Starts an episode in a cell. A grip that was made before, in the same scene and from the same place, is not made
    again.

    Args:
        touch_force: with which grippers grip the object [N]; None leaves them open.
        placement: grippers start at most this far from the object along world x and y, drawn from the seed [m].
        arm_of_gripper: of the grippers that begin around the object, by name; others stay where they are, open.
    """

    def __init__(
        self, scene_cell: SceneCell, clock: CellClock, sensors: Mapping[str, SimSensor],
        arm_of_gripper: Mapping[str, str], touch_force: float | None, placement: float = 0.0,
        pool: StatePool | None = None,
    ) -> None:  # fmt: skip
        self._scene_cell, self._clock, self._sensors = scene_cell, clock, sensors
        self._arm_of_gripper = dict(arm_of_gripper)
        self._touch_force, self._placement = touch_force, placement
        self._pool = StatePool() if pool is None else pool
        self._offset = np.zeros(2)

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        """Raises ValueError for an object that is wider than a gripper opens."""
        self._scene_cell.rewind()
        self._offset = self._placement * np.random.default_rng(seed).uniform(-1.0, 1.0, size=2)
        for gripper, arm in self._arm_of_gripper.items():
            open_around(self._scene_cell.cell, gripper, arm, self._offset)
        self._clock.restart(episode=seed)
        for sensor in self._sensors.values():
            sensor.restart(seed)
        return {name: sensor.read(0.0) for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """Raises NoTouch where no grip is found that holds the object, ObjectDropped for one that slips."""
        if self._touch_force is None or not self._arm_of_gripper:
            return
        start = self._scene_cell.scene.model_dump_json(), *self._offset.tolist(), self._touch_force
        touched = self._pool.find(start)
        if touched is None:
            try:
                grip(self._scene_cell.cell, self._arm_of_gripper, self._touch_force)
            except LimitExceeded as failure:  # the object reaches the housing of a gel
                raise NoTouch(f"no grip with touch_force {self._touch_force:g} N: {failure}") from failure
            self._pool.store(start, self._scene_cell.cell.snapshot(), None)
        else:
            self._scene_cell.cell.restore(touched[0])
        self._clock.restart()


def open_around(cell: Cell, gripper: str, arm: str, offset: np.ndarray) -> None:
    """Moves a gripper sideways from where it grips, by `offset` (2,) [m], open by a gap. Raises ValueError for an
    object that is too wide for it."""
    start = cell.pose(arm)
    if offset.any():
        cell.place(arm, Pose(start.position + [*offset, 0.0], start.quaternion))
    here = cell.object_pose()
    turn = se3.relative_pose(cell.pose(arm), here).quaternion
    along = se3.rotation_matrix(start)[:2, 0] @ offset
    size = float(rotated_bounding_size(cell.item.geometry, turn)[0])
    width, drive = size + 2 * (tuning.OPEN_GAP + abs(along)), cell.grippers[gripper]
    if width > drive.max_width:
        raise ValueError(
            f"the object is {size * 1e3:.4g} mm wide where gripper '{gripper}' closes, {abs(along) * 1e3:.3g} mm "
            f"from its middle; with gaps of {tuning.OPEN_GAP * 1e3:g} mm it must open by {width * 1e3:.4g} mm, and "
            f"opens by {drive.max_width * 1e3:.4g} mm: turn the object, or take a smaller one"
        )
    drive.place(width)
    cell.refresh()


def grip(cell: Cell, arm_of_gripper: Mapping[str, str], force: float) -> None:
    """Closes grippers slowly until they hold the object with `force` [N], takes away what it stands on, and lifts it.
    arm_of_gripper: name of the arm, by gripper. Raises NoTouch."""
    _require_enough(cell, force, len(arm_of_gripper))
    _close(cell, arm_of_gripper, force)
    motion: CellMotion = DynamicMotion()
    if cell.has_pedestal:
        cell.take_pedestal_away()
        _wait_for_rest(cell, motion, "its pedestal was taken away")
    height, seconds = cell.item.lift, 0.05
    starts = {arm: cell.pose(arm) for arm in arm_of_gripper.values()}
    steps = int(np.ceil(height / (tuning.LIFT_SPEED * seconds)))
    for number in range(steps):
        up = np.array([0.0, 0.0, height * (number + 1) / steps])
        motion.advance(cell, {arm: Pose(at.position + up, at.quaternion) for arm, at in starts.items()}, seconds)
    if steps:
        _wait_for_rest(cell, motion, "it was lifted")


def _require_enough(cell: Cell, force: float, grippers: int) -> None:
    weight = cell.item.mass * float(np.linalg.norm(cell.scene.gravity))
    least = weight / (2 * grippers * max(cell.item.friction, 1e-9))
    carried = cell.has_pedestal or cell.item.lift > 0
    if carried and force <= least:
        raise NoTouch(
            f"a grip of {force:.4g} N cannot carry the object of {cell.item.mass:.4g} kg with a friction of "
            f"{cell.item.friction:g}: touch_force must be more than {least:.4g} N"
        )


def _close(cell: Cell, arm_of_gripper: Mapping[str, str], force: float) -> None:
    seconds = 0.01
    motion: CellMotion = DynamicMotion()
    widths = {gripper: cell.grippers[gripper].width for gripper in arm_of_gripper}
    pads = [f"{gripper}/{side}" for gripper in arm_of_gripper for side in ("left", "right")]
    least, waited, rested = force * (1 - tuning.GRIP_TOLERANCE), 0.0, 0.0
    while waited < tuning.MAX_REST_TIME:
        for gripper, width in widths.items():
            touches = all(cell.normal_force(f"{gripper}/{side}") > 0 for side in ("left", "right"))
            widths[gripper] = 0.0 if touches else max(width - 2 * tuning.CLOSING_SPEED * seconds, 0.0)
            cell.grippers[gripper].command(widths[gripper], force)
        motion.advance(cell, {}, seconds)
        forces = [cell.normal_force(pad) for pad in pads]
        rested = rested + seconds if min(forces) >= least and cell.is_at_rest() else 0.0
        if rested >= tuning.MIN_REST_TIME:
            return
        waited += seconds if all(width == 0.0 for width in widths.values()) else 0.0
    raise NoTouch(
        f"the grippers closed and found no grip: the least normal force is {min(forces):.3g} N of {force:.3g} N. Is "
        "the object between the fingers, and its face flat or round where they touch it?"
    )


def _wait_for_rest(cell: Cell, motion: CellMotion, what: str) -> None:
    seconds, rested = 0.01, 0.0
    for _ in range(round(tuning.MAX_REST_TIME / seconds)):
        motion.advance(cell, {}, seconds)
        rested = rested + seconds if cell.is_at_rest() else 0.0
        if rested >= tuning.MIN_REST_TIME:
            return
    speed, turn = cell.object_speed()
    raise NoTouch(
        f"the object does not come to rest after {what}: {speed * 1e3:.3g} mm/s, {turn:.3g} rad/s; grip it with more "
        "touch_force, or nearer to its centre of mass"
    )
