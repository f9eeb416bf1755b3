"""How grippers close around an object, in time: slowly, until they hold it; then it is lifted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from tacsim.control import NoTouch
from tacsim.interface import Pose
from tacsim.sim.cell import tuning
from tacsim.sim.cell.cell import Cell

Advance = Callable[[Mapping[str, Pose], float], None]  # to poses of tools, by arm, in a time [s]


def grip_in_time(cell: Cell, arm_of_gripper: Mapping[str, str], force: float, advance: Advance) -> None:
    """Closes grippers slowly until they hold the object with `force` [N], takes away what it stands on, and lifts it.
    arm_of_gripper: name of the arm, by gripper. advance: lets the cell move. Raises NoTouch."""
    require_enough(cell, force, len(arm_of_gripper))
    _close(cell, arm_of_gripper, force, advance)
    if cell.has_pedestal:
        cell.take_pedestal_away()
        _wait_for_rest(cell, advance, "its pedestal was taken away")
    height, seconds = cell.item.lift, 0.05
    starts = {arm: cell.pose(arm) for arm in arm_of_gripper.values()}
    steps = int(np.ceil(height / (tuning.LIFT_SPEED * seconds)))
    for number in range(steps):
        up = np.array([0.0, 0.0, height * (number + 1) / steps])
        advance({arm: Pose(at.position + up, at.quaternion) for arm, at in starts.items()}, seconds)
    if steps:
        _wait_for_rest(cell, advance, "it was lifted")


def min_grip_force(cell: Cell, grippers: int) -> float:
    """Force of each of 2 pads a gripper that just holds the object against gravity [N]."""
    weight = cell.item.mass * float(np.linalg.norm(cell.scene.gravity))
    return weight / (2 * grippers * max(cell.item.friction, 1e-9))


def require_enough(cell: Cell, force: float, grippers: int) -> None:
    least = min_grip_force(cell, grippers)
    carried = cell.has_pedestal or cell.item.lift > 0
    if carried and force <= least:
        raise NoTouch(
            f"a grip of {force:.4g} N cannot carry the object of {cell.item.mass:.4g} kg with a friction of "
            f"{cell.item.friction:g}: touch_force must be more than {least:.4g} N"
        )


def _close(cell: Cell, arm_of_gripper: Mapping[str, str], force: float, advance: Advance) -> None:
    seconds = 0.01
    widths = {gripper: cell.grippers[gripper].width for gripper in arm_of_gripper}
    pads = {gripper: [f"{gripper}/{side}" for side in ("left", "right")] for gripper in arm_of_gripper}
    least, waited, rested = force * (1 - tuning.GRIP_TOLERANCE), 0.0, 0.0
    while waited < tuning.MAX_REST_TIME:
        for gripper, width in widths.items():
            touches = all(cell.normal_force(pad) > 0 for pad in pads[gripper])
            widths[gripper] = 0.0 if touches else max(width - 2 * tuning.CLOSING_SPEED * seconds, 0.0)
            cell.grippers[gripper].command(widths[gripper], force)
        advance({}, seconds)
        forces = [_grip_force([cell.normal_force(pad) for pad in both]) for both in pads.values()]
        rested = rested + seconds if min(forces) >= least and cell.is_at_rest() else 0.0
        if rested >= tuning.MIN_REST_TIME:
            return
        waited += seconds if all(width == 0.0 for width in widths.values()) else 0.0
    raise NoTouch(
        f"the grippers closed and found no grip: the least normal force is {min(forces):.3g} N of {force:.3g} N. Is "
        "the object between the fingers, and its face flat or round where they touch it?"
    )


def _grip_force(pads: Sequence[float]) -> float:
    """Mean of the normal forces of a gripper's pads [N]; 0 unless all touch. An object that cannot move aside presses
    more on one of them, if it is not in the gripper's middle."""
    return sum(pads) / len(pads) if min(pads) > 0 else 0.0


def _wait_for_rest(cell: Cell, advance: Advance, what: str) -> None:
    seconds, rested = 0.01, 0.0
    for _ in range(round(tuning.MAX_REST_TIME / seconds)):
        advance({}, seconds)
        rested = rested + seconds if cell.is_at_rest() else 0.0
        if rested >= tuning.MIN_REST_TIME:
            return
    speed, turn = cell.object_speed()
    raise NoTouch(
        f"the object does not come to rest after {what}: {speed * 1e3:.3g} mm/s, {turn:.3g} rad/s; grip it with more "
        "touch_force, or nearer to its centre of mass"
    )
