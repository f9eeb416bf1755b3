"""Checks of a rig of hardware before anything moves: each driver checks its own part, and here what lies between them.

Nothing is commanded, so a rig may be checked that another program drives.
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
    """All checks of one rig. Mocks that its file asks for are started for as long as it takes.

    file: what the rig is called on the command line, for the commands to be typed next.
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
        return [Check("rig", "fail", str(failure), "mend the rig file")]
    return checks


def examine_arms(config: RigConfig, starts: Mapping[str, Pose], file: str) -> list[Check]:
    """The checks of its arms alone. starts: where the scene of a mock rig has them."""
    found = {
        name: driver.examine(config.arms[name].start_pose or starts.get(name), file)
        for name, driver in arm_drivers(config).items()
    }
    poses = {name: each.sensor_pose for name, each in found.items() if each.sensor_pose is not None}
    pairs = [check_keep_out(rule, poses, file) for rule in config.keep_out if set(rule.arms) <= set(poses)]
    return [*(check for each in found.values() for check in each.checks), *pairs]


def check_keep_out(rule: KeepOut, poses: Mapping[str, Pose], file: str) -> Check:
    """Whether the sensors of two arms, which stand at `poses`, keep their distance."""
    first, second = rule.arms
    gap = float(np.linalg.norm(poses[first].position - poses[second].position))
    words = f"the sensors are {1e3 * gap:.0f} mm apart, at least {1e3 * rule.distance:g} mm are asked for"
    label = f"{first}, {second}: keep-out"
    if gap > rule.distance:
        return Check(label, "ok", words)
    return Check(label, "fail", words, f"`tacsim start {file}` leads it to its start, after your yes")
