"""The gels are guarded by what they show: too deep or dragged too far ends the episode."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from robot.errors import DeviceError, SafetyViolation
from robot.wall import _watch
from tacsim.config import load_rig
from tacsim.interface import SensorSpec, TactileObservation


def sensors(height: bool = True, flow: bool = True) -> Any:
    return {name: SimpleNamespace(spec=SensorSpec((4, 4), height, flow, name)) for name in ("lower", "upper")}


def touch(depth: float, drag: float, hidden: float = 0.0) -> TactileObservation:
    height = np.zeros((4, 4), np.float32)
    valid = np.ones((4, 4), bool)
    height[1, 1], height[3, 3], valid[3, 3] = depth, hidden, False
    flow = np.zeros((2, 2, 2), np.float32)
    flow[0, 1] = (0.6 * drag, -0.8 * drag)
    flow[1, 1] = np.nan  # a marker that was lost
    return TactileObservation(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 2)), height, valid, valid, flow, 0.0, 0.0)


def test_a_gel_pressed_or_dragged_too_far_ends_the_episode() -> None:
    facts = load_rig("mock", overrides=["arms.upper.limits.depth=1 mm", "arms.upper.limits.shear=0.5 mm"]).facts
    watch = _watch(facts, sensors())
    assert watch is not None
    good = touch(0.9e-3, 0.4e-3, hidden=5e-3)
    watch({"lower": touch(3e-3, 3e-3), "upper": good})  # nothing was said of the lower arm
    with pytest.raises(SafetyViolation, match=r"sensor 'upper': depth 1\.1 mm, limits\.depth of arm 'upper' is 1 mm"):
        watch({"lower": good, "upper": touch(1.1e-3, 0.0)})
    with pytest.raises(SafetyViolation, match=r"shear 0\.6 mm"):
        watch({"lower": good, "upper": touch(0.0, 0.6e-3)})


def test_a_limit_that_no_sensor_can_tell_is_refused() -> None:
    deep = load_rig("mock", overrides=["arms.upper.limits.depth=1 mm"]).facts
    with pytest.raises(DeviceError, match=r"arms\.upper\.limits\.depth: sensor 'upper' cannot tell it"):
        _watch(deep, sensors(height=False))
    dragged = load_rig("mock", overrides=["arms.lower.limits.shear=1 mm"]).facts
    with pytest.raises(DeviceError, match=r"arms\.lower\.limits\.shear"):
        _watch(dragged, sensors(flow=False))


def test_without_such_limits_nothing_is_watched() -> None:
    assert _watch(load_rig("mock").facts, sensors()) is None
