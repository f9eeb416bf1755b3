"""The gels are guarded by what they show: too deep or dragged too far ends the episode, and arms are told."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tacsim.control.gel_monitor import GelMonitor
from tacsim.interface import GelReading, SensorSpec, TactileObservation
from tacsim.limits import LimitExceeded
from tacsim.models.hardware import ArmLimits, Workspace

BOX = Workspace(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 1.0))


def limits(depth: float | None = None, shear: float | None = None) -> ArmLimits:
    return ArmLimits(workspace=BOX, depth=depth, shear=shear)


def sensors(height: bool = True, flow: bool = True) -> dict[str, SensorSpec]:
    return {name: SensorSpec((4, 4), height, flow, name) for name in ("lower", "upper")}


def touch(depth: float, drag: float, hidden: float = 0.0, time: float = 0.0) -> TactileObservation:
    height = np.zeros((4, 4), np.float32)
    valid = np.ones((4, 4), bool)
    height[1, 1], height[3, 3], valid[3, 3] = depth, hidden, False
    flow = np.zeros((2, 2, 2), np.float32)
    flow[0, 1] = (0.6 * drag, -0.8 * drag)
    flow[1, 1] = np.nan  # a marker that was lost
    image = np.zeros((4, 4, 3), np.uint8)
    return TactileObservation(
        image,
        gradient=np.zeros((4, 4, 2), np.float32),
        height=height,
        contact=valid,
        valid=valid,
        flow=flow,
        time=time,
        age=0.0,
    )


def blind() -> TactileObservation:
    seen = touch(0.0, 0.0)
    return TactileObservation(
        seen.image, gradient=None, height=None, contact=seen.contact, valid=seen.valid, flow=None, time=0.0, age=0.0
    )


def test_a_gel_pressed_or_dragged_too_far_ends_the_episode() -> None:
    watch = GelMonitor(sensors(), {"upper": limits(1e-3, 0.5e-3)}, {})
    good = touch(0.9e-3, 0.4e-3, hidden=5e-3)
    watch({"lower": touch(3e-3, 3e-3), "upper": good})  # nothing was said of the lower arm
    with pytest.raises(LimitExceeded, match=r"sensor 'upper': depth 1\.1 mm, limits\.depth of arm 'upper' is 1 mm"):
        watch({"lower": good, "upper": touch(1.1e-3, 0.0)})
    with pytest.raises(LimitExceeded, match=r"shear 0\.6 mm"):
        watch({"lower": good, "upper": touch(0.0, 0.6e-3)})


def test_what_is_watched_and_cannot_be_seen_is_too_much() -> None:
    watch = GelMonitor(sensors(), {"upper": limits(depth=1e-3)}, {})
    with pytest.raises(LimitExceeded, match=r"depth is not measured"):
        watch({"lower": touch(0.0, 0.0), "upper": blind()})


def test_arms_are_told_before_anything_is_raised() -> None:
    told: dict[str, GelReading] = {}
    tell = {name: lambda shown, name=name: told.__setitem__(name, shown) for name in ("lower", "upper")}
    watch = GelMonitor(sensors(), {"lower": limits(depth=1e-3)}, tell)
    with pytest.raises(LimitExceeded):
        watch({"lower": touch(2e-3, 1e-4, time=5.0), "upper": touch(3e-4, 2e-4, time=4.0)})
    assert told["lower"].depth == pytest.approx(2e-3)
    assert told["upper"].shear == pytest.approx(2e-4)
    assert told["lower"].exposed == told["upper"].exposed == 4.0  # the oldest picture of the rig
    watch({"lower": touch(1e-4, 0.0), "upper": blind()})
    assert math.isnan(told["upper"].depth)


def test_a_limit_that_no_sensor_can_tell_is_refused() -> None:
    with pytest.raises(ValueError, match=r"arms\.upper\.limits\.depth: sensor 'upper' does not measure it"):
        GelMonitor(sensors(height=False), {"upper": limits(depth=1e-3)}, {})
    with pytest.raises(ValueError, match=r"arms\.lower\.limits\.shear"):
        GelMonitor(sensors(flow=False), {"lower": limits(shear=1e-3)}, {})
