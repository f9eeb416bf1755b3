"""Checks of a rig of hardware before anything moves. Each driver checks its own part; this module checks distances.

The checks send no command, so another program can drive the rig at the same time.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from robot.errors import DeviceError
from robot.rig.parts import arm_drivers, companion_of, sensor_drivers
from tacsim.interface import Pose
from tacsim.models.driver import Check
from tacsim.models.hardware import KeepOut
from tacsim.models.rig import RigConfig


def examine_rig(config: RigConfig, file: str | None = None) -> list[Check]:
    """All checks of one rig. The mocks of its file run while the checks do.

    file: name of the rig on the command line, for the commands in the advice.
    """
    if config.clock != "wall":
        return [Check("rig", "ok", f"'{config.name}' has no hardware: nothing to check")]
    try:
        with companion_of(config) as companion:
            starts = {} if companion is None else companion.start_poses
            checks = examine_arms(config, starts, file or config.name)
            for driver in sensor_drivers(config).values():
                checks += driver.checks()
    except (DeviceError, ValueError, RuntimeError) as failure:
        return [Check("rig", "fail", str(failure), "correct the rig file")]
    return checks


def examine_arms(config: RigConfig, starts: Mapping[str, Pose], file: str) -> list[Check]:
    """The checks of the arms alone. starts: start poses from the scene of a mock rig."""
    found = {
        name: driver.examine(config.arms[name].start_pose or starts.get(name), file)
        for name, driver in arm_drivers(config).items()
    }
    poses = {name: each.sensor_pose for name, each in found.items() if each.sensor_pose is not None}
    pairs = [check_keep_out(rule, poses, file) for rule in config.keep_out if set(rule.arms) <= set(poses)]
    return [*(check for each in found.values() for check in each.checks), *pairs]


def check_keep_out(rule: KeepOut, poses: Mapping[str, Pose], file: str) -> Check:
    """Checks that the sensors of two arms at `poses` are farther apart than the keep-out distance."""
    first, second = rule.arms
    gap = float(np.linalg.norm(poses[first].position - poses[second].position))
    words = f"the sensors are {1e3 * gap:.0f} mm apart, at least {1e3 * rule.distance:g} mm are required"
    label = f"{first}, {second}: keep-out"
    if gap > rule.distance:
        return Check(label, "ok", words)
    return Check(label, "fail", words, f"`tacsim start {file}` moves it to its start, after you confirm")
