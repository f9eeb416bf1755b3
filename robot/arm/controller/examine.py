"""Checks of a UR arm before anything moves: network, versions, remote control, pose, force, limits.

The checks connect to the dashboard and to the RTDE port. They claim no input register and send no program, so another
program can drive the arm at the same time.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator

import numpy as np

from robot.arm.controller.arm_placement import ArmPlacement, check_placement, measure_placement
from robot.arm.controller.dashboard import PORT as DASHBOARD
from robot.arm.controller.dashboard import Dashboard
from robot.arm.controller.rtde import PORT as RTDE
from robot.arm.controller.rtde import read_controller
from robot.common import MOCK_SERIAL
from robot.common.kinematics import Kinematics
from robot.common.tcp import ArmFrames
from robot.errors import DeviceError
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.models.driver import ArmExamination, Check
from tacsim.models.hardware import UrArmConfig

PORTS = {DASHBOARD: "dashboard", 30003: "script", RTDE: "RTDE"}
TIMEOUT = 2.0  # of each connection [s]


def examine(name: str, config: UrArmConfig, start: Pose | None, file: str) -> ArmExamination:
    """The checks of one arm, and the pose of its sensor.

    Args:
        start: world_from_sensor at the start of an episode.
        file: name of the rig file, for the commands in the advice.
    """
    placements: list[ArmPlacement] = []
    checks = list(_run_checks(name, config, start, file, placements))
    return ArmExamination(checks, se3.from_matrix(placements[0].sensor) if placements else None)


def _run_checks(
    name: str, config: UrArmConfig, start: Pose | None, file: str, placements: list[ArmPlacement]
) -> Iterator[Check]:
    closed = [f"{port} ({what})" for port, what in PORTS.items() if not _is_open(config.host, port)]
    if closed:
        advice = "is the controller on, the address right, and the service allowed (Settings, Security, Services)?"
        yield Check(f"{name}: network", "fail", f"{config.host}: no answer at {', '.join(closed)}", advice)
        return
    yield Check(f"{name}: network", "ok", f"{config.host}: ports {', '.join(map(str, PORTS))} answer")
    try:
        with Dashboard(config.host, TIMEOUT) as dashboard:
            yield from _check_controller(name, config, dashboard)
    except DeviceError as failure:
        yield Check(f"{name}: dashboard", "fail", str(failure), "restart the controller, and read its log")
    try:
        placement = measure_placement(config, read_controller(config.host, TIMEOUT))
    except DeviceError as failure:
        yield Check(f"{name}: RTDE", "fail", str(failure), "restart the controller")
    else:
        placements.append(placement)
        yield Check(f"{name}: RTDE", "ok", "version 2")
        yield from check_placement(name, config, placement, start, file)
    yield _describe_limits(name, config)
    yield _check_start(name, config)


def _is_open(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), TIMEOUT).close()
    except OSError:
        return False
    return True


def _check_controller(name: str, config: UrArmConfig, dashboard: Dashboard) -> Iterator[Check]:
    min_polyscope = (5, 6)  # the first version that reports remote control
    version = dashboard.request("PolyscopeVersion")
    found = re.search(r"(\d+)\.(\d+)\.\d+", version)
    fit = found is not None and (int(found[1]), int(found[2])) >= min_polyscope
    lowest = ".".join(map(str, min_polyscope))
    advice = "" if fit else f"update PolyScope to {lowest} or later: older versions do not report remote control"
    yield Check(f"{name}: PolyScope", "ok" if fit else "warn", version, advice)
    model, serial = dashboard.model(), dashboard.serial()
    wrong = model is not None and not config.model.startswith(model)
    yield Check(
        f"{name}: model",
        "fail" if wrong else "ok",
        f"{(model or 'not reported').upper()}, serial number {serial}",
        f"the file says {config.model}; correct one of the two" if wrong else "",
    )
    if config.serial not in (None, serial):
        advice = "is it the right robot, at the right address? Else correct serial in the rig file"
        words = f"the robot has {serial}, the file says {config.serial}"
        yield Check(f"{name}: serial number", "fail", words, advice)
    mock = serial == MOCK_SERIAL
    if mock != (config.mock is not None):
        yield Check(
            f"{name}: kind", "fail", "a mock" if mock else "a real arm", "the file says otherwise (`mock:` block)"
        )
    try:
        dashboard.require_ready(f"arm '{name}'")
        words = f"robot mode {dashboard.mode()}, safety {dashboard.safety()}, remote control"
        program = dashboard.program()
        busy = program == "PLAYING"
        advice = "another program drives it: end that one before a run" if busy else ""
        yield Check(f"{name}: ready", "warn" if busy else "ok", f"{words}, program {program}", advice)
    except DeviceError as failure:
        yield Check(f"{name}: ready", "fail", str(failure), "correct it at the pendant, then check again")


def _describe_limits(name: str, config: UrArmConfig) -> Check:
    limits = config.limits
    size = 1e3 * (np.array(limits.workspace.upper) - limits.workspace.lower)
    words = (
        f"workspace {size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm, {len(limits.planes)} walls, "
        f"{1e3 * limits.speed:.0f} mm/s, {limits.acceleration:g} m/s², {limits.force:g} N, {limits.torque:g} N m"
    )
    advice = (
        "these limits protect the work, not people: set the safety limits on the pendant too"
        if config.mock is None
        else ""
    )
    return Check(f"{name}: limits", "ok", words, advice)


def _check_start(name: str, config: UrArmConfig) -> Check:
    """Checks that the start pose is in the workspace and within reach."""
    label = f"{name}: start"
    if config.start is None:
        if config.mock is not None:
            return Check(label, "ok", "given by the scene")
        return Check(label, "fail", "missing", "give start: world_from_sensor, clear of everything")
    place = np.array(config.start.position)
    if (place < config.limits.workspace.lower).any() or (place > config.limits.workspace.upper).any():
        return Check(label, "fail", f"{place.tolist()} m is outside the workspace", "correct start or limits.workspace")
    kinematics = Kinematics(config.model)
    postures = kinematics.solutions(ArmFrames.of(config).flange(se3.to_matrix(config.start.pose)), np.zeros(6))
    if not postures:
        return Check(
            label, "fail", f"{place.tolist()} m is out of reach", "correct start, world_from_base, or the mount"
        )
    far = max(kinematics.singularity(posture) for posture in postures)
    state, advice = ("ok", "") if far > 0.05 else ("warn", "near a singular posture: place the base elsewhere")
    return Check(label, state, f"within reach, {far:.2f} from a singularity (0.1 to 0.3 is good)", advice)  # type: ignore[arg-type]
