"""Guards of actions, the same for simulated and real arms: pure functions that refuse or shorten, never silently."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import ArrayLike

from tacsim import pose as se3
from tacsim.interface import Action, Pose

FARTHEST = 1e3  # a pose beyond is no target of anything that carries a sensor [m]


class ActionError(ValueError):
    """An action that a rig cannot take: unknown arm, wrong shape or type, a number not finite or out of range."""


def check_action(action: object, movable: Collection[str], rig: str) -> Action:
    """`action`, if rig `rig` can take it: an Action that addresses only `movable` arms, each with a Pose or None.

    Raises ActionError.
    """
    if not isinstance(action, Action):
        raise ActionError(f"rig '{rig}' takes a tacsim.interface.Action, got {type(action).__name__}")
    if not isinstance(action.tool, Mapping):
        raise ActionError(
            "Action.tool must be a mapping from arm names to poses, such as {'upper': pose}, "
            f"got {type(action.tool).__name__}"
        )
    for name, target in action.tool.items():
        if name not in movable:
            names = ", ".join(sorted(movable)) or "(none)"
            raise ActionError(f"action for '{name}', but rig '{rig}' moves only: {names}")
        if target is not None and not isinstance(target, Pose):
            raise ActionError(f"action for '{name}' must be a tacsim.interface.Pose or None (holds), got {target!r}")
        if target is not None and np.abs(target.position).max() > FARTHEST:
            raise ActionError(
                f"target of arm '{name}' is at {target.position.tolist()} m, more than {FARTHEST:g} m from the origin; "
                "poses are in metres, in the world frame"
            )
    return action


def check_workspace(target: Pose, lower: ArrayLike, upper: ArrayLike, arm: str) -> Pose:
    """`target`, if its origin lies within the box from `lower` (3,) to `upper` (3,) [m], the faces included.

    Raises ActionError that names the axis; ValueError for a box that has no inside.
    """
    least, most = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    if least.shape != (3,) or most.shape != (3,) or not (least < most).all():
        raise ValueError(
            f"workspace of arm '{arm}' must run from a lower to an upper corner [m], got {lower!r} to {upper!r}"
        )
    for axis, value, low, high in zip("xyz", target.position, least, most, strict=True):
        if not low <= value <= high:
            raise ActionError(
                f"target of arm '{arm}' is outside its workspace: {axis} = {value:.6g} m, allowed {low:.6g} to "
                f"{high:.6g} m; ask for a pose inside, or widen the workspace after checking that nothing stands there"
            )
    return target


def shorten(target: Pose, now: Pose, longest: float, widest: float) -> Pose:
    """`target` itself if it is within `longest` [m] and `widest` [rad] of `now`; otherwise the farthest pose on the
    straight way there (translation and rotation in step) that is. The caller tells what was really sent.

    Raises ValueError for limits that are not positive.
    """
    if not longest > 0 or not widest > 0:
        raise ValueError(f"shorten: limits must be positive, got {longest} m and {widest} rad")
    metres, radians = se3.distance(now, target)
    excess = max(metres / longest, radians / widest)
    if excess <= 1.0 + 1e-9:  # rounding of a motion at the limit is none
        return target
    return se3.interpolate(now, target, 1.0 / excess)
